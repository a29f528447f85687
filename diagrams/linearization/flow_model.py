"""The derivative of the flow of a diagram over the time between two ticks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...blocks.core import left_of
from ..flat import NONE, FlatDiagram, announcers
from .derivatives import LocalDerivatives

EQUILIBRIUM = 1e-9
"""Largest residual of an equilibrium."""


def differentiate_flow(
    flat: FlatDiagram, local: LocalDerivatives, t: float, x1: np.ndarray, w: np.ndarray, h: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the derivatives of x after the time h by x before it, by w and by d, and x after the time h.

    Only continuous states change. At an equilibrium the derivative is a matrix exponential. Elsewhere the variational
    equation is integrated along the motion (DOP853 at 1e-12), from one discontinuity of a source to the next.
    """
    from scipy.linalg import expm

    xc = flat.continuous
    nc, nx, nw, m = len(xc), flat.width, len(w), local.n_inputs
    many = nx + nw + m

    def differentiate(time: float, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = x1.copy()
        x[xc] = state
        J = local.differentiate(NONE, time, x, w)
        rest = J["dx", "x"].copy()
        rest[:, xc] = 0.0
        return np.hstack([J["dx", "x"][:, xc], rest, J["dx", "w"], J["dx", "d"]]), J["dx"]

    start, end = x1[xc], t + h
    F, f0 = differentiate(t, start)
    final = x1.copy()
    if not local.varies and all(size_of_change(*part) <= EQUILIBRIUM for part in local.parts(f0, start)):
        big = np.zeros((nc + many, nc + many), dtype=F.dtype)
        big[:nc] = F
        whole = np.asarray(expm(big * h))[:nc]
        final[xc] = start + f0 * h
    else:
        from scipy.integrate import solve_ivp

        s = np.concatenate([start, np.hstack([np.eye(nc), np.zeros((nc, many))]).ravel()]).astype(F.dtype)
        for begin, edge in _split_at_discontinuities(flat, t, end):
            left = left_of(edge) if edge < end else edge

            def rates(time: float, s: np.ndarray, left: float = left) -> np.ndarray:
                J, dx = differentiate(min(time, left), s[:nc])
                V = s[nc:].reshape(nc, nc + many)
                forced = J[:, :nc] @ V
                forced[:, nc:] += J[:, nc:]
                return np.concatenate([dx, forced.ravel()])

            found = solve_ivp(rates, (begin, edge), s, method="DOP853", rtol=1e-12, atol=1e-14)
            s = np.asarray(found.y)[:, -1]
        final[xc] = s[:nc]
        whole = s[nc:].reshape(nc, nc + many)
    E, Ew, Ed = (np.asarray(M, dtype=F.dtype) for M in (np.eye(nx), np.zeros((nx, nw)), np.zeros((nx, m))))
    E[np.ix_(xc, xc)] = whole[:, :nc]
    E[xc] += whole[:, nc : nc + nx]
    Ew[xc], Ed[xc] = whole[:, nc + nx : nc + nx + nw], whole[:, nc + nx + nw :]
    return E, Ew, Ed, final


def size_of_change(change: np.ndarray, state: np.ndarray) -> float:
    """Return the largest change, relative to 1 + the size of the state."""
    return float(np.max(np.abs(change) / (1.0 + np.abs(state)), initial=0.0))


def _split_at_discontinuities(flat: FlatDiagram, t: float, end: float) -> Iterator[tuple[float, float]]:
    """Yield the parts of an interval between the discontinuities of the sources."""
    sources = announcers(flat)
    while t < end:
        edge = min([end, *(source.next_instant(t) for _, source in sources)])
        yield t, edge
        t = edge
