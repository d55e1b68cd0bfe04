"""Training of the initial force."""
