"""Null vectors of a matrix with rounding, each with a state that the others lack, and the matrix without them."""

from __future__ import annotations

import numpy as np

NULL = 1e-12
"""Largest singular value of a direction that counts as an eigenvector of 0, relative to the largest one."""
ERROR = 1e-6
"""The most that this is where the entries of an FMU's model have an error."""
UNSEEN = 1e-9
"""Relative size of an entry, or of a row, of directions that counts as none."""
ROUNDED = 1e-15
"""Entry of a matrix, relative to the largest one, that may be a zero that rounding has changed."""
CHAIN = 1e-9
"""Share of a direction outside of the range of A below which it counts as the end of a Jordan chain."""


def find_scales(M: np.ndarray, error: float = 0.0) -> np.ndarray:
    """Return the factors, powers of two, that balance a matrix; entries that are rounding, or error, count as 0."""
    from scipy.linalg import matrix_balance

    least = max(10.0 * error, ROUNDED * float(np.max(np.abs(M), initial=0.0)))
    with np.errstate(invalid="ignore"):
        _, (d, _) = matrix_balance(np.where(np.abs(M) <= least, 0.0, M), permute=False, separate=True)
    return np.asarray(d)


def find_null_spaces(M: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return bases of the right and left null space of a matrix whose entries have an error, by columns.

    The third result is the size of singular values that count as none, relative to the largest one.
    """
    if not len(M):
        return np.zeros((0, 0)), np.zeros((0, 0)), NULL
    d = find_scales(M, error)
    U, sigma, Wt = np.linalg.svd(M * d / d[:, None])
    relative = 100.0 * error / (float(np.max(np.abs(M))) or 1.0)
    rest = max(NULL, min(ERROR, relative))
    first = len(M) - int(np.sum(sigma <= rest * sigma[0]))
    return d[:, None] * Wt[first:].T, U[:, first:] / d[:, None], rest


def find_null_space(S: np.ndarray) -> np.ndarray:
    """Return a basis of the directions in which all rows of a matrix of relative sizes are 0."""
    if not S.size:
        return np.eye(S.shape[1])
    _, sigma, Wt = np.linalg.svd(S, full_matrices=True)
    count = int(np.sum(sigma > UNSEEN))
    return np.asarray(Wt[count:].T)


def localize(V: np.ndarray, M: np.ndarray, rest: float) -> np.ndarray:
    """Return the basis of a space of null vectors in which each one has a state that the others lack.

    Zeros that rounding moved are 0. ``rest`` is the relative size of singular values that count as none.
    """
    from scipy.linalg import qr

    if not V.shape[1]:
        return V
    d = find_scales(M)
    scaled = V / d[:, None]
    _, _, order = qr(scaled.T, pivoting=True, mode="economic")
    own = order[: V.shape[1]]
    made, balanced = scaled @ np.linalg.inv(scaled[own]), M * d / d[:, None]
    for _ in range(2):  # a slow pole next to them turns singular vectors by the rounding over its size
        made = made - np.linalg.lstsq(balanced, balanced @ made, rcond=rest)[0]
    made[np.abs(made) <= UNSEEN * np.max(np.abs(made), axis=0)] = 0.0
    return np.asarray(d[:, None] * made)


def leave_out_chains(
    found: list[tuple[np.ndarray, tuple[str, ...]]], left: np.ndarray, d: np.ndarray
) -> list[tuple[np.ndarray, tuple[str, ...]]]:
    """Return the directions that together reach out of the range of the matrix: no Jordan chain ends in them.

    Directions are orthogonal to the left null vectors exactly where they are in the range.
    """
    L, _ = np.linalg.qr(left * d[:, None])
    kept: list[tuple[np.ndarray, tuple[str, ...]]] = []
    basis = np.zeros((L.shape[1], 0))
    for v, alone in found:
        scaled = v / d
        part = L.T @ (scaled / np.linalg.norm(scaled))
        part = part - basis @ (basis.T @ part)
        size = float(np.linalg.norm(part))
        if size > CHAIN:
            basis = np.column_stack([basis, part / size])
            kept.append((v, alone))
    return kept


def deflate(A: np.ndarray, V: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Q and P of `FreeMotions` for eigenvectors V of a matrix: the rest of it is P A Q.

    With x = V a + Q b the matrix is block triangular, so P A Q has its other eigenvalues. Q keeps all states but one
    for each motion, the largest in balanced units: zeros of the matrix stay zeros.
    """
    from scipy.linalg import qr

    d, n = find_scales(A), len(A)
    _, _, order = qr((V / d[:, None]).T, pivoting=True, mode="economic")
    gone = order[: V.shape[1]]
    others = np.setdiff1d(np.arange(n), gone)
    P = np.eye(n)[others]
    P[:, gone] = -np.linalg.solve(V[gone].T, V[others].T).T
    return np.eye(n)[:, others], P
