"""Margins of a loop with one channel: refined roots of its frequency response, confirmed by eigenvalues."""

from __future__ import annotations

from typing import TYPE_CHECKING, get_type_hints

import numpy as np

from ...blocks.core import ConfirmationError, ParameterError, accepts, kinds, on_one_thread
from .carried import carries_findings
from .confirm import (
    confirm_crossing,
    confirm_delay,
    confirm_limit,
    confirm_no_limit,
    confirm_on_limit,
    confirm_peak,
    count_unstable,
    find_level_frequencies,
)
from .crossings import Crossing, Peak, Scan
from .features import find_hidden_unstable
from .margins_found import GainCrossover, Margins, PhaseCrossover
from .number import Confirmation, Number
from .nyquist import count_encirclements
from .realization import Realization, refuse_singular

if TYPE_CHECKING:
    from .state_space import LinearSystem

EIGENVALUES = "closed-loop eigenvalues"
GAINS = (1.5, 2.0, 5.0, 10.0, 100.0, 1e3)


@accepts(delay=kinds.finite, skew=kinds.number)
@carries_findings
@on_one_thread
def margins(loop: LinearSystem, *, delay: int = 0, skew: float = 0.0) -> Margins:
    """Return all margins of a loop with one channel, each confirmed by a second computation.

    Parameters
    ----------
    loop : control.StateSpace
        L with S = 1/(1 + L): continuous (dt = 0) or sampled (dt = T). It may have poles at s = 0 or z = 1, and
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
    r = Realization.of(loop, delay=delay)
    if r.D.shape != (1, 1):
        raise ParameterError(
            f"found a loop with {r.D.shape[1]} inputs and {r.D.shape[0]} outputs; expected one of each. "
            "Use mimo_disk_margin for several channels.",
            block="margins",
        )
    if not r.order:
        raise ParameterError(
            f"found a loop that is the constant {r.D[0, 0]:.6g}: no state is controllable and observable; expected "
            "dynamics. Look at the wire at which the loop is opened.",
            block="margins",
        )
    if abs(1 + r.D[0, 0]) < 1e-12:
        raise ParameterError(
            "found L = −1 at infinite frequency: the closed loop is ill-posed; expected another value. Look at the "
            "loop's direct feedthrough D.",
            block="margins",
        )
    with refuse_singular("margins"):
        return _MarginFinder(r, skew).find_margins()


class _MarginFinder:
    """A scanned loop; each ``_find_…`` computes some of the margins and confirms them."""

    def __init__(self, r: Realization, skew: float):
        self.r, self.skew, self.scan = r, skew, Scan(r)
        self.gain, self.phase = self.scan.find_gain_crossovers(), self.scan.find_phase_crossovers()
        self.unstable = r.count_unstable()

    def find_margins(self) -> Margins:
        r = self.r
        poles = r.eigenvalues()
        if self.unstable:
            near = r.growth(poles).max()
            reason = f"the closed loop is not stable: {self.unstable} of its poles are not (largest growth {near:.3g})"
            units = {"phase_margin_deg": "deg", "delay_margin_s": "s", "delay_margin_samples": "samples"}
            units |= dict.fromkeys(("ms_frequency", "mt_frequency", "bandwidth"), "rad/s")
            names = [name for name, kind in get_type_hints(Margins).items() if kind is Number]
            found = {name: Number(np.nan, units.get(name, "1"), np.nan, reason) for name in names}
            try:
                encirclements = count_encirclements(r, self.scan.features).encirclements
            except ConfirmationError:  # a pole on the limit itself: the curve passes through −1
                encirclements = self.unstable - self.scan.features.unstable_poles()
        else:
            encirclements = count_encirclements(r, self.scan.features).encirclements
            found = {**self._find_gain_margins(), **self._find_phase_margin()}
            found |= {**self._find_delay_margin(), **self._find_peaks()}
        return Margins(
            stable=not self.unstable,
            gain_crossovers=tuple(self._make_gain_crossover(c) for c in self.gain),
            phase_crossovers=tuple(self._make_phase_crossover(c) for c in self.phase),
            closed_loop_poles=tuple(complex(p) for p in np.sort_complex(poles + 1 if r.dt else poles)),
            hidden_poles=tuple(complex(p) for p in (r.hidden + 1 if r.dt else r.hidden)),
            hidden_unstable=find_hidden_unstable(r),
            encirclements=encirclements,
            dt=r.dt,
            findings=(),
            **found,
        )

    def _frequency(self, c: Crossing, how: str) -> Number:
        ends = c.omega in (0.0, np.inf) or c.omega == self.r.nyquist
        return Number(c.omega, "rad/s", 0.0 if ends else c.tolerance * c.omega, how)

    def _make_gain_crossover(self, c: Crossing) -> GainCrossover:
        how = confirm_crossing(self.r, c, -1 / c.L, "gain_crossover")
        return GainCrossover(
            self._frequency(c, how), Number(_missing_phase(c), "deg", 2 * np.degrees(c.tolerance), how)
        )

    def _make_phase_crossover(self, c: Crossing) -> PhaseCrossover:
        k = -1 / c.L.real
        how = confirm_crossing(self.r, c, k, "phase_crossover")
        return PhaseCrossover(self._frequency(c, how), Number(k, "1", k * 2 * c.tolerance, how))

    def _find_gain_margins(self) -> dict[str, Number]:
        factors = {-1 / c.L.real: c for c in self.phase}
        low = max((k for k in factors if k < 1), default=0.0)
        high = min((k for k in factors if k > 1), default=np.inf)
        found = {}
        for name, k in (("gain_margin_low", low), ("gain_margin_high", high)):
            if k in factors:
                how = confirm_limit(name, k, [o for o in factors if o != k], 1.0, self.r.is_stable, EIGENVALUES)
                found[name] = Number(k, "1", k * 2 * factors[k].tolerance, how)
            else:
                values = [1 / g for g in GAINS[:-1]] if k == 0.0 else GAINS
                found[name] = Number(k, "1", 0.0, confirm_no_limit(name, values, self.r.is_stable, EIGENVALUES))
        return found

    def _find_phase_margin(self) -> dict[str, Number]:
        def stable(degrees: float) -> bool:
            return self.r.is_stable(np.exp(-1j * np.radians(degrees)))

        name = "phase_margin_deg"
        if not self.gain:
            how = confirm_no_limit(name, [30.0, 60.0, 90.0, 120.0, 150.0, 180.0], stable, EIGENVALUES)
            return {name: Number(np.inf, "deg", 0.0, how)}
        margin, c = min(((abs(_missing_phase(c)), c) for c in self.gain), key=lambda pair: pair[0])
        if margin > 180 - 1e-6:  # L = 1: both directions have the same limit
            return {name: Number(180.0, "deg", 1e-6, confirm_crossing(self.r, c, -1 / c.L, name))}
        others = [abs(_missing_phase(o)) for o in self.gain if o is not c]
        others += [360 - o for o in (margin, *others)]  # the same limits, reached by rotating to the other side
        how = confirm_limit(name, margin, others, 0.0, stable, EIGENVALUES + " with L rotated")
        return {name: Number(margin, "deg", 2 * np.degrees(c.tolerance), how)}

    def _find_delay_margin(self) -> dict[str, Number]:
        r = self.r
        lags = {c: np.radians(_missing_phase(c)) % (2 * np.pi) for c in self.gain if 0 < c.omega < np.inf}
        limits = sorted((lag / c.omega, c.tolerance * (1 + 1 / lag)) for c, lag in lags.items())
        if not r.dt:
            tau, error = limits[0] if limits else (np.inf, 0.0)
            others = [(lag + 2 * np.pi * k) / c.omega for c, lag in lags.items() for k in range(50)]
            if abs(r.D[0, 0]) >= 1:
                tau, error, how = 0.0, 0.0, "|L| ≥ 1 at infinite frequency: any delay has poles beyond the limit"
            elif not limits:
                how = "|L| < 1 at all frequencies: no delay matters"
            else:
                how = confirm_delay(r, self.scan.features, tau, [o for o in others if o != tau])
            samples = Number(np.nan, "samples", np.nan, "the loop is not sampled")
            return {"delay_margin_s": Number(tau, "s", tau * error, how), "delay_margin_samples": samples}
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

    def _confirm_samples(self, n: float, lags: dict[Crossing, float]) -> str:
        """Confirm a margin by the number of unstable poles with the whole samples next to it; return the computation.

        ``lags`` are the phases in rad by which the crossings are ahead of −1.
        """
        below, above = int(np.floor(n)), int(np.floor(n)) + 1
        whole = abs(n - round(n)) <= 1e-9 * max(n, 1.0) and n > 0.5
        if whole:  # with exactly these samples poles lie on the unit circle
            below, above = round(n) - 1, round(n) + 1
            confirm_on_limit(self.r, round(n))
        for samples in (below, above):
            expected = 0
            for c, lag in lags.items():
                passed = 1 + np.floor((samples * c.omega * self.r.dt - lag) / (2 * np.pi))
                expected += 2 * int(max(0, passed)) * (1 if c.slope < 0 else -1)
            found = count_unstable(self.r, self.scan.features, samples)
            if found != expected:
                raise ConfirmationError(
                    f"found a margin of {n:.9g} samples, but {found} unstable poles with {samples} samples of delay; "
                    f"expected {expected}. Look at closed_loop_poles.",
                    block="delay_margin",
                )
        with_z = EIGENVALUES if above <= 100 else "encirclements"
        on_it = f", on the limit at n = {round(n)}" if whole else ""
        return Confirmation(
            f"{with_z} with z⁻ⁿ: stable at n = {below}{on_it}, as many unstable at n = {above} as crossovers say",
            f"{with_z} with z⁻ⁿ: stable with fewer samples, as many unstable with more as crossovers say",
        )

    def _confirm_no_samples(self) -> str:
        """Confirm that no number of samples ends stability; return the computation."""

        def stable(n: float) -> bool:
            return count_unstable(self.r, self.scan.features, int(n)) == 0

        return confirm_no_limit("delay_margin", [1, 2, 5, 10], stable, EIGENVALUES + " with z⁻ⁿ")

    def _count_whole_samples(self) -> tuple[float, str]:
        """Return the whole samples of delay that the loop bears, and the computation that says so."""
        n = 0
        while n < 100 and count_unstable(self.r, self.scan.features, n + 1) == 0:
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
            how = confirm_peak(self.r, a, b, peak.value, name)
            found[name] = Number(peak.value, "1", peak.value * self._error(peak, t), how)
            found[name + "_frequency"] = Number(peak.omega, "rad/s", *self._tolerate(peak, how))
        ms = found["ms"]
        found["modulus_margin"] = Number(1 / ms.value, "1", ms.tolerance / ms.value**2, ms.confirmed_by)
        how = confirm_peak(self.r, upper, lower, disk.value, "disk_margin")
        found["disk_margin"] = Number(1 / disk.value, "1", self._error(disk, t) / disk.value, how)
        return {**found, "bandwidth": self._find_bandwidth()}

    def _error(self, peak: Peak, t: Peak) -> float:
        """Return the relative error of a peak: that of L, times the largest |T|."""
        inside = 0 < peak.omega < np.inf and not any(a.omega == peak.omega for a in self.scan.features.axis_poles)
        return max(1e-12, (self.r.error(peak.omega) if inside else 1e-13) * 3 * (1 + t.value))

    def _tolerate(self, peak: Peak, how: str) -> tuple[float, str]:
        ends = peak.omega in (0.0, np.inf) or peak.omega == self.r.nyquist
        return (0.0 if ends else 1e-7 * peak.omega), how

    def _find_bandwidth(self) -> Number:
        L = self.scan.ends()[0][1]
        low = 1.0 if np.isinf(L) else abs(L / (1 + L))
        level = low / np.sqrt(2)
        omega = self.scan.find_fall_below(level) if level > 0 else np.nan
        if np.isnan(omega):
            return Number(omega, "rad/s", np.nan, "T vanishes at low frequency")
        found = find_level_frequencies(self.r, 0.0, 1.0, level)
        if np.isinf(omega):
            return Number(omega, "rad/s", 0.0, "the response: |T| never falls below 1/√2 of its low-frequency value")
        if found is None:
            how = "the frequency response only: |T| is above the level at the highest frequency"
        elif not len(found) or np.min(np.abs(found - omega)) > 1e-3 * omega:
            raise ConfirmationError(
                f"found {omega:.12g} rad/s, but the Hamiltonian has the level of |T| at {found!r} rad/s; expected it "
                "at the same frequency. Look at closed_loop_poles: the realization may be ill-conditioned.",
                block="bandwidth",
            )
        else:
            how = "Hamiltonian eigenvalues: |T| falls to 1/√2 of its low-frequency value within 0.1 % of this"
        return Number(omega, "rad/s", 1e-10 * omega, how)


def find_disk_frequency(r: Realization) -> float:
    """Return the frequency in rad/s at which |S − T| is largest: that of the disk margin."""
    return float(Scan(r).find_peak(0.5, -0.5).omega)


def _missing_phase(c: Crossing) -> float:
    """Return the phase by which L is ahead of −1, in degrees above −180 and up to 180."""
    degrees = float(np.degrees(np.angle(-c.L)))
    return degrees if degrees > -180 else 180.0
