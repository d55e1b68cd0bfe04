"""The tracks for benchopt: `PYTHONPATH=. benchopt run benchmarks/force/benchopt -s "entrant[entrant=clarabel]" -d "track[track=smooth]"`."""

from benchopt import BaseObjective

from benchmarks.force.score import parts_of, score


class Objective(BaseObjective):
    """The share of problems that are not solved to 1e-6, and the largest gap, balance, violation and excess."""

    name = "grasp forces"
    sampling_strategy = "run_once"
    parameters = {"objective": ["sum", "phi"]}  # noqa: RUF012

    def set_data(self, sessions):  # noqa: D102
        self.sessions = sessions

    def get_objective(self):  # noqa: D102
        return {"sessions": self.sessions, "objective": self.objective}

    def evaluate_result(self, answers):  # noqa: D102
        rows = []
        for session, each in zip(self.sessions, answers, strict=True):
            values = session.references[self.objective].value.tolist()
            for problem, best, answer in zip(session.problems, values, each, strict=True):
                rows.append(score(problem, self.objective, best, parts_of(problem, answer)))
        unsolved = 1.0 - sum(row["solved"] for row in rows) / len(rows)
        names = ("gap", "balance", "violation", "limit_excess")
        return {"value": unsolved} | {name: max(row.get(name, float("inf")) for row in rows) for name in names}

    def get_one_result(self):  # noqa: D102
        return {"answers": [[None] * len(session.problems) for session in self.sessions]}

    def skip(self, sessions):  # noqa: D102
        lacking = any(self.objective not in session.references for session in sessions)
        return lacking, f"the track has no {self.objective}" if lacking else None
