"""Limits and peaks over one quantity: seen in a scan, refined, and confirmed by a computation that shares neither.

All margins are found in these three steps. A scan is a list of values at rising places; the refinement searches between
two of them; the result is a `Candidate`. Its confirmation evaluates stability on both sides, and makes it a `Number`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ...blocks.core import ConfirmationError
from .number import Confirmation, Number

EQUAL = 1e-9
"""Relative difference below which numbers count as equal."""
STEP = 0.01
"""Relative distance from a limit at which stability is tested."""
FEW = 6
"""Values up to which a confirmation names each."""
MOST_PEAKS = 8
"""Number of candidates of a largest value that are refined."""

Function = Callable[[float], float]


def first_largest(values: Any) -> int:
    """Return the place of the largest number, the first of those that equal it but for rounding; NaN never is."""
    row = np.asarray(values, dtype=float)
    largest = np.nanmax(row)
    return int(np.argmax(row >= largest - EQUAL * abs(largest)))


def order_key(value: float) -> float:
    """Return a number without its last digits, so that a second key orders those that are equal but for rounding."""
    return float(f"{value:.9e}")


# --- refine ---------------------------------------------------------------------------------------------------------


def refine_sign_change(function: Function, low: float, high: float, *, xtol: float, rtol: float = 1e-14) -> float:
    """Return where a function changes its sign between two values, by Brent's method."""
    from scipy.optimize import brentq

    # A scan computes many values at once, which may round otherwise than one by one. An end at which the function is 0
    # but for rounding can then have lost the sign that the scan saw; it is the place that is looked for.
    first, last = function(low), function(high)
    if (first < 0.0) == (last < 0.0):
        return low if abs(first) <= abs(last) else high
    return float(brentq(function, low, high, xtol=xtol, rtol=rtol, maxiter=200))


def find_first_limit(growth: Function, begin: float, places: Iterable[float]) -> float | None:
    """Return the first limit of stability beyond ``begin``, where the growth rate is negative; None if there is none.

    ``places`` are those of the scan in order; a limit and a return to stability between two of them are not seen.
    """
    inside = begin
    for place in places:
        if growth(place) >= 0:
            return refine_sign_change(growth, inside, place, xtol=1e-14 * abs(place))
        inside = place
    return None


def find_largest(function: Function, omega: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    """Return the largest value of a function of frequency, refined by bounded minimization, and its frequency.

    ``values`` are those at the frequencies ``omega`` of a scan, which rise, from 0 to infinity where it has the ends.
    Of peaks that are equal but for rounding it is the one at the lowest frequency.
    """
    from scipy.optimize import minimize_scalar

    start = first_largest(values)
    best, where = float(values[start]), float(omega[start])
    padded = np.concatenate([[-np.inf], values, [-np.inf]])
    refined: list[tuple[float, float]] = []
    peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    for k in peaks[np.argsort(-values[peaks], kind="stable")][:MOST_PEAKS]:
        if not 0.0 < omega[k] < np.inf:  # the ends, which are evaluated exactly
            continue
        low, high = omega[max(k - 1, 0)] or omega[k] / 10, omega[min(k + 1, len(omega) - 1)]
        high = high if np.isfinite(high) else 10 * omega[k]
        found = minimize_scalar(
            lambda x: -function(np.exp(x)),
            bounds=(np.log(low), np.log(high)),
            method="bounded",
            options={"xatol": 1e-12},
        )
        refined.append((float(np.exp(float(found.x))), -float(found.fun)))
    refined.sort()
    # a sample near a peak may equal it but for rounding: it counts where it is larger than every peak
    if refined and (highest := max(value for _, value in refined)) > best * (1.0 - EQUAL):
        best, where = max(best, highest), refined[first_largest([value for _, value in refined])][0]
    return best, where


# --- confirm --------------------------------------------------------------------------------------------------------


def pick_test_values(value: float, others: Sequence[float], nominal: float) -> tuple[float, float]:
    """Return two values at which stability is tested, 1 % to both sides of a limit; the nominal side comes first.

    They are nearer where another limit, or the nominal value, would lie in between.
    """
    apart = [abs(o - value) / abs(value) for o in (*others, nominal) if abs(o - value) > 1e-9 * abs(value)]
    h = min([STEP, *(0.5 * a for a in apart)])
    inner, outer = value * (1 - h), value * (1 + h)
    return (inner, outer) if abs(nominal - inner) < abs(nominal - outer) else (outer, inner)


def confirm_limit(
    name: str, value: float, others: Sequence[float], nominal: float, stable: Callable[[float], bool], how: str
) -> Confirmation:
    """Confirm that stability ends at a limit, seen from the nominal value; return the computation."""
    inside, outside = pick_test_values(value, others, nominal)
    found = stable(inside), stable(outside)
    if found != (True, False):
        words = ["stable" if s else "unstable" for s in found]
        raise ConfirmationError(
            f"found the limit {value:.12g}, but {how} say {words[0]} at {inside:.12g} and {words[1]} at "
            f"{outside:.12g}; expected stable before it and unstable beyond it. Look at closed_loop_poles: the "
            "realization may be ill-conditioned.",
            block=name,
        )
    return Confirmation(
        f"{how}: stable at {inside:.9g}, unstable at {outside:.9g}",
        f"{how}: stable just before this value, unstable just beyond it",
    )


def confirm_no_limit(name: str, values: Sequence[float], stable: Callable[[float], bool], how: str) -> Confirmation:
    """Confirm that the loop is stable at all the values; return the computation."""
    bad = [v for v in values if not stable(v)]
    if bad:
        raise ConfirmationError(
            f"found no limit, but {how} say unstable at {bad[0]:.6g}; expected stable. Look at closed_loop_poles.",
            block=name,
        )
    method = f"{how}: stable at all values that were tried"
    if len(values) > FEW:
        text = f"{how}: stable at {len(values)} values from {values[0]:.6g} to {values[-1]:.6g}"
    else:
        text = f"{how}: stable at " + ", ".join(f"{v:.6g}" for v in values)
    return Confirmation(text, method)


@dataclass(frozen=True)
class Candidate:
    """A number that was scanned and refined, with the computation that will confirm it.

    ``confirm`` returns what agreed, and raises `ConfirmationError` where nothing does.
    """

    value: float
    unit: str
    tolerance: float
    confirm: Callable[[], str]
    is_gain: bool = False

    @classmethod
    def of_limit(
        cls,
        name: str,
        value: float,
        unit: str,
        tolerance: float,
        stable: Callable[[float], bool],
        how: str,
        *,
        nominal: float = 0.0,
        others: Sequence[float] = (),
        tried: Sequence[float] = (),
        is_gain: bool = False,
    ) -> Candidate:
        """Return a limit of stability.

        ``value``: the limit; 0 or infinite where none was found, so that stability is confirmed at values of ``tried``.
        ``stable``: whether the loop is stable at a value, by a computation other than the scan; ``how`` names it.
        ``nominal``: value at which the loop is stable, as it is.
        ``others``: further limits, which the tests on both sides stay clear of.
        """
        if value in (0.0, np.inf):
            return cls(value, unit, 0.0, partial(confirm_no_limit, name, tried, stable, how), is_gain)
        return cls(value, unit, tolerance, partial(confirm_limit, name, value, others, nominal, stable, how), is_gain)

    @classmethod
    def known(cls, value: float, unit: str, tolerance: float, how: str) -> Candidate:
        """Return a number that needs no further computation; ``how`` says what makes it certain, or why it is NaN."""
        return cls(value, unit, tolerance, lambda: how)

    def confirmed(self) -> Number:
        """Return the number, confirmed."""
        return Number(self.value, self.unit, self.tolerance, self.confirm(), is_gain=self.is_gain)
