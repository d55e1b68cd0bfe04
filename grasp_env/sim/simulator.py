"""What the package asks of a physics engine."""

from __future__ import annotations

from typing import Protocol

from grasp_env._check import Array
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.objects.description import ObjectDescription


class Simulator(Protocol):
    """One hand and one object in a physics engine, made from the hand, `gui` and `visuals`; see `engine.ENGINES`.

    Everything is in the world frame and in the hand's own numbering: no convention of an engine passes this boundary. Drawing is apart,
    see `Painter`.
    """

    def load(self, config: SceneConfig, angles: Array) -> None:
        """Builds the scene with the joints at `angles` (M,) [rad], all at rest; no kept state is left."""
        ...

    def advance(self, torques: list[float], wrench: list[float] | None) -> None:
        """One step of the scene, `config.substeps` of the engine.

        Args:
            torques: of the joints [N m], (M,), within their limits.
            wrench: force [N] and moment about its centre [N m] on the object besides gravity, (6,), object frame as it turns; None: none.
        """
        ...

    def read(self) -> Array:
        """What `core.Scene.read` takes: joint angles and rates, the object, the contacts of hand and object.

        Contacts and their forces are those of the last `advance`, a row for each of its steps with the step's share of the force;
        after `reset` those of when the state was kept. Valid until the next call.
        """
        ...

    def self_contacts(self) -> list[tuple[int, int]]:
        """Links of the hand that pushed each other in the last step, in pairs by their numbers; -1 is the palm."""
        ...

    def set_gravity(self, gravity: Array) -> None:
        """Another gravity (3,) [m/s^2] from now on."""
        ...

    def set_object(self, item: ObjectDescription) -> None:
        """Another mass, inertia and friction of the object from now on; `reset` does not undo it."""
        ...

    def keep(self, name: str) -> None:
        """Makes the present state one that `reset` returns to; one of each name."""
        ...

    def reset(self, name: str) -> None:
        """Returns to a kept state bit by bit, its contact forces included."""
        ...

    def close(self) -> None:
        """Frees the engine; calling it again does nothing."""
        ...
