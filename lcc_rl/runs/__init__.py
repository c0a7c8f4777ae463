"""States of runs, sweeps, progress and loggers."""
