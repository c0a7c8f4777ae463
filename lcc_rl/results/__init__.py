"""Result room: parquet files, tables and figures."""

from lcc_rl.results.runs import load

__all__ = ["load"]
