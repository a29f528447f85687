"""Reductions: a number, or a few, that stand for a whole run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...blocks.core import OptionError, accepts, explain_calls, kinds
from ..results import Run

KINDS = ("final", "maximum", "minimum", "mean", "settling_time")
_SIGNAL = kinds.text.worded("the name of a signal, such as 'y'", "Give one.")


@explain_calls
@dataclass(frozen=True)
class Reduction:
    """A number of each entry of a signal over a run; `final`, `maximum` and their like make them.

    Attributes
    ----------
    kind : str
        Kind of the number.
    signal : str
        The signal, by the names that ``run[name]`` takes.
    band, target : float
        Of a settling time: distance from the target that counts as settled, in the signal's unit, and the target; None
        for the final value.
    since : float
        Time in s from which on samples count.
    """

    kind: str
    signal: str
    band: float = 0.0
    target: float | None = None
    since: float = 0.0

    def __call__(self, run: Run) -> np.ndarray:
        """Return the number of each entry of the signal, in the shape of the signal."""
        values, t = run[self.signal], run.t
        if self.since > 0.0:
            values, t = values[t >= self.since], t[t >= self.since]
        if not len(t):
            return np.full(values.shape[1:], np.nan)
        if self.kind == "final":
            return np.array(values[-1])
        if self.kind == "maximum":
            return np.array(values.max(axis=0))
        if self.kind == "minimum":
            return np.array(values.min(axis=0))
        if self.kind == "mean":
            return _mean(t, values)
        return _settling_time(t, values, self.band, self.target, max(self.since, float(run.t[0])))

    @property
    def unit(self) -> str | None:
        """Unit of the number; None for that of the signal."""
        return "s" if self.kind == "settling_time" else None


@accepts(signal=_SIGNAL)
def final(signal: str) -> Reduction:
    """Return the reduction to a signal's last sample."""
    return Reduction("final", signal)


@accepts(signal=_SIGNAL, since=kinds.number)
def maximum(signal: str, *, since: float = 0.0) -> Reduction:
    """Return the reduction to the largest sample of each entry, from a time in s on."""
    return Reduction("maximum", signal, since=since)


@accepts(signal=_SIGNAL, since=kinds.number)
def minimum(signal: str, *, since: float = 0.0) -> Reduction:
    """Return the reduction to the smallest sample of each entry, from a time in s on."""
    return Reduction("minimum", signal, since=since)


@accepts(signal=_SIGNAL, since=kinds.number)
def mean(signal: str, *, since: float = 0.0) -> Reduction:
    """Return the reduction to the mean over time, by the trapezoidal rule, from a time in s on."""
    return Reduction("mean", signal, since=since)


@accepts(
    signal=_SIGNAL,
    band=kinds.positive.worded("a distance from the target, positive", "Give one.", kinds.by_name),
    target=kinds.number,
    since=kinds.number,
)
def settling_time(signal: str, *, band: float, target: float | None = None, since: float = 0.0) -> Reduction:
    """Return the reduction to the time after which a signal stays in a band around its target.

    It is counted from ``since`` on: 0 where the signal never leaves the band, NaN where the last sample is outside. The
    instant at which it enters is found by linear interpolation between two samples.

    Parameters
    ----------
    signal : str
        The signal.
    band : float
        Distance from the target that counts as settled, in the signal's unit.
    target : float, optional
        The target; the last sample without it.
    since : float
        Time in s from which on it is counted, such as that of a step.
    """
    return Reduction("settling_time", signal, band=float(band), target=target, since=since)


def check_reductions(reduce: Any, diagram: str) -> dict[str, Callable[[Run], Any]]:
    """Return reductions by name."""
    if not isinstance(reduce, Mapping) or not all(isinstance(name, str) for name in reduce):
        raise OptionError(
            f"found reduce={reduce!r}; expected reductions by name. Give reduce={{'end': final('y')}}.", block=diagram
        )
    for name, function in reduce.items():
        if not callable(function):
            signal = function if isinstance(function, str) else "y"
            raise OptionError(
                f"found {function!r} for {name!r}; expected final(signal), maximum(signal) or another reduction, or a "
                f"function that takes a run and returns numbers. Give reduce={{{name!r}: final({signal!r})}}.",
                block=diagram,
                port="reduce",
            )
    return dict(reduce)


def _mean(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    widths = np.diff(t).reshape(-1, *[1] * (values.ndim - 1))
    if not np.sum(widths) > 0.0:
        return np.array(values[-1])
    return np.asarray(np.sum(0.5 * widths * (values[1:] + values[:-1]), axis=0) / (t[-1] - t[0]))


def _settling_time(t: np.ndarray, values: np.ndarray, band: float, target: float | None, origin: float) -> np.ndarray:
    shape, columns = values.shape[1:], values.reshape(len(t), -1)
    away = columns - (columns[-1] if target is None else float(target))
    found = np.zeros(columns.shape[1])
    for i, e in enumerate(away.T):
        outside = np.flatnonzero(~(np.abs(e) <= band))  # a NaN is outside
        if not len(outside):
            continue
        k = int(outside[-1])
        if k == len(t) - 1:
            found[i] = np.nan
            continue
        part = (e[k] - np.copysign(band, e[k])) / (e[k] - e[k + 1]) if np.isfinite(e[k]) else 1.0
        found[i] = t[k] + part * (t[k + 1] - t[k]) - origin
    return found.reshape(shape)
