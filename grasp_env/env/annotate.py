"""What a picture of an episode says: forces, cones, the wrench that is balanced, and where the episode stands."""

from __future__ import annotations

import math

import numpy as np

from grasp_env._check import Array
from grasp_env.control.loop import ForceLoop
from grasp_env.sim.picture.overlay import Annotation
from grasp_env.sim.snapshot import Snapshot


def annotate(
    loop: ForceLoop, snapshot: Snapshot, colors: Array, time: float, drift: float, tilt: float, failure: str
) -> Annotation:
    """The overlay of now.

    Args:
        loop: its last command and solution.
        snapshot: of the scene.
        colors: (N, 3) of the fingers.
        time: [s]. drift: [m]. tilt: [rad]. failure: "" while the object is held.
    """
    active = np.zeros(len(loop.force))
    active[loop.fingers] = 1.0
    solution, to_world = loop.solution, snapshot.rotation
    return Annotation(
        points=snapshot.touch,
        normals=snapshot.normals @ to_world.T,
        forces=np.einsum("nij,nj->ni", to_world @ loop.frames, loop.force),
        measured=snapshot.forces @ to_world.T,
        friction=np.full(len(active), loop.friction),
        active=active,
        wrench=np.concatenate([to_world @ loop.wrench[:3], to_world @ loop.wrench[3:]]),
        center=snapshot.position,
        colors=colors,
        lines=(
            ("time", f"{time:.2f} s"),
            ("iterations", str(solution.iterations) if solution else "-"),
            ("margin", f"{solution.cone_margin:.2f} N" if solution else "-"),
            ("drift", f"{1e3 * drift:.2f} mm, {math.degrees(tilt):.2f} deg"),
            *((("lost", failure),) if failure else ()),
        ),
    )
