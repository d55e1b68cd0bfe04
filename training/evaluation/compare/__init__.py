"""Comparisons of starts, controllers, hands and engines: each is a function of settings that
returns rows.
"""
