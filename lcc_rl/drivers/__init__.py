"""Driver models, their calibration and driver populations."""
