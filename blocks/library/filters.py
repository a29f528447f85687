"""Filters of sampled subsystems: FIR, moving average, IIR."""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from ..core import Array, Block, Input, Output, ParameterError, State, kinds, lay_out, parameter
from .linear import section
from .remembered_inputs import PastInputs


class FIR(PastInputs):
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

    @property
    def kept(self) -> int:
        """Number of past inputs that are remembered."""
        return len(self.coefficients) - 1

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the weighted sum."""
        return self.coefficients[0] * u.u + self.coefficients[1:][::-1] @ x.line


class MovingAverage(PastInputs):
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

    @property
    def kept(self) -> int:
        """Number of past inputs that are remembered."""
        return self.samples - 1

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the average."""
        return (u.u + np.sum(x.line, axis=0)) / self.samples


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
                "matrices with one row for each section. Give b and a as scipy.signal.butter(…) returns them.",
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
                f"found shape {rows.shape}; expected rows of six numbers. Give those of scipy.signal.butter(…, "
                "output='sos'), or two lists: b and a.",
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
