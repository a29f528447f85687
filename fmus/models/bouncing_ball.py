"""Ball that bounces on the floor: ḣ = v, v̇ = −g, and at an impact, where h falls through 0, v⁺ = −e v⁻.

Each bounce takes e times the time of the last, so that all bounces end within a finite time. Therefore the ball comes
to rest at the first impact that it would leave with less than ``resting_speed``: then h = v = 0. It must start above
the floor.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import Array, Block, Event, State, parameter
from ..export import build as _build

__all__ = ["BouncingBall", "build", "nominal"]


class BouncingBall(Block):
    """Ball that bounces on the floor and comes to rest."""

    gravity: float = parameter(default=9.81, unit="m/s2", above=0.0, description="gravitational acceleration g")
    restitution: float = parameter(
        default=0.7, unit="1", minimum=0.0, maximum=1.0, description="coefficient of restitution e"
    )
    resting_speed: float = parameter(
        default=0.01, unit="m/s", minimum=0.0, description="the ball rests after an impact that would leave it slower"
    )
    start_height: float = parameter(
        default=1.0, unit="m", above=0.0, structural=True, description="height at the start"
    )
    start_velocity: float = parameter(
        default=0.0, unit="m/s", structural=True, description="velocity at the start, upwards"
    )

    height = State(unit="m", description="height h of the ball's lowest point", start="start_height", output=True)
    velocity = State(unit="m/s", description="velocity v, upwards", start="start_velocity", output=True)
    bounces = State(unit="1", description="number of impacts so far", discrete=True, output=True)
    resting = State(unit="1", description="1 when the ball has come to rest, 0 before", discrete=True, output=True)
    impact = Event("falling", "the ball hits the floor")

    def derivative(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the rates of height and velocity."""
        return x.velocity, np.where(x.resting > 0.5, 0.0, -self.gravity)

    def indicators(self, t: Array, x: Any, u: Any) -> Array:
        """Return the height."""
        return x.height

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[Array, Array, Array, Array]:
        """Return the states after an impact."""
        leaving = -self.restitution * x.velocity
        rests = leaving < self.resting_speed
        return 0.0 * x.height, np.where(rests, 0.0, leaving), x.bounces + 1.0, np.where(rests, 1.0, x.resting)


nominal = BouncingBall()
"""Dropped from 1 m; e = 0.7."""


def build(
    model: BouncingBall = nominal,
    out: Path | str | None = None,
    *,
    name: str = "bouncing_ball",
    internal_step: float = 1e-2,
    **options: Any,
) -> Path:
    """Export it as an FMU, ``bouncing_ball.fmu``, and return the file; ``options`` as `loopwright.build`."""
    return _build(model, out, name=name, internal_step=internal_step, stop_time=3.0, **options)
