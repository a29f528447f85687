"""Feedback linearization of transverse coordinates, equations (8) to (11) of Flixeder, Glück, Böck, Kugi (2014).

Numbers in parentheses are the paper's equations, E1 to E27 its errata (docs/explanation/paper.md). F is the force on
the robot, t and n the unit tangent and normal (to the left), κ the signed curvature (the paper's φ′), κ_s its
derivative with respect to the arc length, q = 1 − κ ξ₁.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core import Array, Block, GuardError, Input, Output, ParameterError, parameter
from ..paths import Path
from .planar_model import PlanarModel
from .transverse import A_MODEL, A_PATH, position_inputs


class FeedbackLinearization(Block):
    """Input-output feedback linearization (10), which makes η̈₁ = v∥ and ξ̈₁ = v⊥, (11).

    The virtual output (8) is ỹ = (ξ₁, η₁). With J = [nᵀ; tᵀ/q] its rate is J ẏ, and (9) reads ỹ¨ = b + D_u (u + dhᵀF),
    D_u = J dh G_v (E2, E3). Solved for the motor force, J⁻¹ = [n, q t] in closed form (E4 orders v):

        u = (dh G_v)⁻¹ { n (v⊥ + κ q η₂²) + t (q v∥ − 2 κ η₂ ξ₂ − κ_s ξ₁ η₂²) − dh f_v − (dh)˙ x_v } − dhᵀ F.

    It applies to any fully actuated planar model with ẋ_v = f_v + G_v (u + dhᵀ F), y = h(x_c); the gantry is the case h
    = identity. It cancels the measured force F on the robot, with the sign of E6.

    The inputs are ``theta``, θ̂ of the foot point; ``position`` x_c and ``velocity`` x_v in the model's coordinates;
    ``force`` F on the robot; ``v_par`` and ``v_perp``, the wanted η̈₁ and ξ̈₁. The output ``motor_force`` is u, in the
    model's unit.

    Raises
    ------
    ParameterError
        For a path that is no `Path`, and a model that is no `PlanarModel` or has no f_v or G_v, when the block is made.
    GuardError
        In a run, if |det(dh G_v)| falls to ``minimum_determinant``.
    """

    path: Path = parameter(kw_only=False, description="the path", kind=A_PATH)
    model: PlanarModel = parameter(kw_only=False, description="model that is inverted: f_v, G_v, h", kind=A_MODEL)
    minimum_determinant: float = parameter(
        default=1e-9, minimum=0.0, description="smallest |det(dh G_v)|: below it the model can't be inverted"
    )

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """θ̂, the model's position and velocity, the force on the robot, v∥ and v⊥."""
        return {
            "theta": Input(name="theta"),
            **position_inputs(self.model),
            "force": Input(shape=(2,), unit="N", name="force"),
            "v_par": Input(unit="m/s2", name="v_par"),
            "v_perp": Input(unit="m/s2", name="v_perp"),
        }

    @property
    def outputs(self) -> Mapping[str, Output]:  # type: ignore[override]
        """The motor force in the model's unit."""
        return {"motor_force": Output(shape=(2,), unit=self.model.input_unit, name="motor_force")}

    def check(self) -> None:
        """Refuse a model without its equations."""
        for name, text in (("f_v", "f_v(x_c, x_v)"), ("G_v", "G_v(x_c)")):
            if getattr(type(self.model), name) is getattr(PlanarModel, name):
                raise ParameterError(
                    f"{type(self.model).__name__} has no {text}; expected a PlanarModel that defines it, equation (2). "
                    "Write it.",
                    port="model",
                )

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the motor force."""
        model, x_c, x_v = self.model, u.position, u.velocity
        y, dy = model.output_map(x_c, x_v)
        f = self.path.frame(u.theta)
        xi1 = f.normal @ (y - f.sigma)
        q = 1.0 - f.curvature * xi1
        eta2, xi2 = f.tangent @ dy / q, f.normal @ dy
        along_n = u.v_perp + f.curvature * q * eta2**2
        along_t = q * u.v_par - 2.0 * f.curvature * eta2 * xi2 - f.curvature_rate * xi1 * eta2**2
        wanted = f.normal * along_n + f.tangent * along_t
        dh, dh_rate = model.dh(x_c), model.dh_rate(x_c, x_v)
        free = dh @ model.f_v(x_c, x_v) + dh_rate @ x_v
        return _solve(dh @ model.G_v(x_c), wanted - free) - dh.T @ u.force

    def guards(self, t: Array, x: Any, u: Any) -> dict[str, Array]:
        """Return the distance of the determinant from its minimum."""
        A = self.model.dh(u.position) @ self.model.G_v(u.position)
        return {"determinant": np.abs(A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]) - self.minimum_determinant}

    def guard_error(self, name: str, value: float, u: Any, y: Any, x: Any = None) -> GuardError:
        """Return the error of a model that can't be inverted at its position."""
        return GuardError(
            f"|det(dh G_v)| of {type(self.model).__name__} is {value + self.minimum_determinant:.6g} at the position "
            f"{np.asarray(u.position).tolist()} {self.model.coordinate_unit}; expected more than minimum_determinant = "
            f"{self.minimum_determinant:g}, as it is inverted there. Keep away from singular positions, or correct G_v."
        )


def _solve(A: Array, b: Array) -> Array:
    """Return the solution of a 2 × 2 system, in closed form."""
    det = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    return np.stack([A[1, 1] * b[0] - A[0, 1] * b[1], A[0, 0] * b[1] - A[1, 0] * b[0]]) / det
