"""Results of runs: windows, intervals and tables."""

from lcc_rl.results.loading import load

__all__ = ["load"]
