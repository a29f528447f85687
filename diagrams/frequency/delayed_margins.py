"""Margins of a continuous loop with delays: roots of its exact response, confirmed by counting the closed loop's roots.

The scan and its refinement are those of every loop. Each limit is confirmed by the argument of the closed loop's
characteristic function, which includes the poles of L itself beyond the limit of stability: stable just inside the
limit, unstable just beyond it. A peak γ of |(a + b L)/(1 + L)| is a limit, too: with the factor (1 + b δ)/(1 + a δ)
on L the loop stays stable for every |δ| < 1/γ, and for one δ of this size it doesn't.
"""

from __future__ import annotations

import numpy as np

from ...blocks.core import ConfirmationError
from .delayed_realization import DelayedRealization
from .loop_scan import Crossing, LoopScan, Peak
from .number import Confirmation
from .nyquist import count_encirclements
from .sensitivity_peaks import LEVEL

ARGUMENT = "argument of the closed loop's characteristic function"
FLOORS = (0.3, 0.1, 0.03, 0.01, 1e-3, 1e-4, 1e-6, 1e-9)
"""|L| above which all turns of the response are resolved; tried until a phase crossover lies between it and 1."""
ON_RIM = 24
"""Factors on the rim of a disk at which stability is tested."""
SAME = 1e-8
"""Relative difference of two computations of one number."""


class ByArgument:
    """The scan of a loop with delays, and confirmations by counting roots of its characteristic function."""

    stability = ARGUMENT
    late = ARGUMENT + ", with the delay in series"

    def __init__(self, r: DelayedRealization):
        self.r, self.floor = r, 0.0
        self.scan = self._scan()

    def _scan(self) -> LoopScan:
        features = self.r.features()
        size = 1.0
        if not any(a.omega == 0.0 for a in features.axis_poles):  # L(0) may be 0: of a washout, of a cancelled delay
            bends = np.append(0.0, np.abs(features.points()))
            size = float(np.clip(np.max(np.abs(self.r.matrix(1j * bends)[:, 0, 0])), 1e-3, 1.0))
        for part in FLOORS:
            self.floor = part * size
            scan = LoopScan(self.r, features, floor=self.floor)
            if np.isfinite(self.r.settled) or any(self.floor <= abs(c.L) < 1.0 for c in scan.phase_crossovers):
                break  # one that turns up to infinite frequency is scanned as far as it changes
            if all(np.all(np.abs(L) > self.floor) for L, _ in scan.samples):
                break  # a lower floor leads to the same samples
        return scan

    def count_encirclements(self) -> int:
        """Return the clockwise encirclements of −1, confirmed."""
        return count_encirclements(self.r, self.scan.features).encirclements

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
        elif any(p.omega == peak.omega for p in self.scan.features.axis_poles):
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

    def gain_at_infinity(self) -> float:
        """Return the largest |L| at infinite frequency."""
        return float(np.max(np.abs(self.r.at_infinity)))

    def is_stable_late(self, tau: float) -> bool:
        """Whether the closed loop is stable with a further delay in series."""
        return self.r.put_late(tau).is_stable()
