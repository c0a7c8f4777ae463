"""Result room: parquet files, tables and figures."""
