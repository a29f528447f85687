"""Margins of a loop with one channel: refined roots of its frequency response, confirmed by eigenvalues."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import (
    ConfirmationError,
    Finding,
    ParameterError,
    accepts,
    brief,
    explain_calls,
    kinds,
    on_one_thread,
)
from .delayed_margins import ByArgument
from .delayed_realization import DelayedRealization, realize
from .loop_scan import Crossing, LoopScan, Peak
from .margin_analysis import EIGENVALUES, MarginFinder, StabilityMargins
from .number import Confirmation, Number, carries_findings
from .nyquist import count_encirclements, winding_number
from .poles_and_zeros import Features, find_hidden_unstable, tell_hidden_unstable
from .realization import ROUNDOFF, Realization
from .scan_refine_confirm import confirm_no_limit, number_of_limit
from .sensitivity_peaks import confirm_peak, find_level_frequencies
from .state_space import findings_of

if TYPE_CHECKING:
    from .state_space import LinearSystem

GAINS = (1.5, 2.0, 5.0, 10.0, 100.0, 1e3)
"""Factors, and reciprocals of factors, that are tried where no limit of the gain was found."""
MOST_SAMPLES = 100
"""Samples of delay up to which closed-loop eigenvalues count the unstable poles; beyond, encirclements do."""
PRINTED = 4
"""Crossovers of each kind that the printed table of margins has; the others are counted."""
SHOWN = 24
"""Phase crossovers that are given of a loop which has them up to infinite frequency."""


@explain_calls
@dataclass(frozen=True, repr=False)
class GainCrossover:
    """A frequency at which |L| = 1, and the rotation that takes L to −1 there (−180° to 180°)."""

    frequency: Number
    phase_margin_deg: Number

    def __repr__(self) -> str:
        return brief(f"gain crossover at {self.frequency}", f"phase margin {self.phase_margin_deg}")


@explain_calls
@dataclass(frozen=True, repr=False)
class PhaseCrossover:
    """A frequency at which L is real and negative, and the factor that takes it to −1 there."""

    frequency: Number
    gain_margin: Number

    def __repr__(self) -> str:
        return brief(f"phase crossover at {self.frequency}", f"gain margin {self.gain_margin}")


@explain_calls
@dataclass(frozen=True, repr=False)
class Margins(StabilityMargins):
    """Margins of a loop L with S = 1/(1 + L) and T = L/(1 + L).

    The margins of an unstable closed loop are NaN; its crossings and poles are there.

    Parameters
    ----------
    stable : bool
        Whether all of `closed_loop_poles` are stable. Hidden modes are not among them: see `hidden_unstable`.
    gain_crossovers, phase_crossovers : tuple
        All crossovers by rising frequency; phase crossovers also at 0, at π/T and at infinity. With delays there are
        infinitely many phase crossovers: those with the smaller |L| are left out.
    gain_margin_low, gain_margin_high : Number
        Largest factor below 1, and smallest above 1, on L that ends stability; 0 and infinity where there is none.
    phase_margin_deg : Number
        Smallest rotation of L, to either side, that ends stability; infinite where |L| = 1 nowhere.
    delay_margin_s, delay_margin_samples : Number
        Smallest delay τ in series, e^(−jωτ), that ends stability. In a sampled loop it is read from the response
        between the samples. Where |L| > 1 at π/T that has no meaning: the whole samples that the loop bears are given.
        `delayed_hold_margin` gives another number, the delay in front of the plant's hold.
    modulus_margin : Number
        Smallest distance of L to −1, 1/M_s.
    disk_margin : Number
        α of the symmetric disk (S − T), or of that with the given skew; see `disk_margin`.
    ms, ms_frequency, mt, mt_frequency : Number
        Largest |S| and |T|, and their frequencies.
    bandwidth : Number
        Lowest frequency at which |T| falls below 1/√2 (3.0103 dB) of its value at low frequency.
    closed_loop_poles : tuple of complex
        In the s plane (continuous) or the z plane (sampled). Multiple poles scatter, as ε^(1/multiplicity). With delays
        there are infinitely many: those far to the left are left out, and ``stable`` doesn't hang on their number.
    hidden_poles : tuple of complex
        Poles that are not controllable or not observable in the loop; none of the numbers above contains them.
    hidden_unstable : tuple of complex
        Hidden poles beyond the limit of stability. No gain in this loop stabilizes them: another loop must.
    gain_crossovers, phase_crossovers : tuple
        Crossings of the unit circle and of the negative real axis by rising frequency. Where a way without a state goes
        through a delay the curve crosses the axis up to infinite frequency: the first 23 and the one at the end are
        given, and all are looked at.
    encirclements : float
        Clockwise encirclements of −1 by L; infinite where L turns around it up to infinite frequency.
    dt : float
        Sample time of the loop in s, 0 of a continuous one.
    findings : tuple of Finding
        Effects on the loop that its linear model leaves out, such as a kink at the operating point. Every number
        carries them.
    """

    stable: bool
    gain_crossovers: tuple[GainCrossover, ...]
    phase_crossovers: tuple[PhaseCrossover, ...]
    gain_margin_low: Number
    gain_margin_high: Number
    phase_margin_deg: Number
    delay_margin_s: Number
    delay_margin_samples: Number
    modulus_margin: Number
    disk_margin: Number
    ms: Number
    ms_frequency: Number
    mt: Number
    mt_frequency: Number
    bandwidth: Number
    closed_loop_poles: tuple[complex, ...]
    hidden_poles: tuple[complex, ...]
    hidden_unstable: tuple[complex, ...]
    encirclements: float
    dt: float = 0.0
    findings: tuple[Finding, ...] = ()

    def deciding_frequencies(self) -> list[float]:
        """Return the frequencies in rad/s at which the gain and phase margins are read: positive finite ones."""
        limits = (self.gain_margin_low.value, self.gain_margin_high.value)
        found = [c.frequency.value for c in self.gain_crossovers]
        found += [p.frequency.value for p in self.phase_crossovers if p.gain_margin.value in limits]
        return [w for w in found if 0.0 < w < np.inf]

    def _further_facts(self) -> list[tuple[str, str]]:
        gains = [f"{c.frequency}, phase margin {c.phase_margin_deg}" for c in self.gain_crossovers]
        phases = [f"{p.frequency}, factor {p.gain_margin}" for p in self.phase_crossovers]
        facts = []
        for name, texts in (("gain_crossover", gains), ("phase_crossover", phases)):
            facts += [(name, text) for text in texts[:PRINTED]]
            if (more := len(texts) - PRINTED) > 0:
                facts.append(("", f"and {more} more: margins.{name}s"))
        return [*facts, *tell_hidden_unstable(self.hidden_unstable)]


@accepts(delay=kinds.finite, skew=kinds.number)
@carries_findings
@on_one_thread
def margins(loop: LinearSystem, *, delay: int = 0, skew: float = 0.0) -> Margins:
    """Return all margins of a loop with one channel, each confirmed by a second computation.

    Parameters
    ----------
    loop : control.StateSpace
        L with S = 1/(1 + L): continuous (dt = 0), with delays or without, or sampled (dt = T).
        It may have poles at s = 0 or z = 1, and
        unstable ones. A transfer function is realized first, in powers of z − 1 where it is sampled: the margins
        are those of its coefficients as they were given, whose rounding the tolerances count.
    delay : int
        Whole samples of delay in series with a sampled loop.
    skew : float
        Skew of the disk margin; 0 gives the symmetric disk, S − T.

    Raises
    ------
    ConfirmationError
        If a number and its confirmation disagree, or rounding leaves an equation without a solution.
    ParameterError
        If the loop has several channels, no states or no definite sample time, or L is −1 at infinite frequency.

    Examples
    --------
    >>> import control
    >>> p = 20.0
    >>> found = margins(control.ss(control.tf([3 * p, 3 * p**2, p**3], [1, 0, 0, 0])))
    >>> round(found.phase_margin_deg.value, 4), round(9 * found.gain_margin_low.value, 9)
    (71.2498, 1.0)
    """
    r = realize(loop, delay=delay)
    if r.D.shape != (1, 1):
        raise ParameterError(
            f"found a loop with {r.D.shape[1]} inputs and {r.D.shape[0]} outputs; expected one of each. "
            "Use mimo_disk_margin for several channels.",
            block="margins",
        )
    if not r.order:
        raise _constant_loop_error(float(r.D[0, 0]), findings_of(loop))
    if abs(1 + r.D[0, 0]) < 1e-12:
        raise ParameterError(
            "found L = −1 at infinite frequency: the closed loop is ill-posed; expected another value. Look at the "
            "loop's direct feedthrough D.",
            block="margins",
        )
    return _LoopMarginFinder(r, skew).find_margins()


def _constant_loop_error(value: float, findings: tuple[Finding, ...]) -> ParameterError:
    """Return the error of a loop without dynamics; its findings name the blocks that have no slope."""
    found = "".join(f"; {finding}" for finding in findings if finding.remedy)
    steps = " ".join(dict.fromkeys(finding.remedy for finding in findings if finding.remedy))
    return ParameterError(
        f"found a loop that is the constant {value:.6g}: no state is controllable and observable{found}; expected "
        f"dynamics. {steps or 'Look at the wire at which the loop is opened.'}",
        block="margins",
    )


class ByEigenvalues:
    """The scan of a loop without delays, and confirmations by eigenvalues of its matrices."""

    stability = EIGENVALUES
    late = "encirclements of 1 + L exp(−sτ)"

    def __init__(self, r: Realization):
        self.r, self.scan, self.floor = r, LoopScan(r), 0.0

    def count_encirclements(self) -> int:
        """Return the clockwise encirclements of −1, confirmed."""
        return count_encirclements(self.r, self.scan.features).encirclements

    def gain_at_infinity(self) -> float:
        """Return |L| at infinite frequency."""
        return abs(float(self.r.D[0, 0]))

    def is_stable_late(self, tau: float) -> bool:
        """Whether the closed loop of a continuous loop is stable with a delay in series."""
        features = self.scan.features
        return winding_number(self.r, features, delay=tau) + features.unstable_poles() == 0

    def confirm_crossing(self, c: Crossing, factor: complex, name: str) -> str:
        """Confirm that the loop, multiplied by this factor, has a closed-loop pole at the crossing's frequency."""
        return _confirm_crossing(self.r, c, factor, name)

    def confirm_peak(self, a: float, b: float, peak: Peak, name: str) -> str:
        """Confirm the largest |(a + b L)/(1 + L)|."""
        return confirm_peak(self.r, a, b, peak.value, name)

    def confirm_bandwidth(self, omega: float, level: float) -> str:
        """Confirm the lowest frequency at which |T| falls to a level."""
        found = find_level_frequencies(self.r, 0.0, 1.0, level)
        if found is None:
            return "the frequency response only: |T| is above the level at the highest frequency"
        if not len(found) or np.min(np.abs(found - omega)) > 1e-3 * omega:
            raise ConfirmationError(
                f"found {omega:.12g} rad/s, but the Hamiltonian has the level of |T| at {found!r} rad/s; expected it "
                "at the same frequency. Look at closed_loop_poles: the realization may be ill-conditioned.",
                block="bandwidth",
            )
        return "Hamiltonian eigenvalues: |T| falls to 1/√2 of its low-frequency value within 0.1 % of this"


class _LoopMarginFinder(MarginFinder[Margins]):
    """A scanned loop; each ``_find_…`` computes some of the margins and confirms them."""

    result = Margins

    def __init__(self, r: Realization | DelayedRealization, skew: float):
        super().__init__(r)
        self.by: Any = ByArgument(r) if isinstance(r, DelayedRealization) else ByEigenvalues(r)
        self.eigenvalues = self.by.stability
        self.skew, self.scan = skew, self.by.scan
        self.gain = self.scan.find_gain_crossovers()
        self.phase = [c for c in self.scan.phase_crossovers if abs(c.L) >= self.by.floor]

    def find_numbers(self) -> dict[str, Number]:
        return {
            **self._find_gain_margins(),
            "phase_margin_deg": self._find_phase_margin(),
            **self._find_delay_margin(),
            **self._find_peaks(),
        }

    def describe(self) -> dict[str, Any]:
        r = self.r
        try:
            encirclements = self.by.count_encirclements()
        except ConfirmationError:  # of an unstable loop a pole may lie on the limit: the curve passes through −1
            if not self.unstable:
                raise
            encirclements = self.unstable - self.scan.features.unstable_poles()
            encirclements = encirclements if np.isinf(encirclements) else int(encirclements)
        return {
            "gain_crossovers": tuple(self._make_gain_crossover(c) for c in self.gain),
            "phase_crossovers": tuple(self._make_phase_crossover(c) for c in self._shown(self.phase)),
            "hidden_poles": tuple(complex(p) for p in (r.hidden + 1 if r.dt else r.hidden)),
            "hidden_unstable": find_hidden_unstable(r),
            "encirclements": encirclements,
        }

    def _shown(self, crossings: Sequence[Crossing]) -> Sequence[Crossing]:
        """Return the first of the crossings that a loop has up to infinite frequency, and the last; else all."""
        if np.isinf(self.r.settled) or len(crossings) <= SHOWN:
            return crossings
        return [*crossings[: SHOWN - 1], crossings[-1]]

    def _is_end(self, omega: float) -> bool:
        """Return whether a frequency is an end of the axis, which is known without an error."""
        return omega in (0.0, np.inf) or omega == self.r.nyquist

    def _frequency(self, c: Crossing, how: str) -> Number:
        return Number(c.omega, "rad/s", 0.0 if self._is_end(c.omega) else c.tolerance * c.omega, how)

    def _make_gain_crossover(self, c: Crossing) -> GainCrossover:
        how = self.by.confirm_crossing(c, -1 / c.L, "gain_crossover")
        return GainCrossover(
            self._frequency(c, how), Number(_missing_phase(c), "deg", 2 * np.degrees(c.tolerance), how)
        )

    def _make_phase_crossover(self, c: Crossing) -> PhaseCrossover:
        k = -1 / c.L.real
        how = self.by.confirm_crossing(c, k, "phase_crossover")
        return PhaseCrossover(self._frequency(c, how), Number(k, "1", k * 2 * c.tolerance, how, is_gain=True))

    def _find_gain_margins(self) -> dict[str, Number]:
        factors = {-1 / c.L.real: c for c in self.phase}
        low = max((k for k in factors if k < 1), default=0.0)
        high = min((k for k in factors if k > 1), default=np.inf)
        tried: dict[str, Sequence[float]] = {"gain_margin_low": [1 / g for g in GAINS[:-1]], "gain_margin_high": GAINS}
        found = {}
        for name, k in (("gain_margin_low", low), ("gain_margin_high", high)):
            error = k * 2 * factors[k].tolerance if k in factors else 0.0
            others = [o for o in factors if o != k]
            found[name] = self.make_gain_margin(name, k, error, others=others, tried=tried[name])
        return found

    def _find_phase_margin(self) -> Number:
        if not self.gain:
            return self.make_phase_margin(np.inf, 0.0)
        margin, c = min(((abs(_missing_phase(c)), c) for c in self.gain), key=lambda pair: pair[0])
        if margin > 180 - 1e-6:  # L = 1: both directions have the same limit
            return Number(180.0, "deg", 1e-6, self.by.confirm_crossing(c, -1 / c.L, "phase_margin_deg"))
        others = [abs(_missing_phase(o)) for o in self.gain if o is not c]
        return self.make_phase_margin(margin, 2 * np.degrees(c.tolerance), others=others)

    def _find_delay_margin(self) -> dict[str, Number]:
        r = self.r
        lags = {c: np.radians(_missing_phase(c)) % (2 * np.pi) for c in self.gain if 0 < c.omega < np.inf}
        limits = sorted((lag / c.omega, c.tolerance * (1 + 1 / lag)) for c, lag in lags.items())
        if not r.dt:
            samples = Number(np.nan, "samples", np.nan, "the loop is not sampled")
            return {"delay_margin_s": self._find_continuous_delay(lags, limits), "delay_margin_samples": samples}
        end = self.scan.ends()[1][1]
        if abs(end) >= 1:
            n, how = self._count_whole_samples()
            error = 0.0
        else:
            n, error = (limits[0][0] / r.dt, limits[0][1]) if limits else (np.inf, 0.0)
            how = self._confirm_samples(n, lags) if limits else self._confirm_no_samples()
        return {
            "delay_margin_s": Number(n * r.dt, "s", n * r.dt * error if error else 0.0, how),
            "delay_margin_samples": Number(n, "samples", n * error if error else 0.0, how),
        }

    def _find_continuous_delay(self, lags: dict[Crossing, float], limits: list[tuple[float, float]]) -> Number:
        """Return the delay margin in s of a continuous loop, confirmed by the encirclements of 1 + L e^(−sτ)."""
        if self.by.gain_at_infinity() >= 1:
            return Number(0.0, "s", 0.0, "|L| ≥ 1 at infinite frequency: any delay has poles beyond the limit")
        if not limits:
            return Number(np.inf, "s", 0.0, "|L| < 1 at all frequencies: no delay matters")
        tau, error = limits[0]
        others = [(lag + 2 * np.pi * k) / c.omega for c, lag in lags.items() for k in range(50)]
        others = [o for o in others if o != tau]
        name, how = "delay_margin_s", self.by.late
        return number_of_limit(name, tau, "s", tau * error, self.by.is_stable_late, how, others=others)

    def _confirm_samples(self, n: float, lags: dict[Crossing, float]) -> str:
        """Confirm a margin by the number of unstable poles with the whole samples next to it; return the computation.

        ``lags`` are the phases in rad by which the crossings are ahead of −1.
        """
        below, above = int(np.floor(n)), int(np.floor(n)) + 1
        whole = abs(n - round(n)) <= 1e-9 * max(n, 1.0) and n > 0.5
        if whole:  # with exactly these samples poles lie on the unit circle
            below, above = round(n) - 1, round(n) + 1
            _confirm_on_limit(self.r, round(n))
        for samples in (below, above):
            expected = 0
            for c, lag in lags.items():
                passed = 1 + np.floor((samples * c.omega * self.r.dt - lag) / (2 * np.pi))
                expected += 2 * int(max(0, passed)) * (1 if c.slope < 0 else -1)
            found = _count_unstable(self.r, self.scan.features, samples)
            if found != expected:
                raise ConfirmationError(
                    f"found a margin of {n:.9g} samples, but {found} unstable poles with {samples} samples of delay; "
                    f"expected {expected}. Look at closed_loop_poles.",
                    block="delay_margin",
                )
        with_z = EIGENVALUES if above <= MOST_SAMPLES else "encirclements"
        on_it = f", on the limit at n = {round(n)}" if whole else ""
        return Confirmation(
            f"{with_z} with z⁻ⁿ: stable at n = {below}{on_it}, as many unstable at n = {above} as crossovers say",
            f"{with_z} with z⁻ⁿ: stable with fewer samples, as many unstable with more as crossovers say",
        )

    def _confirm_no_samples(self) -> str:
        """Confirm that no number of samples ends stability; return the computation."""

        def stable(n: float) -> bool:
            return _count_unstable(self.r, self.scan.features, int(n)) == 0

        return confirm_no_limit("delay_margin", [1, 2, 5, 10], stable, EIGENVALUES + " with z⁻ⁿ")

    def _count_whole_samples(self) -> tuple[float, str]:
        """Return the whole samples of delay that the loop bears, and the computation that says so."""
        n = 0
        while n < MOST_SAMPLES and _count_unstable(self.r, self.scan.features, n + 1) == 0:
            n += 1
        return float(n), Confirmation(
            f"{EIGENVALUES} with z⁻ⁿ: stable at n = {n}, unstable at n = {n + 1} (|L| ≥ 1 at π/T)",
            f"{EIGENVALUES} with z⁻ⁿ: stable with these samples, unstable with one more (|L| ≥ 1 at π/T)",
        )

    def _find_peaks(self) -> dict[str, Number]:
        upper, lower = (1 + self.skew) / 2, -(1 - self.skew) / 2
        s, t, disk = self.scan.find_peak(1, 0), self.scan.find_peak(0, 1), self.scan.find_peak(upper, lower)
        found = {}
        for name, peak, (a, b) in (("ms", s, (1.0, 0.0)), ("mt", t, (0.0, 1.0))):
            how = self.by.confirm_peak(a, b, peak, name)
            found[name] = Number(peak.value, "1", peak.value * self._error(peak, t), how)
            error = 0.0 if self._is_end(peak.omega) else 1e-7 * peak.omega
            found[name + "_frequency"] = Number(peak.omega, "rad/s", error, how)
        ms = found["ms"]
        found["modulus_margin"] = Number(1 / ms.value, "1", ms.tolerance / ms.value**2, ms.confirmed_by)
        how = self.by.confirm_peak(upper, lower, disk, "disk_margin")
        found["disk_margin"] = Number(1 / disk.value, "1", self._error(disk, t) / disk.value, how)
        return {**found, "bandwidth": self._find_bandwidth()}

    def _error(self, peak: Peak, t: Peak) -> float:
        """Return the relative error of a peak: that of L, times the largest |T|."""
        inside = 0 < peak.omega < np.inf and not any(a.omega == peak.omega for a in self.scan.features.axis_poles)
        end = max(1e-13, self.r.end_error) if np.isinf(peak.omega) else 1e-13
        return max(1e-12, (self.r.error(peak.omega) if inside else end) * 3 * (1 + t.value))

    def _find_bandwidth(self) -> Number:
        L = self.scan.ends()[0][1]
        low = 1.0 if np.isinf(L) else abs(L / (1 + L))
        with np.errstate(all="ignore"):
            largest = max((float(np.nanmax(np.abs(L / (1 + L)))) for L, _ in self.scan.samples), default=0.0)
        level = low / np.sqrt(2)
        vanishes = level == 0 or low <= _VANISHES * largest  # rounding leaves something of a 0
        omega = np.nan if vanishes else self.scan.find_fall_below(level)
        if np.isnan(omega):
            return Number(omega, "rad/s", np.nan, "T vanishes at low frequency")
        if np.isinf(omega):
            return Number(omega, "rad/s", 0.0, "the response: |T| never falls below 1/√2 of its low-frequency value")
        return Number(omega, "rad/s", 1e-10 * omega, self.by.confirm_bandwidth(omega, level))


_VANISHES = 1e-9
"""|T| at low frequency, of its largest value, below which there is no bandwidth."""


class _Unconfirmed:
    """A scan whose numbers nothing confirms."""

    def __init__(self, by: ByEigenvalues | ByArgument):
        self.scan, self.floor, self.stability = by.scan, by.floor, by.stability

    def confirm_crossing(self, c: Crossing, factor: complex, name: str) -> str:
        """Return no confirmation."""
        return ""

    def confirm_peak(self, a: float, b: float, peak: Peak, name: str) -> str:
        """Return no confirmation."""
        return ""

    def confirm_bandwidth(self, omega: float, level: float) -> str:
        """Return no confirmation."""
        return ""


class _ScanFinder(_LoopMarginFinder):
    """A scanned loop of which the numbers are given as they are found."""

    def __init__(self, r: Realization | DelayedRealization, skew: float):
        super().__init__(r, skew)
        self.by: Any = _Unconfirmed(self.by)

    def find_numbers(self) -> dict[str, Number]:
        return {**self._find_gain_margins(), "phase_margin_deg": self._find_phase_margin(), **self._find_peaks()}

    def make_gain_margin(
        self, name: str, factor: float, tolerance: float, *, others: Sequence[float] = (), tried: Sequence[float]
    ) -> Number:
        return Number(factor, "1", tolerance, "")

    def make_phase_margin(self, degrees: float, tolerance: float, *, others: Sequence[float] = ()) -> Number:
        return Number(degrees, "deg", tolerance, "")


def scan_margins(loop: LinearSystem, *, delay: int = 0, skew: float = 0.0) -> dict[str, Number]:
    """Return the margins of a loop with one channel but for those of delay, which nothing confirms.

    They are for comparisons: a number of many that are compared with one that is confirmed. Those of an unstable loop
    are none. Arguments and errors are those of `margins`.
    """
    finder = _ScanFinder(realize(loop, delay=delay), skew)
    return {} if finder.unstable else finder.find_numbers()


def find_disk_frequency(r: Realization | DelayedRealization, skew: float = 0.0) -> float:
    """Return the frequency in rad/s at which |S + (σ − 1)/2| is largest: that of the disk margin."""
    scan = ByArgument(r).scan if isinstance(r, DelayedRealization) else LoopScan(r)
    return float(scan.find_peak((1 + skew) / 2, -(1 - skew) / 2).omega)


def _missing_phase(c: Crossing) -> float:
    """Return the phase by which L is ahead of −1, in degrees above −180 and up to 180."""
    degrees = float(np.degrees(np.angle(-c.L)))
    return degrees if degrees > -180 else 180.0


def _confirm_crossing(r: Realization, c: Crossing, factor: complex, name: str) -> str:
    """Confirm that the loop, multiplied by this factor, has a closed-loop pole at the crossing's frequency."""
    if np.isinf(c.omega):
        ok = abs(1 + factor * r.D[0, 0]) < 1e-9
        where = "1 + D vanishes with this factor: a closed-loop pole passes through infinity"
    else:
        p = complex(r.point(np.array(1j * c.omega)))
        closed = r.closed_matrix(factor)
        distance = np.min(np.abs(np.linalg.eigvals(closed) - p), initial=np.inf)
        ok = distance <= 1e-5 * abs(p) + 1e-7 * r.scale
        where = "a closed-loop eigenvalue that lies there with this factor"
        if not ok:  # a large factor leaves few digits of an eigenvalue: is p one of a matrix within rounding of this?
            apart = np.linalg.svd(p * np.eye(r.order) - closed, compute_uv=False).min(initial=np.inf)
            ok = apart <= r.order * ROUNDOFF * float(np.linalg.norm(closed))
            where += ", as far as rounding lets it be seen"
    if not ok:
        raise ConfirmationError(
            f"found a crossing at {c.omega:.12g} rad/s, but no closed-loop eigenvalue there with the factor "
            f"{factor:.6g}; expected one. Look at closed_loop_poles: the realization may be ill-conditioned.",
            block=name,
        )
    return where


def _confirm_on_limit(r: Realization, n: int) -> None:
    """Confirm that n samples of delay in series put a closed-loop pole on the unit circle, up to 100 samples."""
    if n > MOST_SAMPLES:
        return
    delayed = r.delay_by(n)
    nearest = float(np.min(np.abs(delayed.growth(delayed.eigenvalues()))))
    if nearest > 1e-6:
        raise ConfirmationError(
            f"found a margin of {n} samples, but with that delay no closed-loop pole is nearer than {nearest:.3g} to "
            "the unit circle; expected one on it. Look at closed_loop_poles.",
            block="delay_margin",
        )


def _count_unstable(r: Realization, features: Features, n: int) -> int:
    """Return the number of closed-loop poles that are not stable with n samples of delay in series."""
    if n > MOST_SAMPLES:
        return winding_number(r, features, delay=n * r.dt) + features.unstable_poles()
    return r.delay_by(n).count_unstable()
