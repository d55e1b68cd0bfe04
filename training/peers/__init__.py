"""Solvers of others for the same conic force problem, for the benchmark; none is needed by anything else."""

from training.peers.catalogue import NAMES, Peer, available, reference
from training.peers.problem import Achieved, BatchSolver, MissingPeer, Solver, achieved

__all__ = ["NAMES", "Achieved", "BatchSolver", "MissingPeer", "Peer", "Solver", "achieved", "available", "reference"]
