"""Margins of a loop with one channel: roots and peaks of its frequency response, confirmed by its closed-loop poles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
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
from .confirmations import confirmations_of
from .delayed_realization import DelayedRealization, realize
from .loop_model import LoopModel, find_hidden_unstable, tell_hidden_unstable
from .loop_scan import Crossing, LoopScan, Peak
from .margin_analysis import MarginFinder, StabilityMargins
from .number import Number, carries_findings
from .nyquist import count_encirclements
from .realization import Realization
from .scan_refine_confirm import Candidate
from .state_space import findings_of

if TYPE_CHECKING:
    from .state_space import LinearSystem

GAINS = (1.5, 2.0, 5.0, 10.0, 100.0, 1e3)
"""Factors, and reciprocals of factors, that are tried where no limit of the gain was found."""
VANISHES = 1e-9
"""|T| at low frequency, of its largest value, below which there is no bandwidth."""
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


class _LoopMarginFinder(MarginFinder[Margins]):
    """Margins of a scanned loop; each ``_find_…`` returns some of them as candidates."""

    result = Margins

    def __init__(self, r: Realization | DelayedRealization, skew: float):
        super().__init__(r)
        self.skew, self.scan = skew, LoopScan.of(r)
        self.by: Any = confirmations_of(r)
        self.eigenvalues = self.by.stability
        self.gain = self.scan.find_gain_crossovers()
        self.phase = [c for c in self.scan.phase_crossovers if abs(c.L) >= self.scan.floor]

    def find_candidates(self) -> dict[str, Candidate]:
        return {**self.find_without_delay(), **self._find_delay_margin()}

    def find_without_delay(self) -> dict[str, Candidate]:
        """Return the margins that the scan has by itself: all but those of delay, whose limits are searched."""
        return {**self._find_gain_margins(), "phase_margin_deg": self._find_phase_margin(), **self._find_peaks()}

    def describe(self) -> dict[str, Any]:
        r = self.r
        try:
            encirclements: float = count_encirclements(r).encirclements
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

    def _find_gain_margins(self) -> dict[str, Candidate]:
        factors = {-1 / c.L.real: c for c in self.phase}
        low = max((k for k in factors if k < 1), default=0.0)
        high = min((k for k in factors if k > 1), default=np.inf)
        tried: dict[str, Sequence[float]] = {"gain_margin_low": [1 / g for g in GAINS[:-1]], "gain_margin_high": GAINS}
        found = {}
        for name, k in (("gain_margin_low", low), ("gain_margin_high", high)):
            error = k * 2 * factors[k].tolerance if k in factors else 0.0
            others = [o for o in factors if o != k]
            found[name] = self.limit_gain(name, k, error, others=others, tried=tried[name])
        return found

    def _find_phase_margin(self) -> Candidate:
        if not self.gain:
            return self.limit_rotation(np.inf, 0.0)
        margin, c = min(((abs(_missing_phase(c)), c) for c in self.gain), key=lambda pair: pair[0])
        if margin > 180 - 1e-6:  # L = 1: both directions have the same limit
            confirm = partial(self.by.confirm_crossing, c, -1 / c.L, "phase_margin_deg")
            return Candidate(180.0, "deg", 1e-6, confirm)
        others = [abs(_missing_phase(o)) for o in self.gain if o is not c]
        return self.limit_rotation(margin, 2 * np.degrees(c.tolerance), others=others)

    def _find_delay_margin(self) -> dict[str, Candidate]:
        """Return the delay margin in s, and in samples where the loop is sampled."""
        T = self.r.dt
        lags = {c: np.radians(_missing_phase(c)) % (2 * np.pi) for c in self.gain if 0 < c.omega < np.inf}
        limits = sorted((lag / c.omega, c.tolerance * (1 + 1 / lag)) for c, lag in lags.items())
        if not T:
            samples = Candidate.known(np.nan, "samples", np.nan, "the loop is not sampled")
            return {"delay_margin_s": self._find_continuous_delay(lags, limits), "delay_margin_samples": samples}
        if abs(self.scan.ends()[1][1]) >= 1:
            n, how = self.by.count_whole_samples()
            error, confirm = 0.0, lambda: how
        elif limits:
            n, error = limits[0][0] / T, limits[0][1]
            confirm = cache(partial(self.by.confirm_samples, n, lags))
        else:
            n, error, confirm = np.inf, 0.0, cache(self.by.confirm_no_samples)
        return {
            "delay_margin_s": Candidate(n * T, "s", n * T * error if error else 0.0, confirm),
            "delay_margin_samples": Candidate(n, "samples", n * error if error else 0.0, confirm),
        }

    def _find_continuous_delay(self, lags: dict[Crossing, float], limits: list[tuple[float, float]]) -> Candidate:
        """Return the delay margin in s of a continuous loop."""
        if self.r.gain_at_infinity >= 1:
            return Candidate.known(0.0, "s", 0.0, "|L| ≥ 1 at infinite frequency: any delay has poles beyond the limit")
        if not limits:
            return Candidate.known(np.inf, "s", 0.0, "|L| < 1 at all frequencies: no delay matters")
        tau, error = limits[0]
        others = [(lag + 2 * np.pi * k) / c.omega for c, lag in lags.items() for k in range(50)]
        others = [o for o in others if o != tau]
        name, how = "delay_margin_s", self.by.late
        return Candidate.of_limit(name, tau, "s", tau * error, self.by.is_stable_late, how, others=others)

    def _find_peaks(self) -> dict[str, Candidate]:
        upper, lower = (1 + self.skew) / 2, -(1 - self.skew) / 2
        s, t, disk = self.scan.find_peak(1, 0), self.scan.find_peak(0, 1), self.scan.find_peak(upper, lower)
        found = {}
        for name, peak, (a, b) in (("ms", s, (1.0, 0.0)), ("mt", t, (0.0, 1.0))):
            confirm = cache(partial(self.by.confirm_peak, a, b, peak, name))
            found[name] = Candidate(peak.value, "1", peak.value * self._error(peak, t), confirm)
            error = 0.0 if self._is_end(peak.omega) else 1e-7 * peak.omega
            found[name + "_frequency"] = Candidate(peak.omega, "rad/s", error, confirm)
        ms = found["ms"]
        found["modulus_margin"] = Candidate(1 / ms.value, "1", ms.tolerance / ms.value**2, ms.confirm)
        of_disk = partial(self.by.confirm_peak, upper, lower, disk, "disk_margin")
        found["disk_margin"] = Candidate(1 / disk.value, "1", self._error(disk, t) / disk.value, of_disk)
        return {**found, "bandwidth": self._find_bandwidth()}

    def _error(self, peak: Peak, t: Peak) -> float:
        """Return the relative error of a peak: that of L, times the largest |T|."""
        inside = 0 < peak.omega < np.inf and not any(a.omega == peak.omega for a in self.scan.features.axis_poles)
        end = max(1e-13, self.r.end_error) if np.isinf(peak.omega) else 1e-13
        return max(1e-12, (self.r.error(peak.omega) if inside else end) * 3 * (1 + t.value))

    def _find_bandwidth(self) -> Candidate:
        L = self.scan.ends()[0][1]
        low = 1.0 if np.isinf(L) else abs(L / (1 + L))
        with np.errstate(all="ignore"):
            largest = max((float(np.nanmax(np.abs(L / (1 + L)))) for L, _ in self.scan.samples), default=0.0)
        level = low / np.sqrt(2)
        vanishes = level == 0 or low <= VANISHES * largest  # rounding leaves something of a 0
        omega = np.nan if vanishes else self.scan.find_fall_below(level)
        if np.isnan(omega):
            return Candidate.known(omega, "rad/s", np.nan, "T vanishes at low frequency")
        if np.isinf(omega):
            how = "the response: |T| never falls below 1/√2 of its low-frequency value"
            return Candidate.known(omega, "rad/s", 0.0, how)
        return Candidate(omega, "rad/s", 1e-10 * omega, partial(self.by.confirm_bandwidth, omega, level))


def scan_margins(loop: LinearSystem, *, delay: int = 0, skew: float = 0.0) -> dict[str, float]:
    """Return the values of the margins of a loop with one channel but for those of delay, which nothing confirms.

    They are for comparisons: a number of many that are compared with one that is confirmed. Those of an unstable loop
    are none. Arguments and errors are those of `margins`.
    """
    finder = _LoopMarginFinder(realize(loop, delay=delay), skew)
    return {} if finder.unstable else {name: found.value for name, found in finder.find_without_delay().items()}


def find_disk_frequency(r: LoopModel, skew: float = 0.0) -> float:
    """Return the frequency in rad/s at which |S + (σ − 1)/2| is largest: that of the disk margin."""
    return LoopScan.of(r).find_peak((1 + skew) / 2, -(1 - skew) / 2).omega


def _missing_phase(c: Crossing) -> float:
    """Return the phase by which L is ahead of −1, in degrees above −180 and up to 180."""
    degrees = float(np.degrees(np.angle(-c.L)))
    return degrees if degrees > -180 else 180.0
