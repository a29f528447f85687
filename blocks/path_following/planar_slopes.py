"""Derivatives of a planar model, equation (2)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..core import Array, identity
from ..tracing import flat_column, wrap
from .planar_model import PlanarModel


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
