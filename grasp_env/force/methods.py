"""The methods behind `optimize_force`: each is made for one grasp and turns wrench and start into a `ForceSolution`.

| method | problem | contacts |
|---|---|---|
| reduced_flow, full_flow | Phi by the paper's gradient flows | hard, elliptic, frictionless |
| newton | Phi by Newton | all, further limits |
| conic | least sum, or least maximum, of normal forces | all, further limits |

What the core solves contact by contact is in `hard_methods.py`, `newton` within limits in `limits_method.py`, with soft contacts in
`soft_method.py`. What hard contacts do not need is imported where it is asked for.
"""

from __future__ import annotations

import numpy as np

from grasp_env import core
from grasp_env.errors import UnsupportedProblemError
from grasp_env.force.basis import core_contacts
from grasp_env.force.hard_methods import Conic, Flow, Newton
from grasp_env.force.method import Method, Settings
from grasp_env.force.objective import Objective
from grasp_env.grasp.grasp import Grasp

DESCENTS = ("reduced_flow", "full_flow", "newton")
"""Methods on Phi: they take a start, a known optimum and a trace."""
METHODS = (*DESCENTS, "conic")
"""What `method` may be; `conic` starts from its own centre."""


def make_method(grasp: Grasp, settings: Settings) -> Method:
    """The method of `settings` for a grasp.

    Raises:
        UnsupportedProblemError: the method does not know these contacts or limits.
    """
    general = not grasp.hard or settings.limits is not None
    if settings.method in ("reduced_flow", "full_flow"):
        if general:
            raise UnsupportedProblemError(
                f"method {settings.method!r} knows hard contacts (round, elliptic or frictionless) without further limits; "
                "use method='newton' or 'conic'"
            )
        return Flow(grasp, settings)
    if settings.method == "newton" and not general:
        return Newton(grasp, settings)
    if settings.method == "conic" and not general and settings.criterion == "sum":
        interior = np.empty(3 * grasp.n_contacts)
        contacts = core_contacts(grasp, Objective())
        if core.Newton.make(contacts, 1.0, 0).internal_force(interior):
            return Conic(grasp, settings, contacts, interior)
    if settings.method == "newton" and settings.limits is not None:
        from grasp_env.force.limits_method import limited_newton

        method = limited_newton(grasp, settings)
        if method is not None:
            return method
    if settings.method == "newton" and settings.limits is None:
        from grasp_env.force.soft_method import soft_newton

        method = soft_newton(grasp, settings)
        if method is not None:
            return method
    from grasp_env.force.program_methods import ProgramConic, ProgramNewton

    return (ProgramNewton if settings.method == "newton" else ProgramConic)(grasp, settings)
