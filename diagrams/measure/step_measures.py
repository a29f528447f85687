"""Overshoot, settling time and rise time of a sampled step response."""

from __future__ import annotations

import math
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


def measure_step(t: np.ndarray, r: np.ndarray, *, held: bool, target: float | None = None) -> dict[str, Measured]:
    """Return the numbers of a step response: ``final``, ``overshoot``, ``settling``, ``rise`` and ``peak``.

    Parameters
    ----------
    t : (N,) array
        Time since the step in s, equally spaced.
    r : (N,) array
        Change of the signal.
    held : bool
        Whether the signal is constant between the samples. Otherwise a peak may lie between two: the tolerance has the
        height of a parabola through three of them.
    target : float, optional
        Final change that is expected, such as the linear model's. A response that is not there at the end has not
        settled: a limit may hold it elsewhere. Without it the response's own end is taken.

    Returns
    -------
    dict of str to Measured
        All but the peak are NaN where the response has no final value, or goes back to zero. With a target, the times
        of a response that does not come to it are infinite. An overshoot within its tolerance is 0.

    Examples
    --------
    >>> t = np.linspace(0.0, 10.0, 1001)
    >>> found = measure_step(t, 1 - np.exp(-t), held=False)
    >>> [round(found[name].value, 2) for name in ("final", "overshoot", "settling", "rise")]
    [1.0, 0.0, 3.91, 2.2]
    """
    dt = float(t[1] - t[0])
    size = float(np.max(np.abs(r)))
    bend = 0.0 if held or len(r) < 3 else float(np.max(np.abs(np.diff(r, 2)))) / 8
    found = {"peak": Measured(size, bend + 1e-9 * size)}
    tail = r[int(0.9 * len(r)) :]
    final = float(np.mean(tail))
    spread = float(np.max(np.abs(tail - final)))
    if target is not None and abs(target) > NOTHING * size and np.max(np.abs(tail - target)) > BAND * abs(target):
        over = max(0.0, float(np.max(r / target)) - 1.0)
        missed = {"final": Measured(final, spread), "overshoot": Measured(over, bend / abs(target) + 1e-9)}
        return found | missed | dict.fromkeys(("settling", "rise"), Measured(math.inf, 0.0))
    if not abs(final) > NOTHING * size or not spread <= FLAT * abs(final):
        return found | dict.fromkeys(("final", "overshoot", "settling", "rise"), NONE)
    y = r / final
    off = spread / abs(final)
    over = max(0.0, float(np.max(y)) - 1.0)
    over_error = off * (1.0 + over) + bend / abs(final) + 1e-9
    outside = np.flatnonzero(np.abs(y - 1.0) > BAND)
    last = int(outside[-1]) if len(outside) else -1
    settling = 0.0 if last < 0 else float(t[last + 1]) if held or last + 1 >= len(t) else _inside(t, y, last)
    rise = _crossing(t, y, 0.9, held=held) - _crossing(t, y, 0.1, held=held)
    return found | {
        "final": Measured(final, spread + 1e-9 * abs(final)),
        "overshoot": Measured(over if over > over_error else 0.0, over_error),
        "settling": Measured(settling, dt + _slack(t, y, off, settling)),
        "rise": Measured(rise, dt),
    }


def is_at_rest(r: np.ndarray) -> bool:
    """Return whether a response hardly moves in the last tenth of its record, beside its largest change."""
    tail = r[int(0.9 * len(r)) :]
    return float(np.max(np.abs(tail - np.mean(tail)))) <= FLAT * float(np.max(np.abs(r)))


def _inside(t: np.ndarray, y: np.ndarray, last: int) -> float:
    """Return when a response comes into the band for good, between the samples ``last`` and the next."""
    before, after = abs(y[last] - 1.0), abs(y[last + 1] - 1.0)
    return float(t[last] + (t[last + 1] - t[last]) * (before - BAND) / (before - after))


def _slack(t: np.ndarray, y: np.ndarray, off: float, settling: float) -> float:
    """Return how far the settling time moves when the band is wider or narrower by the final value's error."""
    ends = []
    for band in (BAND - off, BAND + off):
        outside = np.flatnonzero(np.abs(y - 1.0) > band)
        ends.append(float(t[min(int(outside[-1]) + 1, len(t) - 1)]) if len(outside) else 0.0)
    return max(abs(end - settling) for end in ends)


def _crossing(t: np.ndarray, y: np.ndarray, level: float, *, held: bool) -> float:
    """Return when a response first reaches a level."""
    k = int(np.argmax(y >= level))
    if held or k == 0:
        return float(t[k])
    return float(t[k - 1] + (t[k] - t[k - 1]) * (level - y[k - 1]) / (y[k] - y[k - 1]))
