"""Command line, sweeps, states of runs, progress and loggers."""
