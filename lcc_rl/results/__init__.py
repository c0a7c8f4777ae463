"""Results of runs: parquet files, tables, figures and the page."""

from lcc_rl.results.runs import load

__all__ = ["load"]
