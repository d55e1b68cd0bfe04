"""Run folders, the processes that fill them, and the statistics, claims and interrupts that every room shares."""

from training.runs.folder import Run, default_name, provenance, understood

__all__ = ["Run", "default_name", "provenance", "understood"]
