"""The control loop of the hand, and the closing of the fingers before an episode."""
