"""Fully actuated planar mechanical models, equations (1) to (3), and the derivatives of one, equation (2)."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np

from ..core import Array, Block, DefinitionError, identity
from ..tracing import flat_column, wrap


class PlanarModel(Block):
    """Mechanical system with two coordinates x_c, two actuators, and an output in the plane.

    Equation (1), with F the force on the end effector (E1, E6): ẋ_c = x_v, ẋ_v = f_v(x_c, x_v) + G_v(x_c)(u + dhᵀ F),
    and (3): y = h(x_c). A subclass gives `f_v` and `G_v`, and `h` with its first two derivatives if h is not the
    identity. If it declares ports and states it is a plant as well: then the plant and the model that a controller
    inverts are one definition.

    Raises
    ------
    DefinitionError
        If f_v or G_v is needed and not written.
    """

    coordinate_unit: ClassVar[str] = "m"
    """Unit of x_c."""
    input_unit: ClassVar[str] = "N"
    """Unit of the motor force u."""

    def f_v(self, x_c: Array, x_v: Array) -> Array:
        """Return the drift f_v of (2), shape (2,), in the coordinates' unit per s²."""
        raise self._undefined_error("f_v(x_c, x_v)")

    def G_v(self, x_c: Array) -> Array:  # noqa: N802 - the paper's symbol
        """Return the input matrix G_v of (2), shape (2, 2)."""
        raise self._undefined_error("G_v(x_c)")

    def _undefined_error(self, member: str) -> DefinitionError:
        return DefinitionError(
            f"found no {member}; expected a PlanarModel to define it, equation (2). Write it.",
            block=type(self).__name__,
        )

    def h(self, x_c: Array) -> Array:
        """Return the output y = h(x_c), (3), in m."""
        return x_c

    def dh(self, x_c: Array) -> Array:
        """Return the Jacobian of h, shape (2, 2)."""
        return np.eye(2)

    def dh_rate(self, x_c: Array, x_v: Array) -> Array:
        """Return the time derivative of the Jacobian of h, shape (2, 2), which is its derivative times x_v."""
        return np.zeros((2, 2))

    def output_map(self, x_c: Array, x_v: Array) -> tuple[Array, Array]:
        """Return y and ẏ = dh x_v."""
        return self.h(x_c), self.dh(x_c) @ x_v

    def coordinate_acceleration(self, x_c: Array, x_v: Array, motor_force: Array, force: Array) -> Array:
        """Return ẋ_v of (1)."""
        return self.f_v(x_c, x_v) + self.G_v(x_c) @ (motor_force + self.dh(x_c).T @ force)

    def output_acceleration(self, x_c: Array, x_v: Array, motor_force: Array, force: Array) -> Array:
        """Return ÿ = dh ẋ_v + (dh)˙ x_v."""
        a = self.coordinate_acceleration(x_c, x_v, motor_force, force)
        return self.dh(x_c) @ a + self.dh_rate(x_c, x_v) @ x_v


class PlanarSlopes(NamedTuple):
    """Input matrix and derivatives of a planar model at a position and a velocity."""

    G_v: np.ndarray
    """Input matrix G_v."""
    slope: np.ndarray
    """Derivative of f_v by the velocity."""
    by_position: np.ndarray
    """Derivatives of f_v and G_v by the position, one after the other."""


_KNOWN: dict[Any, PlanarSlopes] = {}
MOST = 64
"""Slopes that are kept: every variant of a loop asks for those of its models again."""


def planar_slopes(model: PlanarModel, position: Array, velocity: Array) -> PlanarSlopes:
    """Return G_v, ∂f_v/∂x_v and the derivatives by the position, by algorithmic differentiation."""
    # those of models of this package are kept; the equations of others may have changed since
    ours = type(model).__module__.partition(".")[0] == __name__.partition(".")[0]
    key = identity(model), np.asarray(position, dtype=float).tobytes(), np.asarray(velocity, dtype=float).tobytes()
    found = _KNOWN.get(key) if ours else None
    if found is None:
        found = _differentiate(model, position, velocity)
        if ours:
            for value in found:
                value.setflags(write=False)
            _KNOWN[key] = found
            while len(_KNOWN) > MOST:
                _KNOWN.pop(next(iter(_KNOWN)), None)
    return found


def _differentiate(model: PlanarModel, position: Array, velocity: Array) -> PlanarSlopes:
    import casadi as ca

    x_c, x_v = ca.MX.sym("x_c", 2), ca.MX.sym("x_v", 2)
    f = flat_column(model.f_v(wrap(x_c, (2,)), wrap(x_v, (2,))))
    G = flat_column(model.G_v(wrap(x_c, (2,))))
    moved = ca.vertcat(ca.vec(ca.jacobian(f, x_c)), ca.vec(ca.jacobian(G, x_c)))
    made = ca.Function("slopes", [x_c, x_v], [G, ca.jacobian(f, x_v), moved])(position, velocity)
    values = [np.array(v.full()) for v in made]
    return PlanarSlopes(values[0].reshape(2, 2), values[1], values[2])
