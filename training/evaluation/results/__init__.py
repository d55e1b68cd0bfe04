"""Results of comparisons: run folders, typed tables, claims, and a map over shards."""

from training.evaluation.results.run import Run, default_name, provenance, understood

__all__ = ["Run", "default_name", "provenance", "understood"]
