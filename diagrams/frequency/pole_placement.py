"""Placement of the poles of state feedback, confirmed by characteristic polynomials."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ...blocks.core import ConfirmationError, ParameterError, accepts, kinds
from .scan_refine_confirm import first_largest

REACH = 1e-8
"""Distance from an uncontrollable pair below which gains are refused: about the root of the rounding."""
OUT_OF_REACH = 1e-12
"""Distance below which a mode is not controllable, whatever gains are accepted: that of rounding."""
AGREE = 1e-6
"""Largest difference of characteristic polynomials that agree, relative to the largest scaled coefficient."""
DEPENDENT = 1e-9
"""Part of a vector outside a space, relative to its length, below which the vector lies in the space."""
CANDIDATES = 40
"""Random feedbacks that are tried where no chain of integrators fits."""


@accepts(A=kinds.matrix, B=kinds.matrix, poles=kinds.roots, reach=kinds.number)
def place(A: ArrayLike, B: ArrayLike, poles: Sequence[complex], *, reach: float = REACH) -> np.ndarray:
    """Return K that gives A − B K the poles, multiple ones included.

    SciPy's `place_poles` places as many coinciding poles as there are independent inputs, if there are several. It
    refuses more of them, and with a single input it loses digits from four states on, as it needs the eigenvectors.
    There each input drives a chain of integrators (Brunovsky), and Ackermann's formula places the poles of each chain.
    Where conjugate pairs don't fit into the chains, a feedback makes one input reach all states (Heymann): one chain.
    The result is confirmed by characteristic polynomials, since multiple eigenvalues scatter.

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
    wanted, n = np.asarray(poles, dtype=complex), len(system)
    if system.shape != (n, n) or inputs.shape[0] != n or wanted.shape != (n,):
        raise ParameterError(
            f"found A {system.shape}, B {inputs.shape} and {wanted.size} poles; expected (n, n), (n, m) and n poles.",
            block="place",
        )
    for name, values in (("A", system), ("B", inputs), ("poles", wanted)):
        if not np.isfinite(values).all():
            raise ParameterError(
                "found NaN or infinity; expected finite numbers. Look at the operating point of the model.",
                block="place",
                port=name,
            )
    polynomial = real_polynomial(wanted)
    distance, mode = _find_weakest_mode(system, inputs)
    if distance < OUT_OF_REACH:
        raise ParameterError(
            f"found a mode at {mode:.6g} that no input reaches; expected a controllable system. Leave the mode out, or "
            "place the others on a reduced model.",
            block="place",
        )
    try:
        K = _find_gains(system, inputs, wanted, polynomial)
    except ConfirmationError as error:
        if distance < reach:
            raise _make_weak_error(distance, mode, reach, "no gains that give these poles") from error
        raise
    if distance < reach:
        raise _make_weak_error(distance, mode, reach, f"gains up to {np.max(np.abs(K)):.3g}")
    return K


def real_polynomial(poles: np.ndarray) -> np.ndarray:
    """Return the coefficients of the polynomial with these roots, multiplied out pairwise so that they are real."""
    c = np.poly(poles)
    size = np.poly(-np.abs(poles))
    if np.any(np.abs(np.imag(c)) > 1e-9 * np.abs(size) + 1e-300):
        raise ParameterError(
            f"found the poles {list(poles)!r}; expected complex ones in conjugate pairs. Add the missing conjugates.",
            block="place",
            port="poles",
        )
    return np.asarray(np.real(c))


def relative_difference(found: np.ndarray, wanted: np.ndarray, size: float = 0.0) -> float:
    """Return the largest difference of two monic polynomials' coefficients, relative to the largest wanted one.

    Time is scaled by the size of the wanted roots, or by ``size`` where all of them are zero.
    """
    n = len(wanted) - 1
    roots = float(np.max(np.abs(wanted[1:]) ** (1 / np.arange(1, n + 1)), initial=0.0))
    scale = (roots or size or 1.0) ** np.arange(n + 1)
    return float(np.max(np.abs(found - wanted) / scale) / np.max(np.abs(wanted) / scale))


def confirm_polynomial(found: np.ndarray, wanted: np.ndarray, caller: str, size: float = 0.0) -> None:
    """Confirm that a characteristic polynomial is the wanted one."""
    difference = relative_difference(found, wanted, size)
    if not difference < AGREE:
        raise ConfirmationError(
            f"found a characteristic polynomial that differs from the wanted one by {difference:.3g} of its largest "
            f"coefficient; expected less than {AGREE:g}. Scale the states, or leave out modes that are nearly "
            "uncontrollable.",
            block=caller,
        )


def _find_gains(A: np.ndarray, B: np.ndarray, wanted: np.ndarray, polynomial: np.ndarray) -> np.ndarray:
    """Return the gains of the first method that can place the poles, confirmed."""
    size = float(np.linalg.norm(A))

    def differ(K: np.ndarray) -> float:
        return relative_difference(np.poly(A - B @ K), polynomial, size)

    lengths = np.linalg.norm(B, axis=0)  # units of the inputs don't matter
    rank = int(np.linalg.matrix_rank(B / np.where(lengths > 0.0, lengths, 1.0), tol=1e-10))
    multiplicity = max(int(np.sum(np.abs(wanted - p) < 1e-9 * (1 + abs(p)))) for p in wanted)
    if rank > 1 and multiplicity <= rank:
        from scipy.signal import place_poles

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about robustness: the poles are confirmed below
            K = np.asarray(place_poles(A, B, wanted).gain_matrix)
    else:
        chained = _place_in_chains(A, B, wanted)
        if chained is None or (B.shape[1] > 1 and differ(chained) > AGREE):
            chained = _place_by_one_input(A, B, wanted, differ)
        K = chained
    confirm_polynomial(np.poly(A - B @ K), polynomial, "place", size)
    return K


def _find_weakest_mode(A: np.ndarray, B: np.ndarray) -> tuple[float, complex | float]:
    """Return the smallest relative distance from a pair with a mode that no input reaches, and that mode.

    It is the smallest singular value of (A − s I, B) over the modes s (Popov, Belevitch, Hautus), with balanced states
    and B relative to its size, so that units don't matter.
    """
    M, b, _ = _balance(A, B)
    size = np.linalg.norm(M)
    M, b = M / (size or 1.0), b / (np.linalg.norm(b) or 1.0)
    modes = np.linalg.eigvals(M)
    found = [np.linalg.svd(np.hstack([M - s * np.eye(len(M)), b]), compute_uv=False)[-1] for s in modes]
    weakest = first_largest(-np.array(found))
    return float(found[weakest]), modes[weakest] * size


def _balance(A: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A and B with balanced states x/d, and d."""
    from scipy.linalg import matrix_balance

    d = np.asarray(matrix_balance(A, permute=False, separate=True)[1][0])
    return A * d / d[:, None], B / d[:, None], d


def _make_weak_error(distance: float, mode: complex | float, reach: float, found: str) -> ParameterError:
    return ParameterError(
        f"found {found}: the inputs hardly reach a mode at {mode:.6g}, as a change of A and B by {distance:.2g} of "
        f"their size takes it out of reach; expected at least {reach:.2g}. Leave that mode where it is, on a reduced "
        "model, or accept these gains with place(…, reach=0).",
        block="place",
    )


def _place_in_chains(A: np.ndarray, B: np.ndarray, poles: np.ndarray) -> np.ndarray | None:
    """Return K that gives each of Brunovsky's chains of integrators its share of the poles; None if pairs don't fit.

    K = [qᵢ A^(κᵢ−1) B]⁻¹ [qᵢ pᵢ(A)] with the last row qᵢ and the length κᵢ of each chain: Ackermann's formula, chain
    by chain. States and time are scaled, so that the chains' vectors get one size.
    """
    n, m = B.shape
    M, b, d = _balance(A, B)
    size = float(np.linalg.norm(M)) or 1.0
    M = M / size
    lengths = _find_chain_lengths(M, b) if m > 1 else [n]
    shared = _share_poles(poles, lengths)
    if sum(lengths) < n or shared is None:
        return None
    chains = np.hstack([np.linalg.matrix_power(M, k) @ b[:, i : i + 1] for i in range(m) for k in range(lengths[i])])
    ends = np.cumsum(lengths)[np.array(lengths) > 0] - 1
    last = np.linalg.solve(chains.T, np.eye(n)[:, ends]).T
    reached, feedback = [], []
    for q, length, group in zip(last, (k for k in lengths if k), (g for g in shared if g), strict=True):
        value = np.zeros((n, n))
        for k, c in enumerate(real_polynomial(np.array(group))):
            value = value @ M + c / size**k * np.eye(n)
        reached.append(q @ np.linalg.matrix_power(M, length - 1) @ b)
        feedback.append(q @ value)
    return np.asarray(np.linalg.pinv(np.array(reached)) @ np.array(feedback) * size / d)


def _find_chain_lengths(A: np.ndarray, B: np.ndarray) -> list[int]:
    """Return how many of the vectors b, A b, A² b, … of each input are independent of those before them.

    The vectors are taken by their power, then by their input, as parts that are orthogonal to all before.
    """
    n, m = B.shape
    lengths, basis = [0] * m, np.zeros((n, 0))
    growing = {i: B[:, i] for i in range(m)}
    while growing and basis.shape[1] < n:
        for i, vector in list(growing.items()):
            rest = vector - basis @ (basis.T @ vector)
            rest = rest - basis @ (basis.T @ rest)
            if np.linalg.norm(rest) <= DEPENDENT * np.linalg.norm(vector):
                del growing[i]
                continue
            unit = rest / np.linalg.norm(rest)
            basis = np.hstack([basis, unit[:, None]])
            growing[i], lengths[i] = A @ unit, lengths[i] + 1
    return lengths


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


def _place_by_one_input(
    A: np.ndarray, B: np.ndarray, poles: np.ndarray, differ: Callable[[np.ndarray], float]
) -> np.ndarray:
    """Return a feedback that makes a combination of the inputs reach all states, plus the gains of that input."""
    # the candidates are drawn, the same each time; the one with the smallest gain and the best poles is taken
    rng = np.random.default_rng(0)
    polynomial = real_polynomial(poles)
    size = max(np.linalg.norm(A), np.max(np.abs(polynomial[1:]) ** (1 / np.arange(1, len(polynomial)))))
    best: tuple[float, np.ndarray] | None = None
    for _ in range(CANDIDATES):
        F = rng.normal(size=(B.shape[1], len(A))) * size / (np.linalg.norm(B) * np.sqrt(B.shape[1] * len(A)))
        q = rng.normal(size=(B.shape[1], 1))
        gains = _place_in_chains(A - B @ F, B @ q, poles)
        if gains is None:
            continue
        K = F + q @ gains
        cost = float(np.linalg.norm(K)) * (1 + 1e6 * differ(K))
        if best is None or cost < best[0]:
            best = cost, K
    if best is None:
        raise ParameterError(
            "found no combination of the inputs that reaches all states; expected a controllable system. Leave out the "
            "modes that no input reaches.",
            block="place",
        )
    return best[1]
