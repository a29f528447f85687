"""Structured singular value of a matrix for independent complex scalars: its upper and its lower bound."""

from __future__ import annotations

import numpy as np


def mu_bound(M: np.ndarray, *, polish: bool = True) -> float:
    """Return the upper bound min σ̄(D M D⁻¹) of the structured singular value for independent complex scalars.

    Two channels have a closed form: d² = |m₂₁|/|m₁₂| makes the Frobenius norm smallest, and so σ̄, as the determinant
    is given. It is found by a singular value decomposition: norm and determinant give two equal singular values with
    half of the digits only. For more channels the bound is convex in log D and minimized. Without ``polish`` the
    minimum is rough; it still is a bound.
    """
    if len(M) == 2:
        across = np.sqrt(abs(M[0, 1]) * abs(M[1, 0]))
        upper, lower = across * np.exp(1j * np.angle([M[0, 1], M[1, 0]]))
        return float(np.linalg.norm([[M[0, 0], upper], [lower, M[1, 1]]], 2))
    return mu_scaling(M, polish=polish)[0]


def mu_scaling(M: np.ndarray, *, polish: bool = True) -> tuple[float, np.ndarray]:
    """Return σ̄(D M D⁻¹) with the diagonal of the D that makes it smallest, about the bound of `mu_bound`."""
    if len(M) == 1:
        return float(abs(M[0, 0])), np.ones(1)
    return _minimize_scaling(M, polish=polish)


def _minimize_scaling(M: np.ndarray, *, polish: bool = True) -> tuple[float, np.ndarray]:
    """Minimize σ̄(D M D⁻¹) over log D by its gradient σ̄ (|u|² − |v|²), and without a gradient where σ̄ has a kink."""
    from scipy.optimize import minimize

    def bound_and_gradient(x: np.ndarray) -> tuple[float, np.ndarray]:
        d = np.exp(np.append(np.clip(x, -20, 20), 0.0))
        U, sigma, V = np.linalg.svd(d[:, None] * M / d)
        return float(sigma[0]), sigma[0] * (np.abs(U[:, 0]) ** 2 - np.abs(V[0]) ** 2)[:-1]

    if not M.any():
        return 0.0, np.ones(len(M))
    size = np.abs(M) + 1e-12 * np.abs(M).max()
    d = np.ones(len(M))
    for _ in range(20):  # Osborne's balancing: rows and columns get one size
        row, column = np.linalg.norm(d[:, None] * size / d, axis=1), np.linalg.norm(d[:, None] * size / d, axis=0)
        d = d * np.sqrt(column / row)
    x = np.log(d[:-1] / d[-1])
    found = minimize(bound_and_gradient, x, jac=True, method="BFGS")
    x_found, gradient = np.asarray(found.x), np.asarray(found.jac)
    tried = [x_found, x]
    best = min(float(found.fun), bound_and_gradient(x)[0])
    if polish and float(np.max(np.abs(gradient))) > 1e-7 * best:
        options = {"xatol": 1e-9, "fatol": 1e-12 * best, "maxiter": 2000}
        again = minimize(lambda x: bound_and_gradient(x)[0], x_found, method="Nelder-Mead", options=options)
        tried.append(np.asarray(again.x))
    bound, x = min(((bound_and_gradient(x)[0], x) for x in tried), key=lambda pair: pair[0])
    return bound, np.exp(np.append(np.clip(x, -20, 20), 0.0))


def mu_lower_bound(M: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the lower bound max ρ(M Q) over diagonal unitary Q, and its perturbation δ with det(I − M δ) = 0."""
    from scipy.optimize import minimize, minimize_scalar

    def radius(x: np.ndarray) -> float:
        return -float(np.max(np.abs(np.linalg.eigvals(M * np.exp(1j * np.append(0.0, x))))))

    n = len(M)
    if n == 1:
        x = np.zeros(0)
    elif n == 2:
        grid = np.linspace(-np.pi, np.pi, 361)
        k = int(np.argmin([radius(np.array([g])) for g in grid]))
        span = (grid[k] - 0.02, grid[k] + 0.02)
        found = minimize_scalar(
            lambda g: radius(np.array([g])), bounds=span, method="bounded", options={"xatol": 1e-12}
        )
        x = np.array([float(found.x) if float(found.fun) < radius(grid[k : k + 1]) else grid[k]])
    else:
        rng = np.random.default_rng(0)
        starts = [np.zeros(n - 1), *rng.uniform(-np.pi, np.pi, (24, n - 1))]
        options = {"xatol": 1e-10, "fatol": 1e-13, "maxiter": 4000}
        runs = [minimize(radius, s, method="Nelder-Mead", options=options) for s in starts]
        x = np.asarray(min(runs, key=lambda run: float(run.fun)).x)
    turn = np.exp(1j * np.append(0.0, x))
    eigenvalues = np.linalg.eigvals(M * turn)
    largest = eigenvalues[np.argmax(np.abs(eigenvalues))]
    return float(abs(largest)), turn / largest if largest else np.full(n, np.inf, dtype=complex)
