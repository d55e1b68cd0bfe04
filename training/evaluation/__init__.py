"""Comparisons of starts, controllers, hands and engines, their results and reports."""
