"""Contact: a spring with a damper, a wall, the push of a hand. Forces act on the body."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..core import (
    Array,
    Block,
    Event,
    Input,
    Output,
    ParameterError,
    ShapeError,
    State,
    kinds,
    parameter,
    shape_of,
    shorten,
)
from .branching import check_fits
from .sources import smooth_step

_MATRIX_AT_MOST = kinds.dimensions(2).worded("at most two dimensions", "Give a number, a vector or a matrix.")


class SpringDamper(Block):
    """Spring and damper between a body and an anchor: F = −k (p − p_a − r) − d (v − v_a).

    Each axis is on its own, in any number of dimensions; k and d may be matrices, F = −K (…) − D (…). The anchor may be
    wired, such as to a hand that holds the body or to another body; else it rests at zero.

    Raises
    ------
    ShapeError
        For inputs or parameters of different shapes, when the diagram is built.
    """

    stiffness: Array = parameter(
        unit="N/m", description="stiffness k: a number, one for each axis, or a matrix", kind=_MATRIX_AT_MOST
    )
    damping: Array = parameter(
        default=0.0, unit="N.s/m", description="damping d: like the stiffness", kind=_MATRIX_AT_MOST
    )
    rest: Array = parameter(default=0.0, unit="m", description="offset r from the anchor at which the spring rests")
    position = Input(shape=None, unit="m", description="position p of the body")
    velocity = Input(shape=None, unit="m/s", default=0.0, description="its velocity v")
    anchor = Input(shape=None, unit="m", default=0.0, description="position p_a of the anchor")
    anchor_velocity = Input(shape=None, unit="m/s", default=0.0, description="its velocity v_a")
    force = Output(shape=None, unit="N", description="force F on the body")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the force."""
        for name, value in (*u._asdict().items(), ("rest", self.rest)):
            check_fits(value, name, u.position, "position")
        stretch = u.position - u.anchor - self.rest
        rate = u.velocity - u.anchor_velocity + 0.0 * u.position
        return -self._multiply("stiffness", stretch) - self._multiply("damping", rate)

    def _multiply(self, name: str, value: Array) -> Array:
        factor = getattr(self, name)
        n = shape_of(value)
        if shape_of(factor) not in ((), n, (*n, *n)):
            raise ShapeError(
                f"found shape {shape_of(factor)} next to a position of shape {n}; expected a number, one for each "
                "axis, or a square matrix. Give another one.",
                port=name,
            )
        return factor @ value if len(shape_of(factor)) == 2 else factor * value


class Wall(Block):
    """One-sided wall with a spring and a damper in front: it pushes, and never pulls.

    With the depth δ = nᵀ(p_w − p) and δ̇ = −nᵀ v,

        F = n max(k δ + d δ̇, 0) in the wall, δ > 0;    F = 0 outside.

    n points out of the wall. A damped wall's force jumps when the body enters, and ends before the body leaves. In a
    continuous subsystem that jump is an event. Without damping the force has a kink only, and the event is for
    ``contact``.

    Raises
    ------
    ParameterError
        For a normal of length zero.
    ShapeError
        For point, normal and inputs of different shapes, when the diagram is built.
    """

    stiffness: float = parameter(unit="N/m", above=0.0, description="stiffness k")
    damping: float = parameter(default=0.0, unit="N.s/m", minimum=0.0, description="damping d")
    point: Array = parameter(unit="m", description="a point p_w of the wall's surface")
    normal: Array = parameter(unit="1", description="direction n out of the wall; its length does not matter")
    position = Input(shape=None, unit="m", description="position p of the body")
    velocity = Input(shape=None, unit="m/s", default=0.0, description="its velocity v")
    force = Output(shape=None, unit="N", description="force F on the body")
    depth = Output(unit="m", secondary=True, description="depth δ in the wall; a gap is negative")
    contact = Output(secondary=True, description="1 while the wall pushes, else 0")
    touching = State(discrete=True, description="1 while the wall pushes; with damping", only_if="damping")
    touch = Event("both", "the body reaches the wall", nominal=1e-3)
    press = Event("both", "the wall stops pushing, or pushes again; with damping", only_if="damping")

    def check(self) -> None:
        """Refuse a normal of length zero, or of another shape than the point's."""
        if np.ndim(self.normal) > 1 or np.shape(self.normal) != np.shape(self.point) or not np.any(self.normal):
            raise ParameterError(
                f"found normal={shorten(self.normal)} for point={shorten(self.point)}; expected a direction out of the "
                "wall with as many entries as the point has. Give the normal, such as (0, −1).",
                port="normal",
            )

    def _measure(self, u: Any) -> tuple[Array, Array, Array]:
        """Return n, the depth δ, and k δ + d δ̇."""
        expected = shape_of(self.point)
        for name, value in u._asdict().items():
            if shape_of(value) not in ((expected,) if name == "position" else ((), expected)):
                raise ShapeError(
                    f"found shape {shape_of(value)}; expected {expected}, as the wall's point has. Wire another "
                    "signal, or give another point and normal.",
                    port=name,
                )
        n = self.normal / np.sqrt(np.sum(self.normal * self.normal))
        depth = np.sum(n * (self.point - u.position))
        return n, depth, self.stiffness * depth - self.damping * np.sum(n * u.velocity)

    def _pushes(self, u: Any) -> Array:
        """Return 1 if the wall pushes, else 0; NaN passes through."""
        _, depth, push = self._measure(u)
        inside = np.where(depth > 0.0, 1.0, np.where(depth <= 0.0, 0.0, depth))
        return inside * np.where(push > 0.0, 1.0, np.where(push <= 0.0, 0.0, push))

    @property
    def starts_from_inputs(self) -> bool:
        """Whether there is a state, which `initial` computes."""
        return bool(self.damping)

    def initial(self, u: Any) -> Array:
        """Return 1 if the wall pushes at the start, else 0."""
        return np.asarray(self._pushes(u))

    def output(self, t: Array, x: Any, u: Any, T: Array = None) -> tuple[Array, Array, Array]:
        """Return force, depth and contact."""
        n, depth, push = self._measure(u)
        contact = x.touching if T is None and x else self._pushes(u)
        return n * np.where(contact > 0.5, push, np.where(contact <= 0.5, 0.0, contact)), depth, contact

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Keep the contact."""
        return self._pushes(u)

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, Array] | Array:
        """Return δ and k δ + d δ̇."""
        _, depth, push = self._measure(u)
        return (depth, push) if x else depth

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> Array | tuple[()]:
        """Return the contact after an event, if it is a state."""
        return self._pushes(u) if x else ()


class HandProfile(Block):
    """Push of a human hand: the force rises, is held, and falls. F = e F₀ s(t), with the unit vector e.

    s rises from 0 to 1 over ``rise_time``, stays for ``hold_time`` and falls to 0 over ``release_time``. These are
    7th-order smooth steps, so the force and its first three derivatives are continuous.
    """

    start_time: float = parameter(default=0.0, unit="s", description="time at which the hand begins to push")
    rise_time: float = parameter(default=0.3, unit="s", above=0.0, description="duration of the rise")
    hold_time: float = parameter(unit="s", minimum=0.0, description="duration of the full force")
    release_time: float = parameter(default=0.3, unit="s", above=0.0, description="duration of the fall")
    peak_force: float = parameter(unit="N", description="full force F₀")
    direction: Array = parameter(
        default=1.0,
        unit="1",
        description="direction e; its length does not matter",
        kind=kinds.dimensions(1)
        .where(np.any)
        .worded(
            "a direction that is not zero, such as (1, 0), or 1 or −1 for a scalar force", "Give one.", kinds.shortened
        ),
    )
    force = Output(shape=None, unit="N", description="force on the body, of the direction's shape")

    def _corners(self) -> tuple[Array, Array, Array, Array]:
        """Return the times at which the rise begins and ends, and at which the fall begins and ends."""
        up = self.start_time + self.rise_time
        return self.start_time, up, up + self.hold_time, up + self.hold_time + self.release_time

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the force."""
        start, _, release, _ = self._corners()
        rise = smooth_step(t, start, self.rise_time, 0.0, 1.0)[0]
        fall = smooth_step(t, release, self.release_time, 0.0, 1.0)[0]
        e = self.direction / np.sqrt(np.sum(self.direction * self.direction))
        return e * self.peak_force * (rise - fall)

    def next_instant(self, t: float) -> float:
        """Return the next corner of the profile."""
        return min((corner for corner in self._corners() if corner > t), default=math.inf)
