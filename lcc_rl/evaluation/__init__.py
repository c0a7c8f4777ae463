"""Evaluation room: every driver behind every held-out profile, and what is measured there."""
