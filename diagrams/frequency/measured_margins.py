"""Margins of a loop that was measured: from frequency-response data, with intervals from its uncertainty.

Between two points the data are interpolated over the logarithm of the frequency: the logarithm of the gain, and the
phase without jumps. The value is that of a monotone cubic; the distance of a straight line from it is added to the
uncertainty, so that sparse points make wide intervals. Beyond the first and last point nothing is known: a margin whose
crossing is not among the points is NaN, and a note says so.

Margins are distances from instability of a closed loop that is stable. Data can't show that it is: a loop that was
measured in closed loop was.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...blocks.core import OptionError, Sheet, accepts, brief, explain_calls, kinds
from .margin_analysis import MarginTable
from .number import Interval

FINE = 200
"""Frequencies between two measured points."""
NOTHING = (math.nan, math.nan, math.nan)


@explain_calls
@dataclass(frozen=True)
class MeasuredMargins(MarginTable):
    """Margins of a measured loop; the quantities are those of `Margins`.

    Attributes
    ----------
    gain_margin_low, gain_margin_high : Interval
        The factors below and above 1 at which the loop reaches −1.
    phase_margin_deg : Interval
        The smallest rotation to −1, of all gain crossovers.
    delay_margin_s : Interval
        The smallest delay that does so.
    modulus_margin, ms : Interval
        Smallest distance of L from −1, and its inverse, the largest |S|; NaN where |L| does not fall below 1 among the
        data. Beyond the last point |L| is taken to stay below its last value.
    crossover : Interval
        Gain crossover of the phase margin, in rad/s.
    notes : tuple of str
        Remarks on margins that are not in the data.
    """

    gain_margin_low: Interval
    gain_margin_high: Interval
    phase_margin_deg: Interval
    delay_margin_s: Interval
    modulus_margin: Interval
    ms: Interval
    crossover: Interval
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        facts = (
            f"phase_margin_deg {self.phase_margin_deg}",
            f"gain_margin_high {self.gain_margin_high}",
            f"ms {self.ms}",
        )
        return brief("measured margins", *facts, then="print(…) shows all")

    def _sheet(self) -> Sheet:
        return Sheet("measured margins", (), (self._grid(),), self.notes)


@dataclass(frozen=True, eq=False)
class _Curve:
    """The interpolated loop: ln |L| and phase + 180° in rad, with bounds of their errors."""

    w: np.ndarray
    gain: np.ndarray
    turn: np.ndarray
    gain_error: np.ndarray
    turn_error: np.ndarray


@accepts(uncertainty=kinds.numbers)
def measured_margins(data: Any, uncertainty: ArrayLike | None = None) -> MeasuredMargins:
    """Return the margins of a measured loop.

    Parameters
    ----------
    data : control.FrequencyResponseData or FrequencyResponse
        The loop L: data of python-control or `read_frequency_data`, or a measurement, `Diagram.frequency_response`.
    uncertainty : array_like, optional
        Relative uncertainty of L at each frequency, or one for all; without it the data's own, or 0.

    Raises
    ------
    OptionError
        If there are several inputs or outputs, fewer than 3 frequencies, values that are not finite, an uncertainty
        that does not fit, is not finite or not below 1.

    Examples
    --------
    >>> import control, numpy as np
    >>> w = np.geomspace(0.1, 10.0, 60)
    >>> found = measured_margins(control.frd(control.tf([2.0], [1.0, 1.0, 0.0]), w), uncertainty=0.01)
    >>> 38.668 in found.phase_margin_deg
    True
    """
    loop, w, r = _read(data, uncertainty)
    curve = _interpolate(loop, w, r)
    notes = []
    phase = _phase_margin(curve)
    if math.isnan(phase[0][0]):
        crossed = np.any((curve.gain[1:] > 0.0) != (curve.gain[:-1] > 0.0))
        how = "may cross 1 outside the points between" if crossed else "does not cross 1 between"
        notes.append(f"|L| {how} {w[0]:.4g} and {w[-1]:.4g} rad/s: no phase and delay margin.")
    low, high = _gain_margins(curve)
    if math.isnan(low[0]) and math.isnan(high[0]):
        notes.append(f"L is not real and negative between {w[0]:.4g} and {w[-1]:.4g} rad/s: no gain margin.")
    value = np.exp(curve.gain + 1j * (curve.turn - np.pi))
    distance = np.abs(1.0 + value)
    beyond = np.abs(value) * (np.expm1(curve.gain_error) + curve.turn_error)
    modulus = (
        float(np.min(distance)),
        max(0.0, float(np.min(distance - beyond))),
        float(np.min(distance + beyond)),
    )
    modulus = _with_the_rest(modulus, curve, int(np.argmin(distance)))
    if math.isnan(modulus[0]):
        notes.append(
            f"the smallest distance from −1 need not lie between {w[0]:.4g} and {w[-1]:.4g} rad/s: "
            "no modulus margin and M_s."
        )
    ms = (1.0 / modulus[0], 1.0 / modulus[2], 1.0 / modulus[1] if modulus[1] != 0.0 else math.inf)
    return MeasuredMargins(
        Interval(*low, "1"),
        Interval(*high, "1"),
        Interval(*phase[0], "deg"),
        Interval(*phase[1], "s"),
        Interval(*modulus, "1"),
        Interval(*ms, "1"),
        Interval(*phase[2], "rad/s"),
        tuple(notes),
    )


def _with_the_rest(modulus: tuple[float, float, float], curve: _Curve, least: int) -> tuple[float, float, float]:
    """Return the distance from −1 and its bounds, with what the loop can do beyond the last point.

    From there on |L| is taken to stay below its last value, so that 1 − |L| bounds the distance. Where |L| has not
    fallen below 1, or the distance is smallest at the first point, the data don't have the smallest one.
    """
    last = float(np.exp(curve.gain[-1] + curve.gain_error[-1]))
    if last >= 1.0 or (least == 0 and modulus[0] < 1.0):
        return NOTHING
    return modulus[0], min(modulus[1], 1.0 - last), modulus[2]


def _read(data: Any, uncertainty: ArrayLike | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return L, the frequencies in rad/s, rising, and the relative uncertainty of L."""
    own = getattr(data, "uncertainty", None) if uncertainty is None else uncertainty
    data = data if hasattr(data, "frdata") else getattr(data, "L", data)
    name = str(getattr(data, "name", None) or "loop")
    if not hasattr(data, "frdata") or np.shape(data.frdata)[:2] != (1, 1):
        found = f"a shape {np.shape(data.frdata)[:2]}" if hasattr(data, "frdata") else type(data).__name__
        raise OptionError(
            f"found {found}; expected frequency-response data of one input and one output. Make it: "
            "control.frd(values, omega), read_frequency_data(file), or diagram.frequency_response(wire, …).",
            block=name,
            port="data",
        )
    w, loop = np.asarray(data.omega, dtype=float), np.asarray(data.frdata, dtype=complex)[0, 0]
    r = np.asarray(0.0 if own is None else own, dtype=float)
    if r.shape not in ((), w.shape) or not np.all(np.isfinite(r)) or np.any(r < 0.0) or np.any(r >= 1.0):
        raise OptionError(
            f"found an uncertainty of shape {r.shape} up to {np.max(r, initial=0.0):g} for {len(w)} frequencies; "
            "expected one for each, or one for all, from 0 to below 1, relative to L. Leave out points that are not "
            "known better.",
            block=name,
            port="uncertainty",
        )
    order = np.argsort(w, kind="stable")
    w, loop, r = w[order], loop[order], np.broadcast_to(r, w.shape)[order]
    fits = np.isfinite(loop) & (loop != 0.0)
    if (twice := w[1:][np.diff(w) <= 0.0]).size:
        raise OptionError(
            f"found the frequency {twice[0]:g} rad/s more than once; expected each one once. Leave the others out, or "
            "take their mean.",
            block=name,
            port="data",
        )
    if len(w) < 3 or not np.all(fits) or w[0] <= 0.0:
        raise OptionError(
            f"found {len(w)} frequencies from {w[0] if len(w) else math.nan:g} rad/s on, {int(np.sum(~fits))} of them "
            "with a value that is not finite or is 0; expected at least 3, above 0. Drop the others.",
            block=name,
            port="data",
        )
    return loop, w, r


def _interpolate(loop: np.ndarray, w: np.ndarray, r: np.ndarray) -> _Curve:
    from scipy.interpolate import PchipInterpolator

    x = np.log(w)
    fine = np.concatenate([np.linspace(a, b, FINE, endpoint=False) for a, b in itertools.pairwise(x)])
    fine = np.append(fine, x[-1])
    values = np.log(np.abs(loop)), np.unwrap(np.angle(loop))
    smooth = [PchipInterpolator(x, y)(fine) for y in values]
    apart = [np.abs(np.interp(fine, x, y) - s) for y, s in zip(values, smooth, strict=True)]
    left = np.minimum(np.searchsorted(x, fine, side="right") - 1, len(x) - 2)
    own = np.maximum(r[left], r[left + 1])
    gain_error, turn_error = apart[0] - np.log1p(-own), apart[1] + np.arcsin(own)
    return _Curve(np.exp(fine), smooth[0], smooth[1] + np.pi, gain_error, turn_error)


def _phase_margin(curve: _Curve) -> tuple[tuple[float, float, float], ...]:
    """Return the smallest phase margin in degrees, delay margin in s, and crossover in rad/s, with their bounds."""
    turn = (curve.turn + np.pi) % (2.0 * np.pi) - np.pi
    possible = np.abs(curve.gain) <= curve.gain_error
    crossed = np.flatnonzero((curve.gain[1:] > 0.0) != (curve.gain[:-1] > 0.0))
    if not crossed.size:
        return NOTHING, NOTHING, NOTHING
    found = possible.copy()
    found[crossed] = found[crossed + 1] = True
    part = -curve.gain[crossed] / (curve.gain[crossed + 1] - curve.gain[crossed])

    def at(y: np.ndarray) -> np.ndarray:
        return np.asarray(y[crossed] + part * (y[crossed + 1] - y[crossed]))

    if found[0] or found[-1]:  # a crossing may lie beyond the data
        return NOTHING, NOTHING, NOTHING
    rotation, w = np.abs(at(turn)), at(curve.w)
    least, most = np.maximum(np.abs(turn) - curve.turn_error, 0.0), np.abs(turn) + curve.turn_error
    forward = at(turn) % (2.0 * np.pi)  # a delay turns one way only
    late = (turn % (2.0 * np.pi)) / curve.w
    k, d = int(np.argmin(rotation)), int(np.argmin(forward / w))

    def around(i: int) -> slice:
        return _find_range(found, int(crossed[i]))

    error = curve.turn_error / curve.w
    return (
        tuple(np.degrees([rotation[k], np.min(least[found]), np.max(most[around(k)])]).tolist()),
        (
            float(forward[d] / w[d]),
            max(0.0, float(np.min((late - error)[found]))),
            float(np.max((late + error)[around(d)])),
        ),
        (float(w[k]), float(curve.w[around(k)][0]), float(curve.w[around(k)][-1])),
    )


def _find_range(possible: np.ndarray, crossed: int) -> slice:
    """Return the frequencies around a crossing at which it may lie, as the data's uncertainty makes it possible."""
    outside = np.flatnonzero(~possible)
    first, last = outside[outside < crossed], outside[outside > crossed + 1]
    return slice(int(first[-1]) + 1 if first.size else 0, int(last[0]) if last.size else len(possible))


def _gain_margins(curve: _Curve) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return the gain margins below and above 1, with their bounds."""
    turn = (curve.turn + np.pi) % (2.0 * np.pi) - np.pi
    near = np.abs(turn) < 0.5 * np.pi
    crossed = np.flatnonzero(((turn[1:] > 0.0) != (turn[:-1] > 0.0)) & near[1:] & near[:-1])
    lower, upper = NOTHING, NOTHING
    possible = (np.abs(turn) <= curve.turn_error) & near
    for i in crossed:
        part = -turn[i] / (turn[i + 1] - turn[i])
        value = math.exp(-(curve.gain[i] + part * (curve.gain[i + 1] - curve.gain[i])))
        where = _find_range(possible, int(i))
        least = math.exp(-float(np.max((curve.gain + curve.gain_error)[where])))
        most = math.exp(-float(np.min((curve.gain - curve.gain_error)[where])))
        found = value, min(least, value), max(most, value)
        if value >= 1.0 and not value >= upper[0]:
            upper = found
        if value < 1.0 and not value <= lower[0]:
            lower = found
    return lower, upper
