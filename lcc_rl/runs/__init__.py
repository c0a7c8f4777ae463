"""What a command does around its work: command line, sweeps, states of runs, progress, loggers."""
