"""Gains and poles of a sampled PID loop around a chain of integrators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial
from typing import Literal

import numpy as np

from ...blocks.core import ParameterError, accepts, explain_calls, kinds
from .pole_placement import confirm_polynomial, real_polynomial

Integral = Literal["forward", "backward", "trapezoidal"]


@explain_calls
@dataclass(frozen=True)
class SampledDesign:
    """Gains and true poles of a sampled PID loop around a chain of integrators.

    Parameters
    ----------
    gains : tuple of float
        (a₀, a₁, a₂, …): gains of the integral, of the error, of its rate, …
    sample_time : float
        T in s.
    delay : int
        Samples between measurement and hold.
    poles : tuple of complex
        All closed-loop poles as s = log(z)/T in 1/s, the slowest first. Multiple ones scatter.
    poles_z : tuple of complex
        All closed-loop poles in the z plane, in the order of ``poles``.
    polynomial : tuple of float
        Characteristic polynomial in w = (z − 1)/T, highest power first.
    """

    gains: tuple[float, ...]
    sample_time: float
    delay: int
    poles: tuple[complex, ...]
    poles_z: tuple[complex, ...]
    polynomial: tuple[float, ...]

    @property
    def stable(self) -> bool:
        """Whether all poles lie inside the unit circle."""
        return all(abs(z) < 1 for z in self.poles_z)


@accepts(gains=kinds.roots, sample_time=kinds.number, delay=kinds.finite, integral=kinds.text)
def sampled_poles(
    gains: Sequence[float], sample_time: float, *, delay: int = 0, integral: Integral = "forward"
) -> SampledDesign:
    """Return the poles that a sampled implementation of the error dynamics has.

    v = −(a₀ ∫e + a₁ e + a₂ ė + …) is held over each sample and drives a chain of integrators, one for each gain but
    a₀. e and its rates are measured at the ticks. `ErrorDynamics` integrates by forward Euler.

    Parameters
    ----------
    gains : sequence of float
        (a₀, a₁, a₂): of the integral, of the error, of its rate; more for a longer chain.
    sample_time : float
        T in s.
    delay : int
        Samples between measurement and hold.
    integral : {"forward", "backward", "trapezoidal"}
        Sum for ∫e: without the error of this tick, with it, or with half of it.
    """
    base, parts = _affine_polynomial(len(gains), sample_time, delay, integral)
    polynomial = base.copy()
    for a, part in zip(gains, parts, strict=True):
        polynomial[-len(part) :] += a * part
    w = np.roots(polynomial)
    with np.errstate(divide="ignore"):
        s = np.log((1 + sample_time * w).astype(complex)) / sample_time
    order = np.lexsort((-s.imag, np.abs(s)))  # of a pair the upper one first
    return SampledDesign(
        gains=tuple(float(a) for a in gains),
        sample_time=sample_time,
        delay=delay,
        poles=tuple(complex(v) for v in s[order]),
        poles_z=tuple(complex(v) for v in 1 + sample_time * w[order]),
        polynomial=tuple(float(c) for c in polynomial),
    )


@accepts(poles=kinds.roots, sample_time=kinds.number, delay=kinds.finite, integral=kinds.text)
def sampled_gains(
    poles: Sequence[complex], sample_time: float, *, delay: int = 0, integral: Integral = "forward"
) -> SampledDesign:
    """Return the gains that give the sampled loop the poles, multiple ones included.

    The characteristic polynomial is affine in the gains. It must be divisible by the polynomial of the wanted poles
    z = exp(s T), which gives linear equations. A delay adds one pole a sample that can't be chosen; the result holds
    these too.

    Parameters
    ----------
    poles : sequence of complex
        In 1/s, one for each gain, complex ones in conjugate pairs, in the left half plane.
    sample_time : float
        T in s.
    delay : int
        Samples between measurement and hold.
    integral : {"forward", "backward", "trapezoidal"}
        Sum for ∫e; see `sampled_poles`.

    Raises
    ------
    ParameterError
        If the poles are not stable or not in pairs, or a pole that the delay adds is unstable.
    ConfirmationError
        If the polynomial with these gains does not have the wanted roots.
    """
    wanted = np.asarray(poles, dtype=complex)
    if not np.all(wanted.real < 0) or not np.isfinite(wanted).all():
        text = (
            f"found {list(poles)!r}; expected poles in the left half plane, one for each gain, in 1/s. Give s, not z."
        )
        raise ParameterError(text, block="sampled_gains", port="poles")
    w = np.expm1(wanted * sample_time) / sample_time
    asked = real_polynomial(w)
    base, parts = _affine_polynomial(len(w), sample_time, delay, integral)
    # a vanishing remainder covers multiple poles, too
    size = float(np.max(np.abs(w)))
    columns = [_remainder(part, asked, size) for part in parts]
    gains = np.linalg.solve(np.array(columns).T, -_remainder(base, asked, size))
    design = sampled_poles([float(a) for a in gains], sample_time, delay=delay, integral=integral)
    quotient, _ = _divide(np.array(design.polynomial), asked)
    confirm_polynomial(np.array(design.polynomial), np.polymul(quotient, asked), "sampled_gains")
    others = 1 + sample_time * np.roots(quotient)
    if np.any(np.abs(others) >= 1):
        raise ParameterError(
            f"found gains for these poles, but the delay adds others at z = {others.round(6).tolist()}, which are not "
            "stable; expected |z| < 1. Ask for slower poles.",
            block="sampled_gains",
            port="poles",
        )
    return design


def _affine_polynomial(gains: int, T: float, delay: int, integral: Integral) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return p₀ and the pᵢ of the characteristic polynomial p₀ + Σ aᵢ pᵢ in w = (z − 1)/T.

    A chain of k integrators behind a hold has the transfer function T^k E_k(z)/(k! (z − 1)^k), with the Eulerian
    polynomial E_k.
    """
    if (chain := gains - 1) < 1 or not (np.isfinite(T) and T > 0) or delay < 0 or int(delay) != delay:
        raise ParameterError(
            f"found {gains} gains, a sample time of {T} s and a delay of {delay} samples; expected two gains or more, "
            "a positive sample time, and a whole number of samples that is not negative. Correct it.",
            block="sampled_design",
        )
    sums = {"forward": [1.0], "backward": [T, 1.0], "trapezoidal": [T / 2, 1.0]}
    if integral not in sums:
        text = f"found integral={integral!r}; expected 'forward', 'backward' or 'trapezoidal'. Choose one of them."
        raise ParameterError(text, block="sampled_design")
    base = np.array([1.0] + [0.0] * (chain + 1))
    for _ in range(int(delay)):
        base = np.polymul(base, [T, 1.0])
    # a₁ multiplies the output of the whole chain, the last gain that of its first integrator
    parts = [np.polymul(_eulerian_polynomial(k, T), [1.0] + [0.0] * (chain + 1 - k)) for k in range(chain, 0, -1)]
    return base, [np.polymul(sums[integral], _eulerian_polynomial(chain, T)), *parts]


def _remainder(polynomial: np.ndarray, divisor: np.ndarray, size: float) -> np.ndarray:
    """Return the remainder of a division of polynomials in w, computed in w/size to keep its digits."""
    scaled = polynomial * size ** np.arange(len(polynomial) - 1, -1, -1.0)
    by = divisor * size ** np.arange(len(divisor) - 1, -1, -1.0)
    return _divide(np.append(np.zeros(max(0, len(by) - len(scaled))), scaled), by)[1]


def _divide(polynomial: np.ndarray, divisor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return quotient and remainder; the remainder has one coefficient for each root of the divisor."""
    rest, steps = np.array(polynomial, dtype=float), len(polynomial) - len(divisor) + 1
    quotient = np.zeros(steps)
    for k in range(steps):
        quotient[k] = rest[k] / divisor[0]
        rest[k : k + len(divisor)] -= quotient[k] * divisor
    return quotient, rest[steps:]


def _eulerian_polynomial(k: int, T: float) -> np.ndarray:
    """Return the Eulerian polynomial E_k(z)/k! in w, where z = 1 + T w."""
    eulerian = [1.0]
    for n in range(2, k + 1):
        longer = [0.0] * n
        for j in range(n):
            longer[j] = (j + 1) * (eulerian[j] if j < n - 1 else 0.0) + (n - j) * (eulerian[j - 1] if j else 0.0)
        eulerian = longer
    out: np.ndarray = np.zeros(1)
    for c in eulerian:
        out = np.polyadd(np.polymul(out, [T, 1.0]), [c])
    return np.asarray(np.trim_zeros(out, "f")) / factorial(k)
