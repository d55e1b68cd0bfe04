"""The environments' entries in Gymnasium's registry, and the specification of an environment."""

from __future__ import annotations

from dataclasses import replace

from gymnasium.envs.registration import EnvSpec, WrapperSpec, registry

ENV_ID = "FourFingerGrasp-v0"
IDS = {
    ENV_ID: ("FourFingerGrasp", None),
    "UncertainGrasp-v0": ("UncertainGrasp", 200),
    "FragileGrasp-v0": ("FragileGrasp", 200),
}
"""Class and number of steps of every environment; None: as long as its task."""
FINISH = WrapperSpec("finish", "grasp_env.env.env:finish", {})
"""The wrapper that `gym.make` applies last."""


class GraspSpec(EnvSpec):
    """A specification whose JSON keeps the names of records, for `EnvSpec.from_json`."""

    def to_json(self) -> str:
        """Return the specification as JSON.

        Raises:
            TypeError: a keyword has no JSON, such as a function; Gymnasium's own specifications
                raise the same.
        """
        from grasp_env.config.env import keywords_to_json

        kwargs, faults = keywords_to_json(self.kwargs)
        if faults:
            raise TypeError("; ".join(faults))
        return EnvSpec.to_json(replace(self, kwargs=kwargs))


def register() -> None:
    """Enter the environments in Gymnasium's registry, unless they are there already."""
    for name, (made, steps) in IDS.items():
        if name not in registry:
            registry[name] = GraspSpec(
                name,
                f"grasp_env.env:{made}",
                max_episode_steps=steps,
                additional_wrappers=(FINISH,),
            )
