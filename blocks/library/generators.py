"""Test signals: ramps, chirps, pulse trains, other waves, the clock.

Times are in s; a change at ``t0`` acts from the first instant t ≥ t0 on. A periodic signal is computed from the number
of the period, never by adding up periods: period k begins at k times the period as it is written in decimals, at any t.
An instant that is a few rounding errors before such an edge (1e-15 t) counts as the edge itself. So with a period of
0.1 s the tick at 0.3 s, which is less than three times the number nearest to 0.1, belongs to the fourth period.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..core import Array, Output, ParameterError, Source, exact_number, kinds, next_edge, parameter, period_of


class Clock(Source):
    """Clock: y = t."""

    unit: str | None = parameter(default="s", description="unit of the output")
    y = Output(description="time")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the time."""
        return t


class Ramp(Source):
    """Ramp: y = y₀ until the start time t₀, then y₀ + slope (t − t₀)."""

    slope: float = parameter(description="rate of change, per s")
    start_time: float = parameter(default=0.0, unit="s", description="time at which the ramp begins, t₀")
    initial_value: float = parameter(default=0.0, description="value before the ramp, y₀")
    y = Output()

    def instants(self) -> Array:
        """Return the start time."""
        return np.array([self.start_time])

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the ramp."""
        return self.initial_value + self.slope * np.where(t > self.start_time, t - self.start_time, 0.0)


class Chirp(Source):
    """Chirp, a sine whose frequency runs from f₀ to f₁: y = A sin(φ₀ + φ(τ)) + bias, τ = t − t₀ within [0, D].

    ``linear``: φ = 2π (f₀ τ + (f₁ − f₀) τ² / (2 D)), the frequency φ̇/2π = f₀ + (f₁ − f₀) τ/D. ``logarithmic``: φ = 2π
    f₀ D / λ (exp(λ τ/D) − 1), λ = ln(f₁/f₀), the frequency f₀ exp(λ τ/D): equal times for equal ratios. Before t₀ the
    phase is φ₀; after t₀ + D the sine continues at the frequency f₁.

    Raises
    ------
    ParameterError
        For another sweep, and for a logarithmic one from or to zero or between equal frequencies.
    """

    amplitude: float = parameter(default=1.0, description="amplitude A")
    start_frequency: float = parameter(unit="Hz", minimum=0.0, description="frequency at the start, f₀")
    end_frequency: float = parameter(unit="Hz", minimum=0.0, description="frequency at the end, f₁")
    duration: float = parameter(unit="s", above=0.0, description="duration of the sweep, D")
    sweep: str = parameter(
        default="linear", description="'linear' or 'logarithmic'", kind=kinds.choice("linear", "logarithmic")
    )
    start_time: float = parameter(default=0.0, unit="s", description="time at which the sweep starts, t₀")
    phase: float = parameter(default=0.0, unit="rad", description="phase at the start, φ₀")
    bias: float = parameter(default=0.0, description="mean value")
    y = Output()

    def check(self) -> None:
        """Refuse a sweep that is not defined."""
        super().check()
        first, last = self.start_frequency, self.end_frequency
        if self.sweep == "logarithmic" and (min(first, last) == 0.0 or first == last):
            raise ParameterError(
                f"found {first:g} and {last:g} Hz; expected two different frequencies above zero for a logarithmic "
                "sweep. Take sweep='linear'.",
                port="start_frequency",
            )

    def instants(self) -> Array:
        """Return the times at which the sweep starts and ends."""
        return np.array([self.start_time, self.start_time + self.duration])

    def time_scale(self) -> float:
        """Return a tenth of the shortest period."""
        fastest = max(self.start_frequency, self.end_frequency)
        return 0.1 / fastest if fastest else math.inf

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the sweep."""
        first, last, D = self.start_frequency, self.end_frequency, self.duration
        tau = np.where(t > self.start_time, t - self.start_time, 0.0)
        after = np.where(tau > D, tau - D, 0.0)
        tau = np.where(tau > D, D, tau)
        if self.sweep == "linear":
            turns = tau * (first + (last - first) * tau / (2.0 * D))
        else:
            rate = np.log(last / first) / D
            turns = first * np.expm1(rate * tau) / rate
        return self.amplitude * np.sin(2.0 * np.pi * (turns + last * after) + self.phase) + self.bias


class PulseTrain(Source):
    """Rectangular pulses: y = base + A from each edge t₀ + k P on, for the part ``duty`` of the period P; else base.

    k = 0, 1, …; before t₀ the output is the base. Edges never drift: both are at their decimal times, to 1e-15 t.

    Raises
    ------
    ParameterError
        For a duty of 1 or more.
    """

    amplitude: float = parameter(default=1.0, description="height of the pulses, A")
    period: float = parameter(unit="s", above=0.0, description="time from pulse to pulse, P")
    duty: float = parameter(
        default=0.5,
        above=0.0,
        description="duration of a pulse as a part of the period, below 1",
        kind=kinds.number.where(lambda duty: duty < 1.0).worded(
            "a part of the period below 1", "Use Step for a pulse without an end."
        ),
    )
    delay: float = parameter(default=0.0, unit="s", minimum=0.0, description="time at which the first pulse begins, t₀")
    base: float = parameter(default=0.0, description="value between the pulses")
    y = Output()

    def next_instant(self, t: float) -> float:
        """Return the next edge."""
        period, delay, duty = map(exact_number, (self.period, self.delay, self.duty))
        return next_edge(t, self.period, self.delay, float(delay + duty * period))

    def changes(self) -> tuple[Array, Array]:
        """Return the first edge with the height."""
        return np.array([self.delay]), np.array([self.amplitude])

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the pulses."""
        number, part, tolerance = period_of(t, self.period, self.delay)
        high = np.where(number < 0.0, 0.0, np.where(part < self.duty - tolerance, 1.0, 0.0))
        return self.base + self.amplitude * high


class Sawtooth(Source):
    """Sawtooth: y rises from bias − A to bias + A within each period P, from t₀ on, and falls back at once.

    y = bias + A (2 p − 1) with the part p = (t − t₀) / P − k of period k = 0, 1, …; before t₀ it is bias − A. A
    negative amplitude makes it fall. Edges never drift, as those of `PulseTrain`. `scipy.signal.sawtooth` has the same
    shape.
    """

    amplitude: float = parameter(default=1.0, description="amplitude A")
    period: float = parameter(unit="s", above=0.0, description="time from edge to edge, P")
    delay: float = parameter(
        default=0.0, unit="s", minimum=0.0, description="time at which the first period begins, t₀"
    )
    bias: float = parameter(default=0.0, description="mean value")
    y = Output()

    def next_instant(self, t: float) -> float:
        """Return the next edge."""
        return next_edge(t, self.period, self.delay)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the sawtooth."""
        number, part, _ = period_of(t, self.period, self.delay)
        return self.bias + self.amplitude * (2.0 * np.where(number < 0.0, 0.0, part) - 1.0)


class Triangle(Source):
    """Triangle wave: y rises from bias − A to bias + A in the part ``rise`` of each period P, then falls back.

    Before t₀ it is bias − A. Corners never drift, as the edges of `PulseTrain`. ``scipy.signal.sawtooth(…,
    width=rise)`` has the same shape.

    Raises
    ------
    ParameterError
        For a rise of 1 or more; `Sawtooth` falls at once.
    """

    amplitude: float = parameter(default=1.0, description="amplitude A")
    period: float = parameter(unit="s", above=0.0, description="time from corner to corner, P")
    rise: float = parameter(
        default=0.5,
        above=0.0,
        description="duration of the rise as a part of the period, below 1",
        kind=kinds.number.where(lambda rise: rise < 1.0).worded(
            "a part of the period below 1", "Use Sawtooth to fall at once."
        ),
    )
    delay: float = parameter(
        default=0.0, unit="s", minimum=0.0, description="time at which the first period begins, t₀"
    )
    bias: float = parameter(default=0.0, description="mean value")
    y = Output()

    def next_instant(self, t: float) -> float:
        """Return the next corner."""
        period, delay, rise = map(exact_number, (self.period, self.delay, self.rise))
        return next_edge(t, self.period, self.delay, float(delay + rise * period))

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the triangle."""
        number, part, _ = period_of(t, self.period, self.delay)
        up = part / self.rise
        shape = np.where(number < 0.0, 0.0, np.where(part < self.rise, up, (1.0 - part) / (1.0 - self.rise)))
        return self.bias + self.amplitude * (2.0 * shape - 1.0)
