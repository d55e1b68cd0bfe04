"""The Gymnasium environment: `FourFingerGrasp`, its episodes, observations and rewards."""

from grasp_env.env.env import FourFingerGrasp

__all__ = ["FourFingerGrasp"]
