"""Results of runs: parquet files, tables, figures and the page."""

from lcc_rl.results.loading import load

__all__ = ["load"]
