"""Linear blocks of sampled subsystems: integrator and filters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

import numpy as np

from ..core import Array, Block, Input, Output, ParameterError, State, kinds, lay_out, parameter
from .branching import truth
from .delays import History, push
from .initial_values import StartsAtInput
from .integrators import check_limits, clip
from .linear import section

_WEIGHTS = {"forward": (0.0, 1.0), "backward": (1.0, 0.0), "trapezoidal": (0.5, 0.5)}


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
    value = Input(shape=None, description="value after a reset; with reset_to_input only")
    y = Output(shape=None, description="the integral")
    before = Output(shape=None, secondary=True, description="the sum over the past ticks, before a reset in this one")
    total = State(start="initial_value", like="u", description="the sum over the past ticks")
    last = State(start=1.0, description="reset at the last tick")

    def check(self) -> None:
        """Refuse limits that the sum can't keep."""
        check_limits(self, "initial_value")

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """``u``, ``reset``, and with ``reset_to_input`` ``value``."""
        cls = type(self)
        own = {"u": cls.u, "reset": cls.reset}
        return {**own, "value": cls.value} if self.reset_to_input else own

    def sums(self, x: Any, u: Any, T: Array) -> tuple[Array, Array]:
        """Return y, and the sum from which the next tick starts."""
        target = u.value if self.reset_to_input else self.initial_value
        edge = truth(u.reset) * (1.0 - truth(x.last))
        total = np.where(edge > 0.5, 0.0 * x.total + target, np.where(edge <= 0.5, x.total, edge))
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


class FIR(StartsAtInput, Block):
    """FIR filter: y[k] = c₀ u[k] + c₁ u[k − 1] + … + c_n u[k − n], of a scalar or, element by element, of a vector.

    The inputs before the first tick are ``initial_value``; without it, the input just before t = 0: of a source that
    jumps there, the value before the jump.

    Raises
    ------
    ParameterError
        For fewer than two coefficients.
    SampleTimeError
        In a continuous subsystem, when the diagram is built.
    """

    coefficients: Array = parameter(
        description="c₀, c₁, …, at least two",
        kind=kinds.row.where(lambda c: len(c) > 1).worded("two coefficients or more", "Use Gain for one."),
    )
    initial_value: Array | None = parameter(default=None, description="earlier inputs; None: u just before t = 0")
    u = Input(shape=None, description="signal to filter, a scalar or a vector")
    y = Output(shape=None, description="the filtered input")
    line = History("taps", "initial_value", description="the last inputs, the oldest first, one row for each")
    _rows = "taps"

    @property
    def taps(self) -> int:
        """Number of past inputs that are kept."""
        return len(self.coefficients) - 1

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the weighted sum."""
        return self.coefficients[0] * u.u + self.coefficients[1:][::-1] @ x.line

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Return the history with this input."""
        return push(x.line, u.u)


class MovingAverage(StartsAtInput, Block):
    """Moving average: y[k] = (u[k] + u[k − 1] + … + u[k − n + 1]) / n, of a scalar or a vector.

    The sum is computed in full at each tick, so no rounding error builds up. The inputs before the first tick are
    ``initial_value``; without it, the input just before t = 0: of a source that jumps there, the value before the jump.

    Raises
    ------
    SampleTimeError
        In a continuous subsystem, when the diagram is built.
    """

    samples: int = parameter(minimum=2, description="number of samples in the average, n")
    initial_value: Array | None = parameter(default=None, description="earlier inputs; None: u just before t = 0")
    u = Input(shape=None, description="signal to average, a scalar or a vector")
    y = Output(like="u", description="the average of the last n inputs")
    line = History("taps", "initial_value", description="the last inputs, the oldest first, one row for each")
    _rows = "taps"

    @property
    def taps(self) -> int:
        """Number of past inputs that are kept."""
        return self.samples - 1

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the average."""
        return (u.u + np.sum(x.line, axis=0)) / self.samples

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Return the history with this input."""
        return push(x.line, u.u)


class IIR(Block):
    """IIR filter: Y(z) = (b₀ + b₁ z⁻¹ + …) / (a₀ + a₁ z⁻¹ + …) U(z), in SciPy's convention; it starts at rest.

    With matrices, each row of ``b`` and ``a`` is a section, and the sections follow one another. `from_sos` takes the
    sections that SciPy's filter designs return, such as ``scipy.signal.butter(…, output="sos")``. The realization is
    the transposed direct form II. Give filters of order 4 and more in sections: the coefficients of one long polynomial
    don't define them well.

    Raises
    ------
    ParameterError
        For coefficients that don't fit each other, and an a₀ of zero.
    SampleTimeError
        In a continuous subsystem, when the diagram is built.

    Examples
    --------
    >>> IIR(b=[0.1], a=[1.0, -0.9])
    IIR(b=[0.1], a=[1.0, -0.9])
    """

    b: Array = parameter(description="numerator in powers of 1/z, or one row for each section")
    a: Array = parameter(description="denominator in powers of 1/z, or one row for each section")
    u = Input(description="signal to filter")
    y = Output(description="the filtered input")
    x = State(start=lambda block: np.zeros(sum(block.orders)), description="states of the sections, one after another")

    def check(self) -> None:
        """Refuse coefficients that don't make a filter."""
        shapes = np.shape(self.b), np.shape(self.a)
        alike = len(shapes[0]) == len(shapes[1]) and shapes[0][:-1] == shapes[1][:-1]
        if not alike or len(shapes[0]) not in (1, 2) or 0 in shapes[0] + shapes[1]:
            raise ParameterError(
                f"found b of shape {shapes[0]} and a of shape {shapes[1]}; expected two lists of coefficients, or two "
                "matrices with one row for each section.",
                port="b",
            )
        if np.any(np.asarray(self.a)[..., 0] == 0):
            raise ParameterError(
                "found a first coefficient of zero; expected another number, since all are divided by it. Leave "
                "leading zeros out of b and a.",
                port="a",
            )
        if max(shapes[0][-1], shapes[1][-1]) < 2:
            text = "found one coefficient each; expected two or more. Use Gain."
            raise ParameterError(text, port="b")

    @property
    def orders(self) -> list[int]:
        """Order of each section."""
        rows = self.b.shape[0] if len(self.b.shape) == 2 else 1
        return [max(self.b.shape[-1], self.a.shape[-1]) - 1] * rows

    @classmethod
    def from_sos(cls, sections: Any, *, name: str | None = None) -> Self:
        """Return the filter of second-order sections, in SciPy's rows of b₀, b₁, b₂, a₀, a₁, a₂.

        Raises
        ------
        ParameterError
            For an array of another shape.
        """
        rows = np.asarray(sections, dtype=float)
        if rows.ndim != 2 or rows.shape[1] != 6 or not len(rows):
            raise ParameterError(
                f"found shape {rows.shape}; expected rows of six numbers, as scipy.signal.butter(…, output='sos') "
                "gives.",
                block=name or cls.__name__,
                port="sections",
            )
        return cls(b=rows[:, :3], a=rows[:, 3:], name=name)

    def cascade(self, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the output and the next state."""
        signal, parts = u.u, []
        several = len(self.b.shape) == 2
        for i, (n, place) in enumerate(zip(self.orders, lay_out(self.orders), strict=True)):
            b, a = (_pad(c[i] if several else c, n + 1) for c in (self.b, self.a))
            signal, part = section(b, a, x.x[place], signal)
            parts.append(part)
        return signal, np.concatenate(parts)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the output."""
        return self.cascade(x, u)[0]

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Return the next state."""
        return self.cascade(x, u)[1]


def _pad(coefficients: Array, n: int) -> Array:
    return np.concatenate([coefficients, np.zeros(n - coefficients.shape[0])])
