"""Two-link planar arm (SCARA) in the plane of the gantry: axes y and z, base at the origin.

Joint angles q: q₁ from the y axis, q₂ from the first link to the second. With link lengths l, the distance c of each
link's centre of mass from its joint, mass m, inertia I about that centre, and the drives' inertias J, as seen from the
joints:

    M(q) q̈ + C(q, q̇) q̇ + G(q) + τ_F(q̇) = τ + (dh)ᵀ F

    M₁₁ = J₁ + I₁ + m₁ c₁² + m₂ l₁² + I₂ + m₂ c₂² + 2 β cos q₂,    β = m₂ l₁ c₂
    M₁₂ = M₂₁ = I₂ + m₂ c₂² + β cos q₂,    M₂₂ = J₂ + I₂ + m₂ c₂²
    C q̇ = β sin q₂ (−2 q̇₁ q̇₂ − q̇₂², q̇₁²)
    G = g ((m₁ c₁ + m₂ l₁) cos q₁ + m₂ c₂ cos(q₁ + q₂), m₂ c₂ cos(q₁ + q₂))
    τ_F,i = τ_c,i tanh(q̇_i / w) + b_i q̇_i

    y = h(q) = l₁ (cos q₁, sin q₁) + l₂ (cos(q₁ + q₂), sin(q₁ + q₂))

F is the force on the end effector. A SCARA moves horizontally: g = 0 by default. Each drive's rotor is assumed to spin
with its own joint only. All numbers are our choice: an arm of 1.1 m that covers the paper's ellipse with its elbow bent
by 59° to 129°.

In a singular pose (q₂ = 0 or π) `FeedbackLinearization` stops the run, since det(dh) = l₁ l₂ sin q₂.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import Array, Input, Output, ParameterError, State, parameter
from ...blocks.path_following import PlanarModel
from ..export import build as _build

__all__ = ["INTERNAL_STEP", "Scara", "build", "nominal"]

INTERNAL_STEP = 1.0 / 5000.0
"""Start value of the FMU's internal Runge-Kutta step in s; the joints' friction has a rate of 200 1/s at rest."""


class Scara(PlanarModel):
    """Two-link planar arm with Coulomb and viscous friction in its joints."""

    coordinate_unit = "rad"
    input_unit = "N.m"

    link_length: Array = parameter(
        default=(0.6, 0.5), shape=(2,), unit="m", above=0.0, description="lengths l of the links"
    )
    center_of_mass: Array = parameter(
        default=(0.3, 0.25),
        shape=(2,),
        unit="m",
        minimum=0.0,
        description="distance c of the link's centre from its joint",
    )
    link_mass: Array = parameter(
        default=(6.0, 4.0), shape=(2,), unit="kg", above=0.0, description="masses m of the links"
    )
    link_inertia: Array = parameter(
        default=(0.2, 0.1), shape=(2,), unit="kg.m2", minimum=0.0, description="inertia I about the link's centre"
    )
    drive_inertia: Array = parameter(
        default=(1.0, 0.4), shape=(2,), unit="kg.m2", minimum=0.0, description="inertia J of the drive, at the joint"
    )
    coulomb_friction: Array = parameter(
        default=(4.0, 2.0), shape=(2,), unit="N.m", minimum=0.0, description="Coulomb friction τ_c of the joints"
    )
    viscous_friction: Array = parameter(
        default=(5.0, 3.0), shape=(2,), unit="N.m.s/rad", minimum=0.0, description="viscous friction b of the joints"
    )
    coulomb_scale: float = parameter(default=1.0, unit="1", minimum=0.0, description="factor on the Coulomb friction")
    viscous_scale: float = parameter(default=1.0, unit="1", minimum=0.0, description="factor on the viscous friction")
    friction_width: float = parameter(
        default=0.02, unit="rad/s", above=0.0, description="width w of the friction's sign change"
    )
    gravity: float = parameter(default=0.0, unit="m/s2", description="gravitational acceleration g, against z")
    start_angle: Array = parameter(
        default=(0.07072564, 1.0852782),
        shape=(2,),
        unit="rad",
        structural=True,
        description="joint angles at the start; the end effector is at (0.8, 0.5) m",
    )
    start_rate: Array = parameter(
        default=(0.0, 0.0), shape=(2,), unit="rad/s", structural=True, description="joint velocities at the start"
    )

    motor_torque = Input(shape=(2,), unit="N.m", description="torque τ of the drives, at the joints")
    external_force = Input(shape=(2,), unit="N", description="force F on the end effector")
    joint_angle = State(unit="rad", description="joint angles q", start="start_angle", output=True)
    joint_velocity = State(unit="rad/s", description="rates of the joint angles", start="start_rate", output=True)
    position = Output(shape=(2,), unit="m", description="position of the end effector")
    velocity = Output(shape=(2,), unit="m/s", description="velocity of the end effector")
    acceleration = Output(shape=(2,), unit="m/s2", description="acceleration of the end effector")

    def inertia(self, x_c: Array) -> Array:
        """Return the inertia matrix M in kg m²."""
        (m1, m2), (c1, c2), l1 = self.link_mass, self.center_of_mass, self.link_length[0]
        (i1, i2), (j1, j2) = self.link_inertia, self.drive_inertia
        bent = m2 * l1 * c2 * np.cos(x_c[1])
        outer = i2 + m2 * c2**2
        m11 = j1 + i1 + m1 * c1**2 + m2 * l1**2 + outer + 2.0 * bent
        return _matrix(m11, outer + bent, outer + bent, j2 + outer + 0.0 * bent)

    def friction(self, x_v: Array) -> Array:
        """Return the friction torque τ_F of each joint in N m."""
        coulomb = self.coulomb_scale * self.coulomb_friction * np.tanh(x_v / self.friction_width)
        return coulomb + self.viscous_scale * self.viscous_friction * x_v

    def f_v(self, x_c: Array, x_v: Array) -> Array:
        """Return M⁻¹ (−C q̇ − G − τ_F), rad/s²."""
        (m1, m2), (c1, c2), l1 = self.link_mass, self.center_of_mass, self.link_length[0]
        bent = m2 * l1 * c2 * np.sin(x_c[1])
        coriolis = bent * np.stack([-2.0 * x_v[0] * x_v[1] - x_v[1] ** 2, x_v[0] ** 2])
        outer = m2 * c2 * np.cos(x_c[0] + x_c[1])
        weight = self.gravity * np.stack([(m1 * c1 + m2 * l1) * np.cos(x_c[0]) + outer, outer])
        return -self.G_v(x_c) @ (coriolis + weight + self.friction(x_v))

    def G_v(self, x_c: Array) -> Array:  # noqa: N802 - the paper's symbol
        """Return M⁻¹, 1/(kg m²)."""
        M = self.inertia(x_c)
        return _matrix(M[1, 1], -M[0, 1], -M[1, 0], M[0, 0]) / (M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0])

    def h(self, x_c: Array) -> Array:
        """Return the position of the end effector in m."""
        inner, outer = self._links(x_c)
        return inner + outer

    def dh(self, x_c: Array) -> Array:
        """Return the Jacobian of h, m/rad."""
        (y1, z1), (y2, z2) = self._links(x_c)
        return _matrix(-z1 - z2, -z2, y1 + y2, y2)

    def dh_rate(self, x_c: Array, x_v: Array) -> Array:
        """Return the rate of the Jacobian."""
        (y1, z1), (y2, z2) = self._links(x_c)
        v1, v2 = x_v[0], x_v[0] + x_v[1]
        return _matrix(-y1 * v1 - y2 * v2, -y2 * v2, -z1 * v1 - z2 * v2, -z2 * v2)

    def _links(self, x_c: Array) -> tuple[Array, Array]:
        """Return both links as vectors from joint to end."""
        l1, l2 = self.link_length
        both = x_c[0] + x_c[1]
        return (
            l1 * np.stack([np.cos(x_c[0]), np.sin(x_c[0])]),
            l2 * np.stack([np.cos(both), np.sin(both)]),
        )

    def joint_angles(self, position: Array, *, elbow: int = 1) -> np.ndarray:
        """Return the joint angles for a position of the end effector: plain Python, for start values.

        Parameters
        ----------
        position : array_like
            Position in m, shape (2,).
        elbow : {1, -1}
            Sign of q₂.

        Raises
        ------
        ParameterError
            If the position is out of reach, or the pose would be singular.
        """
        y, z = np.asarray(position, dtype=float)
        l1, l2 = (float(v) for v in self.link_length)
        cosine = (y**2 + z**2 - l1**2 - l2**2) / (2.0 * l1 * l2)
        if not -1.0 < cosine < 1.0:
            raise ParameterError(
                f"found the position {[float(y), float(z)]} m, at {np.hypot(y, z):.6g} m from the base; expected "
                f"a distance between {abs(l1 - l2):.6g} and {l1 + l2:.6g} m; move it, or lengthen the links.",
                block=self.label,
                port="position",
            )
        q2 = np.copysign(np.arccos(cosine), elbow)
        return np.array([np.arctan2(z, y) - np.arctan2(l2 * np.sin(q2), l1 + l2 * np.cos(q2)), q2])

    def derivative(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the right-hand side of the equation of motion."""
        q, rate = x.joint_angle, x.joint_velocity
        return rate, self.coordinate_acceleration(q, rate, u.motor_torque, u.external_force)

    def output(self, t: Array, x: Any, u: Any) -> tuple[Array, Array, Array]:
        """Return position, velocity and acceleration of the end effector."""
        q, rate = x.joint_angle, x.joint_velocity
        return *self.output_map(q, rate), self.output_acceleration(q, rate, u.motor_torque, u.external_force)


def _matrix(a: Array, b: Array, c: Array, d: Array) -> Array:
    return np.stack([np.stack([a, b]), np.stack([c, d])])


nominal = Scara()
"""The arm described above, which is also the model that the controller inverts."""


def build(
    model: Scara = nominal,
    out: Path | str | None = None,
    *,
    name: str = "scara",
    internal_step: float = INTERNAL_STEP,
    **options: Any,
) -> Path:
    """Export it as an FMU, ``scara.fmu``, and return the file; ``options`` as `loopwright.build`."""
    return _build(model, out, name=name, internal_step=internal_step, stop_time=11.0, **options)
