"""Margins of a periodic loop: one static factor on a wire that is renewed several times in the period.

The loop is lifted: L is N × N, with a channel for each of the N renewals, and one factor f multiplies all of them. The
closed loop has a pole at z = e^(jθ) where −1/f is an eigenvalue of L(e^(jθ)). The factors that destabilize are curves
in the complex plane, F = {−1/λ(L(e^(jθ)))}, and a margin is a distance to them. Closed-loop eigenvalues of the lifted
system find the limits of gain, rotation and delay, and confirm the disk margin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import ConfirmationError, Finding, ParameterError, explain_calls, on_one_thread
from .disk_margins import disk_gains
from .margin_analysis import MarginFinder, StabilityMargins
from .number import Confirmation, Number, carries_findings
from .poles_and_zeros import SIDES
from .realization import Realization
from .scan_refine_confirm import Candidate, find_first_limit, find_largest, first_largest
from .sensitivity_peaks import confirm_peak, sensitivity_at

if TYPE_CHECKING:
    from .state_space import LinearSystem

EIGENVALUES = "closed-loop eigenvalues of the lifted system"
LARGEST = 1e4
"""Largest gain at which a limit is looked for, and reciprocal of the smallest."""
SMALLEST_STEP = 1e-3
"""Least relative step of the search for a limit."""
RENEWALS = 100
"""Most renewals of delay that are tried."""
INSIDE = 1e-3
"""Relative distance from the disk's rim at which closed-loop eigenvalues are looked at."""
ON_RIM = 180
"""Factors on the upper half of the disk's rim at which they are looked at."""


@explain_calls
@dataclass(frozen=True, repr=False)
class PeriodicMargins(StabilityMargins):
    """Margins of a periodic loop, of one static factor on the wire; those of an unstable closed loop are NaN.

    Parameters
    ----------
    stable : bool
        Whether all of `closed_loop_poles` are stable.
    gain_margin_low, gain_margin_high : Number
        Largest factor below 1, and smallest above 1, that ends stability; 0 and infinity where there is none.
    phase_margin_deg : Number
        Smallest angle φ, to either side, for which the factor e^(jφ) ends stability; infinite where none does.
    delay_margin_samples, delay_margin_s : Number
        Whole renewals of delay on the wire that the loop bears, and the time that they take; one more ends stability.
    disk_margin : Number
        Smallest α for which a factor (1 + δ/2)/(1 − δ/2), |δ| = α, ends stability. For a loop with one renewal in
        the period it is that of `disk_margin`.
    disk_frequency : Number
        Frequency θ/T of the closed-loop pole that this factor puts on the limit, T the period.
    ms, mt : Number
        Largest gain, in energy over all times and for disturbances of every shape, from a disturbance at the wire to
        what its consumers get, and to the answer that comes back: the largest singular values of the lifted S and T
        over frequency. For a loop with one renewal in the period they are max |S| and max |T|.
    modulus_margin : Number
        1/M_s: L may be changed by anything of a smaller gain, with memory and varying in time.
    destabilizing : complex
        The factor.
    closed_loop_poles : tuple of complex
        Poles z over the period.
    renewals : int
        Renewals of the wire in the period.
    dt : float
        The period in s.
    findings : tuple of Finding
        Effects on the loop that its linear model leaves out.
    """

    stable: bool
    gain_margin_low: Number
    gain_margin_high: Number
    phase_margin_deg: Number
    delay_margin_samples: Number
    delay_margin_s: Number
    disk_margin: Number
    disk_frequency: Number
    modulus_margin: Number
    ms: Number
    mt: Number
    destabilizing: complex
    closed_loop_poles: tuple[complex, ...]
    renewals: int
    dt: float
    findings: tuple[Finding, ...] = ()

    def _title(self) -> str:
        return f"margins of a periodic loop, period {self.dt:g} s"

    def _further_facts(self) -> list[tuple[str, str]]:
        return [("period", f"{self.dt:g} s, in which the wire is renewed {self.renewals} times")]


@explain_calls
@carries_findings
@on_one_thread
def periodic_margins(loop: LinearSystem) -> PeriodicMargins:
    """Return the margins of a periodic loop, each confirmed by closed-loop eigenvalues of the lifted system.

    All slower and faster loops are closed. A factor stays the same at all renewals: a gain, a rotation, or any factor
    of the disk. For the loop with the slower loops open take `margins` of ``loop(wire, slow="open")``.

    Parameters
    ----------
    loop : control.StateSpace
        Lifted loop of one wire, ``Linearization.loop(wire, lifted=True)``: N × N, a channel for each renewal, sampled
        with the period.

    Raises
    ------
    ConfirmationError
        If a number and its confirmation disagree.
    ParameterError
        If the loop is not sampled, not square, of several wires, without states, or without a unique solution when it
        is closed.

    Examples
    --------
    >>> import control
    >>> D = [[0.0, 0.0], [0.4, 0.0]]  # x⁺ = x + 0.4 u, over two renewals
    >>> lifted = control.ss([[1.0]], [[0.4, 0.4]], [[1.0], [1.0]], D, 0.2)
    >>> round(periodic_margins(lifted).gain_margin_high.value, 9)
    5.0
    """
    r = Realization.of(loop)
    n, wires = len(r.D), {str(name).rpartition("@")[0] for name in getattr(loop, "input_labels", ())}
    if len(wires) > 1:  # a delay of one renewal is a shift by one channel
        raise ParameterError(
            f"found channels of {len(wires)} wires or entries, {', '.join(sorted(wires))}; expected one. Take the loop "
            "of one entry, loop('motor_force[0]', lifted=True).",
            block="periodic_margins",
        )
    if not r.dt or r.D.shape != (n, n) or not r.order:
        raise ParameterError(
            f"found a loop of shape {r.D.shape} with dt = {r.dt:g} and {r.order} states; expected a sampled square one "
            "with states, a channel for each renewal of a wire. Take Linearization.loop(wire, lifted=True).",
            block="periodic_margins",
        )
    if not np.linalg.cond(np.eye(n) + r.D) < 1e12:
        raise ParameterError(
            "found a loop without a unique solution when it is closed; expected a direct feedthrough D with I + D "
            "regular. Look at the feedthrough of the loop.",
            block="periodic_margins",
        )
    return PeriodicMarginFinder(r).find_margins()


class PeriodicMarginFinder(MarginFinder[PeriodicMargins]):
    """Factors that destabilize a lifted loop, on a grid of θ; each ``_find_…`` returns margins as candidates."""

    result = PeriodicMargins
    eigenvalues = EIGENVALUES
    rotated = " with the factor rotated"

    def __init__(self, r: Realization):
        super().__init__(r)
        self.theta = _make_grid(r)
        self.factor = complex(np.nan)

    @cached_property
    def all_factors(self) -> np.ndarray:
        """All factors that destabilize, with their conjugates."""
        upper = np.concatenate([s / (s - 1.0) for s in map(_moved, np.linalg.eigvals(self.on_grid))])
        return np.concatenate([upper, np.conj(upper)])

    @cached_property
    def on_grid(self) -> np.ndarray:
        """S = (I + L)⁻¹ at the angles of the grid, shape (angles, n, n)."""
        return sensitivity_at(self.r, self.theta / self.r.dt)

    def find_candidates(self) -> dict[str, Candidate]:  # noqa: D102 - as in the base
        disk, self.factor = self._find_disk_margin()
        limits = {**self._find_gain_margins(), **self._find_phase_margin(), **self._find_delay_margin()}
        return {**limits, **disk, **self._find_peaks()}

    def describe(self) -> dict[str, Any]:  # noqa: D102 - as in the base
        return {"destabilizing": self.factor, "renewals": len(self.r.D)}

    def sensitivities(self, theta: float) -> np.ndarray:
        """Return the eigenvalues of S = (I + L)⁻¹ at e^(jθ) that aren't 1: S is finite where L is not."""
        return _moved(np.linalg.eigvals(sensitivity_at(self.r, theta / self.r.dt)))

    def _distance(self, f: complex) -> float:
        """Return the distance of a factor to the nearest one of the grid that destabilizes."""
        return float(np.min(np.abs(self.all_factors - f), initial=np.inf))

    def _find_limit(self, at: Callable[[float], complex], begin: float, end: float) -> float | None:
        """Return the first limit of stability along a curve of factors; None if there is none.

        ``at`` is the factor at a number; its derivative has the size of the factor. A step is as long as the distance
        to the destabilizing factors allows, so that no limit is stepped over.
        """

        def growth(x: float) -> float:
            return float(np.max(self.r.growth(self.r.eigenvalues(at(x)))))

        def steps() -> Iterator[float]:
            x, sign = begin, np.sign(end - begin)
            while (end - x) * sign > 0:
                f = at(x)
                step = max(0.5 * self._distance(f) / abs(f), SMALLEST_STEP)
                x = x + sign * min(step, abs(end - x))
                yield x

        return find_first_limit(growth, begin, steps())

    def _find_gain_margins(self) -> dict[str, Candidate]:
        found = {}
        for name, none, end in (("gain_margin_low", 0.0, -1.0), ("gain_margin_high", np.inf, 1.0)):
            x = self._find_limit(lambda x: complex(np.exp(x)), 0.0, end * np.log(LARGEST))
            k = none if x is None else float(np.exp(x))
            tried = [float(v) for v in LARGEST ** (end * np.linspace(0.1, 1.0, 10))]
            found[name] = self.limit_gain(name, k, 1e-9 * k, tried=tried)
        return found

    def _find_phase_margin(self) -> dict[str, Candidate]:
        x = self._find_limit(lambda x: complex(np.exp(1j * x)), 0.0, np.pi)
        degrees = np.inf if x is None else float(np.degrees(x))
        return {"phase_margin_deg": self.limit_rotation(degrees, 1e-7)}

    def _find_delay_margin(self) -> dict[str, Candidate]:
        n, delayed, T = 0, _delay_by_a_renewal(self.r), self.r.dt / len(self.r.D)
        while n < RENEWALS and delayed.is_stable():
            n, delayed = n + 1, _delay_by_a_renewal(delayed)
        if n < RENEWALS:
            how: str = Confirmation(
                f"{EIGENVALUES}, delayed by whole renewals: stable at {n}, unstable at {n + 1}",
                f"{EIGENVALUES}, delayed by whole renewals: stable with these, unstable with one more",
            )
            samples, seconds = float(n), n * T
        elif self._is_small():
            how = "the largest singular value of the lifted loop is below 1 at all frequencies: no delay matters"
            samples = seconds = np.inf
        else:
            how = f"no value: {EIGENVALUES} say stable with each of up to {RENEWALS} renewals of delay"
            samples = seconds = np.nan
        error = np.nan if np.isnan(samples) else 0.0
        return {
            "delay_margin_samples": Candidate.known(samples, "samples", error, how),
            "delay_margin_s": Candidate.known(seconds, "s", error, how),
        }

    def _is_small(self) -> bool:
        """Return whether the largest singular value of the lifted loop is below 1 at all frequencies."""
        try:
            L = self.r.matrix(1j * self.theta / self.r.dt)
            return bool(np.all(np.linalg.norm(L, 2, axis=(-2, -1)) < 1))
        except np.linalg.LinAlgError:  # a pole on the limit, such as an integrator's: the loop is unbounded there
            return False

    def _find_disk_margin(self) -> tuple[dict[str, Candidate], complex]:
        def reach(s: np.ndarray) -> float:
            """Return the largest |s − 1/2|, 1/α of the factors of an angle: (f + 1)/(f − 1) = 2 s − 1."""
            return float(np.max(np.abs(s - 0.5), initial=0.0))

        on_grid = np.array([reach(_moved(s)) for s in np.linalg.eigvals(self.on_grid)])
        largest, theta = find_largest(lambda theta: reach(self.sensitivities(theta)), self.theta, on_grid)
        values = self.sensitivities(theta)
        s = complex(values[first_largest(np.abs(values - 0.5))])
        alpha, factor = 1 / largest, s / (s - 1.0)
        confirm = cache(partial(self._confirm_disk, alpha, factor, theta))
        return {
            "disk_margin": Candidate(alpha, "1", 1e-8 * alpha, confirm),
            "disk_frequency": Candidate(theta / self.r.dt, "rad/s", 1e-3 * theta / self.r.dt, confirm),
        }, factor

    def _find_peaks(self) -> dict[str, Candidate]:
        """Return the largest singular values of the lifted S and T."""
        found = {}
        for name, a, b in (("ms", 1.0, 0.0), ("mt", 0.0, 1.0)):

            def gain(S: np.ndarray, a: float = a, b: float = b) -> np.ndarray:
                return np.asarray(np.linalg.norm(b * np.eye(S.shape[-1]) + (a - b) * S, 2, axis=(-2, -1)))

            def gain_at(theta: float, gain: Callable[[np.ndarray], np.ndarray] = gain) -> float:
                return float(gain(sensitivity_at(self.r, theta / self.r.dt)))

            value, _ = find_largest(gain_at, self.theta, gain(self.on_grid))
            confirm = cache(partial(confirm_peak, self.r, a, b, value, name))
            found[name] = Candidate(value, "1", 1e-8 * value, confirm)
        ms = found["ms"]
        return {"modulus_margin": Candidate(1 / ms.value, "1", ms.tolerance / ms.value**2, ms.confirm), **found}

    def _confirm_disk(self, alpha: float, factor: complex, theta: float) -> Confirmation:
        """Confirm a disk margin by eigenvalues around the rim and at the factor; return the computation."""
        delta = 2 * (factor - 1) / (factor + 1)
        low, high, phase = disk_gains(alpha, 0.0)
        together = f"gains {low:.6g} … {high:.6g} and phases up to ± {phase:.6g}° may vary together"
        if np.isclose(alpha, 2.0, rtol=1e-12) or abs(2 - delta) < 1e-9:
            return Confirmation("the loop's factors: one of them is 0 or infinite").and_by(together, "")

        def at(d: complex) -> complex:
            return (1 + d / 2) / (1 - d / 2)

        turns = np.concatenate([np.linspace(0.0, np.pi, ON_RIM + 1), [abs(np.angle(delta))]])
        inner = [at((1 - INSIDE) * alpha * np.exp(1j * turn)) for turn in turns]
        bad = [f for f in inner if not self.r.is_stable(f)]
        p = complex(self.r.point(np.array(1j * theta / self.r.dt)))
        apart = float(np.min(np.abs(self.r.eigenvalues(factor) - p)))
        beyond = self.r.is_stable(at((1 + INSIDE) * delta))
        if bad or beyond or apart > 1e-6 * (1 + abs(p)):
            raise ConfirmationError(
                f"found α = {alpha:.9g} at the factor {factor:.6g}, but {EIGENVALUES} say {len(bad)} of {len(inner)} "
                f"factors just inside unstable, just beyond {'stable' if beyond else 'unstable'}, and the nearest pole "
                f"{apart:.3g} from e^(jθ); expected none, unstable, and a pole there. Look at closed_loop_poles.",
                block="disk_margin",
            )
        return Confirmation(
            f"{EIGENVALUES}: stable at {len(inner)} factors of {1 - INSIDE:g} α, unstable at {1 + INSIDE:g} α, "
            "a pole on the limit at the factor itself"
        ).and_by(together, "")


def _moved(s: np.ndarray) -> np.ndarray:
    """Return the eigenvalues of S that aren't 1: the finite factors −1/λ = s/(s − 1) put a closed-loop pole there."""
    return np.asarray(s[np.abs(s - 1.0) > 1e-14])


def _make_grid(r: Realization) -> np.ndarray:
    """Return angles θ up to π that resolve the poles of the open and the closed loop."""
    s = r.logarithm(np.concatenate([np.linalg.eigvals(r.A), r.eigenvalues()]))
    s = s[np.isfinite(s)] * r.dt  # those of z = 0 are no numbers
    sizes = np.abs(s)[np.abs(s) > 1e-9]
    low = 1e-2 * float(np.min(sizes, initial=1.0))
    around = [np.abs(s.imag) + np.abs(s.real) * side for side in SIDES]
    near = [np.abs(s) * (1 + 0.1 * k) for k in range(-3, 4)]
    theta = np.concatenate([np.geomspace(low, np.pi, 400), np.linspace(low, np.pi, 400), *around, *near])
    return np.unique(np.append(theta[(theta >= low) & (theta <= np.pi)], 0.0))


def _delay_by_a_renewal(r: Realization) -> Realization:
    """Return a lifted loop with one renewal of delay: a channel gets the one before it, the first one the last one."""
    n, m = r.order, len(r.D)
    A = np.block([[r.A, np.zeros((n, 1))], [r.C[-1:], -np.ones((1, 1))]])  # p s = y − s
    B = np.vstack([r.B, r.D[-1:]])
    C = np.block([[np.zeros((1, n)), np.ones((1, 1))], [r.C[:-1], np.zeros((m - 1, 1))]])
    D = np.vstack([np.zeros((1, m)), r.D[:-1]])
    return Realization(A, B, C, D, r.dt, r.hidden, hidden_errors=r.hidden_errors, turned=r.turned)
