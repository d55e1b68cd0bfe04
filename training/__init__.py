"""Training, evaluation, reports, and the program `grasp` (`training.cli`)."""
