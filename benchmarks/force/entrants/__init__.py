"""Solvers that enter the benchmark, one file each; they import their packages when they are set up."""

ENTRANTS = {
    "conic": "benchmarks.force.entrants.ours:Conic",
    "newton": "benchmarks.force.entrants.ours:Newton",
    "flow": "benchmarks.force.entrants.ours:Flow",
    "conic_python": "benchmarks.force.entrants.ours:ConicPython",
    "newton_python": "benchmarks.force.entrants.ours:NewtonPython",
    "flow_python": "benchmarks.force.entrants.ours:FlowPython",
    "learned_python": "benchmarks.force.entrants.ours:LearnedPython",
    "qocogen_fast": "benchmarks.force.entrants.qocogen:QocogenFast",
    "qocogen": "benchmarks.force.entrants.qocogen:Qocogen",
    "qoco": "benchmarks.force.entrants.qoco:Qoco",
    "clarabel": "benchmarks.force.entrants.clarabel:Clarabel",
    "ecos": "benchmarks.force.entrants.ecos:Ecos",
    "moreau": "benchmarks.force.entrants.moreau:Moreau",
    "piqp": "benchmarks.force.entrants.piqp:Piqp",
    "highs": "benchmarks.force.entrants.highs:Highs",
    "cvxpy_clarabel": "benchmarks.force.entrants.cvxpy_clarabel:CvxpyClarabel",
    "slsqp": "benchmarks.force.entrants.slsqp:Slsqp",
}
"""Name: where its class is, "module:Class"."""
