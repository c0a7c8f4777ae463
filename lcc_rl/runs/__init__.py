"""States of runs, sweeps, progress, checkpoints and loggers."""
