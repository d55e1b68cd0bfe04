"""Linear program of grasp forces with friction pyramids inside the cones, by HiGHS.

Kerr, Roth 1986 and Cheng, Orin 1990 used it for hands. Its forces lie on edges of the pyramids:
along a path of the wrench they have kinks, and they may jump where several forces cost the same.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog

from grasp_env.errors import NotConvergedError
from grasp_env.grasp import Grasp
from grasp_env.inputs.arguments import ContactForces, Wrench

_TOLERANCE = 1e-10
"""Smallest feasibility tolerance of HiGHS [N]."""


def pyramid_forces(grasp: Grasp, wrench: Wrench, facets: int = 8) -> ContactForces:
    """Return balancing forces (N, 3) [N] inside friction pyramids, of least normal force.

    min sum normal_i s.t. G f + w = 0, f_i = sum_k c_ik e_ik, c >= 0, where the `facets` edges e_ik
    lie on the cone of contact i, the first at normal + mu_o o. 8 facets cost 3 % more than the
    cones in the median, at most 8 %.

    Args:
        grasp: hard contacts.
        wrench: (6,) external wrench on the object [N, N m], object frame; about 1 N, since balance
            holds to 1e-10 N.
        facets: edges of each pyramid, at least 3.

    Raises:
        NotConvergedError: HiGHS found no force inside the pyramids that balances the wrench. One
            inside the cones may exist.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> force = pyramid_forces(grasp, np.array([1, 0.5, -0.6, -0.1, 0.2, 0]))
        >>> round(float(force[:, 0].sum()), 3), grasp.cone_margin(force) > -1e-9
        (8.868, True)
    """
    angles = 2.0 * np.pi * np.arange(facets) / facets
    around = np.stack([np.ones(facets), np.cos(angles), np.sin(angles)])
    across = np.concatenate([np.ones((grasp.n_contacts, 1)), grasp.models.friction], axis=1)
    edges = across[:, :, None] * around  # (N, 3, facets)
    frame = grasp.unit_frame
    balance = np.einsum("rni,nik->rnk", (frame @ grasp.matrix).reshape(6, -1, 3), edges)
    options = {
        "presolve": False,
        "primal_feasibility_tolerance": _TOLERANCE,
        "dual_feasibility_tolerance": _TOLERANCE,
    }
    total = np.ones(edges[:, 0].size)
    left = balance.reshape(6, -1)
    right = -frame @ wrench
    answer = linprog(total, A_eq=left, b_eq=right, method="highs-ds", options=options)
    if answer.status != 0:
        raise NotConvergedError(
            f"the linear program of wrench {wrench.tolist()} found no force: {answer.message}"
        )
    return np.einsum("nik,nk->ni", edges, answer.x.reshape(-1, facets))
