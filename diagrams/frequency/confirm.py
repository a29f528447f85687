"""Independent confirmations: closed-loop eigenvalues beside a limit, encirclements with a delay, Hamiltonian levels.

Each ``confirm_…`` raises ConfirmationError if its computation disagrees, and else returns it as a text.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ...blocks.core import ConfirmationError
from .crossings import Crossing
from .features import Features
from .number import Confirmation
from .nyquist import winding_number
from .realization import Realization

STEP = 0.01
LEVEL = 1e-3
FEW = 6
"""Values up to which a confirmation names each."""


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
    """Confirm that stability ends at a limit, seen from the nominal value; return the computation.

    Raises
    ------
    ConfirmationError
        If the loop is not stable on the near side and unstable on the far side.
    """
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


def confirm_crossing(r: Realization, c: Crossing, factor: complex, name: str) -> str:
    """Confirm that the loop, multiplied by this factor, has a closed-loop pole at the crossing's frequency."""
    if np.isinf(c.omega):
        ok = abs(1 + factor * r.D[0, 0]) < 1e-9
        where = "1 + D vanishes with this factor: a closed-loop pole passes through infinity"
    else:
        p = complex(r.point(np.array(1j * c.omega)))
        distance = np.min(np.abs(r.eigenvalues(factor) - p), initial=np.inf)
        ok = distance <= 1e-5 * abs(p) + 1e-7 * r.scale
        where = "a closed-loop eigenvalue that lies there with this factor"
    if not ok:
        raise ConfirmationError(
            f"found a crossing at {c.omega:.12g} rad/s, but no closed-loop eigenvalue there with the factor "
            f"{factor:.6g}; expected one. Look at closed_loop_poles: the realization may be ill-conditioned.",
            block=name,
        )
    return where


def sensitivity_matrices(r: Realization, a: float, b: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the matrices of b I + (a − b) (I + L)⁻¹ in continuous time; a sampled one is mapped with its norm kept."""
    eye = np.eye(len(r.D))
    inverse = np.linalg.inv(eye + r.D)
    A, B, C, D = r.A - r.B @ inverse @ r.C, r.B @ inverse, -(a - b) * inverse @ r.C, b * eye + (a - b) * inverse
    if r.dt:
        P = np.linalg.inv(np.eye(r.order) + A / 2)
        A, B, C, D = A @ P / r.dt, P @ B, C @ P / r.dt, D - C @ P @ B / 2
    ratio = np.sqrt((np.linalg.norm(C) + 1e-300) / (np.linalg.norm(B) + 1e-300))
    return A, B * ratio, C / ratio, D


def find_level_eigenvalues(r: Realization, a: float, b: float, gamma: float) -> np.ndarray | None:
    """Return the eigenvalues of the Hamiltonian of (a + b L)(1 + L)⁻¹ for the level gamma.

    An eigenvalue jω lies on the imaginary axis where a singular value is gamma at ω. None where the value at infinite
    frequency (at z = −1) is above gamma.
    """
    A, B, C, D = sensitivity_matrices(r, a, b)
    R = gamma**2 * np.eye(len(D)) - D.T @ D
    if np.linalg.eigvalsh(R).min() <= 0:
        return None
    inner = A + B @ np.linalg.solve(R, D.T @ C)
    H = np.block(
        [
            [inner, B @ np.linalg.solve(R, B.T)],
            [-C.T @ (np.eye(len(D)) + D @ np.linalg.solve(R, D.T)) @ C, -inner.T],
        ]
    )
    return np.asarray(np.linalg.eigvals(H))


def find_level_frequencies(r: Realization, a: float, b: float, gamma: float) -> np.ndarray | None:
    """Return the frequencies at which a singular value of (a + b L)(1 + L)⁻¹ is gamma, rad/s.

    None where `find_level_eigenvalues` gives none.
    """
    eigenvalues = find_level_eigenvalues(r, a, b, gamma)
    if eigenvalues is None:
        return None
    omega = np.sort(np.abs(eigenvalues[np.abs(eigenvalues.real) <= 1e-4 * np.abs(eigenvalues)].imag))
    return np.asarray(2 / r.dt * np.arctan(omega * r.dt / 2) if r.dt else omega)


def confirm_peak(r: Realization, a: float, b: float, value: float, name: str) -> str:
    """Confirm a largest singular value over frequency by Hamiltonian eigenvalues for levels below and above it.

    For the lower level some eigenvalues lie on the imaginary axis, for the upper one none. Rounding moves them by an
    amount that depends on the realization, so the two distances from the axis are compared with each other.
    """
    apart = []
    for level in (value * (1 - LEVEL), value * (1 + LEVEL)):
        eigenvalues = find_level_eigenvalues(r, a, b, level)
        if eigenvalues is None:
            apart.append(0.0)
        else:
            apart.append(float(np.min(np.abs(eigenvalues.real) / (np.abs(eigenvalues) + 1e-300), initial=1.0)))
    below, above = apart
    if not (above > 1e-9 and below < 0.05 * above):
        raise ConfirmationError(
            f"found the peak {value:.12g}, but the Hamiltonian eigenvalues are {below:.3g} from the axis at "
            f"{1 - LEVEL:g} of it and {above:.3g} at {1 + LEVEL:g}, relative to their size; expected them on the axis "
            "at the first only. Look at closed_loop_poles for a very narrow resonance, which a scan may miss.",
            block=name,
        )
    return f"Hamiltonian eigenvalues: the peak reaches {1 - LEVEL:g} of this value, and not {1 + LEVEL:g}"


def confirm_delay(r: Realization, features: Features, value: float, others: Sequence[float]) -> str:
    """Confirm the delay margin of a continuous loop by the encirclements of 1 + L e^(−sτ)."""
    unstable = features.unstable_poles()

    def stable(tau: float) -> bool:
        return winding_number(r, features, delay=tau) + unstable == 0

    return confirm_limit("delay_margin", value, others, 0.0, stable, "encirclements of 1 + L exp(−sτ)")


def confirm_on_limit(r: Realization, n: int) -> None:
    """Confirm that n samples of delay in series put a closed-loop pole on the unit circle; beyond 100 do nothing."""
    if n > 100:
        return
    delayed = r
    for _ in range(n):
        delayed = delayed.delay_once()
    nearest = float(np.min(np.abs(delayed.growth(delayed.eigenvalues()))))
    if nearest > 1e-6:
        raise ConfirmationError(
            f"found a margin of {n} samples, but with that delay no closed-loop pole is nearer than {nearest:.3g} to "
            "the unit circle; expected one on it. Look at closed_loop_poles.",
            block="delay_margin",
        )


def count_unstable(r: Realization, features: Features, n: int) -> int:
    """Return the number of closed-loop poles that are not stable with n samples of delay in series.

    Eigenvalues count them up to 100 samples, encirclements beyond.
    """
    if n > 100:
        return winding_number(r, features, delay=n * r.dt) + features.unstable_poles()
    delayed = r
    for _ in range(n):
        delayed = delayed.delay_once()
    return delayed.count_unstable()
