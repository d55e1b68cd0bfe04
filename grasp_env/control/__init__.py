"""The control loop of the hand: sensors, forces, torques, and how an episode starts."""
