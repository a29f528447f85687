"""Slopes of margins: derivatives of a loop's margins along a change of its matrices A, B, C, D.

A crossing is a root in the frequency, so that it moves by the implicit function theorem; a peak's frequency does not
count to first order. A margin of several crossings is the smallest one's: where two are equal it has a kink.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ...blocks.core import ParameterError, on_one_thread
from .disk_margins import mimo_disk_margin
from .loop_margins import Margins, find_disk_frequency, margins
from .number import Number
from .realization import Realization
from .state_space import FourMatrices, read_matrices
from .structured_value import mu_bound

if TYPE_CHECKING:
    from .state_space import LinearSystem

KINK = 1e-6
"""Relative difference of two candidates of a margin below which it has a kink."""
NEAR_POLE = 1e-13
"""Distance of a point from a pole, relative to its size and the pole's, at which L is infinite."""
LOW = 1e-5
"""Frequency in place of 0, in parts of the slowest pole that is not 0."""
PLACES = ("ms_frequency", "mt_frequency")
"""Places of peaks, which have no slopes here."""


@dataclass(frozen=True)
class MarginSlope:
    """A number of a loop, and its derivatives along changes of the loop's matrices; NaN where it has none."""

    number: Number
    slopes: tuple[float, ...]
    kink: bool = False
    """Whether another crossing has nearly the same margin: the slopes are those of one of them."""


@on_one_thread
def margin_slopes(
    loop: LinearSystem,
    changes: Sequence[FourMatrices],
    *,
    delay: int = 0,
    skew: float = 0.0,
    found: Margins | None = None,
) -> dict[str, MarginSlope]:
    """Return the margins of a loop by name, with their derivatives along changes (dA, dB, dC, dD) of its matrices.

    ``found`` are its `margins`, where they are known. Of a loop with several channels there is the disk margin alone.
    """
    A, B, C, D, dt = read_matrices(loop)
    for change in changes:
        if [M.shape for M in change] != [M.shape for M in (A, B, C, D)]:
            raise ParameterError(
                f"found a change of shapes {[M.shape for M in change]}; expected those of the loop's A, B, C, D, "
                f"{[M.shape for M in (A, B, C, D)]}.",
                block="margin_slopes",
            )
    response = _Response((A, B, C, D), changes, float(dt or 0.0), delay)
    if len(D) > 1:
        return {"disk_margin": _disk(loop, response, delay, skew)}
    given = found if found is not None else margins(loop, delay=delay, skew=skew)
    return _Slopes(Realization.of(loop, delay=delay), response, given, skew).all()


class _Response:
    """L of a loop at a frequency, with its derivatives by the frequency and along the changes."""

    def __init__(self, matrices: FourMatrices, changes: Sequence[FourMatrices], dt: float, delay: int):
        self.matrices, self.changes, self.dt, self.delay = matrices, changes, dt, delay

    @cached_property
    def _size(self) -> float:
        return float(np.max(np.abs(self.matrices[0]), initial=0.0))

    def at(self, omega: float) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return L, dL/dω and dL along each change; None at a pole of L."""
        A, *_, D = self.matrices
        if np.isinf(omega):
            return D + 0j, np.zeros_like(D, dtype=complex), np.array([d + 0j for *_, d in self.changes])
        n, T = len(A), self.dt
        if n and not omega > 0:
            M = -(A - np.eye(n) if T else A)
            if np.linalg.svd(M, compute_uv=False)[-1] <= NEAR_POLE * self._size:
                return None
        return self._value(omega)

    def _value(self, omega: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        A, B, C, D = self.matrices
        n, T = len(A), self.dt
        p, rate = (np.expm1(1j * omega * T), 1j * T * np.exp(1j * omega * T)) if T else (1j * omega, 1j)
        M = p * np.eye(n) - (A - np.eye(n) if T else A)
        x = np.linalg.solve(M, B)
        left = np.linalg.solve(M.T, C.T).T
        L, by_omega = D + C @ x, -rate * (left @ x)
        along = np.array([c @ x + left @ a @ x + left @ b + d for a, b, c, d in self.changes])
        if self.delay:
            shift = np.exp(-1j * omega * T * self.delay)
            by_omega = shift * (by_omega - 1j * T * self.delay * L)
            L, along = shift * L, shift * along
        return L, by_omega, along.reshape(len(self.changes), *D.shape)

    def _find_low_frequency(self) -> float:
        """Return a frequency far below all poles that are not 0."""
        poles = np.linalg.eigvals(self.matrices[0] - (np.eye(len(self.matrices[0])) if self.dt else 0.0))
        sizes = np.abs(poles) / (self.dt or 1.0)
        return LOW * float(np.min(sizes[sizes > 1e-6 * np.max(sizes)], initial=np.max(sizes)) or 1.0)

    def sensitivity(self, omega: float) -> tuple[np.ndarray, np.ndarray]:
        """Return S = (I + L)⁻¹ and its derivatives along the changes; both are finite at a pole of L, too."""
        found = self.at(omega)
        if found is not None:
            S = np.linalg.inv(np.eye(len(found[0])) + found[0])
            return S, -S @ found[2] @ S
        A, B, C, D = self.matrices
        direct = np.linalg.inv(np.eye(len(D)) + D)
        p = np.expm1(1j * omega * self.dt) if self.dt else 1j * omega
        M = p * np.eye(len(A)) - (A - np.eye(len(A)) if self.dt else A) + B @ direct @ C
        values = np.linalg.svd(M, compute_uv=False)
        if len(M) and values[-1] <= NEAR_POLE * (values[0] + self._size):  # a pole at 0 that the loop doesn't move
            low = self._find_low_frequency()
            L, _, changes = self._value(low)
            S = np.linalg.inv(np.eye(len(D)) + L)
            return S, -S @ changes @ S
        x, left = np.linalg.solve(M, B @ direct), np.linalg.solve(M.T, (direct @ C).T).T
        S = direct - direct @ C @ x
        along = [S @ c @ x + left @ a @ x + left @ b @ S + S @ d @ S for a, b, c, d in self.changes]
        return S, -np.array(along).reshape(len(self.changes), *D.shape)


class _Slopes:
    """Slopes of the numbers of a loop with one channel."""

    def __init__(self, r: Realization, response: _Response, found: Margins, skew: float):
        self.r, self.response, self.found, self.skew = r, response, found, skew
        self.none = np.full(len(response.changes), np.nan)

    def all(self) -> dict[str, MarginSlope]:
        """Return all numbers with their slopes."""
        numbers = {k: n for k, n in self.found.numbers().items() if k not in PLACES}
        made = dict.fromkeys(numbers, (self.none, False))
        if self.found.stable:
            made |= self._gains() | self._phases() | self._peaks()
            made["bandwidth"] = (self._bandwidth(), False)
        return {name: MarginSlope(n, tuple(map(float, made[name][0])), made[name][1]) for name, n in numbers.items()}

    def _logarithm(self, omega: float) -> tuple[complex, complex, np.ndarray] | None:
        """Return L, and the derivatives of log L by the frequency and along the changes."""
        found = self.response.at(omega)
        if found is None:
            return None
        L = complex(found[0][0, 0])
        return L, complex(found[1][0, 0]) / L, found[2][:, 0, 0] / L

    def _gains(self) -> dict[str, tuple[np.ndarray, bool]]:
        """Return the slopes of the gain margins k = −1/L where L is real."""
        made = {}
        every = [c.gain_margin.value for c in self.found.phase_crossovers]
        for name in ("gain_margin_low", "gain_margin_high"):
            k = getattr(self.found, name).value
            mine = [c for c in self.found.phase_crossovers if c.gain_margin.value == k]
            found = self._logarithm(mine[0].frequency.value) if mine else None
            if found is None:
                made[name] = (self.none, False)
                continue
            _, by_omega, along = found
            omega = mine[0].frequency.value
            ends = omega in (0.0, np.inf) or omega == self.r.nyquist
            moved = 0.0 if ends else -along.imag / by_omega.imag
            made[name] = (-k * (along.real + by_omega.real * moved), _has_near(every, k))
        return made

    def _crossover(self, omega: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Return how a gain crossover moves along the changes, and how the phase there does, in rad."""
        found = self._logarithm(omega)
        if found is None or omega in (0.0, np.inf) or omega == self.r.nyquist:
            return None
        _, by_omega, along = found
        moved = -along.real / by_omega.real
        return moved, along.imag + by_omega.imag * moved

    def _phases(self) -> dict[str, tuple[np.ndarray, bool]]:
        """Return the slopes of the phase margin and of the delay margins."""
        made, f = dict[str, tuple[np.ndarray, bool]](), self.found
        every = [(c.frequency.value, c.phase_margin_deg.value) for c in f.gain_crossovers]
        mine = [(w, d) for w, d in every if abs(d) == f.phase_margin_deg.value]
        turned = self._crossover(mine[0][0]) if mine else None
        if turned is not None:
            kink = _has_near([abs(d) for _, d in every], f.phase_margin_deg.value)
            made["phase_margin_deg"] = (np.sign(mine[0][1]) * np.degrees(turned[1]), kink)
        lags = [(np.radians(d) % (2 * np.pi) / w, w) for w, d in every if 0 < w < np.inf]
        tau = f.delay_margin_s.value
        near = [(abs(lag - tau), w) for lag, w in lags if abs(lag - tau) <= 1e-9 * tau]
        turned = self._crossover(min(near)[1]) if near and np.isfinite(tau) else None
        if turned is not None:
            omega, kink = min(near)[1], _has_near([lag for lag, _ in lags], tau)
            slope = (turned[1] - tau * turned[0]) / omega
            made["delay_margin_s"] = (slope, kink)
            if self.r.dt:
                made["delay_margin_samples"] = (slope / self.r.dt, kink)
        return made

    def _peaks(self) -> dict[str, tuple[np.ndarray, bool]]:
        """Return the slopes of the peaks of |a + b T|, T = L/(1 + L), and of margins that are their inverses."""
        f, made = self.found, {}
        upper, lower = (1 + self.skew) / 2, -(1 - self.skew) / 2
        disk = find_disk_frequency(self.r, self.skew)
        places = {"ms": (f.ms_frequency.value, 1.0, 0.0), "mt": (f.mt_frequency.value, 0.0, 1.0)}
        for name, (omega, a, b) in {**places, "disk_margin": (disk, upper, lower)}.items():
            S, along = self.response.sensitivity(omega)
            share = np.real((a - b) * along / (b + (a - b) * S))[:, 0, 0]
            value = getattr(f, name).value
            made[name] = (-value * share if name == "disk_margin" else value * share, False)
        made["modulus_margin"] = (-made["ms"][0] / f.ms.value**2, False)
        return made

    def _bandwidth(self) -> np.ndarray:
        """Return the slope of the frequency at which |T| has fallen to a share of its value at 0."""
        omega = self.found.bandwidth.value
        here = self._logarithm(omega) if np.isfinite(omega) else None
        if here is None:
            return self.none
        L, by_omega, along = here
        S, by_p = self.response.sensitivity(0.0)
        before = np.real(-by_p / (1 - S))[:, 0, 0]
        return np.asarray(-(np.real(along / (1 + L)) - before) / np.real(by_omega / (1 + L)))


def _has_near(every: Sequence[float], value: float) -> bool:
    """Whether a second one of all values is nearly as large as ``value``."""
    return bool(sum(abs(v - value) <= KINK * abs(value) for v in every) > 1)


def _disk(loop: LinearSystem, response: _Response, delay: int, skew: float) -> MarginSlope:
    """Return the disk margin of a loop with several channels, α = 1/μ, with its slopes at the frequency of the peak."""
    found = mimo_disk_margin(loop, delay=delay, skew=skew)
    here, n = response.at(found.frequency.value), len(response.matrices[3])
    if here is None:
        return MarginSlope(found.alpha, (np.nan,) * len(response.changes))
    S = np.linalg.inv(np.eye(n) + here[0])
    M = S + (skew - 1) / 2 * np.eye(n)
    slopes = [-(found.alpha.value**2) * _mu_slope(M, -S @ dL @ S) for dL in here[2]]
    return MarginSlope(found.alpha, tuple(slopes))


def _mu_slope(M: np.ndarray, change: np.ndarray) -> float:
    """Return the slope of the bound min σ̄(D M D⁻¹) along a change of M."""
    # with the best D the bound is a singular value, and the change of D does not count; of more than two channels it is
    # a difference of fourth order
    if len(M) == 2 and M[0, 1] * M[1, 0] != 0:
        d = np.array([np.sqrt(abs(M[1, 0] / M[0, 1])), 1.0])
        U, _, V = np.linalg.svd(d[:, None] * M / d)
        return float(np.real(U[:, 0].conj() @ (d[:, None] * change / d) @ V[0].conj()))
    size = float(np.max(np.abs(change))) / float(np.max(np.abs(M)) or 1.0)
    if not size:
        return 0.0
    h = 1e-3 / size
    b = [mu_bound(M + s * h * change) for s in (1.0, -1.0, 2.0, -2.0)]
    return float((8 * (b[0] - b[1]) - (b[2] - b[3])) / (12 * h))
