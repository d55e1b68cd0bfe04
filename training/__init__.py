"""Training, evaluation and reports, with the `grasp` program (`training.cli`)."""
