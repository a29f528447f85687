"""A loop as its margins see it: a response over frequency, and a closed loop with poles; without delays and with."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from .poles_and_zeros import Features, PolePlane, split_axis_poles


class LoopModel(PolePlane, ABC):
    """A loop L for scans and confirmations; poles are in the plane of p, frequencies and points are given as s."""

    D: np.ndarray
    """L at infinite frequency."""
    hidden: np.ndarray
    """Poles that input or output doesn't see."""
    hidden_errors: np.ndarray
    """How far rounding may have moved each."""

    @property
    @abstractmethod
    def order(self) -> int:
        """Number of states, and of delays."""

    @property
    @abstractmethod
    def late(self) -> float:
        """Delay in s by which L turns at most, not counting the turns that its poles and zeros make."""

    @property
    @abstractmethod
    def settled(self) -> float:
        """Frequency in rad/s from which L is what it is at infinite frequency, but turns without end; else infinite."""

    @property
    @abstractmethod
    def end_error(self) -> float:
        """Relative error of L at infinite frequency."""

    @property
    @abstractmethod
    def gain_at_infinity(self) -> float:
        """Largest |L| at infinite frequency."""

    @property
    @abstractmethod
    def rounding_scale(self) -> float:
        """Size to which the rounding of the poles is relative."""

    @property
    @abstractmethod
    def features(self) -> Features:
        """Poles, zeros and closed-loop poles, as far as they shape the response."""

    @abstractmethod
    def matrix(self, s: np.ndarray) -> np.ndarray:
        """Return the transfer matrix at the points s, shape (..., outputs, inputs)."""

    @abstractmethod
    def values(self, s: np.ndarray, slope: complex = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return L and ``slope`` times dL/ds of a loop with one channel at the points s."""

    @abstractmethod
    def error(self, omega: float) -> float:
        """Return an estimate of the relative error of L at ω."""

    @abstractmethod
    def rounding(self, s: np.ndarray) -> np.ndarray:
        """Return a bound of the rounding error of the transfer matrix at points s, shape (...)."""

    @abstractmethod
    def grid(self, low: float, high: float, count: int) -> np.ndarray:
        """Return frequencies in rad/s to draw a response at: ``count`` over the logarithm, and more where it bends."""

    @abstractmethod
    def eigenvalues(self, factor: Any = 1.0) -> np.ndarray:
        """Return the closed-loop poles with L multiplied by a factor."""

    @abstractmethod
    def count_unstable(self, factor: Any = 1.0) -> float:
        """Return the number of closed-loop poles that are not stable; poles on the limit, up to rounding, count."""

    @abstractmethod
    def find_marginal(self) -> np.ndarray:
        """Return the closed-loop poles on the limit of stability, up to rounding."""

    @abstractmethod
    def count_open(self) -> float:
        """Return the number of poles of L beyond the limit of stability; those on it are not counted."""

    def response(self, omega: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Return L and dL/dω of a loop with one channel at the frequencies ω."""
        return self.values(1j * np.atleast_1d(np.asarray(omega, dtype=float)), slope=1j)

    def is_stable(self, factor: Any = 1.0) -> bool:
        """Whether all closed-loop poles are stable, with L multiplied by a factor."""
        return self.count_unstable(factor) == 0


def find_hidden_unstable(r: LoopModel) -> tuple[complex, ...]:
    """Return the hidden poles beyond the limit, in the planes of s or z.

    Coinciding poles on the limit scatter to both sides and are left out.
    """
    if not len(r.hidden):
        return ()
    scale = max(r.rounding_scale, float(np.abs(r.hidden).max()))
    _, rest = split_axis_poles(r, r.hidden, scale, r.hidden_errors)
    beyond = rest[rest.real > 0]
    if r.dt:
        beyond = np.exp(beyond * r.dt)
        is_real = np.abs(beyond.imag) <= 1e-15 * np.abs(beyond)  # a negative one has the angle π, whose sine rounds
        beyond = np.where(is_real, beyond.real, beyond)
    return tuple(complex(p) for p in beyond)


def tell_hidden_unstable(poles: tuple[complex, ...]) -> list[tuple[str, str]]:
    """Return the fact of a table that names hidden unstable poles, as `find_hidden_unstable` returns them."""
    if not poles:
        return []
    named = ", ".join(f"{p:.6g}" if p.imag else f"{p.real:.6g}" for p in poles)
    return [("hidden_unstable", f"{named}: not in this loop, and not moved by feedback around it")]
