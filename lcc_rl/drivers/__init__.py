"""Calibration of driver models, and driver populations."""
