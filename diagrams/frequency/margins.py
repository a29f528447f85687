"""Margins of a loop with one channel: from its frequency response with polished roots, confirmed by eigenvalues."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ...blocks.core.errors import ConfirmationError, ParameterError
from . import confirm
from .crossings import Crossing, Peak, Scan
from .features import clusters
from .number import Number
from .nyquist import count
from .one_thread import on_one_thread
from .realization import Realization

EIGENVALUES = "closed-loop eigenvalues"
GAINS = (1.5, 2.0, 5.0, 10.0, 100.0, 1e3)


@dataclass(frozen=True)
class GainCrossover:
    """A frequency at which |L| = 1, and the phase that is missing to −1 there (−180° to 180°)."""

    frequency: Number
    phase_margin_deg: Number


@dataclass(frozen=True)
class PhaseCrossover:
    """A frequency at which L is real and negative, and the factor that takes it to −1 there."""

    frequency: Number
    gain_margin: Number


@dataclass(frozen=True)
class Margins:
    """Margins of a loop L with S = 1/(1 + L) and T = L/(1 + L).

    The margins of an unstable closed loop are NaN; its crossings and poles are there.

    Parameters
    ----------
    stable : bool
        Whether all of `closed_loop_poles` are stable. Hidden modes are not among them: look at `hidden_unstable`, too.
    gain_crossovers, phase_crossovers : tuple
        All of them, by rising frequency; phase crossovers also at 0, at π/T and at infinity.
    gain_margin_low, gain_margin_high : Number
        The largest factor below 1, and the smallest above 1, at which the loop gain ends stability; 0 and infinity
        where there is none.
    phase_margin_deg : Number
        The smallest rotation of L, to either side, that ends stability; infinite where |L| = 1 nowhere.
    delay_margin_s, delay_margin_samples : Number
        The smallest delay τ in series, e^(−jωτ), that ends stability. Of a sampled loop it is read between the samples
        from the response; where |L| > 1 at π/T that has no meaning, and the whole samples that it bears are given.
        What a delay of a fraction of a sample in front of the plant's hold does is another number:
        `delayed_hold_margin`.
    modulus_margin : Number
        Smallest distance of L to −1, 1/M_s.
    disk_margin : Number
        α of the symmetric disk (S − T), or of the given skew; see `disk_margin`.
    ms, ms_frequency, mt, mt_frequency : Number
        Largest |S| and |T|, and where.
    bandwidth : Number
        Lowest frequency at which |T| falls below 1/√2 (3.0103 dB) of its value at low frequency.
    closed_loop_poles : tuple of complex
        In the s plane (continuous) or the z plane (sampled). Multiple poles scatter, as ε^(1/multiplicity).
    hidden_poles : tuple of complex
        Poles that are not controllable or not observable in the loop, left out of everything above.
    hidden_unstable : tuple of complex
        Those of them that are not stable, except on the limit itself. This loop does not show them, and no gain in it
        stabilizes them: another loop must.
    encirclements : int
        Clockwise encirclements of −1 by L.
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
    encirclements: int

    def numbers(self) -> dict[str, Number]:
        """Return the single numbers by name, in the order of the report."""
        found = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value for name, value in found.items() if isinstance(value, Number)}

    def as_dict(self) -> dict[str, Any]:
        """Return the single numbers as they stand in a report's JSON."""
        return {name: number.as_dict() for name, number in self.numbers().items()}

    def __str__(self) -> str:
        lines = [f"{name:22s}{number}" for name, number in self.numbers().items()]
        if self.hidden_unstable:
            lines.append(
                f"hidden_unstable       {', '.join(f'{p:.6g}' for p in self.hidden_unstable)}: not in this loop"
            )
        return "\n".join(lines)


@on_one_thread
def margins(loop: Any, *, delay: int = 0, skew: float = 0.0) -> Margins:
    """Return all margins of a loop with one channel, each confirmed by a second computation.

    Parameters
    ----------
    loop : control.StateSpace
        L with S = 1/(1 + L): continuous (dt = 0) or sampled (dt = T). Poles at s = 0 or z = 1 are welcome, and so are
        open-loop unstable ones. A transfer function is realized first.
    delay : int
        Whole samples of delay in series with a sampled loop.
    skew : float
        Skew of the disk margin; 0 is the symmetric one, S − T.

    Raises
    ------
    ConfirmationError
        If a number and its confirmation disagree.
    ParameterError
        If the loop has not one channel, no sample time is given, or 1 + L is singular at infinite frequency.

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
            f"found a loop that is the constant {r.D[0, 0]:.6g}: no state is both reached and seen; expected dynamics. "
            "Look at the wire at which the loop is opened.",
            block="margins",
        )
    if abs(1 + r.D[0, 0]) < 1e-12:
        raise ParameterError("found L = −1 at infinite frequency; the closed loop is ill-posed.", block="margins")
    return _Judge(r, skew).margins()


class _Judge:
    """One loop, scanned; each method makes some of the numbers and confirms them."""

    def __init__(self, r: Realization, skew: float):
        self.r, self.skew, self.scan = r, skew, Scan(r)
        self.gain, self.phase = self.scan.gain_crossovers(), self.scan.phase_crossovers()
        self.unstable = r.unstable()

    def margins(self) -> Margins:
        r = self.r
        poles = r.eigenvalues()
        top = max((c.omega for c in self.gain), default=0.0)
        if self.unstable:
            near = r.growth(poles).max()
            reason = f"the closed loop is not stable: {self.unstable} of its poles are not (largest growth {near:.3g})"
            units = {"phase_margin_deg": "deg", "delay_margin_s": "s", "delay_margin_samples": "samples"}
            units |= dict.fromkeys(("ms_frequency", "mt_frequency", "bandwidth"), "rad/s")
            names = [f.name for f in fields(Margins) if f.type == "Number"]
            found = {name: Number(np.nan, units.get(name, "1"), np.nan, reason) for name in names}
            try:
                encirclements = count(r, self.scan.features).encirclements
            except ConfirmationError:  # a pole on the limit itself: the curve passes through −1
                encirclements = self.unstable - self.scan.features.unstable_poles()
        else:
            encirclements = count(r, self.scan.features).encirclements
            found = {**self._gain_margins(), **self._phase_margin(), **self._delay_margin(top), **self._peaks()}
        return Margins(
            stable=not self.unstable,
            gain_crossovers=tuple(self._gain_crossover(c) for c in self.gain),
            phase_crossovers=tuple(self._phase_crossover(c) for c in self.phase),
            closed_loop_poles=tuple(complex(p) for p in np.sort_complex(poles + 1 if r.dt else poles)),
            hidden_poles=tuple(complex(p) for p in (r.hidden + 1 if r.dt else r.hidden)),
            hidden_unstable=self._hidden_unstable(),
            encirclements=encirclements,
            **found,
        )

    def _hidden_unstable(self) -> tuple[complex, ...]:
        """Return the hidden poles beyond the limit; coinciding ones on it are computed with a scatter to both sides."""
        r = self.r
        if not len(r.hidden):
            return ()
        _, rest = clusters(r, r.hidden, max(r.scale, float(np.abs(r.hidden).max())))
        beyond = rest[rest.real > 0]
        return tuple(complex(p) for p in (np.exp(beyond * r.dt) if r.dt else beyond))

    def _frequency(self, c: Crossing, how: str) -> Number:
        ends = c.omega in (0.0, np.inf) or c.omega == self.r.nyquist
        return Number(c.omega, "rad/s", 0.0 if ends else c.tolerance * c.omega, how)

    def _gain_crossover(self, c: Crossing) -> GainCrossover:
        how = confirm.at_crossing(self.r, c, -1 / c.L, "gain_crossover")
        return GainCrossover(
            self._frequency(c, how), Number(_missing_phase(c), "deg", 2 * np.degrees(c.tolerance), how)
        )

    def _phase_crossover(self, c: Crossing) -> PhaseCrossover:
        k = -1 / c.L.real
        how = confirm.at_crossing(self.r, c, k, "phase_crossover")
        return PhaseCrossover(self._frequency(c, how), Number(k, "1", k * 2 * c.tolerance, how))

    def _gain_margins(self) -> dict[str, Number]:
        factors = {-1 / c.L.real: c for c in self.phase}
        low = max((k for k in factors if k < 1), default=0.0)
        high = min((k for k in factors if k > 1), default=np.inf)
        found = {}
        for name, k in (("gain_margin_low", low), ("gain_margin_high", high)):
            if k in factors:
                how = confirm.limit(name, k, [o for o in factors if o != k], 1.0, self.r.stable, EIGENVALUES)
                found[name] = Number(k, "1", k * 2 * factors[k].tolerance, how)
            else:
                values = [1 / g for g in GAINS[:-1]] if k == 0.0 else GAINS
                found[name] = Number(k, "1", 0.0, confirm.none(name, values, self.r.stable, EIGENVALUES))
        return found

    def _phase_margin(self) -> dict[str, Number]:
        def stable(degrees: float) -> bool:
            return self.r.stable(np.exp(-1j * np.radians(degrees)))

        name = "phase_margin_deg"
        if not self.gain:
            how = confirm.none(name, [30.0, 60.0, 90.0, 120.0, 150.0, 180.0], stable, EIGENVALUES)
            return {name: Number(np.inf, "deg", 0.0, how)}
        margin, c = min(((abs(_missing_phase(c)), c) for c in self.gain), key=lambda pair: pair[0])
        if margin > 180 - 1e-6:  # L = 1: from either side the same limit
            how = confirm.at_crossing(self.r, c, -1 / c.L, name)
            return {name: Number(180.0, "deg", 1e-6, how)}
        others = [abs(_missing_phase(o)) for o in self.gain if o is not c]
        others += [360 - o for o in (margin, *others)]  # rotated to the other side
        how = confirm.limit(name, margin, others, 0.0, stable, EIGENVALUES + " with L rotated")
        return {name: Number(margin, "deg", 2 * np.degrees(c.tolerance), how)}

    def _delay_margin(self, top: float) -> dict[str, Number]:
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
                how = confirm.delay(r, self.scan.features, tau, [o for o in others if o != tau])
            samples = Number(np.nan, "samples", np.nan, "the loop is not sampled")
            return {"delay_margin_s": Number(tau, "s", tau * error, how), "delay_margin_samples": samples}
        end = self.scan.ends()[1][1]
        if abs(end) >= 1:
            n, how = self._whole_samples(limits)
            error = 0.0
        else:
            n, error = (limits[0][0] / r.dt, limits[0][1]) if limits else (np.inf, 0.0)
            how = self._count_samples(n, lags) if limits else self._no_samples()
        return {
            "delay_margin_s": Number(n * r.dt, "s", n * r.dt * error if error else 0.0, how),
            "delay_margin_samples": Number(n, "samples", n * error if error else 0.0, how),
        }

    def _count_samples(self, n: float, lags: dict[Crossing, float]) -> str:
        """Confirm by the number of unstable poles with the next whole samples below and above."""
        below, above = int(np.floor(n)), int(np.floor(n)) + 1
        whole = abs(n - round(n)) <= 1e-9 * max(n, 1.0) and n > 0.5
        if whole:  # with that many samples the poles lie on the limit itself
            below, above = round(n) - 1, round(n) + 1
            confirm.on_the_limit(self.r, round(n))
        for samples in (below, above):
            expected = 0
            for c, lag in lags.items():
                passed = 1 + np.floor((samples * c.omega * self.r.dt - lag) / (2 * np.pi))
                expected += 2 * int(max(0, passed)) * (1 if c.slope < 0 else -1)
            found = confirm.whole_samples(self.r, self.scan.features, samples)
            if found != expected:
                raise ConfirmationError(
                    f"found a margin of {n:.9g} samples, which means {expected} unstable poles with {samples} samples "
                    f"of delay, but there are {found}. Look at closed_loop_poles.",
                    block="delay_margin",
                )
        with_z = EIGENVALUES if above <= 100 else "encirclements"
        on_it = f", on the limit at n = {round(n)}" if whole else ""
        return f"{with_z} with z⁻ⁿ: stable at n = {below}{on_it}, as many unstable at n = {above} as crossovers say"

    def _no_samples(self) -> str:
        def stable(n: float) -> bool:
            return confirm.whole_samples(self.r, self.scan.features, int(n)) == 0

        return confirm.none("delay_margin", [1, 2, 5, 10], stable, EIGENVALUES + " with z⁻ⁿ")

    def _whole_samples(self, limits: list[tuple[float, float]]) -> tuple[float, str]:
        n = 0
        while n < 100 and confirm.whole_samples(self.r, self.scan.features, n + 1) == 0:
            n += 1
        return float(n), f"{EIGENVALUES} with z⁻ⁿ: stable at n = {n}, unstable at n = {n + 1} (|L| ≥ 1 at π/T)"

    def _peaks(self) -> dict[str, Number]:
        upper, lower = (1 + self.skew) / 2, -(1 - self.skew) / 2
        s, t, disk = self.scan.peak(1, 0), self.scan.peak(0, 1), self.scan.peak(upper, lower)
        found = {}
        for name, peak, (a, b) in (("ms", s, (1.0, 0.0)), ("mt", t, (0.0, 1.0))):
            how = confirm.peak(self.r, a, b, peak.value, name)
            found[name] = Number(peak.value, "1", peak.value * self._error(peak, t), how)
            found[name + "_frequency"] = Number(peak.omega, "rad/s", *self._at(peak, how))
        ms = found["ms"]
        found["modulus_margin"] = Number(1 / ms.value, "1", ms.tolerance / ms.value**2, ms.confirmed_by)
        how = confirm.peak(self.r, upper, lower, disk.value, "disk_margin")
        found["disk_margin"] = Number(1 / disk.value, "1", self._error(disk, t) / disk.value, how)
        return {**found, "bandwidth": self._bandwidth()}

    def _error(self, peak: Peak, t: Peak) -> float:
        """Return the relative error of a peak: that of L, times |T|."""
        inside = 0 < peak.omega < np.inf and not any(a.omega == peak.omega for a in self.scan.features.axis_poles)
        return max(1e-12, (self.r.error(peak.omega) if inside else 1e-13) * 3 * (1 + t.value))

    def _at(self, peak: Peak, how: str) -> tuple[float, str]:
        ends = peak.omega in (0.0, np.inf) or peak.omega == self.r.nyquist
        return (0.0 if ends else 1e-7 * peak.omega), how

    def _bandwidth(self) -> Number:
        L = self.scan.ends()[0][1]
        low = 1.0 if np.isinf(L) else abs(L / (1 + L))
        level = low / np.sqrt(2)
        omega = self.scan.falls_below(level) if level > 0 else np.nan
        if np.isnan(omega):
            return Number(omega, "rad/s", np.nan, "T vanishes at low frequency")
        found = confirm.level_frequencies(self.r, 0.0, 1.0, level)
        if np.isinf(omega):
            return Number(omega, "rad/s", 0.0, "the response: |T| never falls below 1/√2 of its low-frequency value")
        if found is None:
            how = "the frequency response only: |T| is above the level at the highest frequency"
        elif not len(found) or np.min(np.abs(found - omega)) > 1e-3 * omega:
            raise ConfirmationError(
                f"found {omega:.12g} rad/s, but the Hamiltonian says that |T| has this level at {found!r} rad/s only.",
                block="bandwidth",
            )
        else:
            how = "Hamiltonian eigenvalues: |T| has this level there, to 0.1 %"
        return Number(omega, "rad/s", 1e-10 * omega, how)


def _missing_phase(c: Crossing) -> float:
    """Return the phase of L above −180°, in degrees, above −180 and up to 180."""
    degrees = float(np.degrees(np.angle(-c.L)))
    return degrees if degrees > -180 else 180.0
