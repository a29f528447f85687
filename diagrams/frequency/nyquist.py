"""Encirclements of −1 by the Nyquist curve: the winding number of 1 + L, confirmed by eigenvalues."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...blocks.core import (
    ConfirmationError,
    Finding,
    ParameterError,
    Sheet,
    ShownAsTable,
    accepts,
    explain_calls,
    kinds,
)
from .delayed_realization import realize
from .loop_model import LoopModel, find_hidden_unstable, tell_hidden_unstable
from .loop_scan import TURNS_MATTER, make_grid
from .number import carries_findings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .state_space import LinearSystem


@explain_calls
@dataclass(frozen=True, repr=False)
class NyquistCount(ShownAsTable):
    """Numbers of the Nyquist criterion Z = N + P.

    P and Z are those of the realization that was given. A mode that input or output doesn't see is no part of L, and no
    feedback around L moves it: where it is unstable it counts in P and in Z, and N doesn't depend on it.

    Parameters
    ----------
    encirclements : int
        N, clockwise encirclements of −1: the winding number of 1 + L along a contour that passes poles on the axis on
        the right.
    open_loop : int
        P, open-loop poles beyond the limit of stability, the hidden ones among them.
    closed_loop : int
        Z = N + P, closed-loop poles beyond the limit, the hidden ones among them; the eigenvalues agree.
    hidden_unstable : tuple of complex
        The hidden ones, in the s plane (continuous) or the z plane (sampled). One on the limit is not among them.
    findings : tuple of Finding
        Effects on the loop that its linear model leaves out.
    """

    encirclements: int
    open_loop: int
    closed_loop: int
    hidden_unstable: tuple[complex, ...] = ()
    findings: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        names = ("encirclements", "open_loop", "closed_loop", *(("hidden_unstable",) if self.hidden_unstable else ()))
        return f"{type(self).__name__}({', '.join(f'{name}={getattr(self, name)!r}' for name in names)})"

    def _sheet(self) -> Sheet:
        facts = (
            ("N", f"{self.encirclements} clockwise encirclements of −1"),
            ("P", f"{self.open_loop} unstable poles of the open loop"),
            ("Z = N + P", f"{self.closed_loop} unstable poles of the closed loop"),
        )
        return Sheet("Nyquist criterion", (*facts, *tell_hidden_unstable(self.hidden_unstable)))


@accepts(delay=kinds.finite)
@carries_findings
def nyquist_count(loop: LinearSystem, *, delay: int = 0) -> NyquistCount:
    """Count the clockwise encirclements of −1, and confirm them by the eigenvalues of open and closed loop.

    Parameters
    ----------
    loop : control.StateSpace
        Loop transfer function L with one channel, S = 1/(1 + L).
    delay : int
        Whole samples of delay in series with a sampled loop.

    Raises
    ------
    ConfirmationError
        If the winding number and the eigenvalues disagree, or a closed-loop pole is on the limit of stability up to
        rounding: the curve passes through −1.

    Examples
    --------
    >>> import control
    >>> nyquist_count(control.ss(control.tf([2.0], [1.0, -1.0])))
    NyquistCount(encirclements=-1, open_loop=1, closed_loop=0)

    Two equal lags in parallel have a mode that the loop doesn't see:

    >>> print(nyquist_count(control.ss([[1, 0], [0, 1]], [[1], [1]], [[1, 1]], 0)))
    Nyquist criterion
      N                -1 clockwise encirclements of −1
      P                2 unstable poles of the open loop
      Z = N + P        1 unstable poles of the closed loop
      hidden_unstable  1: not in this loop, and not moved by feedback around it
    """
    return count_encirclements(realize(loop, delay=delay))


def count_encirclements(r: LoopModel) -> NyquistCount:
    """Count the encirclements of a realization; see `nyquist_count`."""
    closed, found = r.count_unstable(), r.count_open()
    if np.isinf(closed) or np.isinf(found):
        raise ConfirmationError(
            "found ways around the delays without a state whose gain is 1 or more; expected less: there are infinitely "
            "many unstable poles, and the curve turns around −1 without end. Put a lag into the loop.",
            block="nyquist",
        )
    eigenvalues, open_loop = int(closed), int(found)
    if len(marginal := r.find_marginal()):
        pole = complex(marginal[0]) + (1.0 if r.dt else 0.0)
        raise ConfirmationError(
            f"found a closed-loop pole on the limit of stability, {'z' if r.dt else 's'} = {pole:.6g}, at which the "
            "curve passes through −1; expected none, since rounding decides on which side it passes. Change the gain "
            "a little, or look at margins(loop).closed_loop_poles.",
            block="nyquist",
        )
    n = winding_number(r)
    if n + open_loop != eigenvalues:
        how = "roots of the characteristic function" if r.late else "eigenvalues"
        raise ConfirmationError(
            f"found {n} clockwise encirclements of −1 and {open_loop} unstable open-loop poles, but {eigenvalues} "
            f"unstable {how} of the closed loop; expected Z = N + P. Look at closed_loop_poles: one may lie on "
            "the limit of stability.",
            block="nyquist",
        )
    hidden = find_hidden_unstable(r)
    return NyquistCount(n, open_loop + len(hidden), eigenvalues + len(hidden), hidden)


def winding_number(r: LoopModel, *, delay: float = 0.0) -> int:
    """Return the clockwise encirclements of 0 by 1 + L e^(−sτ) along the limit of stability.

    A sampled loop takes a delay τ of whole samples.

    Only the upper half of the contour is followed: the lower one is its mirror image. The contour passes each pole on
    the axis by a half-circle to the right, smaller than the distance to any other pole, zero or closed-loop pole.
    """
    turning = delay + r.late > 0.0
    if len(r.D) != 1:
        raise ParameterError(f"found a loop of {len(r.D)} channels; expected one. Open a single wire.", block="nyquist")
    if turning and not r.dt and abs(r.D[0, 0]) >= 1:
        raise ParameterError(
            f"found |D| = {abs(r.D[0, 0]):.6g}; expected less than 1: with a delay the curve turns around −1 without "
            "end. Leave the delay out.",
            block="nyquist",
        )
    path = _make_contour(r, delay)
    total, last = 0.0, 0j
    for s in path:
        values = _follow_loop(r, s, delay)
        if last:
            total += float(np.angle(values[0] / last))
        total += float(np.sum(np.angle(values[1:] / values[:-1])))
        last = values[-1]
    if not r.dt:  # the arc at infinity
        total += float(np.angle((1.0 if turning else 1 + r.D[0, 0]) / last))
    turns = -total / np.pi
    if abs(turns - round(turns)) > 1e-3:
        raise ConfirmationError(
            f"found {turns:.6f} half turns of 1 + L; expected a whole number. Look at closed_loop_poles: one may lie "
            "on the limit of stability.",
            block="nyquist",
        )
    return round(turns)


def _make_contour(r: LoopModel, delay: float) -> list[np.ndarray]:
    """Return the upper half of the contour as lines and arcs of points s."""
    features, turning = r.features, delay + r.late > 0.0
    segments = make_grid(r, delay=delay, floor=TURNS_MATTER if turning else 0.0)
    others = np.concatenate([features.poles, features.closed, features.zeros])
    spots = [a.omega for a in features.axis_poles]
    top = segments[-1][-1]
    if turning and not r.dt:  # beyond the last sample with |L| ≥ 0.95 the curve does not turn around 0
        every = np.concatenate(segments)
        large = np.flatnonzero(np.abs(r.matrix(1j * every)[:, 0, 0]) >= 0.95)
        top = every[min(large[-1] + 1, len(every) - 1)] if len(large) else every[0]
    arcs = []
    for a in features.axis_poles:
        at = 1j * a.omega
        apart = [abs(at - s) for s in others] + [abs(a.omega - w) for w in spots if w != a.omega]
        apart += [a.omega or np.inf, (r.nyquist - a.omega) or np.inf, 0.3 / r.dt if r.dt else np.inf]
        radius = 0.3 * min(apart)
        if not np.isfinite(radius):
            radius = segments[0][0]
        turn = np.linspace(-np.pi / 2, np.pi / 2, 64 * (1 + a.multiplicity) + 1)
        if a.omega == 0.0:
            turn = turn[turn >= 0]
        if a.omega == r.nyquist:
            turn = turn[turn <= 0]
        arcs.append((a.omega, radius, at + radius * np.exp(1j * turn)))
    first = 0.0 if not any(w == 0.0 for w, *_ in arcs) else None
    omega = np.concatenate([[] if first is None else [first], *segments])
    for w, radius, _ in arcs:
        omega = omega[np.abs(omega - w) > radius]
    omega = omega[omega <= top]
    path, start = [], -np.inf
    for w, _, arc in arcs:
        line = omega[(omega > start) & (omega < w)]
        path += [1j * line] if len(line) else []
        path.append(arc)
        start = w
    line = omega[omega > start]
    return path + ([1j * line] if len(line) else [])


def _follow_loop(r: LoopModel, s: np.ndarray, delay: float) -> NDArray[np.complex128]:
    """Return 1 + L e^(−s delay) along points, bisected until it turns by less than 0.5 rad from one to the next."""
    for _ in range(30):
        f: NDArray[np.complex128] = 1 + r.matrix(s)[:, 0, 0] * np.exp(-s * delay)
        if np.any(f == 0):
            raise ConfirmationError(
                "found 1 + L = 0 on the contour; expected no closed-loop pole on the limit of stability. Look at "
                "closed_loop_poles.",
                block="nyquist",
            )
        coarse = np.abs(np.angle(f[1:] / f[:-1])) > 0.5
        if not coarse.any() or len(s) > 100_000:
            break
        between = 0.5 * (s[1:] + s[:-1])[coarse]
        s = np.insert(s, np.flatnonzero(coarse) + 1, between)
    return f
