"""Comparisons of starts, controllers, hands and engines, as functions that return rows."""
