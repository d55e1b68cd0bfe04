"""Comparisons of starts, controllers, hands and engines: each is a function that takes settings and returns rows."""
