"""The studies of `grasp reproduce`: what the paper leaves open, and its claims."""
