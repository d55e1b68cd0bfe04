"""All peers by name, with what is installed of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from grasp_env._check import Array, Wrench
from grasp_env.errors import UnknownNameError
from training.peers.generated import FAST, PLAIN, Generated, refusal
from training.peers.problem import MissingPeer, Solver, best_times
from training.peers.slsqp import Slsqp
from training.peers.wheels import Clarabel, Ecos, Moreau, Qoco


@dataclass(frozen=True)
class Peer:
    """A solver of others that can run here.

    Attributes:
        name: as in `NAMES`.
        package: its distribution.
        version: of the package.
        licence: of the package.
        setting: how it is used, for a table.
        build: (A (6, 3N), c (N,)) -> the solver of one grasp, not timed.
        most_contacts: beyond these it is not worth the wait; None: no limit.
    """

    name: str
    package: str
    version: str
    licence: str
    setting: str
    build: Callable[[Array, Array], Solver]
    most_contacts: int | None = None


_ROWS: dict[str, tuple[str, str, str, int | None]] = {
    "qocogen": ("qocogen", "BSD-3-Clause", "C: generated, dual, 1e-7, -O3 -march=native", None),
    "qocogen_fast": ("qocogen", "BSD-3-Clause", "C: the same, -Ofast -flto, no refinement", None),
    "qoco": ("qoco", "BSD-3-Clause", "Python: dual, update, 1e-7", None),
    "clarabel": ("clarabel", "Apache-2.0", "Python: dual, update, 1e-8", None),
    "moreau": ("moreau", "Apache-2.0", "Python: dual, compiled, 1e-8; batches on all cores", None),
    "moreau_warm": ("moreau", "Apache-2.0", "Python: the same, from the solution before", None),
    "ecos": ("ecos", "GPL-3.0 (benchmark only)", "Python: dual, 1e-8", None),
    "slsqp": ("scipy", "BSD-3-Clause", "Python: primal, SLSQP, ftol 1e-8", 5),
}
NAMES = tuple(_ROWS)


def available(folder: Path, names: Iterable[str] = NAMES) -> list[Peer | MissingPeer]:
    """The named peers in order, each ready to `build` or with the reason why not.

    Args:
        folder: where generated solvers are compiled and kept; created when the first is built.
        names: some of `NAMES`.

    Raises:
        UnknownNameError: a name that is not in `NAMES`.

    Example:
        >>> [peer.name for peer in available(Path("unused"), ["slsqp"])]
        ['slsqp']
    """
    builds: dict[str, Callable[[Array, Array], Solver]] = {
        "qocogen": partial(Generated, folder=folder, flags=PLAIN),
        "qocogen_fast": partial(Generated, folder=folder, flags=FAST, refinements=0),
        "qoco": Qoco,
        "clarabel": Clarabel,
        "moreau": Moreau,
        "moreau_warm": partial(Moreau, warm=True),
        "ecos": Ecos,
        "slsqp": Slsqp,
    }
    peers: list[Peer | MissingPeer] = []
    for name in names:
        if name not in _ROWS:
            raise UnknownNameError("peer", name, NAMES)
        package, licence, setting, most = _ROWS[name]
        try:
            number = version(package)
        except PackageNotFoundError:
            peers.append(MissingPeer(name, f"{package} is not installed: pip install {package}"))
            continue
        reason = refusal(FAST if name == "qocogen_fast" else PLAIN) if package == "qocogen" else None
        if reason:
            peers.append(MissingPeer(name, reason))
        else:
            peers.append(Peer(name, package, number, licence, setting, builds[name], most))
    return peers


class _Reference:
    """Clarabel at 1e-10, or at the least tolerance it reaches: a few wrenches in a thousand end just short."""

    def __init__(self, cone_matrix: Array, cost: Array) -> None:
        self._solvers = [Clarabel(cone_matrix, cost, tolerance) for tolerance in (1e-10, 1e-9, 1e-8)]

    def solve(self, wrench: Wrench) -> Array:
        force = self._solvers[0].solve(wrench)
        for looser in self._solvers[1:]:
            if np.isfinite(force).all():
                break
            force = looser.solve(wrench)
        return force

    def times(self, wrenches: Array, repeats: int) -> Array:
        return best_times(self.solve, wrenches, repeats)


def reference(cone_matrix: Array, cost: Array) -> Solver:
    """What answers are compared with: Clarabel at 1e-10 (1e-9, 1e-8 where it ends short of that).

    Raises:
        ModuleNotFoundError: clarabel is not installed.
    """
    return _Reference(cone_matrix, cost)
