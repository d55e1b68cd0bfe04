"""`grasp warmup`: compile ahead."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console

from grasp_env._extras import need


@dataclass(frozen=True)
class Warmup:
    """Compile every kernel and cache it on disk, so that later processes load instead of compiling (tens of ms)."""

    def execute(self) -> None:
        """Runs it; raises the errors of the project."""
        need("sim", "report")
        from training.demo import warm_up

        Console().print(f"kernels compiled and cached in {warm_up():.1f} s", highlight=False)
