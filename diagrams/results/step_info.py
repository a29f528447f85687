"""Numbers of a run's response to a step, those of python-control's step_info: rise and settling time, overshoot, peak.

They are measured by `measure_step`, as a report's step responses are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import Grid, OptionError, Sheet, ShownAsTable, brief, enumerate_some, explain_calls, missing_member
from ...blocks.library import Step
from .step_measures import measure_step

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
