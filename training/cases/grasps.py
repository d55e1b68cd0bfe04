"""Cases on other grasps than the fixed one: other friction, other places, random objects."""

from __future__ import annotations

from grasp_env.errors import InvalidInputError
from grasp_env.grasp import presets, wrench
from training.cases.sets import Case, along, generator
from training.data.grasps import EVALUATION, slid

FRICTIONS = (0.2, 0.7, 0.8)
"""Outside the training range of the fixed-grasp model, 0.25 to 0.6."""
DISPLACEMENT = 0.010
"""[m] by which contacts are moved on their faces, at most."""
_PER_GRASP = 4


def grasp_cases(name: str, count: int, seed: int) -> list[Case]:
    """The cases of a set on near or random grasps; see `set_table.SETS`.

    Args:
        name: "friction", "positions" or "random_<contacts>".
        count: about how many.
        seed: of the evaluation.
    """
    rng, fixed = generator(seed, name), presets.paper_cuboid()
    cases: list[Case] = []
    if name == "friction":
        for group, mu in enumerate(FRICTIONS):
            path = wrench.sample_ball(rng, max(2, count // len(FRICTIONS)))
            cases += along(fixed.with_friction(mu), path, group, f"{mu:g}")
    elif name == "positions":
        for group in range(max(1, count // _PER_GRASP)):
            cases += along(slid(rng, fixed, 0.0, DISPLACEMENT), wrench.sample_ball(rng, _PER_GRASP), group)
    elif name.startswith("random_"):
        for group in range(count):
            grasp = EVALUATION.closed(rng, int(name.split("_")[1]))
            cases.append(Case(grasp, wrench.sample_ball(rng, 1)[0], None, group))
    else:
        raise InvalidInputError(f"no grasps are known for the set {name!r}: say in grasp_cases how they are made")
    return cases
