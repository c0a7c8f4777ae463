"""Benchmarks: one module each, run by tools/benchmark.py; see docs/benchmarks.md."""
