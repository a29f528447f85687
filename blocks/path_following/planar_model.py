"""Fully actuated planar mechanical models, equations (1) to (3)."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from ..core import Array, Block, DefinitionError


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
