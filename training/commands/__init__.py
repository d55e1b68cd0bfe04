"""The sub-commands of `grasp`, one per file: a dataclass of options that executes itself. Heavy imports wait for `execute`."""
