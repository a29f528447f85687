"""Biaxial gantry robot of Flixeder, Glück, Böck, Kugi (2014), section II, with the parameters of their Table II.

Two linear axes, y and z, each driven through a ball screw that is stiff and without backlash. With F the force on the
end effector (E1, E6):

    (m_t,i + m_J,i) s̈_i = u_i − F_F,i(ṡ_i) − F_G,i + F_i,        i ∈ {y, z}
    F_F,i(v) = F_c,i tanh(v / w) + c_v,i v,   F_G,y = 0,   F_G,z = g m_t,z

``gantry.build()`` makes the FMU, and ``gantry.nominal`` is the model that a controller inverts: both have one
definition.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import Array, Input, Output, State, parameter
from ...blocks.path_following import PlanarModel
from ..export import build as _build

__all__ = ["INTERNAL_STEP", "Gantry", "build", "nominal"]

INTERNAL_STEP = 1.0 / 5000.0
"""Start value of the FMU's internal Runge-Kutta step in s, for the friction width of 0.01 m/s: five per millisecond."""


class Gantry(PlanarModel):
    """Biaxial gantry robot with Coulomb and viscous friction, equations (1) to (3)."""

    translational_mass: Array = parameter(
        default=(7.61, 4.41), shape=(2,), unit="kg", above=0.0, description="moved translational mass m_t (E10)"
    )
    equivalent_mass: Array = parameter(
        default=(29.26, 16.79),
        shape=(2,),
        unit="kg",
        minimum=0.0,
        description="equivalent mass m_J of motor and ball screw",
    )
    coulomb_friction: Array = parameter(
        default=(65.42, 37.69), shape=(2,), unit="N", minimum=0.0, description="Coulomb friction F_c"
    )
    viscous_friction: Array = parameter(
        default=(175.93, 62.83), shape=(2,), unit="N.s/m", minimum=0.0, description="viscous friction coefficient c_v"
    )
    coulomb_scale: float = parameter(default=1.0, unit="1", minimum=0.0, description="factor on the Coulomb friction")
    viscous_scale: float = parameter(default=1.0, unit="1", minimum=0.0, description="factor on the viscous friction")
    friction_width: float = parameter(
        default=0.01, unit="m/s", above=0.0, description="width w of the friction's sign change (E23)"
    )
    gravity: float = parameter(default=9.81, unit="m/s2", description="gravitational acceleration g, against z")
    start_position: Array = parameter(
        default=(0.8, 0.5), shape=(2,), unit="m", structural=True, description="position at the start"
    )
    start_velocity: Array = parameter(
        default=(0.0, 0.0), shape=(2,), unit="m/s", structural=True, description="velocity at the start"
    )

    motor_force = Input(shape=(2,), unit="N", description="equivalent motor force u, axes y and z")
    external_force = Input(shape=(2,), unit="N", description="force F on the end effector")
    position = State(unit="m", description="position s of the end effector", start="start_position", output=True)
    velocity = State(unit="m/s", description="velocity of the end effector", start="start_velocity", output=True)
    acceleration = Output(shape=(2,), unit="m/s2", description="acceleration of the end effector")

    @property
    def mass(self) -> Array:
        """Inertia of each axis, m_t + m_J, in kg: 36.87 and 21.20 by Table II."""
        return self.translational_mass + self.equivalent_mass

    @property
    def weight(self) -> Array:
        """Weight F_G of each axis in N: that of the translational mass, on z only."""
        return self.gravity * self.translational_mass * np.array([0.0, 1.0])

    def friction(self, x_v: Array) -> Array:
        """Return the friction force F_F of each axis in N at the velocity x_v in m/s."""
        coulomb = self.coulomb_scale * self.coulomb_friction * np.tanh(x_v / self.friction_width)
        return coulomb + self.viscous_scale * self.viscous_friction * x_v

    def f_v(self, x_c: Array, x_v: Array) -> Array:
        """Return the drift of (2), f_v = −(F_F + F_G) / M: friction and weight over inertia, m/s²."""
        return (-self.friction(x_v) - self.weight) / self.mass

    def G_v(self, x_c: Array) -> Array:  # noqa: N802 - the paper's symbol
        """Return the input matrix of (2), G_v = M⁻¹, 1/kg."""
        return np.eye(2) / self.mass

    def coordinate_acceleration(self, x_c: Array, x_v: Array, motor_force: Array, force: Array) -> Array:
        """Return ẋ_v of (1): f_v + G_v (u + F), with one division only, which takes most of an FMU's time."""
        return (motor_force + force - self.friction(x_v) - self.weight) / self.mass

    def derivative(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the right-hand side of (1)."""
        return x.velocity, self.coordinate_acceleration(x.position, x.velocity, u.motor_force, u.external_force)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the acceleration."""
        return self.output_acceleration(x.position, x.velocity, u.motor_force, u.external_force)


nominal = Gantry()
"""The gantry of Table II, which is also the model that the controller inverts."""


def build(
    model: Gantry = nominal,
    out: Path | str | None = None,
    *,
    name: str = "gantry",
    internal_step: float = INTERNAL_STEP,
    notify: Callable[[str], None] | None = None,
    **options: Any,
) -> Path:
    """Export the gantry as an FMU, ``gantry.fmu``, and return the file; it is built once and then cached.

    Every number of Table II is a parameter of the FMU, besides ``coulomb_scale``, ``viscous_scale``,
    ``friction_width``, ``gravity`` and ``internal_step``; ``position`` and ``velocity`` take start values.

    Parameters
    ----------
    model : Gantry, optional
        Parameters and start values.
    out : path, optional
        File to write; without it, the file in the cache is returned.
    name : str, optional
        Name of the model.
    internal_step : float, optional
        Longest step of the FMU's own integrator in s.
    notify : callable, optional
        Called with a line of text when a compilation starts.
    **options
        Further options of `loopwright.build`.
    """
    return _build(model, out, name=name, internal_step=internal_step, stop_time=11.0, notify=notify, **options)
