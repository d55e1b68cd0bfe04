"""Timings by `python -m benchmarks`; compare rows of one run, as times depend on the moment."""
