"""Delays: by whole samples, by a time, and Padé's rational approximation."""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from math import factorial
from typing import Any, ClassVar

import numpy as np

from ..core import Array, Block, Input, Output, SampleTimeError, State, exact_number, parameter
from .remembered_inputs import PastInputs


class Delay(PastInputs):
    """Delay by whole samples: y[k] = u[k − n].

    The first n outputs are ``initial_value``; without it, the input just before t = 0: of a source that jumps there,
    the value before the jump.

    Raises
    ------
    SampleTimeError
        In a continuous subsystem, when the diagram is built.
    ShapeError
        For an ``initial_value`` of another shape than the input's, and for a matrix as input, when the diagram is
        built.
    """

    steps: int = parameter(minimum=1, description="number of samples, n")
    initial_value: Array | None = parameter(default=None, description="first outputs; None: u just before t = 0")
    u = Input(shape=None, description="signal to delay, a scalar or a vector")
    y = Output(like="u", description="the input n ticks ago")

    @property
    def kept(self) -> int:
        """Number of past inputs that are remembered, n."""
        return self.steps

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the oldest input."""
        return x.line[0]


class VariableDelay(PastInputs):
    """Delay of a sampled subsystem that varies: y[k] = u(t_k − τ[k]), with straight lines between the samples of u.

    The delay is an input, from 0 to ``samples`` times the sample time; beyond it the run stops. Before the start u is
    ``initial_value``; without it, the input just before t = 0. With τ = n T it is `Delay`.

    Raises
    ------
    SampleTimeError
        In a continuous subsystem, when the diagram is built; a `TransportDelay` there has one delay.
    ShapeError
        For an ``initial_value`` of another shape than the input's, and for a matrix as input, when the diagram is
        built.
    """

    samples: int = parameter(minimum=1, description="longest delay, in samples")
    initial_value: Array | None = parameter(default=None, description="u before the start; None: u just before t = 0")
    u = Input(shape=None, description="signal to delay, a scalar or a vector")
    delay = Input(unit="s", description="delay τ")
    y = Output(like="u", description="the input τ ago")

    @property
    def kept(self) -> int:
        """Number of past inputs that are remembered, as many as the longest delay."""
        return self.samples

    @property
    def drawn_inside(self) -> str:
        """What a drawing shows."""
        return "u(t − τ)"

    def guards(self, t: Array, x: Any, u: Any, T: Array) -> dict[str, Array]:
        """Return the distances of the delay from its limits, in samples, beyond rounding."""
        return {"delay of 0 or more": u.delay / T + 1e-9, "longest delay": self.samples - u.delay / T + 1e-9}

    def output(self, t: Array, x: Any, u: Any, T: Array) -> Array:
        """Return the input of that time."""
        back = u.delay / T
        y = 0.0
        for n in range(self.samples + 1):  # the share of the sample n ticks ago: a hat of width 2 around n
            distance = np.abs(back - n)
            share = np.where(distance >= 1.0, 0.0, 1.0 - distance)  # a delay that is NaN gives NaN
            y = y + share * (u.u if n == 0 else x.line[-n])
        return y


class TransportDelay(Block):
    """Transport delay: y(t) = u(t − τ), of any shape, and ``initial_value`` while t < τ.

    With ``initial_value=None`` that is the input at t = 0, after a jump there; in a sampled subsystem the input just
    before t = 0, as of `Delay`.

    In a continuous subsystem the solver keeps past inputs. In a sampled subsystem the delay must be a whole number of
    samples; `discretize` returns the block that then replaces this one.

    Raises
    ------
    SampleTimeError
        In a sampled subsystem, if the delay is no multiple of its sample time, when the diagram is built.
    ShapeError
        For an ``initial_value`` of another shape than the input's, when the diagram is built; a number fits any.
    """

    transport: ClassVar[bool] = True
    """True: a solver gives the input of the time ``delay`` ago."""
    delay: float = parameter(
        unit="s", above=0.0, description="delay τ; without one leave the block out, and begin a sweep at a small one"
    )
    initial_value: Array | None = parameter(default=0.0, description="output while t < τ; None: the input at t = 0")
    u = Input(shape=None, description="signal to delay, of any shape")
    y = Output(like="u", description="the input τ ago")

    def discretize(self, sample_time: float | Fraction) -> Delay:
        """Return the delay by whole samples that replaces this block in a sampled subsystem.

        Raises
        ------
        SampleTimeError
            If the delay is no multiple of the sample time. A float is read as a sample time is.
        """
        T = sample_time if isinstance(sample_time, Fraction) else exact_number(sample_time)
        ratio = exact_number(self.delay) / T
        n = round(ratio)
        if n < 1 or abs(ratio / n - 1) > Fraction(1, 10**9):
            low, high = max(int(ratio), 1), int(ratio) + 1
            near = f"{float(low * T):.9g} s" if low == high else f"{float(low * T):.9g} s or {float(high * T):.9g} s"
            raise SampleTimeError(
                f"found a delay of {self.delay:.9g} s in a subsystem with a sample time of {float(T):.9g} s; expected "
                f"a multiple of it. The nearest: {near}. Change one of the two, or put the block outside of the "
                "subsystem.",
                block=self.label,
                port="delay",
            )
        return Delay(steps=n, initial_value=self.initial_value, name=self.name)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Refuse a subsystem without past inputs."""
        raise SampleTimeError(
            "found no past inputs in its subsystem; expected a solver that keeps them. Use Delay(steps=…) in a sampled "
            f"subsystem, PadeDelay(delay={self._delay_text()}, order=…) in a continuous one.",
            block=self.label,
        )

    def _delay_text(self) -> str:
        return f"{self.delay:g}" if isinstance(self.delay, float) else "…"


@lru_cache(maxsize=64)
def _ladder(order: int) -> tuple[float, ...]:
    """Return the entries of the Padé delay's ladder in s τ / 2: β² and the squares of the couplings."""
    # The denominator is the reverse Bessel polynomial θ(z) of z = s τ / 2, the whole θ(−z) / θ(z). The quotient of the
    # lower and the higher of its even and odd part is the continued fraction β² / (z + c₁ / (z + c₂ / (z + …))), whose
    # entries come from Routh's table of θ, in fractions.
    theta = [
        Fraction(factorial(order + k), factorial(order - k) * factorial(k) * 2**k) for k in range(order + 1)
    ]  # highest power first
    high, low = theta[0::2], theta[1::2]
    quotients = []
    while low:
        quotients.append(low[0] / high[0])
        rest = [h - low[i] * high[0] / low[0] if i < len(low) else h for i, h in enumerate(high)][1:]
        high, low = low, rest
    couplings = (a * b for a, b in pairwise(quotients))
    return tuple(map(float, (quotients[0], *couplings)))


class PadeDelay(Block):
    """Padé approximation of a delay: Y(s) = θ(−s τ / 2) / θ(s τ / 2) U(s) ≈ e^(−s τ) U(s), with θ of degree n.

    The block is an all-pass: its gain is 1 at every frequency, its phase that of the delay up to about ω τ = n. A jump
    of the input appears in the output at once, with the sign (−1)ⁿ. θ is the reverse Bessel polynomial. The realization
    is a lossless ladder with a resistor at one end, τ/2 ẋ = (J − b bᵀ / 2) x + b u, y = (−1)ⁿ (u − bᵀ x). It is
    balanced: in the time 2 t / τ both Gramians are the unit matrix. It starts in the steady state of ``initial_value``.
    """

    delay: float = parameter(unit="s", above=0.0, description="delay τ")
    order: int = parameter(default=3, minimum=1, maximum=30, description="degree n, which is also the number of states")
    initial_value: float = parameter(default=0.0, description="input and output before the start")
    u = Input(description="signal to delay")
    y = Output(description="approximately the input τ ago")
    x = State(start=lambda block: block.steady_state() * block.initial_value, description="states of the ladder")

    def ladder(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the matrix and the input column in s τ / 2."""
        first, *couplings = _ladder(self.order)
        matrix = np.diag(np.sqrt(couplings), 1) - np.diag(np.sqrt(couplings), -1)
        matrix[0, 0] = -first
        column = np.zeros(self.order)
        column[0] = np.sqrt(2.0 * first)
        return matrix, column

    def steady_state(self) -> np.ndarray:
        """Return the state at rest for a constant input of 1."""
        matrix, column = self.ladder()
        return -np.linalg.solve(matrix, column)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the approximate delayed input."""
        return (-1.0) ** self.order * (u.u - self.ladder()[1][0] * x.x[0])

    def derivative(self, t: Array, x: Any, u: Any) -> Array:
        """Return ẋ."""
        matrix, column = self.ladder()
        return (matrix @ x.x + column * u.u) * (2.0 / self.delay)
