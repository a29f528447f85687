"""Gantry with compliant ball screws, which the paper assumes to be stiff (section II).

In each axis the motor with its spindle, m_J, drives the slide, m_t, through a spring and a damper, which model nut,
spindle and bearings. With s the slide's position, s_m the motor's as seen from the slide, and δ = s_m − s:

    m_t,i s̈_i = k_i δ_i + d_i δ̇_i − ρ F_F,i(ṡ_i) − F_G,i + F_i,                i ∈ {y, z}
    m_J,i (s̈_i + δ̈_i) = u_i − k_i δ_i − d_i δ̇_i − (1 − ρ) F_F,i(ṡ_i + δ̇_i)

F_F and F_G are the gantry's; ρ is the share of the friction that acts on the slide (the guides); the rest acts on the
motor (nut, bearings). For k → ∞ this is the gantry.

The paper gives no number for the screws. Our choice: k puts the free resonance ω² = k (1/m_t + 1/m_J) at 100 Hz in both
axes, and d damps it by 12 %; both are high for such a drive. The reason: a loop over the slide's position with a triple
pole at −p has the gain 3 p/(2 ζ ω) at the resonance, which must stay below 1, so that the paper's p = 40 1/s needs ζ >
60/ω, 9.5 % at 100 Hz, without friction. With a softer screw, or half of the damping, the paper's gains are unstable on
this plant.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import Array, Output, State, parameter
from ..export import build as _build
from .gantry import Gantry

__all__ = ["INTERNAL_STEP", "GantryElastic", "build", "nominal"]

INTERNAL_STEP = 1.0 / 10000.0
"""Start value of the FMU's internal Runge-Kutta step in s: a hundred per period of the resonance."""


class GantryElastic(Gantry):
    """Biaxial gantry robot with compliant ball screws.

    It inherits `f_v` and `G_v` of the stiff gantry, which a controller without knowledge of the compliance inverts.
    """

    equivalent_mass: Array = parameter(
        default=(29.26, 16.79),
        shape=(2,),
        unit="kg",
        above=0.0,
        description="equivalent mass m_J of motor and ball screw",
    )
    screw_stiffness: Array = parameter(
        default=(2.4e6, 1.4e6), shape=(2,), unit="N/m", above=0.0, description="stiffness k between motor and slide"
    )
    screw_damping: Array = parameter(
        default=(900.0, 530.0), shape=(2,), unit="N.s/m", minimum=0.0, description="damping d between motor and slide"
    )
    slide_friction_share: float = parameter(
        default=0.5, unit="1", minimum=0.0, maximum=1.0, description="share ρ of the friction that acts on the slide"
    )

    deflection = State(
        unit="m",
        description="motor's position less the slide's; it starts where the screw carries the weight",
        start=lambda model: model.weight / model.screw_stiffness,
        nominal=1e-4,
    )
    deflection_rate = State(unit="m/s", description="rate of the deflection", start=(0.0, 0.0), nominal=1e-2)
    motor_position = Output(shape=(2,), unit="m", description="position of the motor, as seen from the slide")

    @property
    def weight(self) -> Array:
        """Weight F_G of each axis in N."""
        return self.gravity * self.translational_mass * np.array([0.0, 1.0])

    @property
    def resonance(self) -> tuple[Array, Array]:
        """Frequency in Hz and damping ratio of each axis' free resonance, without friction."""
        reduced = self.translational_mass * self.equivalent_mass / self.mass
        omega = np.sqrt(self.screw_stiffness / reduced)
        return omega / (2.0 * np.pi), self.screw_damping / (2.0 * reduced * omega)

    def accelerations(self, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the accelerations of slide and motor."""
        screw = self.screw_stiffness * x.deflection + self.screw_damping * x.deflection_rate
        on_slide = self.slide_friction_share * self.friction(x.velocity)
        on_motor = (1.0 - self.slide_friction_share) * self.friction(x.velocity + x.deflection_rate)
        slide = (screw - on_slide - self.weight + u.external_force) / self.translational_mass
        return slide, (u.motor_force - screw - on_motor) / self.equivalent_mass

    def derivative(self, t: Array, x: Any, u: Any) -> Any:
        """Return the right-hand side of the equations above."""
        slide, motor = self.accelerations(x, u)
        return x.velocity, slide, x.deflection_rate, motor - slide

    def output(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the slide's acceleration and the motor's position."""
        return self.accelerations(x, u)[0], x.position + x.deflection


nominal = GantryElastic()
"""Table II with the screws described above."""


def build(
    model: GantryElastic = nominal,
    out: Path | str | None = None,
    *,
    name: str = "gantry_elastic",
    internal_step: float = INTERNAL_STEP,
    **options: Any,
) -> Path:
    """Export it as an FMU, ``gantry_elastic.fmu``, and return the file; ``options`` as `loopwright.build`."""
    return _build(model, out, name=name, internal_step=internal_step, stop_time=11.0, **options)
