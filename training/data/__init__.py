"""Random data: grasps, episodes of the simulated hand, labelled wrenches."""
