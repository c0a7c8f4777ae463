"""Trajectories, car-following episodes and speed profiles from files."""
