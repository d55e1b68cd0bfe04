"""Benchmarks: `grasp bench solver | scaling | batch | env`. Times are of this machine and moment; compare rows of one run."""
