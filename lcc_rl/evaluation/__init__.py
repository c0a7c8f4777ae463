"""Evaluation: strategies driven through the same episodes, and what is measured there."""
