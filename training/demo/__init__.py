"""Pictures and videos of the hand."""
