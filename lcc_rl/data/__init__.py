"""Data room: trajectories of any published layout become one SI table of car-following episodes."""
