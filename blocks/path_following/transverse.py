"""Path following by transverse feedback linearization: section III of Flixeder, Glück, Böck, Kugi (2014).

Numbers in parentheses are the paper's equations, E1 to E27 its errata (docs/explanation/paper.md). F is the force on
the robot, t and n the unit tangent and normal (to the left), κ the signed curvature (the paper's φ′), κ_s its
derivative with respect to the arc length, q = 1 − κ ξ₁.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core import Array, Block, GuardError, Input, Output, PathDomainError, State, kinds, parameter
from ..paths import Path, replace_unlimited
from .planar_model import PlanarModel

_NEWTON = 4  # iterations in a tick; from 1 mm away, three reach the last digit

A_PATH = kinds.one_of_class(Path, "a Path, such as Ellipse(semi_axes=(0.3, 0.15))").worded(
    step=lambda value: "The path comes first, then the model." if isinstance(value, PlanarModel) else "Give one."
)
A_MODEL = kinds.one_of_class(PlanarModel, "a PlanarModel, such as gantry.nominal").worded(step="Give one.")


class PathTracking(Block):
    """Base of blocks that follow the foot point of a position on a path.

    At the start the foot point is the global arg min of (4). From then on Newton's method on (6),
    (y − σ̂(θ̂))ᵀ σ̂′(θ̂) = 0, starts from the last foot point, so that θ counts laps (E17). The state ``foot`` is the last
    foot point, nothing else.

    Raises
    ------
    ParameterError
        For a ``path`` that is no `Path`, when the block is made.
    PathDomainError
        In a run, where the path's coordinates end: q below ``minimum_q``, at or beyond the medial axis, beyond an end
        of an open path, and if the foot point jumps within one tick (E18).
    """

    memory = True
    path: Path = parameter(kw_only=False, description="the path", kind=A_PATH)
    minimum_q: float = parameter(default=0.05, minimum=0.0, description="smallest allowed q = 1 − κ ξ₁")
    tolerance: float = parameter(
        default=1e-9,
        above=0.0,
        description="largest remaining Newton step, as a part of the path's parameter range; 1e-5 in single precision",
    )
    position = Input(shape=(2,), unit="m", description="position y in the plane")
    foot = State(description="last path parameter")

    def initial(self, u: Any) -> float:
        """Return the global arg min of (4), in [0, period); within rounding before the seam counts as after it."""
        theta = float(self.path.project(np.asarray(u.position)))
        period = self.path.period
        if period is None:
            return theta
        theta -= period * np.floor(theta / period)
        return float(theta - period if theta > period * (1.0 - 1e-6) else theta)

    def foot_point(self, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the path parameter θ̂ of the foot point, from (6), and the size of the next Newton step."""
        theta, residual = self.path.newton(x.foot, u.position, _NEWTON)
        return theta, residual

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Keep the foot point, from which the next tick starts."""
        return self.foot_point(x, u)[0]

    def guards(self, t: Array, x: Any, u: Any) -> dict[str, Array]:
        """Return the expressions that are positive as long as the coordinates are valid."""
        theta, residual = self.foot_point(x, u)
        frame = self.path.frame(theta)
        xi = frame.normal @ (u.position - frame.sigma)
        left, right = self.path.reach(theta)
        low, high = self.path.domain or (0.0, self.path.period or 1.0)
        checks = {
            "newton": self.tolerance * (high - low) - np.abs(residual),
            "q": 1.0 - frame.curvature * xi - self.minimum_q,
            "left": left - xi,
            "right": right + xi,
        }
        if self.path.period is not None:  # beyond half a lap, the lap would be a guess
            checks["lap"] = 0.5 * self.path.period - np.abs(theta - x.foot)
        if self.path.domain is not None:
            slack = 1e-3 * self.tolerance * (high - low)
            checks |= {"start": theta - low + slack, "end": high - theta + slack}
        return checks

    def guard_error(self, name: str, value: float, u: Any, y: Any, x: Any = None) -> GuardError:
        """Return the `PathDomainError` with position, θ, ξ and the local reach; ``x`` gives the length of a jump."""
        position = np.asarray(u.position)
        theta = float(self.path.project(position))
        frame = self.path.frame(theta)
        xi = float(frame.normal @ (position - frame.sigma))
        q = 1.0 - float(frame.curvature) * xi
        left, right = self.path.reach(theta)
        reach = replace_unlimited(float(left if xi > 0 else right))
        if name in ("start", "end"):
            beyond = abs(float(frame.tangent @ (position - frame.sigma)))
            where = "before the start" if name == "start" else "beyond the end"
            why = f"it is {beyond:.3g} m {where} of the open path"
        elif name in ("left", "right"):
            why = "it is at or beyond the medial axis, where the nearest point of the path is not unique"
        elif name == "q" and q <= self.minimum_q:
            why = f"q = 1 − κ ξ = {q:.4g} is below {self.minimum_q:g}"
        else:
            why = (
                f"the foot point jumped{self._jump(theta, x)}: the position moved too far within one tick, or it is "
                "near the medial axis"
            )
        shown = "unlimited" if np.isinf(reach) else f"{reach:.6g} m"
        error = PathDomainError(
            f"position {position.tolist()} m has no valid path coordinates: {why}. Nearest foot point θ = {theta:.6g}, "
            f"ξ = {xi:.6g} m, local reach on that side {shown}. Start nearer to the path, or limit the force that "
            "drives the position off it."
        )
        error.position, error.theta, error.xi, error.reach = tuple(position.tolist()), theta, xi, reach
        return error

    def _jump(self, theta: float, x: Any) -> str:
        """Return in words the distance of the nearest foot point from the last one, if that is known."""
        if x is None or not np.all(np.isfinite(x.foot)):
            return ""
        apart = float(np.ravel(x.foot)[0]) - theta
        period = self.path.period
        if period is not None:
            apart -= period * np.floor(apart / period + 0.5)
        way = float(self.path.arc_length(theta + apart)) - float(self.path.arc_length(theta))
        return f" by {abs(way):.3g} m along the path"


class PathProjection(PathTracking):
    """Projection of a position onto the path: θ̂ = arg min ‖y − σ̂(θ̂)‖, (4), tracked through (6).

    The secondary output ``q`` is 1 − κ ξ₁, which scales tangential motion off the path.

    Raises
    ------
    ParameterError, PathDomainError
        See `PathTracking`.
    """

    theta = Output(description="path parameter θ̂ of the foot point, counted over laps (E17)")
    q = Output(description="1 − κ ξ₁", secondary=True)

    def output(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return θ̂ and q."""
        theta, _ = self.foot_point(x, u)
        frame = self.path.frame(theta)
        return theta, 1.0 - frame.curvature * (frame.normal @ (u.position - frame.sigma))


class TransverseTransform(Block):
    """Coordinate transform (7): η = (arc length, its rate), ξ = (signed distance to the path, its rate).

    η₁ = ∫₀^θ̂ ‖σ̂′(τ)‖ dτ, (5), lifted over laps (E17); η₂ = tᵀẏ / q; ξ₁ = nᵀ(y − σ); ξ₂ = nᵀẏ.

    The inputs are ``theta``, the path parameter θ̂ of the foot point, then ``position`` and ``velocity``. Without a
    model these are y and its rate; with a model they are x_c and x_v, and y = h(x_c), ẏ = dh x_v, (3).

    Raises
    ------
    ParameterError
        For a path that is no `Path`, and a model that is no `PlanarModel`, when the block is made.
    """

    path: Path = parameter(kw_only=False, description="the path", kind=A_PATH)
    model: PlanarModel | None = parameter(
        default=None, kw_only=False, description="model with the output map h; None: h is the identity", kind=A_MODEL
    )
    eta = Output(shape=(2,), unit=("m", "m/s"), description="tangential state η")
    xi = Output(shape=(2,), unit=("m", "m/s"), description="transversal state ξ")

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """θ̂, and position and velocity in the model's coordinates."""
        return {"theta": Input(name="theta"), **position_inputs(self.model)}

    def output(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return η and ξ."""
        y, dy = (u.position, u.velocity) if self.model is None else self.model.output_map(u.position, u.velocity)
        f = self.path.frame(u.theta)
        xi1 = f.normal @ (y - f.sigma)
        eta2 = f.tangent @ dy / (1.0 - f.curvature * xi1)
        return np.stack([self.path.arc_length(u.theta), eta2]), np.stack([xi1, f.normal @ dy])


class ForceProjection(Block):
    """Force in the path's moving frame, (13): F∥ = tᵀF, F⊥ = nᵀF, with F the force on the robot (E6).

    Raises
    ------
    ParameterError
        For a path that is no `Path`, when the block is made.
    """

    path: Path = parameter(kw_only=False, description="the path", kind=A_PATH)
    theta = Input(description="path parameter of the foot point")
    force = Input(shape=(2,), unit="N", description="measured force on the robot")
    f_par = Output(unit="N", description="tangential part F∥")
    f_perp = Output(unit="N", description="transversal part F⊥")

    def output(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return F∥ and F⊥."""
        f = self.path.frame(u.theta)
        return f.tangent @ u.force, f.normal @ u.force


def position_inputs(model: PlanarModel | None) -> dict[str, Input]:
    """Return the inputs for a position and its rate: y, or the coordinates of a model, in its unit."""
    unit = "m" if model is None else model.coordinate_unit
    return {
        "position": Input(shape=(2,), unit=unit, description="y, or x_c of the model", name="position"),
        "velocity": Input(shape=(2,), unit=f"{unit}/s", description="its rate", name="velocity"),
    }
