"""Confirmations of a loop's margins: the closed loop's poles, computed without the response that was scanned.

A loop without delays has eigenvalues: at a crossing one of them lies on the limit of stability, and a peak is a level
that a Hamiltonian's eigenvalues reach. They share the loop's realization with the scan, and nothing else.

Of a loop with delays the roots of its characteristic function are counted by the argument, which includes the poles of
L itself beyond the limit of stability. A peak γ of |(a + b L)/(1 + L)| is a limit, too: with the factor
(1 + b δ)/(1 + a δ) on L the loop stays stable for every |δ| < 1/γ, and for one δ of this size it doesn't.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...blocks.core import ConfirmationError
from .delayed_realization import DelayedRealization
from .loop_scan import Crossing, Peak
from .margin_analysis import EIGENVALUES
from .number import Confirmation
from .nyquist import winding_number
from .realization import ROUNDOFF, Realization
from .scan_refine_confirm import confirm_no_limit
from .sensitivity_peaks import LEVEL, confirm_peak, find_level_frequencies

ARGUMENT = "argument of the closed loop's characteristic function"
MOST_SAMPLES = 100
"""Samples of delay up to which closed-loop eigenvalues count the unstable poles; beyond, encirclements do."""
ON_RIM = 24
"""Factors on the rim of a disk at which stability is tested."""
SAME = 1e-8
"""Relative difference of two computations of one number."""


class ByEigenvalues:
    """Confirmations of a loop without delays, by eigenvalues of its matrices."""

    stability = EIGENVALUES
    late = "encirclements of 1 + L exp(−sτ)"

    def __init__(self, r: Realization):
        self.r = r

    def confirm_crossing(self, c: Crossing, factor: complex, name: str) -> str:
        """Confirm that the loop, multiplied by this factor, has a closed-loop pole at the crossing's frequency."""
        r = self.r
        if np.isinf(c.omega):
            ok = abs(1 + factor * r.D[0, 0]) < 1e-9
            where = "1 + D vanishes with this factor: a closed-loop pole passes through infinity"
        else:
            p = complex(r.point(np.array(1j * c.omega)))
            closed = r.closed_matrix(factor)
            distance = np.min(np.abs(np.linalg.eigvals(closed) - p), initial=np.inf)
            ok = distance <= 1e-5 * abs(p) + 1e-7 * r.scale
            where = "a closed-loop eigenvalue that lies there with this factor"
            # a large factor leaves few digits of an eigenvalue: is p one of a matrix within rounding of this?
            if not ok:
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

    def is_stable_late(self, tau: float) -> bool:
        """Whether the closed loop of a continuous loop is stable with a delay in series."""
        return winding_number(self.r, delay=tau) + self.r.count_open() == 0

    # --- whole samples of delay in series with a sampled loop -------------------------------------------------------

    def confirm_samples(self, n: float, lags: Mapping[Crossing, float]) -> str:
        """Confirm a margin by the number of unstable poles with the whole samples next to it.

        ``lags`` are the phases in rad by which the crossings are ahead of −1.
        """
        below, above = int(np.floor(n)), int(np.floor(n)) + 1
        whole = abs(n - round(n)) <= 1e-9 * max(n, 1.0) and n > 0.5
        if whole:  # with exactly these samples poles lie on the unit circle
            below, above = round(n) - 1, round(n) + 1
            self.confirm_on_limit(round(n))
        for samples in (below, above):
            expected = 0
            for c, lag in lags.items():
                passed = 1 + np.floor((samples * c.omega * self.r.dt - lag) / (2 * np.pi))
                expected += 2 * int(max(0, passed)) * (1 if c.slope < 0 else -1)
            found = self._count_unstable(samples)
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

    def confirm_no_samples(self) -> str:
        """Confirm that no number of samples ends stability."""
        tried = (1, 2, 5, 10)
        how = EIGENVALUES + " with z⁻ⁿ"
        return confirm_no_limit("delay_margin", tried, lambda n: self._count_unstable(int(n)) == 0, how)

    def count_whole_samples(self) -> tuple[float, str]:
        """Return the whole samples of delay that the loop bears, and the computation that says so."""
        n = 0
        while n < MOST_SAMPLES and self._count_unstable(n + 1) == 0:
            n += 1
        return float(n), Confirmation(
            f"{EIGENVALUES} with z⁻ⁿ: stable at n = {n}, unstable at n = {n + 1} (|L| ≥ 1 at π/T)",
            f"{EIGENVALUES} with z⁻ⁿ: stable with these samples, unstable with one more (|L| ≥ 1 at π/T)",
        )

    def confirm_on_limit(self, n: int) -> None:
        """Confirm that n samples of delay in series put a closed-loop pole on the unit circle, up to 100 samples."""
        if n > MOST_SAMPLES:
            return
        delayed = self.r.delay_by(n)
        nearest = float(np.min(np.abs(delayed.growth(delayed.eigenvalues()))))
        if nearest > 1e-6:
            raise ConfirmationError(
                f"found a margin of {n} samples, but with that delay no closed-loop pole is nearer than {nearest:.3g} "
                "to the unit circle; expected one on it. Look at closed_loop_poles.",
                block="delay_margin",
            )

    def _count_unstable(self, n: int) -> int:
        """Return the number of closed-loop poles that are not stable with n samples of delay in series."""
        if n > MOST_SAMPLES:
            return winding_number(self.r, delay=n * self.r.dt) + self.r.count_open()
        return self.r.delay_by(n).count_unstable()


class ByArgument:
    """Confirmations of a continuous loop with delays, by counting roots of its characteristic function."""

    stability = ARGUMENT
    late = ARGUMENT + ", with the delay in series"

    def __init__(self, r: DelayedRealization):
        self.r = r

    def confirm_crossing(self, c: Crossing, factor: complex, name: str) -> str:
        """Confirm that the loop, multiplied by this factor, has a root at the crossing's frequency."""
        r = self.r
        if np.isinf(c.omega):
            if abs(1 + factor * r.D[0, 0]) < 1e-9:
                return "1 + L vanishes at infinite frequency with this factor: a chain of poles passes through infinity"
            apart = np.inf
        else:
            root = 1j * c.omega
            system = r.close(complex(factor))
            value, slope = system.evaluate(np.array([root]))
            if not len(system.A):  # gains and delays alone: det(I − H E) is the characteristic function
                E = np.exp(-root * system.tau)
                value, slope = (np.eye(len(E)) - system.H * E)[None], (system.H * (system.tau * E))[None]
            U, sigma, V = np.linalg.svd(value[0])
            moved = abs(np.conj(U[:, -1]) @ slope[0] @ np.conj(V[-1]))
            apart = float(sigma[-1] / max(moved, 1e-300))
        if not apart <= 1e-6 * c.omega + 1e-9 * r.scale:
            raise ConfirmationError(
                f"found a crossing at {c.omega:.12g} rad/s, but the nearest root of the closed loop with the factor "
                f"{factor:.6g} is {apart:.3g} rad/s away; expected one there. Look at closed_loop_poles.",
                block=name,
            )
        return "a root of the closed loop's characteristic function that lies there with this factor"

    def confirm_peak(self, a: float, b: float, peak: Peak, name: str) -> str:
        """Confirm a peak by the stability with factors on the rim of its disk, and just beyond it at the peak."""
        r = self.r
        if not np.isfinite(peak.omega):
            L = complex(r.D[0, 0])
        elif any(p.omega == peak.omega for p in r.features.axis_poles):
            L = complex(np.inf)
        else:
            L = complex(r.matrix(np.array([1j * peak.omega]))[0, 0, 0])
        delta = 0.0 if np.isinf(L) and not b else (-1.0 / b if np.isinf(L) else -(1 + L) / (a + b * L))

        def stable(d: complex) -> bool:
            below = 1 + a * d
            return abs(below) > 1e-12 and r.is_stable((1 + b * d) / below)

        turns = np.angle(delta) + 2 * np.pi * np.arange(ON_RIM) / ON_RIM
        inside = [complex((1 - LEVEL) / peak.value * np.exp(1j * turn)) for turn in turns]
        bad = sum(not stable(d) for d in inside)
        beyond = stable(complex(delta * (1 + LEVEL)))
        if bad or (beyond and 0 < peak.omega < np.inf):
            raise ConfirmationError(
                f"found the peak {peak.value:.12g}, but the {ARGUMENT} says that {bad} of {ON_RIM} factors just inside "
                f"its disk are unstable, and the one just beyond it {'stable' if beyond else 'unstable'}; expected "
                "none, and unstable. Look at closed_loop_poles for a very narrow resonance, which a scan may miss.",
                block=name,
            )
        return Confirmation(
            f"{ARGUMENT}: stable with {ON_RIM} factors in {1 - LEVEL:g} of the disk that the peak leaves, unstable "
            "just beyond it",
        )

    def confirm_bandwidth(self, omega: float, level: float) -> str:
        """Confirm the bandwidth by the closed loop's own equations, and by values below it."""
        lower = omega * np.linspace(1e-3, 1 - 1e-6, 200)
        value = self._complementary(np.append(omega, lower))
        if abs(value[0] / level - 1) > SAME or np.any(value[1:] < level * (1 - SAME)):
            raise ConfirmationError(
                f"found {omega:.12g} rad/s, where the closed loop has |T| = {value[0]:.9g}, the least below it being "
                f"{value[1:].min():.9g}; expected {level:.9g}, and no less below. Look at closed_loop_poles.",
                block="bandwidth",
            )
        return "the closed loop's equations: |T| is 1/√2 of its low-frequency value there, and more below"

    def _complementary(self, omega: np.ndarray) -> np.ndarray:
        """Return |T| of the closed loop's own equations, without L."""
        from control import ss

        from .delayed_system import DelayedSystem

        rest = self.r.rest
        loop = DelayedSystem(ss(rest.A, rest.B, rest.C, rest.D, 0, remove_useless_states=False), self.r.tau)
        return np.asarray(np.abs(loop.feedback(1)(1j * omega)))

    def is_stable_late(self, tau: float) -> bool:
        """Whether the closed loop is stable with a further delay in series."""
        return self.r.put_late(tau).is_stable()


def confirmations_of(r: Realization | DelayedRealization) -> ByEigenvalues | ByArgument:
    """Return what confirms the candidates of a loop's scan."""
    return ByArgument(r) if isinstance(r, DelayedRealization) else ByEigenvalues(r)
