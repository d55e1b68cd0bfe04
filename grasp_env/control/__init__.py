"""The control loop of the hand: sensors, forces, torques, and the closing of the fingers at the
start of an episode.
"""
