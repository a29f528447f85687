"""Overshoot, settling time and rise time of a sampled step response."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

BAND = 0.02
"""Settled is a response within this share of its final change."""
FLAT = 0.01
"""Largest movement in the last tenth, as a share of the final change, of a response that has a final value."""
NOTHING = 1e-3
"""Final change, as a share of the largest one, below which there is none to settle at."""


class Measured(NamedTuple):
    """A measured value with its tolerance; NaN where there is none."""

    value: float
    tolerance: float


NONE = Measured(math.nan, math.nan)


@dataclass(frozen=True, eq=False)
class ExpectedStep:
    """The linear model's response to a step, next to which a response is measured."""

    response: np.ndarray  # (N,): change of the signal at the samples
    final: float  # change that it comes to; NaN where it does not rest
    low: float  # smallest change after the last sample
    high: float  # largest change after the last sample
    between: float  # largest size between the samples, less that at them; NaN where it is not known


def measure_step(
    t: np.ndarray,
    r: np.ndarray,
    *,
    held: bool,
    target: float | None = None,
    expected: ExpectedStep | None = None,
    slowest: float | None = None,
    accuracy: float = 1e-9,
) -> dict[str, Measured]:
    """Return the numbers of a step response: ``final``, ``overshoot``, ``settling``, ``rise`` and ``peak``.

    ``t`` are the times since the step in s, two of one time before and after a jump, ``r`` the change of the signal,
    (N,) both; ``held``: it is constant between samples. Otherwise a peak may lie between two: the tolerance has twice
    the height of a parabola through three of them, or what the linear model has there. ``target`` is the final change
    that is expected; a response that is not there at the end has not settled: a limit may hold it elsewhere. The final
    value of ``expected`` is a target, too. ``slowest`` is the rate in 1/s of the slowest mode, without which a response
    is taken to stay as it is in the last tenth; ``accuracy`` the samples' error, relative to the largest change.

    The tolerances contain what may lie between two samples, and what the response may still do after its record. With a
    linear model next to it, its final value is that of the model plus the distance at the end of the record. That
    distance, or without a model the response itself, may still change by what its slowest mode has left, by its
    movement in the second half of the record.

    The peak of a response that does not rest (`is_at_rest`) is that of its record. All others are NaN where the
    response has no final value, goes back to zero, or may still leave the band around its final value after the
    record. With a target, the times of a response that does not come to it are infinite. An overshoot within its
    tolerance is 0.

    >>> t = np.linspace(0.0, 10.0, 1001)
    >>> found = measure_step(t, 1 - np.exp(-t), held=False)
    >>> [round(found[name].value, 2) for name in ("final", "overshoot", "settling", "rise")]
    [1.0, 0.0, 3.91, 2.2]
    """
    dt = float(np.max(np.diff(t)))
    size = float(np.max(np.abs(r)))
    known = expected is not None and math.isfinite(expected.final)
    if expected is not None and known:
        target = expected.final
        to_come = expected.final - expected.response
        low, high = expected.low - expected.final, expected.high - expected.final
    else:
        to_come, low, high = np.zeros(len(r)), 0.0, 0.0
    arrived = r + to_come
    tail = arrived[int(0.9 * len(r)) :]
    final = float(np.mean(tail))
    spread = float(np.max(np.abs(tail - final))) + _remainder(t, arrived, slowest)
    unknown = expected is None or math.isnan(expected.between)
    bend = _bend(t, r) if expected is None or unknown else expected.between + _bend(t, r - expected.response)
    bend = 0.0 if held else bend
    later = 0.0  # size after the record; of one that does not rest, the peak is that of the record
    if is_at_rest(t, r, expected, slowest):
        later = max(abs(final + low), abs(final + high)) + spread
    found = {"peak": Measured(size, max(bend, later - size) + accuracy * size)}
    given = target is not None and abs(target) > NOTHING * size
    if target is not None and given and abs(final - target) - spread > BAND * abs(target):
        over = max(0.0, float(np.max(r / target)) - 1.0)
        missed = {"final": Measured(final, spread), "overshoot": Measured(over, bend / abs(target) + accuracy)}
        return found | missed | dict.fromkeys(("settling", "rise"), Measured(math.inf, 0.0))
    wide = spread + max(abs(low), abs(high))
    if (
        not abs(final) > NOTHING * size
        or not spread <= FLAT * abs(final)
        or not max(wide, abs(r[-1] - final)) <= BAND * abs(final)
        or (target is not None and given and abs(final - target) + spread > BAND * abs(target))
    ):
        return found | dict.fromkeys(("final", "overshoot", "settling", "rise"), NONE)
    y, off = r / final, spread / (abs(final) - spread)
    over = max(0.0, float(np.max(y)) - 1.0, (high if final > 0 else -low) / abs(final))
    over_error = off * (1.0 + over) + bend / abs(final) + accuracy
    outside = np.flatnonzero(np.abs(y - 1.0) > BAND)
    last = int(outside[-1]) if len(outside) else -1
    settling = 0.0 if last < 0 else float(t[last + 1]) if held else _inside(t, y, last)
    rise = _crossing(t, y, 0.9, held=held) - _crossing(t, y, 0.1, held=held)
    return found | {
        "final": Measured(final, spread + accuracy * size),
        "overshoot": Measured(over if over > over_error else 0.0, over_error),
        "settling": Measured(settling, dt + _slack(t, y, off, settling, held=held)),
        "rise": Measured(rise, dt + _rise_slack(t, y, off, rise, held=held)),
    }


def is_at_rest(
    t: np.ndarray, r: np.ndarray, expected: ExpectedStep | None = None, slowest: float | None = None
) -> bool:
    """Return whether a response hardly moves in the last tenth of its record, nor after it; see `measure_step`."""
    size, tail = float(np.max(np.abs(r))), r[int(0.9 * len(r)) :]
    if not float(np.max(np.abs(tail - np.mean(tail)))) <= FLAT * size:
        return False
    if expected is None or not math.isfinite(expected.final):
        return _remainder(t, r, slowest) <= FLAT * size
    left = max(abs(expected.low - expected.final), abs(expected.high - expected.final))
    left += _remainder(t, r - expected.response, slowest)
    return left <= (BAND * abs(expected.final) if abs(expected.final) > NOTHING * size else FLAT * size)


def _bend(t: np.ndarray, r: np.ndarray) -> float:
    """Return twice the height of a parabola through three samples, which bounds sines of up to 1.7 rad a sample."""
    return float(np.max(_bends(t, r), initial=0.0))


def _bends(t: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return that height around each sample but the first and the last; 0 next to a jump, which is no bend."""
    h = np.diff(t)
    before, after = h[:-1], h[1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.diff(np.diff(r) / h) / (before + after)  # half the second derivative
    return np.where((before > 0.0) & (after > 0.0), np.abs(turn) * np.maximum(before, after) ** 2 / 2, 0.0)


def _remainder(t: np.ndarray, r: np.ndarray, slowest: float | None) -> float:
    """Return how far a response may still go after its record, by its movement in the second half of it.

    What exp(−σt) still moves, of its movement within a time H before, is 1/(exp(σH) − 1); faster modes leave less.
    """
    if slowest is None:
        return 0.0
    half = len(r) // 2
    moved, time = float(np.max(np.abs(r[half:] - r[-1]))), float(t[-1] - t[half])
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        return float(np.divide(moved, np.expm1(slowest * time))) if moved else 0.0


def _inside(t: np.ndarray, y: np.ndarray, last: int) -> float:
    """Return when a response comes into the band for good, between the samples ``last`` and the next."""
    before, after = abs(y[last] - 1.0), abs(y[last + 1] - 1.0)
    return float(t[last] + (t[last + 1] - t[last]) * (before - BAND) / (before - after))


def _slack(t: np.ndarray, y: np.ndarray, off: float, settling: float, *, held: bool) -> float:
    """Return how far the settling time moves when the band is wider or narrower by the final value's error.

    Where the response is not held, it may be nearer to the band's edge between two samples than at both.
    """
    away, off = np.abs(y - 1.0), off * (1.0 + BAND + off)  # at the band's edge
    bends = np.zeros(len(y))
    if not held and len(y) > 2:
        bends[1:-1] = _bends(t, y)
        bends = np.maximum(np.maximum(bends, np.append(bends[1:], 0.0)), np.append(0.0, bends[:-1]))
    late, early = np.flatnonzero(away + bends > BAND - off), np.flatnonzero(away > BAND + off)
    ends = [float(t[min(int(some[-1]) + 1, len(t) - 1)]) if len(some) else 0.0 for some in (late, early)]
    return max(abs(end - settling) for end in ends)


def _rise_slack(t: np.ndarray, y: np.ndarray, off: float, rise: float, *, held: bool) -> float:
    """Return how far the rise time moves when both its levels move by the final value's error."""
    found = [
        _crossing(t, y, 0.9 * by, held=held) - _crossing(t, y, 0.1 * by, held=held) for by in (1.0 - off, 1.0 + off)
    ]
    return max(abs(other - rise) for other in found)


def _crossing(t: np.ndarray, y: np.ndarray, level: float, *, held: bool) -> float:
    """Return when a response first reaches a level."""
    k = int(np.argmax(y >= level))
    if held or k == 0:
        return float(t[k])
    return float(t[k - 1] + (t[k] - t[k - 1]) * (level - y[k - 1]) / (y[k] - y[k - 1]))
