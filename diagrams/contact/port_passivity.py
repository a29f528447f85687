"""Passivity of a contact: whether an environment that is passive itself can destabilize it.

Continuous, the contact is passive if it is stable and Re Y(jω) ≥ 0. The frequencies at which Re Y = 0 are the imaginary
eigenvalues of a Hamiltonian pencil, that of Y(s) + Y(−s); the sign between two of them is looked at once. No frequency
is missed between points of a grid.

Sampled, a force of the frequency ω in the environment reaches the controller as all its aliases ω_n = ω + 2πn/T do, and
the held command moves the contact at all of them (Colgate and Schenkel 1994). Over the aliases the admittance is

    Y_nm = Y₀(jω_n) δ_nm + a_n M b_m/T,     a_n = G_u(jω_n) (1 − e^{−jωT})/(jω_n),    b_m = G_F(jω_m),

with the plant's own admittance Y₀, its transfer functions G_u from the command to the velocity and G_F from the force
to the measured outputs, and the controller in its loop, M = (I − K G)⁻¹ K at z = e^{jωT}. The contact is passive if it
is stable and Y + Yᴴ ≥ 0 at all ω up to π/T, or Z + Zᴴ ≥ 0 for the impedance Z = Y⁻¹, finite at low frequencies:

    Z_nm = δ_nm/Y₀(jω_n) − a'_n M' b'_m/T,    a' = a/Y₀,  b' = b/Y₀,  M' = (I + M Σ b_n a_n/(T Y₀(jω_n)))⁻¹ M.

With r_n = Re 1/Y₀(jω_n) > 0 that is an eigenvalue of a matrix as large as a and b have columns and rows, whose entries
are sums over all aliases of a'ᴴa'/r, b'* b'ᵀ/r and a'ᴴb'*/r: the terms of large n go as 1/n², and are summed to
infinity by their asymptotes. For a mass with the damping b at a virtual wall K + B (1 − 1/z)/T it is Colgate's
condition, b > K T/2 + |B|.

A force or a velocity that is sampled without a filter has aliases whose sum is infinite: no such contact is passive. A
position is filtered by the plant's mass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ...blocks.core import explain_calls, on_one_thread
from ..frequency import hold_inputs
from .contact_loop import close_loop, controller_rows, join_environment
from .coupled_parts import ContactParts
from .held_signals import StateMatrices

ALIASES = 16
"""Aliases on each side that are summed one by one."""
POINTS = 60
"""Frequencies at which a sampled loop is looked at first, in addition to those of its poles."""
PRECISE = 1e-6
"""Error of the margin of a sampled loop."""
LOWEST_SHARE = 1e-3
"""Lowest frequency in π/T: below it, the margin is lost in rounding, and does not change without slow modes."""
MINIMA = 4
"""Lowest minima of the margin that are refined."""
_ROUNDED = 1e-9
"""Size of a real part, or of a way to the controller, relative to what it is made of, that is rounding."""
_DEFECTIVE = 1e6
"""Condition of a matrix of eigenvectors, above which equations are solved."""
_NEAR_AXIS = 1e-3
"""Part of its size that an eigenvalue may be away from the imaginary axis, to be looked at."""


class PassivityReason(StrEnum):
    """Ground of a verdict on passivity."""

    COMPUTED = "the least real part of impedance or admittance over all frequencies, and aliases"
    UNSTABLE = "the loop alone is unstable"
    NEGATIVE = "Re Y is negative at a frequency"
    FORCE_SAMPLED = "the force is sampled without a filter, whose aliases an environment can excite"
    VELOCITY_SAMPLED = "the velocity is sampled without a filter, whose aliases an environment can excite"
    UNDAMPED = "the plant alone has no damping at some frequency"
    SEVERAL_RATES = "not decided in several rates"
    ACTIVE_PLANT = "not decided for a plant that is not passive alone"


@explain_calls
@dataclass(frozen=True)
class PortPassivity:
    """Passivity of a contact against all passive environments, linear and about an operating point.

    Attributes
    ----------
    passive : bool or None
        Verdict; None if it is not decided.
    reason : PassivityReason
        Its ground.
    margin : float
        Least eigenvalue of Z + Zᴴ over all frequencies, relative to the plant's own part of it, if sampled: 1 is
        without control, and 0 the limit. Re Y, in m/(N s), if continuous. NaN where it was not computed.
    frequency : float
        Frequency in rad/s of the margin.
    tolerance : float
        Error of the margin.
    """

    passive: bool | None
    reason: PassivityReason
    margin: float = math.nan
    frequency: float = math.nan
    tolerance: float = math.nan

    def __str__(self) -> str:
        words = {True: "Passive", False: "Not passive", None: "Passivity is open"}[self.passive]
        margin = "" if math.isnan(self.margin) else f", {self.margin:.4g} at {self.frequency:.5g} rad/s"
        return f"{words} against all passive environments: {self.reason.value}{margin}."


@on_one_thread
def find_passivity(parts: ContactParts, direction: np.ndarray, *, stable: bool) -> PortPassivity:
    """Return whether a contact is passive; ``stable`` says whether it is so without an environment."""
    if not stable:
        return PortPassivity(False, PassivityReason.UNSTABLE)
    if not parts.sample_time:
        joined = join_environment(parts, direction)
        loop = close_loop(parts, joined)
        push = loop.at_tick.copy()
        push[: len(joined.A)] += joined.G
        shown = np.zeros((1, len(loop.A)))
        shown[:, : len(joined.A)] = direction @ parts.velocity
        return _judge_continuous(loop.A, push, shown)
    if parts.ticks:
        return PortPassivity(None, PassivityReason.SEVERAL_RATES)
    return _Aliases(parts, direction).judge()


# --- continuous ------------------------------------------------------------------------------------------------------


def find_zeros_of_real_part(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return the frequencies in rad/s at which Re Y(jω) of Y = C (sI − A)⁻¹ B may be zero, rising."""
    from scipy.linalg import eigvals

    n = len(A)
    whole, unit = np.zeros((2 * n + 1, 2 * n + 1)), np.eye(2 * n + 1)
    whole[:n, :n], whole[:n, 2 * n :] = A, B
    whole[n : 2 * n, n : 2 * n], whole[n : 2 * n, 2 * n :] = -A.T, -C.T
    whole[2 * n :, :n], whole[2 * n :, n : 2 * n] = C, B.T
    unit[2 * n, 2 * n] = 0.0
    found = np.asarray(eigvals(whole, unit))
    found = found[np.isfinite(found)]
    close = (np.abs(found.real) <= _NEAR_AXIS * np.abs(found)) & (found.imag > 0.0)
    return np.sort(found.imag[close])


def _judge_continuous(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> PortPassivity:
    zeros = find_zeros_of_real_part(A, B, C)
    sizes = np.abs(np.linalg.eigvals(A))
    low, high = (1e-3 * float(np.min(sizes[sizes > 0.0], initial=1.0)), 1e3 * float(np.max(sizes, initial=1.0)))
    ends = np.concatenate([[min([low, *(1e-2 * zeros)])], zeros, [max([high, *(1e2 * zeros)])]])
    between = np.sqrt(ends[:-1] * ends[1:])
    Y = np.array([(C @ np.linalg.solve(1j * w * np.eye(len(A)) - A, B))[0, 0] for w in between])
    worst = int(np.argmin(Y.real / np.abs(Y)))
    margin, w = float(Y[worst].real), float(between[worst])
    bound = _ROUNDED * float(np.abs(Y[worst]))
    if margin < -bound:
        return PortPassivity(False, PassivityReason.NEGATIVE, margin, w, bound)
    return PortPassivity(True, PassivityReason.COMPUTED, margin, w, bound)


# --- sampled ---------------------------------------------------------------------------------------------------------


class _Aliases:
    """A sampled contact over the aliases of its frequencies."""

    def __init__(self, parts: ContactParts, direction: np.ndarray):
        self.parts, self.T = parts, parts.sample_time
        self.joined = join_environment(parts, direction)
        self.push = parts.force @ direction[:, None]
        self.along = (direction @ parts.velocity)[None, :]
        rows, K = controller_rows(parts, self.joined), parts.controller
        self.many = len(parts.plant.C)
        self.rows = tuple(part[: self.many] for part in (rows.x, rows.last, rows.now))
        self.K = StateMatrices(K.A, K.B[:, : self.many], K.C, K.D[:, : self.many])
        self.felt = (K.B[:, self.many :] @ direction, K.D[:, self.many :] @ direction)
        self.shown = (parts.force_shown @ direction[:, None])[:, 0]
        self.held = hold_inputs(self.joined.A, self.joined.B, self.T)
        self.modes = self._find_modes()

    def judge(self) -> PortPassivity:
        from scipy.optimize import minimize_scalar

        moves = np.any(np.abs(self.along @ self.joined.A) @ np.abs(self.joined.B))
        by_force = self._reads(self.shown) or any(np.any(part) for part in self.felt)
        if moves and by_force:
            return PortPassivity(False, PassivityReason.FORCE_SAMPLED)
        if moves and self._reads((self.parts.plant.C @ self.push)[:, 0]):
            return PortPassivity(False, PassivityReason.VELOCITY_SAMPLED)
        grid = self._grid()
        reason = self._check_plant(grid)
        if reason is not None:
            return reason
        margins = self.margins(grid)
        padded = np.concatenate([[np.inf], margins, [np.inf]])
        lowest = np.flatnonzero((margins <= padded[:-2]) & (margins <= padded[2:]) & (margins < 1.0 - PRECISE))
        found = [(float(np.min(margins)), float(grid[np.argmin(margins)]))]
        for i in lowest[np.argsort(margins[lowest], kind="stable")][:MINIMA]:
            a, b = grid[max(i - 1, 0)], grid[min(i + 1, len(grid) - 1)]
            best = minimize_scalar(
                lambda w: float(self.margins(np.array([w]))[0]),
                bounds=(a, b),
                method="bounded",
                options={"xatol": 1e-6 * b},
            )
            found.append((float(best.fun), float(best.x)))
        margin, w = min(found)
        return PortPassivity(margin > -PRECISE, PassivityReason.COMPUTED, margin, w, PRECISE)

    def _reads(self, column: np.ndarray) -> bool:
        """Whether the controller takes a part of the plant's outputs."""
        size = max(float(np.max(np.abs(column), initial=0.0)), 1e-300)
        parts = (self.K.B @ column, self.K.D @ column)
        of = (np.max(np.abs(self.K.B), initial=0.0), np.max(np.abs(self.K.D), initial=0.0))
        return any(np.any(np.abs(p) > _ROUNDED * size * o) for p, o in zip(parts, of, strict=True) if o)

    def _grid(self) -> np.ndarray:
        """Return frequencies up to π/T: a grid, and those of the poles, more densely."""
        top = math.pi / self.T
        poles = np.linalg.eigvals(close_loop(self.parts, self.joined).A)
        rates = np.log(poles[np.abs(poles) > 1e-12].astype(complex)) / self.T
        rates = np.concatenate([rates, np.linalg.eigvals(self.joined.A)])
        offsets = np.array([-3.0, -1.0, -0.3, 0.0, 0.3, 1.0, 3.0])
        near = np.abs(rates.imag)[:, None] + np.abs(rates.real)[:, None] * offsets
        near = np.abs((near + top) % (2.0 * top) - top).ravel()  # aliases of the plant's own, too
        spread = np.concatenate(
            [np.geomspace(LOWEST_SHARE * top, top, POINTS), np.linspace(LOWEST_SHARE * top, top, POINTS)]
        )
        whole = np.unique(np.concatenate([spread, near]))
        return whole[(whole >= LOWEST_SHARE * top) & (whole <= top)]

    def _transfers(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return Y₀, a (… × inputs) and b (… × outputs) at frequencies of any shape; a without its factor 1 − 1/z."""
        s = 1j * w[..., None]
        if self.modes is not None:
            poles, left, by_velocity, by_rows = self.modes
            share = 1.0 / (s - poles)
            v = (share * by_velocity) @ left
            y = (share * left[:, -1]) @ by_rows.T
            return v[..., -1], v[..., :-1] / s, y
        n = len(self.joined.A)
        B = np.hstack([self.joined.B, self.push]).astype(complex)
        x = np.linalg.solve(s[..., None] * np.eye(n) - self.joined.A, np.broadcast_to(B, (*w.shape, *B.shape)))
        v = (self.along @ x)[..., 0, :]
        return v[..., -1], v[..., :-1] / s, (self.rows[0] @ x[..., -1:])[..., 0]

    def _find_modes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
        """Return poles, inputs of the modes, and the modes' velocity and outputs; None where modes fall together."""
        poles, V = np.linalg.eig(self.joined.A)
        if np.linalg.cond(V) > _DEFECTIVE:
            return None
        left = np.linalg.solve(V, np.hstack([self.joined.B, self.push]).astype(complex))
        return poles, left, (self.along @ V)[0], self.rows[0] @ V

    def _check_plant(self, grid: np.ndarray) -> PortPassivity | None:
        """Return the verdict where the plant alone is not damped."""
        w = (grid[:, None] + 2.0 * math.pi / self.T * np.arange(-3, 4)).ravel()
        Y0 = self._transfers(w)[0]
        least = int(np.argmin(Y0.real / np.abs(Y0) ** 2))
        if Y0.real[least] > 1e-12 * abs(Y0[least]):
            return None
        undamped = abs(Y0.real[least]) <= 1e-12 * abs(Y0[least])
        passive, reason = (False, PassivityReason.UNDAMPED) if undamped else (None, PassivityReason.ACTIVE_PLANT)
        return PortPassivity(passive, reason, frequency=abs(float(w[least])))

    def margins(self, w: np.ndarray) -> np.ndarray:
        """Return the least eigenvalue of Z + Zᴴ, relative to the plant's part of it."""
        gram, through = self._sum_aliases(w)
        M = self._control(w)
        many, size = M.shape[-2], gram.shape[-1]
        M = -np.linalg.solve(np.eye(many) + M @ through / self.T, M) / self.T
        N = np.zeros((len(w), size, size), dtype=complex)
        N[:, :many, many:] = 0.5 * M
        N[:, many:, :many] = 0.5 * np.conj(np.swapaxes(M, -1, -2))
        scale = np.sqrt(np.maximum(np.einsum("kii->ki", gram).real, 1e-300))
        values, vectors = np.linalg.eigh(gram / scale[:, :, None] / scale[:, None, :])
        root = scale[:, :, None] * vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        inner = np.conj(np.swapaxes(root, -1, -2)) @ N @ root
        found: np.ndarray = 1.0 + np.minimum(np.linalg.eigvalsh(inner)[:, 0], 0.0)
        return found

    def _sum_aliases(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums of (a', b'*)ᴴ (a', b'*)/r and of b a/Y₀ over all aliases."""
        from scipy.special import polygamma

        turn = 2.0 * math.pi / self.T
        first, many = 1.0 - np.exp(-1j * w * self.T), self.joined.B.shape[1]
        size = many + self.many

        def terms(at: np.ndarray) -> np.ndarray:
            Y0, a, b = self._transfers(at)
            a = a * first[:, None, None]
            rows = np.concatenate([a / Y0[..., None], np.conj(b / Y0[..., None])], axis=-1)
            r = Y0.real / np.abs(Y0) ** 2
            made = np.conj(rows[..., :, None]) * rows[..., None, :] / r[..., None, None]
            passed = b[..., :, None] * a[..., None, :] / Y0[..., None, None]
            return np.concatenate([made.reshape(*at.shape, -1), passed.reshape(*at.shape, -1)], axis=-1)

        total = terms(w[:, None] + turn * np.arange(-ALIASES, ALIASES)).sum(axis=1)
        x = w / turn
        for sign, begin in ((1.0, ALIASES + x), (-1.0, ALIASES + 1.0 - x)):
            # c₂/k² + c₃/k³ + c₄/k⁴ for the distance k from 0 in turns, from three terms
            k = begin[:, None] * np.array([1.0, 2.0, 4.0])
            powers = np.array([1.0, 2.0, 4.0])[:, None] ** -np.array([2.0, 3.0, 4.0])
            c = np.linalg.solve(powers, terms(sign * turn * k))
            sums = np.stack([polygamma(1, begin), -0.5 * polygamma(2, begin), polygamma(3, begin) / 6.0], axis=-1)
            total = total + np.einsum("kp,kpq->kq", sums * begin[:, None] ** np.array([2.0, 3.0, 4.0]), c)
        cut = size * size
        return total[:, :cut].reshape(-1, size, size), total[:, cut:].reshape(-1, self.many, many)

    def _control(self, w: np.ndarray) -> np.ndarray:
        """Return (I − K G)⁻¹ K at z = e^{jωT}."""
        z = np.exp(1j * w * self.T)[:, None, None]
        F, H = self.held
        x, last, now = self.rows
        G = x @ np.linalg.solve(z * np.eye(len(F)) - F, np.broadcast_to(H, (len(w), *H.shape))) + last / z + now
        K = self.K
        C = K.C @ np.linalg.solve(z * np.eye(len(K.A)) - K.A, np.broadcast_to(K.B, (len(w), *K.B.shape))) + K.D
        return np.linalg.solve(np.eye(C.shape[-2]) - C @ G, C)
