"""Gantry with a wall in its workspace, with contact by events.

The wall is a half-space with a spring and a damper in front, through the point p, with the unit normal n out of the
wall. With the penetration δ = nᵀ(p − s), the force on the end effector in contact is

    F_w = n (k δ + d δ̇),        δ̇ = −nᵀ ṡ,

and the gantry, equations (1) to (3), moves under u + F + F_w. Out of contact F_w = 0. The wall only pushes:

    touch     δ rises through 0                          → contact
    press     k δ + d δ̇ rises through 0 while δ > 0       → contact (it was released, and turned before it was out)
    release   k δ + d δ̇ falls through 0                  → no contact

It doesn't stick, so a damped wall releases before δ = 0, while it still springs back. The state ``contact`` is 1 or 0.
For a start inside the wall set its start value to 1; the default is 0.

By default the wall lies along y at z = 0.64 m, which cuts 10 mm off the top of the paper's ellipse. Stiffness and
damping are our choice: 20 kN/m is a firm rubber, 100 N s/m damps the free bounce of the z axis by 8 %.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import Array, Event, Output, State, parameter
from ..export import build as _build
from .gantry import INTERNAL_STEP, Gantry

__all__ = ["GantryContact", "build", "nominal"]


class GantryContact(Gantry):
    """Biaxial gantry robot with a wall in its workspace.

    It inherits the gantry's `f_v` and `G_v`: for a controller the wall's force is an external force.
    """

    wall_point: Array = parameter(default=(0.5, 0.64), shape=(2,), unit="m", description="a point p of the wall")
    wall_normal: Array = parameter(
        default=(0.0, -1.0), shape=(2,), unit="1", description="direction n out of the wall; its length doesn't matter"
    )
    wall_stiffness: float = parameter(default=2e4, unit="N/m", above=0.0, description="stiffness k of the wall")
    wall_damping: float = parameter(default=100.0, unit="N.s/m", minimum=0.0, description="damping d of the wall")

    contact = State(unit="1", description="1 in contact, 0 else", discrete=True, output=True)
    contact_force = Output(shape=(2,), unit="N", description="force F_w of the wall on the end effector")
    penetration = Output(unit="m", description="depth δ in the wall; a gap is negative")
    touch = Event("rising", "the end effector reaches the wall", nominal=1e-3)
    press = Event("rising", "the wall pushes again", nominal=1.0)
    release = Event("falling", "the wall stops pushing", nominal=1.0)

    def normal(self) -> Array:
        """Return the unit normal n."""
        return self.wall_normal / np.sqrt(self.wall_normal @ self.wall_normal)

    def depth(self, position: Array) -> Array:
        """Return the penetration δ in m."""
        return self.normal() @ (self.wall_point - position)

    def push(self, x: Any) -> Array:
        """Return k δ + d δ̇ in N."""
        return self.wall_stiffness * self.depth(x.position) - self.wall_damping * (self.normal() @ x.velocity)

    def wall_force(self, x: Any) -> Array:
        """Return F_w in N."""
        return self.normal() * np.where(x.contact > 0.5, self.push(x), 0.0)

    def derivative(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the right-hand side of (1), with the wall."""
        force = u.external_force + self.wall_force(x)
        return x.velocity, self.coordinate_acceleration(x.position, x.velocity, u.motor_force, force)

    def output(self, t: Array, x: Any, u: Any) -> tuple[Array, Array, Array]:
        """Return acceleration, contact force and penetration."""
        wall = self.wall_force(x)
        acceleration = self.output_acceleration(x.position, x.velocity, u.motor_force, u.external_force + wall)
        return acceleration, wall, self.depth(x.position)

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, Array, Array]:
        """Return δ and, twice, k δ + d δ̇."""
        push = self.push(x)
        return self.depth(x.position), push, push

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[Array, Array, Array]:
        """Return the states after an event: only the contact changes."""
        inside = np.where(self.depth(x.position) > 0.0, 1.0, x.contact)
        pressed = np.where(fired.press > 0.5, inside, x.contact)
        made = np.where(fired.touch > 0.5, 1.0, pressed)
        return x.position, x.velocity, np.where(fired.release > 0.5, 0.0, made)


nominal = GantryContact()
"""Table II with the wall described above."""


def build(
    model: GantryContact = nominal,
    out: Path | str | None = None,
    *,
    name: str = "gantry_contact",
    internal_step: float = INTERNAL_STEP,
    **options: Any,
) -> Path:
    """Export it as an FMU, ``gantry_contact.fmu``, and return the file; ``options`` as `loopwright.build`."""
    return _build(model, out, name=name, internal_step=internal_step, stop_time=11.0, **options)
