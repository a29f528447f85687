"""Sign of the real part of the admittance that a contact renders, over a scan of frequencies.

Of a sampled loop it is that of the fundamental alone, which disproves passivity and doesn't prove it; `port_passivity`
judges with all aliases.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...blocks.core import Array, Finding, brief, explain_calls
from ..frequency import refine_sign_change
from .port_passivity import PortPassivity

CONTINUOUS = "Re Y(jω) ≥ 0 at all frequencies and no unstable pole is passivity of this linear model, and of it alone."
SAMPLED = (
    "Y is the fundamental of a sampled loop: Re Y(jω) < 0 disproves passivity; Re Y(jω) ≥ 0 doesn't prove it, as the "
    "aliases of a motion carry power too."
)
PERIODIC = (
    " In several rates a force of one frequency moves the contact at others, too, ω + 2πk/T over the common period T; "
    "Y is the part at ω alone."
)
OFF_PATH = (
    " Off the path the force that is conjugate to the rate of η is q F∥ (E22): driven by F∥, the admittance is not "
    "passive in motions that change q, whatever Re Y says at one point."
)
LOWEST, HIGHEST = 1e-2, 1e5
"""Ends of a scan, rad/s."""
_ROUNDED = 1e-10
"""Real part relative to |Y| below which it is rounding."""


@explain_calls
@dataclass(frozen=True, eq=False)
class Passivity:
    """Sign of the real part of a rendered admittance.

    Attributes
    ----------
    frequency : float
        First frequency in rad/s at which Re Y becomes negative; infinite if it doesn't on the scan.
    intervals : tuple of pairs of float
        Ends of the intervals of frequencies with negative Re Y, rad/s; the last may end with the scan.
    scanned : tuple of float
        Ends of the scan in rad/s; the upper one is at most the Nyquist frequency π/T of a sampled loop.
    stable : bool
        Whether the loop alone, without environment, has no pole that grows.
    caveat : str
        Meaning of the sign for this loop, and its limits.
    tolerance : float
        Relative error of the frequencies.
    findings : tuple of Finding
        Kinks and stairs of the diagram that the loop leaves out.
    port : PortPassivity, optional
        Passivity against all passive environments, with the aliases of a sampled loop; that of a `Contact`.
    """

    frequency: float
    intervals: tuple[tuple[float, float], ...]
    scanned: tuple[float, float]
    stable: bool
    caveat: str
    tolerance: float = 1e-9
    findings: tuple[Finding, ...] = ()
    port: PortPassivity | None = None

    def __repr__(self) -> str:
        first = f"Re Y < 0 from {self.frequency:.6g} rad/s" if self.intervals else "Re Y ≥ 0"
        facts = (
            first,
            f"from {self.scanned[0]:.4g} to {self.scanned[1]:.4g} rad/s",
            "" if self.stable else "unstable alone",
        )
        return brief("sign of an admittance's real part", *facts, then=".intervals, .caveat")


def find_negative(
    admittance: Callable[[np.ndarray], Array], low: float, high: float, per_decade: int
) -> tuple[tuple[float, float], ...]:
    """Return the intervals of frequencies in which the real part of an admittance is negative, on a scan in rad/s."""
    grid = np.geomspace(low, high, max(8, math.ceil(per_decade * math.log10(high / low)) + 1))

    def sine(w: np.ndarray | float) -> np.ndarray:
        Y = np.asarray(admittance(np.asarray(w)))
        return np.asarray(Y.real / np.abs(Y) + _ROUNDED)

    positive = sine(grid) >= 0.0

    def find_edge(i: int) -> float:
        return math.exp(
            refine_sign_change(lambda y: float(sine(math.exp(y))), *np.log(grid[i : i + 2]).tolist(), xtol=1e-13)
        )

    edges = ([] if positive[0] else [low]) + [find_edge(int(i)) for i in np.flatnonzero(positive[1:] != positive[:-1])]
    if len(edges) % 2:
        edges.append(high)
    return tuple(zip(edges[::2], edges[1::2], strict=True))
