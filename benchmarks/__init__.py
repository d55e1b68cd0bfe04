"""Timings in one process: `python -m benchmarks`. Times depend on machine and moment, so compare
rows of one run.
"""
