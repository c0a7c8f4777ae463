"""Calibration room: from observed episodes to a population of IDM drivers."""
