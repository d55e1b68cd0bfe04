"""Training of learned starts (`fit`) and agents (`rl`), their evaluation, and the program `grasp`
(`program`).
"""
