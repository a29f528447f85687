"""Sensitivities S = (I + L)⁻¹ over frequency: values, and levels that they reach, by Hamiltonian eigenvalues."""

from __future__ import annotations

import numpy as np

from ...blocks.core import ConfirmationError
from .realization import Realization

LEVEL = 1e-3
"""Relative distance from a peak of the levels that confirm it."""


def sensitivity_at(r: Realization, omega: float | np.ndarray) -> np.ndarray:
    """Return S = (I + L)⁻¹ at ω, by the closed loop: it is finite where the loop has poles on the axis.

    Of an array of finite ω it has the shape of that array, and then (n, n).
    """
    inverse = np.linalg.inv(np.eye(len(r.D)) + r.D)
    if np.any(np.isinf(omega)):
        return np.asarray(inverse)
    p = r.point(1j * np.asarray(omega))[..., None, None]
    pencil = p * np.eye(r.order) - r.closed_matrix()
    inputs = r.B @ inverse
    states = np.linalg.solve(pencil, np.broadcast_to(inputs, (*pencil.shape[:-2], *inputs.shape)))
    return np.asarray(inverse - inverse @ r.C @ states)


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
    """Return the frequencies in rad/s at which a singular value of (a + b L)(1 + L)⁻¹ is gamma; None as above."""
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
