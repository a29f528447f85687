"""Margins by python-control next to ours, with a verdict and its reason where they differ."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from ...blocks.core import ConfirmationError, ParameterError, accepts, explain_calls, kinds, on_one_thread
from .loop_margins import Margins, margins
from .loop_scan import LoopScan
from .realization import Realization
from .scan_refine_confirm import confirm_limit, pick_test_values

if TYPE_CHECKING:
    from control import StateSpace
    from numpy.typing import ArrayLike

    from .state_space import LinearSystem

SAME = 1e-4
"""Relative difference up to which two values are the same."""
ENTRIES_AT_ONCE = 1 << 16
"""Entries of matrices that are solved in one call: 1 MB of complex numbers."""
T = TypeVar("T")


@explain_calls
@dataclass(frozen=True)
class Comparison:
    """One number of a loop, by Loopwright and by python-control.

    Parameters
    ----------
    name : str
        Name as in `Margins`.
    value : float
        Value by Loopwright.
    control : float
        Value by python-control in the same unit; NaN where it gives none.
    function : str
        Function of python-control.
    right : str
        "both", "ours" (also where python-control gives none), or "neither is refuted".
    why : str
        Reason for the verdict.
    """

    name: str
    value: float
    control: float
    function: str
    right: str
    why: str


@accepts(delay=kinds.finite)
def compare_with_control(loop: LinearSystem, *, delay: int = 0) -> tuple[Comparison, ...]:
    """Return each margin with python-control's value, with a verdict and its reason.

    A value that differs is tested: gains and phases by closed-loop eigenvalues at 0.99 and 1.01 of it, frequencies and
    peaks by the frequency response.

    Parameters
    ----------
    loop : control.StateSpace
        L with one channel, closed loop stable.
    delay : int
        Whole samples of delay in series with a sampled loop.

    Raises
    ------
    ParameterError
        If the closed loop is not stable.
    """
    import control

    ours = margins(loop, delay=delay)
    if not ours.stable:
        raise ParameterError(
            "found a closed loop that is not stable; expected a stable one: this one has no margins to compare. Look "
            "at margins(loop).closed_loop_poles.",
            block="compare_with_control",
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # SciPy 1.18 warns of the coefficients; the comparison itself judges the result
        L = control.ss(loop)
    for _ in range(delay):
        L = L * control.ss(0, 1, 1, 0, L.dt)
    return compare_margins(Realization.of(loop, delay=delay), ours, L)


@on_one_thread
def compare_margins(r: Realization, ours: Margins, L: StateSpace) -> tuple[Comparison, ...]:
    """Return computed margins with python-control's values for L; r is the realization of L."""
    judge = _Judge(r, ours)
    found = []
    for name, (function, value, reason) in _ask_control(L, ours).items():
        mine = float(ours.encirclements) if name == "encirclements" else ours.numbers()[name].value
        found.append(judge.compare(name, mine, value, function, reason))
    return tuple(found)


def _ask_control(L: StateSpace, ours: Margins) -> dict[str, tuple[str, float, str]]:
    """Return python-control's numbers of a loop, each with its function; one that raises gives NaN and its message."""
    import control

    L = respond_at_once(L)

    def disk() -> float:
        poles = np.asarray(ours.closed_loop_poles, dtype=complex)
        near = np.abs(np.log(poles[poles != 0.0]) / L.dt if L.dt else poles)  # a sharp minimum is at one of these
        top = np.pi / L.dt if L.dt else 100 * max([1.0, *near])
        omega = np.geomspace(top * 1e-6, top * (1 - 1e-9), 400)
        omega = np.unique([*omega, *near[(near > omega[0]) & (near < omega[-1])]])
        for _ in range(4):  # ever closer around the least one; 4000 frequencies at once take 100 ms
            found = control.disk_margins(L, omega, returnall=True)[0]
            least = int(np.argmin(found))
            omega = np.geomspace(omega[max(least - 1, 0)], omega[min(least + 1, len(omega) - 1)], 41)
        return float(found[least])

    def bandwidth() -> float:
        return float(control.bandwidth(respond_at_once(control.feedback(L, 1))))

    def encirclements() -> float:
        return float(control.nyquist_response(L).count)

    out: dict[str, tuple[str, float, str]] = {}
    margins_of, why = _call_quietly(lambda: control.stability_margins(L))
    gm, pm, sm, _, wgc, _ = margins_of if margins_of is not None else (np.nan,) * 6
    low = gm if gm < 1 else np.nan
    high = gm if gm > 1 else np.nan
    one = "it gives one gain margin only, the other side's is not reported"
    out["gain_margin_low"] = ("stability_margins", float(low), why or one)
    out["gain_margin_high"] = ("stability_margins", float(high), why or one)
    out["phase_margin_deg"] = ("stability_margins", float(pm), why)
    if np.isinf(ours.delay_margin_s.value):
        out["delay_margin_s"] = ("stability_margins", np.inf if np.isinf(pm) else np.nan, why)
    else:
        lag = np.radians(pm % 360)
        out["delay_margin_s"] = ("stability_margins, pm/ωpm", float(lag / wgc) if wgc else np.nan, why)
    out["modulus_margin"] = ("stability_margins", float(sm), why or "it gives none")
    for name, function, call in (
        ("disk_margin", "disk_margins", disk),
        ("bandwidth", "bandwidth", bandwidth),
        ("encirclements", "nyquist_response", encirclements),
    ):
        value, message = _call_quietly(call)
        out[name] = (function, np.nan if value is None else value, message)
    return out


def respond_at_once(system: StateSpace) -> StateSpace:
    """Return a copy whose response at many points is a few calls of NumPy; python-control makes one for each point."""
    import control

    one_by_one = system.horner
    A, B, C, D, n = system.A, system.B, system.C, system.D, system.nstates

    def horner(x: ArrayLike, warn_infinite: bool = True) -> np.ndarray:
        points = np.atleast_1d(np.asarray(x, dtype=complex))
        if n < 2 or points.ndim > 1:  # python-control returns other shapes for these
            return np.asarray(one_by_one(x, warn_infinite))
        at_once = max(1, ENTRIES_AT_ONCE // n**2)
        try:
            parts = [
                C @ np.linalg.solve(some[:, None, None] * np.eye(n) - A, B[None]) + D
                for some in np.split(points, range(at_once, len(points), at_once))
            ]
        except np.linalg.LinAlgError:  # at a pole, where python-control distinguishes infinity from NaN
            return np.asarray(one_by_one(x, warn_infinite))
        return np.moveaxis(np.concatenate(parts), 0, 2)

    copy = control.ss(system)
    copy.horner = horner
    return copy


def _call_quietly(call: Callable[[], T]) -> tuple[T | None, str]:
    """Return the result of a call without its warnings, and "" or the text of the error that it raises."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return call(), ""
        except Exception as error:
            return None, f"it raises {type(error).__name__}: {error}"


class _Judge:
    """Verdicts between two values of one loop."""

    def __init__(self, r: Realization, ours: Margins):
        self.r, self.ours, self.scan = r, ours, LoopScan(r)

    def compare(self, name: str, mine: float, theirs: float, function: str, reason: str) -> Comparison:
        same = mine == theirs or abs(mine - theirs) <= SAME * abs(mine)
        if same:
            return Comparison(name, mine, theirs, function, "both", "they agree")
        if name == "phase_margin_deg" and abs(mine + theirs) <= SAME * abs(mine):
            text = "they agree but for the sign: rotations by as much either way end stability"
            return Comparison(name, mine, theirs, function, "both", text)
        how = "our value is confirmed"
        if name in self.ours.numbers():
            how += " by " + self.ours.numbers()[name].confirmed_by
        if np.isnan(theirs):
            return Comparison(name, mine, theirs, function, "ours", f"{reason or 'it gives none'}; {how}")
        try:
            refuted = self._refute(name, mine, theirs)
        except (np.linalg.LinAlgError, ArithmeticError) as error:
            refuted, reason = "", f"theirs can't be judged ({error})"
        why = refuted or reason or "stability ends at both"
        return Comparison(name, mine, theirs, function, "ours" if refuted else "neither is refuted", f"{why}; {how}")

    def _refute(self, name: str, mine: float, value: float) -> str:
        """Return the reason why a value is wrong, or "" if it may be right."""
        r = self.r
        if name in ("gain_margin_low", "gain_margin_high"):
            if value in (0.0, np.inf):
                return f"it says that there is none, and the factor {mine:.9g} ends stability"
            return self._refute_limit(value, 1.0, r.is_stable)
        if name == "phase_margin_deg":
            if not np.isfinite(value):
                return "|L| = 1 somewhere, and a rotation there ends stability"
            return self._refute_limit(value, 0.0, lambda degrees: r.is_stable(np.exp(-1j * np.radians(degrees))))
        if name == "encirclements":
            return "it is not Z − P of the eigenvalues"
        if name == "bandwidth":
            if value == np.inf:
                return "it says that |T| does not fall to 1/√2 of its low-frequency value, and it does"
            L = complex(r.response(value)[0][0]) if 0 < value <= r.nyquist else complex(np.nan)
            zero = self.scan.ends()[0][1]
            low = 1.0 if np.isinf(zero) else abs(zero / (1 + zero))
            fall = abs(L / (1 + L)) / low
            text = f"|T| is {fall:.6f} of its low-frequency value there, not 1/√2 = {2**-0.5:.6f}"
            return text + (" (10^(−3/20) = 0.707946 is used)" if abs(fall - 10**-0.15) < 1e-5 else "")
        if name == "modulus_margin":
            nearest = 1 / self.scan.find_peak(1, 0).value
            return f"L comes as near as {nearest:.9g} to −1" if nearest < value else "L does not come as near to −1"
        if name == "disk_margin":
            return f"max|S − T|/2 is {self.scan.find_peak(0.5, -0.5).value:.9g}, the reciprocal of ours"
        return "its phase margin or crossover is another" if name == "delay_margin_s" else ""

    @staticmethod
    def _refute_limit(value: float, nominal: float, stable: Callable[[float], bool]) -> str:
        """Return the reason why stability does not end at a value, or "" if it does."""
        try:
            confirm_limit("control", value, [], nominal, stable, "closed-loop eigenvalues")
        except ConfirmationError:
            inside, outside = (stable(v) for v in pick_test_values(value, [], nominal))
            words = ["stable" if s else "unstable" for s in (inside, outside)]
            return f"closed-loop eigenvalues say {words[0]} just before it and {words[1]} just beyond"
        return ""
