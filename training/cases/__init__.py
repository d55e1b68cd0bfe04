"""What the evaluation asks, and every start that answers."""
