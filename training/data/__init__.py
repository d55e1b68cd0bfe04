"""What is drawn: random grasps, episodes of the simulated hand, labelled wrenches."""
