"""Nonlinear blocks that jump or remember: quantizer, relay, backlash, rate limiter.

In a sampled subsystem they act at the ticks, on every element, and their outputs follow the inputs of the same tick. In
a continuous one their jumps are events, so that the outputs are smooth in between.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np

from ..core import (
    Array,
    Block,
    Event,
    Input,
    Output,
    ParameterError,
    SampleTimeError,
    State,
    check_shapes,
    clip,
    parameter,
    shorten,
)
from .branching import expect_scalar
from .remembered_inputs import StartsAtInput


class Quantizer(Block):
    """Quantizer: y = q ⌊u / q + ½⌋, the nearest multiple of q; a tie goes to the upper one. NaN passes through.

    Linear models have its mean slope, 1, which holds for motions of many steps. In a continuous subsystem it steps by
    events, where u crosses the middle between two multiples; at a tie it keeps its level.

    Raises
    ------
    ShapeError
        For a quantum of another shape than the signal's, and a vector in a continuous subsystem, when the diagram is
        built.
    """

    quanta = MappingProxyType({"u": "quantum"})
    quantum: Array = parameter(above=0.0, description="distance q of two levels, a number or one for each element")
    u = Input(shape=None, description="signal to quantize, of any shape")
    y = Output(like="u", description="the quantized signal")
    level = State(like="u", discrete=True, description="number of the level, y / q")
    up = Event("rising", "the signal passes the middle to the next level above")
    down = Event("rising", "the signal passes the middle to the next level below")

    def nearest_level(self, u: Any) -> Array:
        """Return the number of the level nearest to u."""
        check_shapes(quantum=self.quantum, u=u.u)
        ratio = u.u / self.quantum
        level = np.floor(ratio + 0.5)
        return np.where(level - 0.5 > ratio, level - 1.0, level)  # just below a middle the sum is rounded up

    def initial(self, u: Any) -> Array:
        """Return the level at the start."""
        return np.asarray(self.nearest_level(u))

    def output(self, t: Array, x: Any, u: Any, T: Array = None) -> Array:
        """Return the quantized signal."""
        return self.quantum * (x.level if T is None else self.nearest_level(u))

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Keep the level."""
        return self.nearest_level(u)

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the distances of u beyond the middles to both sides, in quanta."""
        off = expect_scalar(u.u, "u") / self.quantum - x.level
        return off - 0.5, -0.5 - off

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> Array:
        """Return the nearest level."""
        return self.nearest_level(u)


class Relay(Block):
    """Relay with hysteresis: it turns on when u > on_point, off when u ≤ off_point, and else stays.

    y is ``on_value`` or ``off_value``. If it starts between the points, ``initially_on`` decides. Equal points make a
    sign function, which can chatter in a loop; set the points apart to end that. In a continuous subsystem it switches
    by events.

    Raises
    ------
    ParameterError
        For an ``off_point`` above the ``on_point``.
    ShapeError
        For points and a signal of different shapes, and for a vector in a continuous subsystem, when the diagram is
        built.
    """

    on_point: Array = parameter(description="the relay turns on above it")
    off_point: Array = parameter(description="the relay turns off at or below it")
    on_value: Array = parameter(default=1.0, description="output when on")
    off_value: Array = parameter(default=0.0, description="output when off")
    initially_on: bool = parameter(default=False, description="whether it is on if it starts between the points")
    u = Input(shape=None, description="signal that switches it, of any shape")
    y = Output(shape=None, description="on_value or off_value")
    on = State(like="u", discrete=True, description="1 when on, 0 when off")
    rise = Event("rising", "the signal passes the point at which the relay turns on")
    fall = Event("falling", "the signal reaches the point at which the relay turns off")

    def check(self) -> None:
        """Refuse points in the wrong order."""
        check_shapes(on_point=self.on_point, off_point=self.off_point)
        if np.any(np.asarray(self.off_point) > np.asarray(self.on_point)):
            raise ParameterError(
                f"found off_point={shorten(self.off_point)} above on_point={shorten(self.on_point)}; expected it at or "
                "below. Exchange them; for a relay that turns on below a point, exchange its values as well.",
                port="off_point",
            )

    def decide(self, on: Array, u: Any) -> Array:
        """Return 1 where the relay is on now, else 0, from its last position; NaN passes through."""
        check_shapes(on_point=self.on_point, off_point=self.off_point, u=u.u)
        between = np.where(u.u <= self.on_point, on, u.u)
        return np.where(u.u > self.on_point, 1.0, np.where(u.u <= self.off_point, 0.0, between))

    def initial(self, u: Any) -> Array:
        """Return the state at the start."""
        return np.asarray(self.decide(1.0 if self.initially_on else 0.0, u))

    def output(self, t: Array, x: Any, u: Any, T: Array = None) -> Array:
        """Return ``on_value`` or ``off_value``."""
        on = x.on if T is None else self.decide(x.on, u)
        check_shapes(on_value=self.on_value, off_value=self.off_value, u=u.u)
        return np.where(on > 0.5, self.on_value, np.where(on <= 0.5, self.off_value, on))

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Keep the position."""
        return self.decide(x.on, u)

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the distances of u above the two points."""
        return expect_scalar(u.u, "u") - self.on_point, u.u - self.off_point

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> Array:
        """Return the position after an event."""
        return self.decide(x.on, u)


class Backlash(Block):
    """Backlash (play): y rests within a dead band, and the ends of the band carry it along: y − b/2 ≤ u ≤ y + b/2.

    y moves with u once the band is used up, y = u ∓ b/2, and rests as soon as u turns. At a tick, exactly:
    y[k] = y[k − 1] limited to [u[k] − b/2, u[k] + b/2]. Before the first tick y is ``initial_value``; without it, the
    input just before t = 0: of a source that jumps there, the value before the jump.

    In a continuous subsystem y starts and stops by events. There u must not jump, and its rate is a second input, whose
    sign shows where u turns: ``Backlash(width=…, with_rate=True)(angle, speed)``.

    Raises
    ------
    SampleTimeError
        In a continuous subsystem without ``with_rate``, when the diagram is built.
    ShapeError
        For a width of another shape than the signal's, and a vector in a continuous subsystem, when the diagram is
        built.
    """

    width: Array = parameter(above=0.0, description="width b of the dead band, a number or one for each element")
    initial_value: Array | None = parameter(
        default=None, description="y at the start, limited to the band; None: y = u just before t = 0"
    )
    with_rate: bool = parameter(default=False, description="True adds the input rate, which events need")
    u = Input(shape=None, description="position of the band, of any shape")
    rate = Input(shape=None, description="time derivative of u; with with_rate only", only_if="with_rate")
    y = Output(like="u", description="position that is carried along")
    rest = State(like="u", discrete=True, description="y at rest; at ticks the last value")
    drive = State(like="u", discrete=True, description="1 when driven up, −1 when driven down, 0 at rest")
    push = Event("rising", "the lower end of the band takes y along")
    pull = Event("rising", "the upper end of the band takes y along")
    turn = Event("falling", "the signal turns, and y rests")

    def carry(self, y: Array, u: Any) -> Array:
        """Return y limited to the band; NaN passes through."""
        check_shapes(width=self.width, u=u.u)
        low, high = u.u - 0.5 * self.width, u.u + 0.5 * self.width
        return np.where(y < low, low, np.where(y > high, high, np.where(low <= high, y, u.u)))

    def initial(self, u: Any) -> tuple[Array, Array]:
        """Return y at the start, at rest."""
        signal = np.asarray(u.u, dtype=float)
        y = signal if self.initial_value is None else self.carry(np.asarray(self.initial_value), u)
        return np.asarray(y), np.zeros(signal.shape)

    def output(self, t: Array, x: Any, u: Any, T: Array = None) -> Array:
        """Return y."""
        if T is not None:
            return self.carry(x.rest, u)
        driven = u.u - 0.5 * x.drive * self.width
        return np.where(np.abs(x.drive) > 0.5, driven, x.rest)

    def update(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Keep y."""
        return self.carry(x.rest, u), x.drive

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, Array, Array]:
        """Return the distances of the band's ends beyond the resting y, and the rate in the driven direction."""
        if not self.with_rate:
            raise SampleTimeError(
                "found no rate; expected the rate of u in a continuous subsystem, to see where u turns. Wire it, "
                "Backlash(width=…, with_rate=True)(u, rate), or put the block into a @subsystem(sample_time=…).",
                port="rate",
            )
        low, high = expect_scalar(u.u, "u") - 0.5 * self.width, u.u + 0.5 * self.width
        return low - x.rest, x.rest - high, x.drive * expect_scalar(u.rate, "rate")

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[Array, Array]:
        """Return the resting y, and the direction in which y is driven after an event."""
        ends = fired.push - fired.pull  # the end that y has reached: 1, −1 or none
        drive = np.where(np.abs(ends) > 0.5, ends, x.drive)
        drive = np.where(drive * u.rate > 0.0, drive, 0.0)  # u must continue towards that end
        stays = np.where(np.abs(ends) > 0.5, u.u - 0.5 * ends * self.width, self.output(t, x, u))
        return np.where(np.abs(drive) > 0.5, x.rest, stays), drive  # while driven, rest keeps its last value


class RateLimiter(StartsAtInput, Block):
    """Rate limiter: y follows u, and rises and falls no faster than the limits.

    At a tick, exactly: y[k] = y[k − 1] + (u[k] − y[k − 1] limited to [−falling·T, rising·T]). Before the first tick y
    is ``initial_value``; without it, the input just before t = 0. So the first output is the first input, unless a
    source jumps at t = 0: then y leaves the value before the jump at the limited rate.

    In a continuous subsystem the rate of u is not known, and ẏ = ((u − y) / τ limited to [−falling, rising]). Within
    the limits y has the lag τ: it is τ r behind a ramp of rate r. It needs no events.

    Raises
    ------
    SampleTimeError
        In a continuous subsystem without a ``time_constant``, when the diagram is built.
    ShapeError
        For limits and a signal of different shapes, when the diagram is built.
    """

    rising: Array = parameter(above=0.0, description="largest rate upwards, in the signal's unit per second")
    falling: Array | None = parameter(default=None, above=0.0, description="largest rate downwards; None: as upwards")
    time_constant: float | None = parameter(
        default=None, unit="s", above=0.0, description="lag τ within the limits, in a continuous subsystem"
    )
    initial_value: Array | None = parameter(default=None, description="y before the start; None: u just before t = 0")
    u = Input(shape=None, description="signal to follow, of any shape")
    y = Output(like="u", description="the limited signal")
    last = State(start="initial_value", like="u", description="y at the last tick; in a continuous subsystem y itself")

    def clip_change(self, change: Array, span: Array) -> Array:
        """Return a change within the limits for a span of time."""
        falling = self.rising if self.falling is None else self.falling
        check_shapes(rising=self.rising, falling=falling, u=change)
        return clip(change, -falling * span, self.rising * span)

    def output(self, t: Array, x: Any, u: Any, T: Array = None) -> Array:
        """Return y."""
        return x.last if T is None else x.last + self.clip_change(u.u - x.last, T)

    def update(self, t: Array, x: Any, u: Any, T: Array = None) -> Array:
        """Keep y."""
        return self.output(t, x, u, T)

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return ẏ in a continuous subsystem."""
        if self.time_constant is None:
            raise SampleTimeError(
                "found none; expected a lag in a continuous subsystem. Give RateLimiter(time_constant=…) in s, short "
                "next to the times that matter, or put the block into a @subsystem(sample_time=…), where it is exact.",
                port="time_constant",
            )
        return self.clip_change((u.u - x.last) / self.time_constant, 1.0)
