"""Sub-commands of `grasp`, one per file: a dataclass of options with a method `execute`, which does
the heavy imports.
"""
