"""Interface that a physics engine must implement."""

from __future__ import annotations

from typing import Protocol

from grasp_env.inputs.arguments import Array
from grasp_env.sim.config import SceneConfig
from grasp_env.sim.objects.description import ObjectDescription

CLOSED = "the simulation is closed; make a new Scene from its config"


class Simulator(Protocol):
    """One hand and one object in a physics engine, made from the hand, `gui` and `visuals`.

    All quantities are in the world frame, and links and joints have the hand's numbers. See
    `engine.ENGINES`, and `Painter` for pictures.
    """

    def load(self, config: SceneConfig, angles: Array) -> None:
        """Build the scene at rest, with the joints at `angles` (M,) [rad]; drop all saved states."""

    def advance(self, torques: list[float], wrench: list[float] | None) -> None:
        """Advance the scene by one step, `config.substeps` steps of the engine.

        Args:
            torques: Joint torques [N m], (M,), within their limits.
            wrench: External force [N] and moment about the centre [N m] on the object, (6,), in the
                frame of the moving object; gravity excluded. None for no wrench.
        """

    def read(self) -> Array:
        """Return the array for `core.Scene.read`: joint angles and rates, the object, contacts.

        Contacts between hand and object and their forces are those of the last `advance`: each
        engine step adds its rows, with the force divided by the number of steps. After `reset` they
        are those saved with the state. The array is valid until the next call.
        """
        ...

    def self_contacts(self) -> list[tuple[int, int]]:
        """Return the pairs of links that pushed each other in the last step; -1 is the palm."""
        ...

    def set_gravity(self, gravity: Array) -> None:
        """Change gravity (3,) [m/s^2]."""

    def set_joint_friction(self, torques: list[float]) -> None:
        """Set the Coulomb friction (M,) of the joints [N m]; `load` sets it to zero."""

    def set_object(self, item: ObjectDescription) -> None:
        """Change the object's mass, inertia and friction. `reset` does not undo the change."""

    def keep(self, name: str) -> None:
        """Save the current state for `reset`, in place of an earlier one of that name."""

    def reset(self, name: str) -> None:
        """Restore a saved state exactly, contact forces included."""

    def close(self) -> None:
        """Free the engine; calling it again does nothing."""
