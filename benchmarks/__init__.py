"""Timings, side by side in one process: `python -m benchmarks`. Times belong to one machine and moment: compare rows of one run."""
