"""Benchmarks: one module each, run by ``lcc-rl benchmark``; see docs/benchmarks.md."""
