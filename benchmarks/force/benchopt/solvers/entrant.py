"""Every entrant of the benchmark, each set up once for a session."""

from benchopt import BaseSolver

from benchmarks.force.entrant import Task
from benchmarks.force.entrants import ENTRANTS
from benchmarks.force.run import entrants


class Solver(BaseSolver):
    """An entrant, called from Python."""

    name = "entrant"
    sampling_strategy = "run_once"
    parameters = {"entrant": list(ENTRANTS)}  # noqa: RUF012

    def set_objective(self, sessions, objective):  # noqa: D102
        make = entrants([self.entrant])[self.entrant]
        self.ready = [(make(), session.problems) for session in sessions]
        for solver, problems in self.ready:
            solver.setup(Task("benchopt", objective, "persistent", problems[0]))

    def run(self, _):  # noqa: D102
        self.answers = [[solver.solve(problem) for problem in problems] for solver, problems in self.ready]

    def get_result(self):  # noqa: D102
        return {"answers": self.answers}

    def skip(self, sessions, objective):  # noqa: D102
        known = getattr(entrants([self.entrant])[self.entrant], "objectives", (objective,))
        return objective not in known, f"{self.entrant} does not minimize {objective}"
