"""Benchmarks: `grasp bench solver | scaling | batch | env | core`. Times are of this machine and moment; compare rows of one run."""
