"""Gantry with stiction: LuGre friction in place of the paper's smooth Coulomb friction.

Canudas de Wit, Olsson, Åström, Lischinsky, "A new model for control of systems with friction", IEEE TAC 40 (1995).
Each axis carries a state z, the mean deflection of the bristles in the contact:

    (m_t,i + m_J,i) s̈_i = u_i − F_F,i − F_G,i + F_i,        i ∈ {y, z}
    F_F,i = σ₀,i z_i + σ₁,i ż_i + c_v,i ṡ_i
    ż_i = ṡ_i − σ₀,i |ṡ_i| z_i / g_i(ṡ_i),   g_i(v) = F_c,i + (F_s,i − F_c,i) e^−(v / v_s)²

At constant velocity v the friction is g(v) sgn v + c_v v: F_s is the breakaway force, the Stribeck effect ends at v_s,
and far above v_s it is the gantry's friction. Within |z| < F_s/σ₀ the axis sticks and yields like a spring.

Table II has F_c and c_v only. The rest is our choice: F_s = 1.3 F_c; v_s = 5 mm/s; σ₀ such that the bristles yield by
about 30 µm at F_c, as rolling guides and ball nuts do, and σ₁ such that the stuck axis has a damping ratio of a half.

The bristles' rate is |v| σ₀/g: 3e4 1/s at 1 m/s. This is stiff, so the FMU starts with the implicit integrator.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import Array, Block, Input, Output, ParameterError, State, parameter
from ..export import Integrator
from ..export import build as _build

__all__ = ["INTERNAL_STEP", "GantryStiction", "build", "nominal"]

INTERNAL_STEP = 1e-3
"""Start value of the FMU's longest internal step in s; Runge-Kutta 4 needs 5e-5 s to be stable up to 1.7 m/s."""


class GantryStiction(Block):
    """Biaxial gantry robot with LuGre friction: stiction, Stribeck effect, presliding."""

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
        default=(65.42, 37.69), shape=(2,), unit="N", above=0.0, description="Coulomb friction F_c"
    )
    breakaway_friction: Array = parameter(
        default=(85.0, 49.0), shape=(2,), unit="N", above=0.0, description="breakaway friction F_s, at least F_c"
    )
    viscous_friction: Array = parameter(
        default=(175.93, 62.83), shape=(2,), unit="N.s/m", minimum=0.0, description="viscous friction coefficient c_v"
    )
    stribeck_velocity: float = parameter(
        default=0.005, unit="m/s", above=0.0, description="velocity v_s where the Stribeck effect ends"
    )
    bristle_stiffness: Array = parameter(
        default=(2.2e6, 1.25e6), shape=(2,), unit="N/m", above=0.0, description="stiffness σ₀ of the bristles"
    )
    bristle_damping: Array = parameter(
        default=(9000.0, 5100.0), shape=(2,), unit="N.s/m", minimum=0.0, description="damping σ₁ of the bristles"
    )
    coulomb_scale: float = parameter(default=1.0, unit="1", minimum=0.0, description="factor on the bristles' force")
    viscous_scale: float = parameter(default=1.0, unit="1", minimum=0.0, description="factor on the viscous friction")
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
    bristle = State(unit="m", description="mean deflection z of the bristles", start=(0.0, 0.0), nominal=3e-5)
    acceleration = Output(shape=(2,), unit="m/s2", description="acceleration of the end effector")
    friction_force = Output(shape=(2,), unit="N", description="friction force F_F, against the velocity")

    def check(self) -> None:
        """Refuse a breakaway friction below the Coulomb friction."""
        if np.any(self.breakaway_friction < self.coulomb_friction):
            raise ParameterError(
                f"found {self.breakaway_friction.tolist()}; expected at least the Coulomb friction, "
                f"{self.coulomb_friction.tolist()}, in N. Raise it, or lower coulomb_friction.",
                block=self.label,
                port="breakaway_friction",
            )

    def bristle_rate(self, velocity: Array, bristle: Array) -> Array:
        """Return ż in m/s."""
        stribeck = np.exp(-((velocity / self.stribeck_velocity) ** 2))
        g = self.coulomb_friction + (self.breakaway_friction - self.coulomb_friction) * stribeck
        return velocity - self.bristle_stiffness * np.abs(velocity) * bristle / g

    def friction(self, velocity: Array, bristle: Array) -> Array:
        """Return the friction force F_F of each axis in N."""
        in_bristles = self.bristle_stiffness * bristle + self.bristle_damping * self.bristle_rate(velocity, bristle)
        return self.coulomb_scale * in_bristles + self.viscous_scale * self.viscous_friction * velocity

    def acceleration_of(self, x: Any, u: Any) -> Array:
        """Return the acceleration, by Newton's law."""
        weight = self.gravity * self.translational_mass * np.array([0.0, 1.0])
        force = u.motor_force + u.external_force - self.friction(x.velocity, x.bristle) - weight
        return force / (self.translational_mass + self.equivalent_mass)

    def derivative(self, t: Array, x: Any, u: Any) -> tuple[Array, Array, Array]:
        """Return the right-hand side of the equations above."""
        return x.velocity, self.acceleration_of(x, u), self.bristle_rate(x.velocity, x.bristle)

    def output(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return acceleration and friction."""
        return self.acceleration_of(x, u), self.friction(x.velocity, x.bristle)


nominal = GantryStiction()
"""Table II with the friction described above."""


def build(
    model: GantryStiction = nominal,
    out: Path | str | None = None,
    *,
    name: str = "gantry_stiction",
    internal_step: float = INTERNAL_STEP,
    integrator: Integrator = "rodas",
    **options: Any,
) -> Path:
    """Export it as an FMU, ``gantry_stiction.fmu``, and return the file; ``options`` as `loopwright.build`."""
    return _build(model, out, name=name, internal_step=internal_step, integrator=integrator, stop_time=11.0, **options)
