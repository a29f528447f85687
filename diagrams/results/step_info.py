"""Numbers of a run's response to a step, those of python-control's step_info: rise and settling time, overshoot, peak.

They are measured by `measure_step`, as a report's step responses are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...blocks.core import Grid, OptionError, Sheet, ShownAsTable, brief, enumerate_some, explain_calls, missing_member
from ...blocks.library import Step

_KEYS = {
    "RiseTime": "rise_time",
    "SettlingTime": "settling_time",
    "SettlingMin": "settling_min",
    "SettlingMax": "settling_max",
    "Overshoot": "overshoot",
    "Undershoot": "undershoot",
    "Peak": "peak",
    "PeakTime": "peak_time",
    "SteadyStateValue": "steady_state_value",
}
"""python-control's names, and those here."""
_SHARES = ("overshoot", "undershoot")
_TIMES = ("rise_time", "settling_time", "peak_time")
_FEWEST = 10
"""Samples after the step from which on there is something to measure."""
_WAYS = {name: f"info.{own}" for name, own in _KEYS.items()} | {
    **dict.fromkeys(("settling", "ts"), "info.settling_time"),
    **dict.fromkeys(("rise", "tr"), "info.rise_time"),
    **dict.fromkeys(("final", "final_value", "end"), "info.steady_state_value"),
}
BAND = 0.02
"""Settled is a response within this share of its final change."""
FLAT = 0.01
"""Largest movement in the last tenth, as a share of the final change, of a response that has a final value."""
NOTHING = 1e-3
"""Final change, as a share of the largest one, below which there is none to settle at."""


@explain_calls
@dataclass(frozen=True, repr=False)
class StepInfo(ShownAsTable):
    """Numbers of a signal's response to a step, as `Run.step_info` returns them.

    A number is NaN where the response doesn't have it: of a signal that still moves in the last tenth of the response,
    all but the peak. A settling or rise time is infinite where the response comes to rest away from the ``final``
    value that was asked for.

    Attributes
    ----------
    signal : str
        Name of the signal.
    unit : str
        Its unit, "" where it is not declared.
    since, until : float
        Time of the step and end of its response in s, in the run's time.
    start_value, steady_state_value : float
        Values before the step and at the end, in the signal's unit.
    rise_time : float
        Time in s from 10 % to 90 % of the change.
    settling_time : float
        Time in s after the step from which on the signal stays within 2 % of its change around the steady state.
    overshoot, undershoot : float
        Largest distance beyond the steady state, and beyond the value before the step to the other side, as shares of
        the change: 0.05 is 5 %. An overshoot that is smaller than its numerical error is 0.
    peak : float
        Value of the signal farthest from that before the step, in its unit.
    peak_time : float
        Time in s after the step at which it is there.
    settling_min, settling_max : float
        Smallest and largest value after the rise, in the signal's unit.
    """

    signal: str
    unit: str
    since: float
    until: float
    start_value: float
    steady_state_value: float
    rise_time: float
    settling_time: float
    overshoot: float
    undershoot: float
    peak: float
    peak_time: float
    settling_min: float
    settling_max: float

    if not TYPE_CHECKING:  # a type checker knows all members

        def __getattr__(self, name):
            raise missing_member(self, name, "a step info", _WAYS)

    @property
    def is_settled(self) -> bool:
        """Whether the signal rests at the end of the response."""
        return math.isfinite(self.settling_time)

    def as_dict(self) -> dict[str, float]:
        """Return the numbers by python-control's names; as there, the overshoot and the undershoot are in percent."""
        found = {key: float(getattr(self, name)) for key, name in _KEYS.items()}
        return found | {key: 100.0 * found[key] for key in ("Overshoot", "Undershoot")}

    def __repr__(self) -> str:
        facts = (
            f"overshoot {100.0 * self.overshoot:.4g} %",
            f"rise_time {self.rise_time:.4g} s",
            f"settling_time {self.settling_time:.4g} s",
        )
        shown = facts if self.is_settled else ("not at rest at the end",)
        return brief(f"step of {self.signal!r} at {self.since:.6g} s", *shown, then="print(…) shows all")

    def _sheet(self) -> Sheet:
        names = ("start_value", "steady_state_value", *_TIMES[:2], *_SHARES, "peak", _TIMES[2])
        rows = tuple((name, getattr(self, name), self._unit(name)) for name in (*names, "settling_min", "settling_max"))
        note = "" if self.is_settled else self._why_not()
        head = f"step of {self.signal!r} at {self.since:.9g} s, until {self.until:.9g} s"
        return Sheet(head, (), (Grid("", ("number", "value", "unit"), rows),), (note,) if note else ())

    def _unit(self, name: str) -> str:
        if name in _SHARES:
            value = 100.0 * getattr(self, name)
            return f"{value:.3g} %" if math.isfinite(value) else ""
        return "s" if name in _TIMES else self.unit

    def _why_not(self) -> str:
        if math.isinf(self.settling_time):
            return f"It rests at {self.steady_state_value:.6g}, away from the final value that was given."
        if self.peak == self.start_value:
            return "The signal doesn't move after the step."
        return (
            "The signal still moves at the end, or goes back to where it was: there is no steady state to measure by. "
            "Simulate longer, or end the response before the next step, until=…."
        )


def find_step(diagram: Any, end: float, start: float, who: str) -> float:
    """Return the time in s of the only step of a diagram's `Step` blocks up to an end; the start without any."""
    blocks: Mapping[str, Any] = {} if diagram is None else diagram.blocks
    found = [
        (float(t), path) for path, block in blocks.items() if isinstance(block, Step) for t in np.ravel(block.times)
    ]
    found = sorted(pair for pair in found if start <= pair[0] < end)
    if len({t for t, _ in found}) > 1:
        steps = enumerate_some([f"{path} at {t:.6g} s" for t, path in found])
        raise OptionError(
            f"found several steps: {steps}; expected the one that is measured. Name its time, and the next one's as "
            f"the end: since={found[0][0]:.6g}, until={found[1][0]:.6g}.",
            block=who,
            port="since",
        )
    return found[0][0] if found else start


def measure_info(
    signal: str, unit: str, t: np.ndarray, y: np.ndarray, since: float, *, held: bool, final: float | None
) -> StepInfo:
    """Return the numbers of a signal's response to a step at ``since``, with times and samples up to its end.

    ``held`` is whether the signal is constant between its samples, ``final`` the value that it should come to.
    """
    first = int(np.searchsorted(t, since * (1.0 - 1e-12) - 1e-12))
    after = t[first:]
    if len(after) < _FEWEST:
        raise OptionError(
            f"found {len(after)} samples from {since:.6g} s to the end at {t[-1] if len(t) else 0.0:.6g} s; expected "
            f"{_FEWEST} at least. Name an earlier time of the step, since=…, or simulate longer.",
            block=signal,
            port="since",
        )
    # The sample before the step is the value at rest; the step itself may already move the first one.
    before = float(y[max(first - 1, 0)])
    times = np.append(0.0, np.maximum(after - since, 0.0))
    r = np.append(0.0, y[first:] - before)
    found = measure_step(times, r, held=held, target=None if final is None else final - before)
    change = found["final"].value
    far = int(np.argmax(np.abs(r)))
    # Extremes after the rise and the undershoot need a change to be measured against.
    low = high = under = math.nan
    if math.isfinite(change) and change != 0.0:
        under = max(0.0, float(np.max(-r / change)))
        up = r / change >= 0.9
        if up.any():
            risen = before + r[int(np.argmax(up)) :]
            low, high = float(risen.min()), float(risen.max())
    return StepInfo(
        signal,
        unit,
        float(since),
        float(t[-1]),
        before,
        before + change,
        found["rise"].value,
        found["settling"].value,
        found["overshoot"].value,
        under,
        before + float(r[far]),
        float(times[far]),
        low,
        high,
    )


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
