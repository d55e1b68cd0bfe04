"""Sub-commands of `grasp`, one per file: a dataclass of options with a method `execute`.

Heavy imports are in that method.
"""
