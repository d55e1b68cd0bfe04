"""A benchmark of grasp forces that any solver can enter: `python -m benchmarks.force --help`."""
