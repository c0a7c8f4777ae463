"""Readers of trajectories, car-following episodes and speed profiles."""
