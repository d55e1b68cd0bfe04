"""Training of starts (`fit`) and agents (`rl`), their evaluation, and the program `grasp`."""
