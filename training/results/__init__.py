"""Results of every comparison: run folders, typed tables of rows, claims about them, and the map that makes them."""

from training.results.run import Run, default_name, provenance, understood

__all__ = ["Run", "default_name", "provenance", "understood"]
