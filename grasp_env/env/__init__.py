"""The Gymnasium environments: `FourFingerGrasp`, and problems with a name of their own."""

from grasp_env.env.env import FourFingerGrasp
from grasp_env.env.named import FragileGrasp, UncertainGrasp

__all__ = ["FourFingerGrasp", "FragileGrasp", "UncertainGrasp"]
