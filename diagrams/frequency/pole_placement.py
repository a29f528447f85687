"""Pole placement: state feedback, and the gains of a sampled PID loop around a chain of integrators."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ...blocks.core import ConfirmationError, ParameterError, accepts, explain_calls, kinds
from .polynomials import divide, eulerian_polynomial, real_polynomial, relative_difference, remainder

Integral = Literal["forward", "backward", "trapezoidal"]
REACH = 1e-8
"""Distance from an uncontrollable pair below which gains are refused: about the root of the rounding."""
AGREE = 1e-6
"""Largest difference of characteristic polynomials that agree, relative to the largest scaled coefficient."""


@accepts(A=kinds.matrix, B=kinds.matrix, poles=kinds.roots, reach=kinds.number)
def place(A: ArrayLike, B: ArrayLike, poles: Sequence[complex], *, reach: float = REACH) -> np.ndarray:
    """Return K that gives A − B K the poles, multiple ones included.

    SciPy places distinct poles, and as many coinciding ones as there are inputs. Ackermann's formula places those of a
    single input. More coinciding poles are dealt out to chains of integrators, one an input (Brunovsky). Where
    conjugate pairs don't fit into the chains, a feedback makes one input reach all states (Heymann), and Ackermann's
    formula places them. The result is confirmed by characteristic polynomials, since multiple eigenvalues scatter.

    Parameters
    ----------
    A, B : array_like
        Continuous or sampled system, controllable; shapes (n, n) and (n, m).
    poles : sequence of complex
        n poles, complex ones in conjugate pairs.
    reach : float
        Least relative distance of A and B, with balanced states, from a pair with a mode that no input reaches. Nearer
        to it the gains are large, and a tiny error of the model is enough to make them useless; 0 accepts them.

    Returns
    -------
    ndarray
        K, shape (m, n).

    Raises
    ------
    ParameterError
        If shapes or conjugate pairs don't fit, entries are not finite, or the system is not, or hardly, controllable.
    ConfirmationError
        If the polynomials differ: the problem is too ill-conditioned.

    Examples
    --------
    >>> place([[0, 1], [0, 0]], [[0], [1]], [-2, -2])
    array([[4., 4.]])
    """
    system, inputs = np.atleast_2d(np.asarray(A, dtype=float)), np.asarray(B, dtype=float)
    inputs = inputs.reshape(-1, 1) if inputs.ndim < 2 else inputs
    wanted = np.asarray(poles, dtype=complex)
    try:
        K = _place(system, inputs, wanted)
    except ConfirmationError as error:
        distance, mode = _find_weakest_mode(system, inputs)
        if distance < reach:
            raise _make_weak_error(distance, mode, reach, "no gains that give these poles") from error
        raise
    distance, mode = _find_weakest_mode(system, inputs) if len(system) else (np.inf, 0j)
    if distance < reach:
        raise _make_weak_error(distance, mode, reach, f"gains up to {np.max(np.abs(K)):.3g}")
    return K


def _find_weakest_mode(A: np.ndarray, B: np.ndarray) -> tuple[float, complex]:
    """Return the smallest relative distance from a pair with a mode that no input reaches, and that mode.

    The states are balanced, and B is taken relative to its size, so that units don't matter.
    """
    from scipy.linalg import matrix_balance

    d = np.asarray(matrix_balance(A, permute=False, separate=True)[1][0])
    M, b = A * d / d[:, None], B / d[:, None]
    M, b = M / (np.linalg.norm(M) or 1.0), b / (np.linalg.norm(b) or 1.0)
    modes = np.linalg.eigvals(M)
    found = [np.linalg.svd(np.hstack([M - s * np.eye(len(M)), b]), compute_uv=False)[-1] for s in modes]
    weakest = int(np.argmin(found))
    return float(found[weakest]), complex(modes[weakest] * np.linalg.norm(A * d / d[:, None]))


def _make_weak_error(distance: float, mode: complex, reach: float, found: str) -> ParameterError:
    return ParameterError(
        f"found {found}: the inputs hardly reach a mode at {mode:.6g}, as a change of A and B by {distance:.2g} of "
        f"their size takes it out of reach; expected at least {reach:.2g}. Leave that mode where it is, on a reduced "
        "model, or accept these gains with place(…, reach=0).",
        block="place",
    )


def _place(A: np.ndarray, B: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    n = len(A)
    if A.shape != (n, n) or B.shape[0] != n or wanted.shape != (n,):
        raise ParameterError(
            f"found A {A.shape}, B {B.shape} and {wanted.size} poles; expected (n, n), (n, m) and n poles.",
            block="place",
        )
    for name, values in (("A", A), ("B", B), ("poles", wanted)):
        if not np.isfinite(values).all():
            raise ParameterError(
                "found NaN or infinity; expected finite numbers. Look at the operating point of the model.",
                block="place",
                port=name,
            )
    polynomial = real_polynomial(wanted)
    lengths = np.linalg.norm(B, axis=0)  # units of the inputs don't matter
    rank = int(np.linalg.matrix_rank(B / np.where(lengths > 0.0, lengths, 1.0), tol=1e-10))
    multiplicity = max(int(np.sum(np.abs(wanted - p) < 1e-9 * (1 + abs(p)))) for p in wanted)
    if rank > 1 and multiplicity <= rank:
        from scipy.signal import place_poles

        _check_controllable(A, B)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about robustness: the poles are confirmed below
            K: np.ndarray | None = np.asarray(place_poles(A, B, wanted).gain_matrix)
    elif B.shape[1] == 1:
        _check_controllable(A, B)
        K = _place_by_ackermann(A, B, polynomial)
    else:
        _check_controllable(A, B)
        K = _place_in_chains(A, B, wanted)
        if K is None or relative_difference(np.poly(A - B @ K), polynomial, float(np.linalg.norm(A))) > AGREE:
            K = _place_by_heymann(A, B, polynomial)
    _confirm_polynomial(np.poly(A - B @ K), polynomial, "place", float(np.linalg.norm(A)))
    return np.asarray(K)


def _check_controllable(A: np.ndarray, B: np.ndarray) -> None:
    """Refuse a system with a mode that no input reaches (Popov, Belevitch, Hautus)."""
    n, scale = len(A), np.linalg.norm(A) + 1e-300
    for value in np.linalg.eigvals(A):
        pencil = np.hstack([(A - value * np.eye(n)) / scale, B / (np.linalg.norm(B) + 1e-300)])
        if np.linalg.svd(pencil, compute_uv=False)[-1] < 1e-12:
            raise ParameterError(
                f"found a mode at {value:.6g} that no input reaches; expected a controllable system. Leave the mode "
                "out, or place the others on a reduced model.",
                block="place",
            )


def _place_by_ackermann(A: np.ndarray, B: np.ndarray, polynomial: np.ndarray) -> np.ndarray:
    """Return eₙᵀ [B, AB, …]⁻¹ p(A), with states and time scaled so that the matrix is well-conditioned."""
    from scipy.linalg import matrix_balance

    n = len(A)
    d = np.asarray(matrix_balance(A, permute=False, separate=True)[1][0])
    size = np.linalg.norm(A * d / d[:, None]) or 1.0
    M, b = A * d / d[:, None] / size, B / d[:, None]
    reached = np.hstack([np.linalg.matrix_power(M, k) @ b for k in range(n)])
    value = np.zeros((n, n))
    for k, c in enumerate(polynomial):
        value = value @ M + c / size**k * np.eye(n)
    row = np.linalg.solve(reached.T, np.eye(n)[-1])
    return np.asarray((row @ value * size / d)[None, :])


def _place_in_chains(A: np.ndarray, B: np.ndarray, poles: np.ndarray) -> np.ndarray | None:
    """Return K that gives each of Brunovsky's chains of integrators poles of its own; None if pairs don't fit.

    K = [qᵢ A^(κᵢ−1) B]⁻¹ [qᵢ pᵢ(A)] with the last row qᵢ and the length κᵢ of each chain: Ackermann's formula, chain
    by chain.
    """
    n, m = len(A), B.shape[1]
    columns: list[list[np.ndarray]] = [[] for _ in range(m)]
    basis = np.zeros((n, 0))
    growing, power = list(range(m)), B / np.linalg.norm(B, axis=0).clip(1e-300)
    while growing and basis.shape[1] < n:
        for i in list(growing):
            rest = power[:, i] - basis @ (basis.T @ power[:, i])
            rest = rest - basis @ (basis.T @ rest)
            if np.linalg.norm(rest) <= 1e-9 * np.linalg.norm(power[:, i]):
                growing.remove(i)
                continue
            columns[i].append(power[:, i])
            basis = np.hstack([basis, (rest / np.linalg.norm(rest))[:, None]])
        power = A @ power
    lengths = [len(c) for c in columns if c]
    shared = _share_poles(poles, lengths)
    if basis.shape[1] < n or shared is None:
        return None
    ends = np.linalg.inv(np.column_stack([v for c in columns for v in c]))[np.cumsum(lengths) - 1]
    reach, feedback = [], []
    for q, k, group in zip(ends, lengths, shared, strict=True):
        value = np.zeros((n, n))
        for c in real_polynomial(np.array(group)):
            value = value @ A + c * np.eye(n)
        reach.append(q @ np.linalg.matrix_power(A, k - 1) @ B)
        feedback.append(q @ value)
    return np.asarray(np.linalg.pinv(np.array(reach)) @ np.array(feedback))


def _share_poles(poles: np.ndarray, lengths: list[int]) -> list[list[complex]] | None:
    """Deal poles out to chains of given lengths in order, pairs together; None if they don't fit."""
    groups: list[list[complex]] = [[] for _ in lengths]
    pairs = [(p, p.conjugate()) for p in poles if p.imag > 0]
    for group in [*pairs, *((p,) for p in poles if p.imag == 0)]:
        room = [i for i, k in enumerate(lengths) if k - len(groups[i]) >= len(group)]
        if not room:
            return None
        groups[room[0]] += group
    return groups if [len(g) for g in groups] == lengths else None


def _place_by_heymann(A: np.ndarray, B: np.ndarray, polynomial: np.ndarray) -> np.ndarray:
    """Return a feedback that makes a combination of the inputs reach all states, plus Ackermann's for that input.

    40 candidates are drawn, the same each time; the one with the smallest gain and the best poles is taken.
    """
    rng = np.random.default_rng(0)
    size = max(np.linalg.norm(A), np.max(np.abs(polynomial[1:]) ** (1 / np.arange(1, len(polynomial)))))
    best: tuple[float, np.ndarray] | None = None
    for _ in range(40):
        F = rng.normal(size=(B.shape[1], len(A))) * size / (np.linalg.norm(B) * np.sqrt(B.shape[1] * len(A)))
        q = rng.normal(size=(B.shape[1], 1))
        try:
            K = F + q @ _place_by_ackermann(A - B @ F, B @ q, polynomial)
        except np.linalg.LinAlgError:
            continue
        cost = float(np.linalg.norm(K)) * (
            1 + 1e6 * relative_difference(np.poly(A - B @ K), polynomial, float(np.linalg.norm(A)))
        )
        if best is None or cost < best[0]:
            best = cost, K
    if best is None:
        raise ParameterError(
            "found no combination of the inputs that reaches all states; expected a controllable system. Leave out the "
            "modes that no input reaches.",
            block="place",
        )
    return best[1]


def _confirm_polynomial(found: np.ndarray, wanted: np.ndarray, caller: str, size: float = 0.0) -> None:
    difference = relative_difference(found, wanted, size)
    if not difference < AGREE:
        raise ConfirmationError(
            f"found a characteristic polynomial that differs from the wanted one by {difference:.3g} of its largest "
            f"coefficient; expected less than {AGREE:g}. Scale the states, or leave out modes that are nearly "
            "uncontrollable.",
            block=caller,
        )


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
        Sum that stands for ∫e: without the error of this tick, with it, or with half of it.
    """
    base, parts = _affine_polynomial(len(gains), sample_time, delay, integral)
    polynomial = base.copy()
    for a, part in zip(gains, parts, strict=True):
        polynomial[-len(part) :] += a * part
    w = np.roots(polynomial)
    with np.errstate(divide="ignore"):
        s = np.log((1 + sample_time * w).astype(complex)) / sample_time
    order = np.argsort(np.abs(s))
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
        Sum that stands for ∫e; see `sampled_poles`.

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
    columns = [remainder(part, asked, size) for part in parts]
    gains = np.linalg.solve(np.array(columns).T, -remainder(base, asked, size))
    design = sampled_poles([float(a) for a in gains], sample_time, delay=delay, integral=integral)
    quotient, _ = divide(np.array(design.polynomial), asked)
    _confirm_polynomial(np.array(design.polynomial), np.polymul(quotient, asked), "sampled_gains")
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
    parts = [np.polymul(eulerian_polynomial(k, T), [1.0] + [0.0] * (chain + 1 - k)) for k in range(chain, 0, -1)]
    return base, [np.polymul(sums[integral], eulerian_polynomial(chain, T)), *parts]
