"""Evaluation of strategies on the same episodes."""
