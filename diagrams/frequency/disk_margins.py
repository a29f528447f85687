"""Disk margins of one channel, and of several channels at once by the structured singular value with D scaling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...blocks.core import (
    ConfirmationError,
    Finding,
    ParameterError,
    Sheet,
    ShownAsTable,
    accepts,
    brief,
    decibels,
    explain_calls,
    kinds,
)
from .confirmations import ByArgument
from .delayed_realization import DelayedRealization, realize
from .loop_scan import LoopScan
from .margin_analysis import EIGENVALUES
from .number import Confirmation, Number, carries_findings
from .realization import Realization
from .scan_refine_confirm import confirm_limit, find_largest
from .sensitivity_peaks import confirm_peak, sensitivity_at
from .state_space import make_state_space, read_matrices
from .structured_value import mu_bound, mu_lower_bound

if TYPE_CHECKING:
    from control import StateSpace

    from .state_space import LinearSystem


@explain_calls
@dataclass(frozen=True)
class DiskMargin(ShownAsTable):
    """Size α of the disk of factors that leave a loop stable.

    The factors are f = (1 + (1 − σ)/2 δ) / (1 − (1 + σ)/2 δ) with |δ| < α, another one in each channel.

    Parameters
    ----------
    alpha : Number
        α, from an upper bound of the structured singular value: no smaller perturbation destabilizes the loop.
    skew : float
        σ: 0 gives the symmetric disk (S − T), 1 that of S, −1 that of T.
    frequency : Number
        Frequency of the largest bound, rad/s.
    gain_low, gain_high : float
        Range of gains that all channels may take at once.
    phase_deg : float
        Phase by which all channels may turn at once, to either side.
    destabilizing : tuple of complex
        Smallest factors found, one a channel, with which the closed loop has a pole at the frequency.
    destabilizing_alpha : float
        |δ| of those factors: α for up to three channels, α or more beyond.
    findings : tuple of Finding
        Effects on the loop that its linear model leaves out.
    """

    alpha: Number
    skew: float
    frequency: Number
    gain_low: float
    gain_high: float
    phase_deg: float
    destabilizing: tuple[complex, ...]
    destabilizing_alpha: float
    findings: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        gains = f"gains of {self.gain_low:.4g} to {self.gain_high:.4g}"
        facts = f"α = {self.alpha} at {self.frequency}", gains, f"phases to ±{self.phase_deg:.4g}°"
        return brief("disk margin", *facts, then=".alpha, .frequency, .destabilizing")

    def _sheet(self) -> Sheet:
        gains = f"{self.gain_low:.4g} to {self.gain_high:.4g}"
        in_db = " to ".join(text for text in (decibels(self.gain_low), decibels(self.gain_high)) if text)
        facts = (
            ("alpha", str(self.alpha)),
            ("frequency", str(self.frequency)),
            ("gains", f"{gains} ({in_db})" if in_db else gains),
            ("phases", f"to ±{self.phase_deg:.4g}°"),
        )
        return Sheet("disk margin", facts)


@accepts(delay=kinds.finite, skew=kinds.number)
@carries_findings
def disk_margin(loop: LinearSystem, *, delay: int = 0, skew: float = 0.0) -> DiskMargin:
    """Return the disk margin of a loop with one channel, α = 1/max|S + (σ − 1)/2|.

    Parameters
    ----------
    loop : control.StateSpace
        L with S = 1/(1 + L).
    delay : int
        Whole samples of delay in series with a sampled loop.
    skew : float
        σ; see `DiskMargin`.

    Raises
    ------
    ConfirmationError
        If eigenvalues or Hamiltonian disagree.
    ParameterError
        If the closed loop is not stable.
    """
    return _compute_disk_margin(realize(loop, delay=delay), skew)


@accepts(delay=kinds.finite, skew=kinds.number)
@carries_findings
def mimo_disk_margin(loop: LinearSystem, *, delay: int = 0, skew: float = 0.0) -> DiskMargin:
    """Return the disk margin of a square loop with independent perturbations in all channels at once.

    1/α is the largest structured singular value of S + (σ − 1)/2 I, S = (I + L)⁻¹, over frequency. D scaling bounds
    it: exactly for up to three channels, in closed form for two.

    Parameters
    ----------
    loop : control.StateSpace
        L at the plant's input or output; `loop_at` makes it from plant and controller, for both places at once too.
    delay : int
        Whole samples of delay in every channel of a sampled loop.
    skew : float
        σ; see `DiskMargin`.

    Raises
    ------
    ConfirmationError
        If no destabilizing perturbation of size α is found (up to three channels), or eigenvalues disagree.
    ParameterError
        If the closed loop is not stable, or the loop is not square.
    """
    return _compute_disk_margin(Realization.of(loop, delay=delay), skew)


@accepts(
    "loop_at",
    ParameterError,
    plant=kinds.system,
    controller=kinds.system,
    where=kinds.choice("input", "output", "both").worded(found=kinds.by_name),
)
@carries_findings
def loop_at(plant: StateSpace, controller: StateSpace, where: str = "input") -> StateSpace:
    """Return the loop transfer matrix at the plant's input (C P), its output (P C), or both at once.

    Parameters
    ----------
    plant, controller : control.StateSpace
        P and C of u = −C y, y = P u.
    where : {"input", "output", "both"}
        Place of the perturbations; ``both`` perturbs all inputs and outputs independently, [[0, C], [−P, 0]].
    """
    import control

    if where == "input":
        return controller * plant
    if where == "output":
        return plant * controller
    P = control.ss(plant)
    both = read_matrices(control.append(control.ss(controller), -P))
    inputs, outputs = int(P.ninputs), int(P.noutputs)
    order = np.argsort([*range(outputs, outputs + inputs), *range(outputs)], kind="stable")  # (u, y) feed (P, C)
    return make_state_space(both.A, both.B[:, order], both.C, both.D[:, order], both.dt)


def factor(delta: np.ndarray | float, skew: float = 0.0) -> np.ndarray:
    """Return f = (1 + (1 − σ)/2 δ) / (1 − (1 + σ)/2 δ); infinite where the denominator vanishes."""
    bottom = 1 - (1 + skew) / 2 * np.asarray(delta)
    infinite = np.abs(bottom) < 1e-12
    return np.where(infinite, np.inf, (1 + (1 - skew) / 2 * delta) / np.where(infinite, 1.0, bottom))


class _Worst(NamedTuple):
    """The smallest perturbation that ends stability: its frequency in rad/s, a bound of its size, and one that does."""

    omega: float
    alpha: float
    delta: np.ndarray  # one entry a channel
    size: float  # of delta
    how: str


def _compute_disk_margin(r: Realization | DelayedRealization, skew: float) -> DiskMargin:
    """Return the disk margin of a loop whose closed loop is stable."""
    n = len(r.D)
    if r.D.shape != (n, n):
        raise ParameterError(f"found a loop of shape {r.D.shape}; expected a square one.", block="disk_margin")
    if not r.order:
        raise ParameterError(
            "found a constant loop: no state is controllable and observable; expected dynamics. Look at the wire at "
            "which the loop is opened.",
            block="disk_margin",
        )
    if not r.is_stable():
        every = "" if isinstance(r, DelayedRealization) else f" of {r.order}"
        raise ParameterError(
            f"found {r.count_unstable():g}{every} closed-loop poles that are not stable; expected a stable closed "
            "loop: this one has no margin. Look at margins(loop).closed_loop_poles.",
            block="disk_margin",
        )
    found = _find_by_peak(r, skew) if isinstance(r, DelayedRealization) else _find_by_structured_value(r, skew)
    omega, alpha = found.omega, found.alpha
    is_end = omega in (0.0, np.inf) or omega == r.nyquist
    low, high, phase = disk_gains(alpha, skew)
    return DiskMargin(
        alpha=Number(alpha, "1", alpha * max(1e-9, 3 * r.error(omega) if 0 < omega < np.inf else 0.0), found.how),
        skew=skew,
        frequency=Number(omega, "rad/s", 0.0 if is_end else 1e-4 * omega, found.how),
        gain_low=low,
        gain_high=high,
        phase_deg=phase,
        destabilizing=tuple(complex(f) for f in factor(found.delta, skew)),
        destabilizing_alpha=found.size,
    )


def _find_by_structured_value(r: Realization, skew: float) -> _Worst:
    """Return the worst perturbation of a loop without delays: the peak of μ, confirmed by its lower bound."""
    n = len(r.D)

    def matrix(omega: float) -> np.ndarray:
        return sensitivity_at(r, omega) + (skew - 1) / 2 * np.eye(n)

    omega = _find_largest(r, skew, matrix)
    bound = mu_bound(matrix(omega))
    alpha = 1 / bound
    lower, delta = mu_lower_bound(matrix(omega))
    # the upper bound of µ is exact for up to three channels: a gap to the lower one is an error, not a property
    if n <= 3 and lower < bound * (1 - 1e-5):
        raise ConfirmationError(
            f"found α = {alpha:.9g}, but {1 / lower:.9g} as the smallest destabilizing perturbation; expected the same "
            "for up to three channels. Look at the response of the loop near "
            f"{omega:.6g} rad/s: it may be ill-conditioned.",
            block="disk_margin",
        )
    how = _confirm_destabilizing(r, delta, skew)
    # with one channel the margin is the peak of one transfer function, which is found in another way
    if n == 1:
        how = how.and_by(confirm_peak(r, (1 + skew) / 2, -(1 - skew) / 2, bound, "disk_margin"))
    else:
        how = how.and_by(f"smallest perturbation found: {1 / lower:.9g}", "the smallest perturbation that was found")
    return _Worst(omega, alpha, delta, 1 / lower, how)


def _find_by_peak(r: DelayedRealization, skew: float) -> _Worst:
    """Return the worst perturbation of a loop with delays and one channel: the peak of one transfer function."""
    scan, upper, lower = LoopScan.of(r), (1 + skew) / 2, -(1 - skew) / 2
    peak = scan.find_peak(upper, lower)
    how = ByArgument(r).confirm_peak(upper, lower, peak, "disk_margin")
    L = next((value for end, value in scan.ends() if end == peak.omega), None)
    L = complex(r.matrix(np.array([1j * peak.omega]))[0, 0, 0]) if L is None else L
    M = complex(lower if np.isinf(L) else (upper + lower * L) / (1 + L))
    return _Worst(peak.omega, 1 / peak.value, np.array([1 / M]), 1 / peak.value, how)


def disk_gains(alpha: float, skew: float = 0.0) -> tuple[float, float, float]:
    """Return the smallest gain, the largest gain and the phase in degrees that a disk of size α allows.

    The disk meets the real axis at f(−α) and f(α), and the unit circle at the phase φ with
    cos φ = (1 + f(−α) f(α)) / (f(−α) + f(α)). Where 1 − (1 + σ)/2 α ≤ 0 the disk becomes a half plane or the outside
    of a circle, without a largest gain.
    """
    low, bottom = float(factor(-alpha, skew)), 1 - (1 + skew) / 2 * alpha
    if abs(bottom) < 1e-12:
        high, cosine = np.inf, low
    else:
        far = float(factor(alpha, skew))
        high, cosine = (far if bottom > 0 else np.inf), (1 + low * far) / (low + far)
    return max(low, 0.0), high, 180.0 if abs(cosine) > 1 else float(np.degrees(np.arccos(cosine)))


def _confirm_destabilizing(r: Realization, delta: np.ndarray, skew: float) -> Confirmation:
    """Confirm that the loop loses its stability when the perturbation grows to δ; return the computation."""

    def stable(size: float) -> bool:
        return r.is_stable(np.diag(factor(size * delta, skew)))

    try:
        return confirm_limit("disk_margin", 1.0, [], 0.0, stable, EIGENVALUES + " with δ scaled")
    except np.linalg.LinAlgError:
        return Confirmation("I + L F is singular at infinite frequency with δ")


def _find_largest(r: Realization, skew: float, matrix: Callable[[float], np.ndarray]) -> float:
    """Return the frequency in rad/s at which the structured singular value's bound is largest."""
    if len(r.D) == 1:
        return LoopScan(r).find_peak((1 + skew) / 2, -(1 - skew) / 2).omega

    def bound(omega: float) -> float:
        return mu_bound(matrix(omega), polish=False)

    omega = _make_grid(r)
    return find_largest(bound, omega, np.array([bound(w) for w in omega]))[1]


def _make_grid(r: Realization) -> np.ndarray:
    """Return frequencies around all open-loop and closed-loop poles, further 20 a decade, and both ends."""
    features = r.features
    sizes = features.sizes()
    low, high = (sizes[0] / 1e3, sizes[-1] * 1e3) if len(sizes) else (1e-3, 1e3)
    high = min(high, r.nyquist)
    low = min(low, high / 10)
    sides = np.array([-3, -1, -0.3, 0.0, 0.3, 1, 3])
    around = [abs(s.imag) + abs(s.real) * sides for s in features.points()]
    omega = np.concatenate([np.geomspace(low, high, int(20 * np.log10(high / low)) + 2), *around])
    return np.unique(np.concatenate([[0.0], omega[(omega >= low) & (omega <= high)], [r.nyquist]]))
