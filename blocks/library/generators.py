"""Test signals: ramps, chirps, pulse trains, tables, noise, the clock.

Times are in s; a change at ``t0`` acts from the first instant t ≥ t0 on. A periodic signal is computed from the number
of the period, never by adding up periods: period k begins at k times the period as it is written in decimals, at any t.
An instant that is a few rounding errors before such an edge (1e-15 t) counts as the edge itself. So with a period of
0.1 s the tick at 0.3 s, which is less than three times the number nearest to 0.1, belongs to the fourth period.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from os import PathLike
from pathlib import Path
from typing import Any, Self

import numpy as np

from ..core import (
    Array,
    Kind,
    OptionError,
    Output,
    ParameterError,
    Source,
    UnknownNameError,
    accepts,
    exact_number,
    explain_disk_errors,
    kinds,
    move_earlier,
    near,
    next_edge,
    parameter,
    period_of,
    shorten,
)
from .piecewise_functions import piecewise

_HALF = 2.0**24  # counters are mixed in two halves, since products of two such numbers are exact
_ROUNDS = 10


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


class _Table(Source):
    """Base of the sources that read a table over time."""

    times: Array = parameter(
        unit="s",
        structural=True,
        description="times of the values, rising",
        kind=Kind(
            "a list of rising times, one or more",
            lambda times: np.ndim(times) == 1 and np.size(times) > 0 and bool(np.all(np.diff(times) > 0)),
            "Sort them, with their values, and leave out repeated ones.",
            lambda name, times: f"found times of shape {np.shape(times)}",
        ),
    )
    values: Array = parameter(structural=True, description="a value for each time: numbers, or a vector in each row")

    def check(self) -> None:
        """Refuse values that don't fit the times."""
        super().check()
        times, values = np.shape(self.times), np.shape(self.values)
        if len(values) not in (1, 2) or values[0] != times[0]:
            raise ParameterError(
                f"found values of shape {values} for {times[0]} times; expected shape ({times[0]},), or "
                f"({times[0]}, n) for vectors of n entries.",
                port="values",
            )

    def piece_starts(self) -> np.ndarray:
        """Return the beginnings of the pieces after each time."""
        times: np.ndarray = self.times
        return times

    @property
    def slopes(self) -> np.ndarray:
        """Slopes between the times, one row for each, for linear interpolation."""
        columns = np.reshape(self.values, (len(self.times), -1))
        result: np.ndarray = np.diff(columns, axis=0) / np.diff(self.times)[:, None]
        return result

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the value at t, from one piece before the first time, those between, and one after the last."""
        columns = np.reshape(self.values, (len(self.times), -1))
        still = np.zeros((1, columns.shape[1]))
        coefficients = np.stack(
            [np.concatenate([columns[:1], columns]), np.concatenate([still, self.slopes, still])], axis=2
        )
        span, times = 1.0 + np.abs(self.times[[0, -1]]), self.piece_starts()
        breaks = np.concatenate([[times[0] - span[0]], times, [times[-1] + span[1]]])
        y = piecewise(breaks, coefficients, t)
        return y if np.ndim(self.values) == 2 else y[0]


class PiecewiseLinear(_Table):
    """Straight lines through points, y(times[i]) = values[i]; beyond the ends the first and the last value are held.

    Raises
    ------
    ParameterError
        For times that don't rise, or not one value for each.
    """

    def instants(self) -> Array:
        """Return the times at which the slope changes."""
        slopes = self.slopes
        still = np.zeros((1, slopes.shape[1]))
        changes = np.abs(np.diff(np.concatenate([still, slopes, still]), axis=0))
        return self.times[np.any(changes > 1e-12 * np.max(np.abs(slopes), initial=0.0), axis=1)]


_FRAME = Kind("a pandas DataFrame or Series", lambda value: all(hasattr(value, name) for name in ("index", "to_numpy")))


class Recorded(_Table):
    """Recorded data: y is interpolated between the samples; beyond them the first and the last value are held.

    ``linear`` interpolates, ``previous`` holds each value until the next time, as a sampled signal does; the times may
    be off by their rounding, as those of ``np.linspace`` are. A solver lands on every sample, in a continuous
    subsystem.

    Raises
    ------
    ParameterError
        For times that don't rise, not one value for each, or another interpolation.
    """

    interpolation: str = parameter(
        default="linear", description="'linear' or 'previous'", kind=kinds.choice("linear", "previous")
    )

    @classmethod
    @accepts("{cls.__name__}", path=kinds.path, columns=kinds.names, time=kinds.text)
    def from_csv(
        cls, path: str | PathLike[str], columns: str | Sequence[str] = "", *, time: str = "", **parameters: Any
    ) -> Self:
        """Return the source that plays columns of a file of comma-separated values with a line of names.

        Semicolons and tabs separate columns, too. `Run.to_csv` writes such a file.

        Parameters
        ----------
        path : path
            The file.
        columns : str or sequence of str
            Column, or columns of a vector; without it, all but the time.
        time : str
            Column of the times in s; without it, the first one.
        **parameters
            Further ones of the block: ``interpolation``, ``unit``, ``name``.

        Raises
        ------
        OptionError
            For a file that can't be read.
        UnknownNameError
            For a column that isn't there; the message has near names.
        ParameterError
            For values that are no numbers, and times that don't rise.
        """
        file = Path(path).expanduser()
        with explain_disk_errors(f"{str(path)!r} can't be read", file, "Name another file.", OptionError, port="path"):
            text = file.read_text(encoding="utf-8-sig")
        head = text.partition("\n")[0]
        separator = max(",;\t", key=head.count)
        lines = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines(), delimiter=separator) if row]
        if not lines:
            raise OptionError(f"{str(path)!r} is empty; expected a line of names, then numbers.", port="path")
        names, *rows = lines
        table: dict[str, list[float]] = {name: [] for name in names}
        for number, row in enumerate(rows, 2):
            try:
                for name, cell in zip(names, row, strict=True):
                    table[name].append(float(cell))
            except ValueError:
                raise ParameterError(
                    f"found the row {number} of {str(path)!r}, {shorten(row)}; expected {len(names)} numbers, one for "
                    "each name in its first line. Leave other rows out.",
                    block=parameters.get("name") or cls.__name__,
                    port="values",
                ) from None
        return cls._from_columns(table, columns, time or names[0], parameters)

    @classmethod
    @accepts("{cls.__name__}", frame=_FRAME, columns=kinds.names, time=kinds.text)
    def from_pandas(cls, frame: Any, columns: str | Sequence[str] = "", *, time: str = "", **parameters: Any) -> Self:
        """Return the source that plays columns of a pandas DataFrame, or a Series.

        Parameters
        ----------
        frame : pandas.DataFrame or pandas.Series
            The data, with the times in s as its index.
        columns : str or sequence of str
            Column, or columns of a vector; without it, all but the time.
        time : str
            Column of the times in s; without it, the index.
        **parameters
            Further ones of the block: ``interpolation``, ``unit``, ``name``.

        Raises
        ------
        UnknownNameError
            For a column that isn't there; the message has near names.
        ParameterError
            For values that are no numbers, and times that don't rise.
        """
        data = frame.to_frame() if hasattr(frame, "to_frame") else frame
        table = {str(name): data[name].to_numpy() for name in data.columns}
        if not time:
            time, table = "index", {**table, "index": data.index.to_numpy()}
        return cls._from_columns(table, columns, time, parameters)

    @classmethod
    def _from_columns(
        cls, table: Mapping[str, Any], columns: str | Sequence[str], time: str, parameters: dict[str, Any]
    ) -> Self:
        chosen = [columns] if isinstance(columns, str) and columns else list(columns) or [n for n in table if n != time]
        for name in (time, *chosen):
            if name not in table:
                raise UnknownNameError(
                    f"the data has no column {name!r}. {near(name, table)}",
                    block=parameters.get("name") or cls.__name__,
                )
        try:
            times, *values = (np.asarray(table[name], dtype=float) for name in (time, *chosen))
        except (TypeError, ValueError):
            raise ParameterError(
                f"found columns {time}, {', '.join(chosen)} with other values than numbers; expected numbers, times "
                "in s. Convert them.",
                block=parameters.get("name") or cls.__name__,
                port="values",
            ) from None
        if parameters.get("interpolation") == "previous":  # at an event a run has two rows: the last one holds
            last = np.append(np.diff(times) != 0.0, True)
            times, values = times[last], [column[last] for column in values]
        return cls(times=times, values=values[0] if len(chosen) == 1 else np.stack(values, axis=1), **parameters)

    def piece_starts(self) -> np.ndarray:
        """Return the times, moved earlier by their rounding if values jump there."""
        times: np.ndarray = self.times
        return move_earlier(times) if self.interpolation == "previous" else times

    @property
    def slopes(self) -> np.ndarray:
        """Slopes between the times; zero if values are held."""
        return super().slopes * float(self.interpolation == "linear")

    def instants(self) -> Array:
        """Return the times of the samples."""
        return self.times


class BandLimitedNoise(Source):
    """Normal noise, white up to its band: a new independent value every ``sample_time`` T, held in between.

    y(t) = mean + √variance n(k), k = ⌊t/T⌋, n(k) standard normal. Its two-sided spectral density is
    variance · T sinc²(f T): flat, in its unit squared per Hz, to 4 % up to f = 0.1/T. ``from_density`` takes that
    density instead of the variance. n(k) is a function of k and ``seed`` alone (a counter is mixed by a Feistel network
    in exact arithmetic, then Box and Muller's transform): the same in every run, from any t on, in any solver, however
    often and in whatever order it is evaluated. It repeats after 2⁴⁸ values; |n| is at most 5.9.
    """

    sample_time: float = parameter(unit="s", above=0.0, description="time between two values, T")
    variance: float = parameter(default=1.0, minimum=0.0, description="variance, in the unit squared")
    mean: float = parameter(default=0.0, description="mean value")
    seed: int = parameter(default=0, minimum=0, description="another seed gives another, independent noise")
    y = Output()
    computed_from = frozenset({"seed"})

    @classmethod
    def from_density(cls, *, density: float, sample_time: float, **parameters: Any) -> Self:
        """Return noise of a given two-sided spectral density at low frequency, in its unit squared per Hz."""
        return cls(variance=density / sample_time, sample_time=sample_time, **parameters)

    def next_instant(self, t: float) -> float:
        """Return the time of the next value."""
        return next_edge(t, self.sample_time, 0.0)

    def constants(self, T: float, method: str) -> dict[str, np.ndarray]:
        """Return the keys of the rounds: numbers of a run, so that another seed changes no code."""
        return {"keys": np.array(_keys(self.seed))}

    @cached_property
    def keys(self) -> np.ndarray:
        """The keys of the rounds, of 24 bits each."""
        return np.array(_keys(self.seed))

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the value that is held at t."""
        number, _, _ = period_of(t, self.sample_time, 0.0)
        low, high = number, np.floor(number / _HALF)
        low = low - _HALF * high
        high = high - _HALF * np.floor(high / _HALF)
        for k in range(_ROUNDS):
            v = low + self.keys[k]
            v = v - _HALF * np.floor(v / _HALF)
            v = high + np.floor(v * (2.0 * v + 1.0) / 4096.0)  # the middle bits of a product depend on all of v
            high, low = low, v - _HALF * np.floor(v / _HALF)
        radius = np.sqrt(-2.0 * np.log((high + 0.5) / _HALF))
        return self.mean + np.sqrt(self.variance) * radius * np.cos(2.0 * np.pi * (low + 0.5) / _HALF)


@lru_cache(maxsize=256)
def _keys(seed: int) -> tuple[float, ...]:
    """Return the keys of the rounds, of 24 bits each."""
    return tuple(float(key >> 8) for key in np.random.SeedSequence(seed).generate_state(_ROUNDS))
