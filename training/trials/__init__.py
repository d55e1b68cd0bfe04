"""What the evaluation measures: trials, saved as arrays, and the numbers that are made of them."""
