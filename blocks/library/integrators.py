"""Integrators, plain, limited, resettable or discrete, and the filtered derivative."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core import Array, Block, Event, Input, Output, ParameterError, ShapeError, State, clip, kinds, parameter
from .branching import truth
from .remembered_inputs import StartsAtInput

_WEIGHTS = {"forward": (0.0, 1.0), "backward": (1.0, 0.0), "trapezoidal": (0.5, 0.5)}
"""Shares of this tick's and of the last tick's input in a sum, by rule."""


class Integrator(Block):
    """Integrator: ẏ = u, element by element.

    In a sampled subsystem every method gives y[k + 1] = y[k] + T u[k], which is exact for an input that is held.

    Raises
    ------
    ShapeError
        For an ``initial_value`` of another shape than the input's, when the diagram is built; a number fits any.
    """

    initial_value: Array = parameter(default=0.0, description="y at the start, a number or of the input's shape")
    u = Input(shape=None, description="signal to integrate, of any shape")
    y = State(start="initial_value", like="u", output=True, description="the integral")

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return the input."""
        return u.u


def check_limits(block: Any, start: str | None = None) -> None:
    """Refuse limits in the wrong order, and a start value (the parameter ``start``) outside of them."""
    low, high = (np.inf * s if v is None else v for s, v in ((-1.0, block.lower), (1.0, block.upper)))
    if not low < high:
        raise ParameterError(
            f"found lower={low:g} and upper={high:g}; expected lower below upper. Exchange them.",
            port="lower",
        )
    value = None if start is None else getattr(block, start)
    if start is not None and value is not None and not np.all((value >= low) & (value <= high)):
        raise ParameterError(
            f"found {value!r}; expected a value within the limits, {low:g} to {high:g}. Move it, or a limit.",
            port=start,
        )


def restart_at_edge(total: Array, target: Array, reset: Array, last: Array) -> Array:
    """Return a sum at a tick: ``target`` at a rising edge of ``reset``, known from its last value; NaN passes."""
    edge = truth(reset) * (1.0 - truth(last))
    return np.where(edge > 0.5, target, np.where(edge <= 0.5, total, edge))


def _excess(y: Array, lower: Array | None, upper: Array | None) -> tuple[Array, Array]:
    """Return the distance of y beyond the nearer limit (negative inside), and its side: 1 upper, −1 lower."""
    if lower is None:
        return y - upper, 1.0 + 0.0 * y
    if upper is None:
        return lower - y, -1.0 + 0.0 * y
    above = y - upper > lower - y
    return np.where(above, y - upper, lower - y), np.where(above, 1.0, -1.0)


class _Limits:
    """Common part of integrators with limits: ``held`` is 1 while y is held at ``upper``, −1 at ``lower``, else 0."""

    lower: Any
    upper: Any

    def find_side(self, y: Array) -> Array:
        """Return ``held`` in a sampled subsystem: 1 or −1 where y is at a limit."""
        held = 0.0 * y
        held = held if self.upper is None else np.where(y >= self.upper, 1.0, held)
        return held if self.lower is None else np.where(y <= self.lower, -1.0, held)

    def limit_indicators(self, y: Array, held: Array, u: Array) -> tuple[Array, Array]:
        """Return the indicators of ``reached`` and ``released``; an event that can't happen now has −1."""
        if getattr(u, "shape", ()):
            raise ShapeError(
                f"found shape {u.shape}; expected a scalar in a continuous subsystem, where each limit is an event. "
                "Index the signal and give each entry its own integrator.",
                port="u",
            )
        free = np.abs(held) < 0.5
        return np.where(free, _excess(y, self.lower, self.upper)[0], -1.0), np.where(free, -1.0, -held * u)

    def limit_jump(self, y: Array, held: Array, fired: Any) -> tuple[Array, Array]:
        """Return y and ``held`` after ``reached``, which puts y exactly onto the limit, or ``released``."""
        side = _excess(y, self.lower, self.upper)[1]
        low, high = (y if v is None else v for v in (self.lower, self.upper))
        reached, released = fired.reached > 0.5, fired.released > 0.5
        onto = np.where(side > 0.0, high, low)
        return np.where(reached, onto, y), np.where(reached, side, np.where(released, 0.0, held))


class LimitedIntegrator(_Limits, Block):
    """Integrator with limits: ẏ = u, but held at a limit while u drives outward.

    In a sampled subsystem y[k + 1] = y[k] + T u[k], limited, which is exact for an input that is held. In a continuous
    one a limit is an event, and so is the input's change of sign that releases y; the input is a scalar there. The
    secondary output ``held`` names the limit at which y is held.

    Raises
    ------
    ParameterError
        For no limit, limits in the wrong order, and an ``initial_value`` outside of them.
    ShapeError
        For a vector in a continuous subsystem, when the diagram is built.
    """

    lower: float | None = parameter(default=None, description="lower limit of y; None: there is none")
    upper: float | None = parameter(default=None, description="upper limit of y; None: there is none")
    initial_value: Array = parameter(default=0.0, description="y at the start, a number or of the input's shape")
    u = Input(shape=None, description="signal to integrate; a scalar in a continuous subsystem")
    y = State(start="initial_value", like="u", output=True, description="the integral")
    side = State(like="u", discrete=True, description="1 while held at the upper limit, −1 at the lower, else 0")
    held = Output(shape=None, secondary=True, description="1 while held at the upper limit, −1 at the lower, else 0")
    reached = Event("rising", "y reaches a limit")
    released = Event("rising", "the input turns inward")

    def check(self) -> None:
        """Refuse an integrator without limits, and limits that y can't keep."""
        if self.lower is None and self.upper is None:
            text = "found no limit; expected one or two. Give lower, upper or both, or use Integrator."
            raise ParameterError(text)
        check_limits(self, "initial_value")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return ``held``."""
        return x.side

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return the input, or zero at a limit."""
        return np.where(np.abs(x.side) > 0.5, 0.0, u.u)

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the distance of y beyond a limit, and the inward rate of the input."""
        return self.limit_indicators(x.y, x.side, u.u)

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[Array, Array]:
        """Hold y, or release it."""
        return self.limit_jump(x.y, x.side, fired)

    def update(self, t: Array, x: Any, u: Any, T: Array) -> tuple[Array, Array]:
        """Return the limited integral at the next tick."""
        new = clip(x.y + T * u.u, self.lower, self.upper)
        return new, self.find_side(new)


class ResettableIntegrator(_Limits, Block):
    """Integrator with a reset: ẏ = u; y = value at a rising edge of ``reset``.

    ``value`` is ``initial_value``, or with ``reset_to_input`` an input. Limits are optional, as in `LimitedIntegrator`.
    In a continuous subsystem an edge is an event. In a sampled one the output is the reset value in the tick of the
    edge already, so ``reset`` feeds through to ``y``. The secondary output ``before`` is the integral before a reset in
    this tick; it has no feedthrough and serves loops that reset themselves. A signal that is true at the start is no
    edge.

    Raises
    ------
    ParameterError
        For limits in the wrong order, and an ``initial_value`` outside of them.
    ShapeError
        For a vector in combination with limits in a continuous subsystem, when the diagram is built.
    """

    initial_value: Array = parameter(default=0.0, description="y at the start, a number or of the input's shape")
    reset_to_input: bool = parameter(default=False, description="True adds the input value, to which y is reset")
    lower: float | None = parameter(default=None, description="lower limit of y; None: there is none")
    upper: float | None = parameter(default=None, description="upper limit of y; None: there is none")
    u = Input(shape=None, description="signal to integrate; with limits a scalar in a continuous subsystem")
    reset = Input(description="logic: a rising edge resets")
    value = Input(shape=None, description="value after a reset; with reset_to_input only", only_if="reset_to_input")
    y = Output(like="u", description="the integral")
    before = Output(like="u", secondary=True, description="the integral before a reset in this tick")
    integral = State(start="initial_value", like="u", description="the integral")
    last = State(start=1.0, discrete=True, description="reset at the last tick, in a sampled subsystem")
    side = State(
        like="u",
        discrete=True,
        description="1 while held at the upper limit, −1 at the lower; with limits",
        only_if="has_limits",
    )
    restart = Event("rising", "an edge of reset")
    reached = Event("rising", "y reaches a limit; with limits", only_if="has_limits")
    released = Event("rising", "the input turns inward; with limits", only_if="has_limits")

    def check(self) -> None:
        """Refuse limits that y can't keep."""
        check_limits(self, "initial_value")

    @property
    def has_limits(self) -> bool:
        """Whether there are limits."""
        return self.lower is not None or self.upper is not None

    def reset_value(self, x: Any, u: Any) -> Array:
        """Return y after a reset, of the integral's shape."""
        target = u.value if self.reset_to_input else self.initial_value
        return clip(0.0 * x.integral + target, self.lower, self.upper)

    def value_at_tick(self, x: Any, u: Any) -> Array:
        """Return y at a tick."""
        return restart_at_edge(x.integral, self.reset_value(x, u), u.reset, x.last)

    def output(self, t: Array, x: Any, u: Any, T: Array = None) -> tuple[Array, Array]:
        """Return the integral after and before a reset in this tick."""
        return (x.integral if T is None else self.value_at_tick(x, u)), x.integral

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return the input, or zero at a limit."""
        rate = u.u + 0.0 * x.integral
        return np.where(np.abs(x.side) > 0.5, 0.0, rate) if self.has_limits else rate

    def indicators(self, t: Array, x: Any, u: Any) -> Any:
        """Return the indicators of the reset and of the limits."""
        restart = u.reset - 0.5
        return (restart, *self.limit_indicators(x.integral, x.side, u.u)) if self.has_limits else restart

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[Array, ...]:
        """Return the states after a reset; else hold y, or release it."""
        restart, value = fired.restart > 0.5, self.reset_value(x, u)
        if not self.has_limits:
            return np.where(restart, value, x.integral), x.last
        y, side = self.limit_jump(x.integral, x.side, fired)
        return np.where(restart, value, y), x.last, np.where(restart, 0.0, side)

    def update(self, t: Array, x: Any, u: Any, T: Array) -> tuple[Array, ...]:
        """Return the integral at the next tick."""
        new = clip(self.value_at_tick(x, u) + T * u.u, self.lower, self.upper)
        return (new, u.reset, self.find_side(new)) if self.has_limits else (new, u.reset)


class DiscreteIntegrator(Block):
    """Discrete integrator: a sum in place of an integral, by one of three rules, element by element.

    ``forward`` y[k] = y[k − 1] + T u[k − 1], ``backward`` y[k] = y[k − 1] + T u[k], ``trapezoidal`` y[k] = y[k − 1] + T
    (u[k − 1] + u[k]) / 2. Before the first tick the input counts as zero. With limits every sum is limited, so that
    nothing winds up. At a rising edge of ``reset`` the sum restarts in the same tick, from ``initial_value`` or, with
    ``reset_to_input``, from the input ``value``. A signal that is true at the start is no edge. The secondary output
    ``before`` is the sum over the past ticks, before a reset, without feedthrough.

    Raises
    ------
    ParameterError
        For another rule, limits in the wrong order, and an ``initial_value`` outside of them.
    SampleTimeError
        In a continuous subsystem, when the diagram is built.
    """

    method: str = parameter(
        default="forward",
        description="'forward', 'backward' or 'trapezoidal'",
        kind=kinds.choice(*_WEIGHTS).worded(f"one of {', '.join(map(repr, _WEIGHTS))}"),
    )
    gain: float = parameter(default=1.0, description="factor of the input")
    initial_value: Array = parameter(default=0.0, description="the sum at the start, a number or of the input's shape")
    lower: float | None = parameter(default=None, description="lower limit of y; None: there is none")
    upper: float | None = parameter(default=None, description="upper limit of y; None: there is none")
    reset_to_input: bool = parameter(default=False, description="True adds the input value, to which y is reset")
    u = Input(shape=None, description="signal to integrate, of any shape")
    reset = Input(default=0.0, description="logic: a rising edge resets")
    value = Input(shape=None, description="value after a reset; with reset_to_input only", only_if="reset_to_input")
    y = Output(shape=None, description="the integral")
    before = Output(shape=None, secondary=True, description="the sum over the past ticks, before a reset in this one")
    total = State(start="initial_value", like="u", description="the sum over the past ticks")
    last = State(start=1.0, description="reset at the last tick")

    def check(self) -> None:
        """Refuse limits that the sum can't keep."""
        check_limits(self, "initial_value")

    def sums(self, x: Any, u: Any, T: Array) -> tuple[Array, Array]:
        """Return y, and the sum from which the next tick starts."""
        target = u.value if self.reset_to_input else self.initial_value
        total = restart_at_edge(x.total, 0.0 * x.total + target, u.reset, x.last)
        now, then = _WEIGHTS[self.method]
        area = self.gain * T * u.u
        y = clip(total + now * area if now else total, self.lower, self.upper)
        return y, clip(y + then * area if then else y, self.lower, self.upper)

    def output(self, t: Array, x: Any, u: Any, T: Array) -> tuple[Array, Array]:
        """Return the integral, and the sum over the past ticks."""
        return self.sums(x, u, T)[0], x.total

    def update(self, t: Array, x: Any, u: Any, T: Array) -> tuple[Array, Array]:
        """Return the sum that includes this tick, and ``reset``."""
        return self.sums(x, u, T)[1], u.reset


class FilteredDerivative(StartsAtInput, Block):
    """Filtered derivative: Y(s) = s / (T_f s + 1) U(s), element by element.

    T_f ẋ = u − x, y = (u − x) / T_f. The filter starts at ``initial_value``; without it, at the input just before t =
    0, so that y is zero at the start, unless a source jumps there.

    Raises
    ------
    ShapeError
        For an ``initial_value`` of another shape than the input's, when the diagram is built; a number fits any.
    """

    time_constant: float = parameter(unit="s", above=0.0, description="time constant of the filter, T_f")
    initial_value: Array | None = parameter(default=None, description="x at the start; None: u just before t = 0")
    u = Input(shape=None, description="signal to differentiate, of any shape")
    y = Output(shape=None, description="the filtered derivative")
    filtered = State(start="initial_value", like="u", description="the filtered input, x")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the derivative of the filtered input."""
        return (u.u - x.filtered) / self.time_constant

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return ẋ, which is y."""
        return (u.u - x.filtered) / self.time_constant

    def to_control(self) -> Any:
        """Return the `control.TransferFunction` of a scalar input, s / (T_f s + 1), with the block's name."""
        import control

        return control.tf([1.0, 0.0], [self.time_constant, 1.0], name=self.name)
