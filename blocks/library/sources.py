"""Sources: constants, references, steps, pulses, sines.

Times are in s; a change at ``t0`` acts from the first instant t ≥ t0 on. Rounding of times is allowed for: an instant
less than 2e-15 t before a change counts as the change itself, so that a step at ``3 * 0.1`` acts at the tick at 0.3 s.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..core import Array, Output, ParameterError, Source, move_earlier, parameter, shorten


def smooth_step(
    t: Array, start_time: Array, duration: Array, initial: Array, final: Array
) -> tuple[Array, Array, Array]:
    """Return the 7th-order smooth step with its two time derivatives.

    s = r₀ + (r₁ − r₀)(35 z⁴ − 84 z⁵ + 70 z⁶ − 20 z⁷), z = (t − t₀)/D clipped to [0, 1]; s, ṡ, s̈ and the third
    derivative are continuous.
    """
    z = (t - start_time) / duration
    z = np.where(z < 0.0, 0.0, np.where(z > 1.0, 1.0, z))
    rise = final - initial
    value = initial + rise * z**4 * (35.0 - z * (84.0 - z * (70.0 - 20.0 * z)))
    rate = rise / duration * 140.0 * z**3 * (1.0 - z) ** 3
    acceleration = rise / duration**2 * 420.0 * z**2 * (1.0 - z) ** 2 * (1.0 - 2.0 * z)
    return value, rate, acceleration


class Reference(Source):
    """Constant reference with its time derivatives: y = (value, 0, 0)."""

    value: float = parameter(kw_only=False, description="the value")
    y = Output(shape=(3,), description="value and its first two time derivatives, which are zero")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the value and two zeros."""
        return np.stack([self.value + 0.0 * t, 0.0 * t, 0.0 * t])


class SmoothStep(Source):
    """Reference of 7th-order smooth steps, with its first two time derivatives: y = (r, ṙ, r̈).

    r steps through ``levels``: from ``levels[i]`` to ``levels[i + 1]``, beginning at ``start_times[i]``, within
    ``durations[i]`` seconds.
    """

    levels: Array = parameter(description="values between the steps, one more than steps")
    start_times: Array = parameter(unit="s", description="time at which each step starts, rising")
    durations: Array = parameter(unit="s", above=0.0, description="duration of each step")
    y = Output(shape=(3,), description="value, rate, acceleration")

    def check(self) -> None:
        """Refuse steps that overlap and lists of unequal length."""
        super().check()
        levels, starts, durations = (np.atleast_1d(v) for v in (self.levels, self.start_times, self.durations))
        if starts.ndim > 1 or durations.ndim > 1 or not len(levels) - 1 == len(starts) == len(durations):
            raise ParameterError(
                f"found {len(levels)} levels, {len(starts)} start times and {len(durations)} durations; expected one "
                "start time and one duration for each step between two levels. Give one level more than steps, such as "
                "levels=(0.0, 1.0), start_times=(0.5,), durations=(0.2,).",
                port="levels",
            )
        if np.any(starts[1:] < (starts + durations)[:-1]):
            raise ParameterError(
                "found a step that starts before the one before it ends; expected each to end first. Move start_times "
                "apart.",
                port="start_times",
            )

    def instants(self) -> Array:
        """Return the times at which each step starts and ends."""
        starts = np.atleast_1d(self.start_times)
        return np.concatenate([starts, starts + self.durations])

    def changes(self) -> tuple[Array, Array]:
        """Return the start of each step with its height."""
        return np.atleast_1d(self.start_times), np.diff(self.levels)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the sum of all steps."""
        levels, starts, durations = self.levels, np.atleast_1d(self.start_times), np.atleast_1d(self.durations)
        value, rate, acceleration = levels[0] + 0.0 * t, 0.0 * t, 0.0 * t
        for i in range(len(levels) - 1):
            rise = levels[i + 1] - levels[i]
            v, r, a = smooth_step(t, starts[i], durations[i], 0.0 * t, rise)
            value, rate, acceleration = value + v, rate + r, acceleration + a
        return np.stack([value, rate, acceleration])


class Step(Source):
    """Steps: y is ``initial_value``, then ``values[i]`` from ``times[i]`` on.

    Rounding of the times is allowed for: a step at ``3 * 0.1`` acts at the tick at 0.3 s. A step at t = 0 is a jump
    like any other: blocks that start from their inputs, such as `FilteredDerivative`, start from ``initial_value``.
    """

    times: Array = parameter(unit="s", description="times of the steps, rising; a number or several")
    values: Array = parameter(description="the value from then on, one for each time")
    initial_value: float = parameter(default=0.0, description="value before the first step")
    y = Output()

    def check(self) -> None:
        """Refuse lists of unequal length and times that do not rise."""
        super().check()
        if np.shape(self.times) != np.shape(self.values) or np.any(np.diff(np.atleast_1d(self.times)) <= 0):
            raise ParameterError(
                f"found times {shorten(self.times)} and values {shorten(self.values)}; expected rising times, one "
                "value each. Give lists of one length, such as times=(0.5, 2.0), values=(1.0, 0.0).",
                port="times",
            )

    def instants(self) -> Array:
        """Return the times of the steps."""
        return np.atleast_1d(self.times)

    def changes(self) -> tuple[Array, Array]:
        """Return the times of the steps with their heights."""
        return np.atleast_1d(self.times), np.diff(np.atleast_1d(self.values), prepend=self.initial_value)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the value at t."""
        y = self.initial_value + 0.0 * t
        for time, value in zip(np.atleast_1d(self.times), np.atleast_1d(self.values), strict=True):
            y = np.where(t >= move_earlier(time), value, y)
        return y


class Pulse(Source):
    """Smooth pulse: up at the start and down at the end, each a 7th-order step over ``rise_time``.

    y = A [smooth(t; t₀, r) − smooth(t; t₁ − r, r)].
    """

    start_time: float = parameter(unit="s", description="time at which the rise begins")
    end_time: float = parameter(unit="s", description="time at which the fall ends")
    amplitude: float = parameter(description="height")
    rise_time: float = parameter(default=0.2, unit="s", above=0.0, description="duration of each flank")
    y = Output()

    def check(self) -> None:
        """Refuse a pulse shorter than its two flanks."""
        super().check()
        if self.end_time - self.start_time < 2 * self.rise_time * (1 - 1e-12):
            raise ParameterError(
                f"found {self.end_time - self.start_time:g} s between start and end; expected at least the two flanks, "
                f"{2 * self.rise_time:g} s. Move end_time or shorten rise_time.",
                port="end_time",
            )

    def instants(self) -> Array:
        """Return the times at which the flanks start and end."""
        first, last, rise = self.start_time, self.end_time, self.rise_time
        return np.array([first, first + rise, last - rise, last])

    def changes(self) -> tuple[Array, Array]:
        """Return the start of the rise with the height."""
        return np.array([self.start_time]), np.array([self.amplitude])

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the pulse."""
        up = smooth_step(t, self.start_time, self.rise_time, 0.0, 1.0)[0]
        down = smooth_step(t, self.end_time - self.rise_time, self.rise_time, 0.0, 1.0)[0]
        return self.amplitude * (up - down)


class Sine(Source):
    """Sine wave: y = A sin(2π f t + φ) + bias."""

    amplitude: float = parameter(default=1.0, description="amplitude")
    frequency: float = parameter(unit="Hz", minimum=0.0, description="frequency")
    phase: float = parameter(default=0.0, unit="rad", description="phase at t = 0")
    bias: float = parameter(default=0.0, description="mean value")
    y = Output()

    def time_scale(self) -> float:
        """Return a tenth of a period."""
        return 0.1 / self.frequency if self.frequency else math.inf

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the sine."""
        return self.amplitude * np.sin(2.0 * np.pi * self.frequency * t + self.phase) + self.bias
