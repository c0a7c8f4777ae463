"""Benchmarks: one module each, run by ``python tools/benchmarks``; see docs/benchmarks.md."""
