"""Reinforcement learning on FourFingerGrasp-v0."""
