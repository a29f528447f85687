"""Mass on a spring and a damper, driven by a force: m s̈ + d ṡ + k s = F."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...blocks.core import Array, Block, Input, Output, State, parameter
from ..export import build as _build

__all__ = ["MassSpringDamper", "build", "nominal"]


class MassSpringDamper(Block):
    """Mass on a spring and a damper, driven by a force."""

    mass: float = parameter(default=1.0, unit="kg", above=0.0, description="mass m")
    damping: float = parameter(default=1.0, unit="N.s/m", minimum=0.0, description="damping d")
    stiffness: float = parameter(default=100.0, unit="N/m", minimum=0.0, description="stiffness k")
    start_position: float = parameter(default=0.1, unit="m", structural=True, description="position at the start")
    start_velocity: float = parameter(default=0.0, unit="m/s", structural=True, description="velocity at the start")

    force = Input(unit="N", description="force F on the mass")
    position = State(
        unit="m", description="position s, zero at the free length of the spring", start="start_position", output=True
    )
    velocity = State(unit="m/s", description="velocity of the mass", start="start_velocity", output=True)
    acceleration = Output(unit="m/s2", description="acceleration of the mass")

    def derivative(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return velocity and acceleration."""
        return x.velocity, self.output(t, x, u)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the acceleration."""
        return (u.force - self.damping * x.velocity - self.stiffness * x.position) / self.mass


nominal = MassSpringDamper()
"""10 rad/s, damped by 5 %."""


def build(
    model: MassSpringDamper = nominal,
    out: Path | str | None = None,
    *,
    name: str = "mass_spring_damper",
    internal_step: float = 1e-3,
    **options: Any,
) -> Path:
    """Export it as an FMU, ``mass_spring_damper.fmu``, and return the file; ``options`` as `loopwright.build`."""
    return _build(model, out, name=name, internal_step=internal_step, stop_time=10.0, **options)
