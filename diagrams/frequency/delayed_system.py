"""A linear system with delays: a system of python-control whose response is exact."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from control import StateSpace, TransferFunction, ss
from control.iosys import InputOutputSystem
from numpy.typing import ArrayLike

from ...blocks.core import Finding, OptionError, brief, count_of, explain_calls
from .delay_matrices import DelayMatrices
from .delayed_response import respond
from .linear_delays import LinearDelays
from .state_space import FourMatrices

if TYPE_CHECKING:
    from control import FrequencyResponseData

SERIES = 1e-9
"""Relative difference up to which a response is that of a system without delays, times one delay."""


def _refuse_matrix(name: str) -> Any:
    """Return a property in place of a matrix that a system with delays doesn't have."""

    def matrix(self: Any) -> np.ndarray:
        raise OptionError(
            f"found a system with delays, which has no {name} of a state space; expected something that evaluates it "
            "at frequencies: system(s), control.bode_plot, margins(system). What needs a rational model takes "
            ".pade(order); .rest and .delays are its parts.",
            block=self.name,
        )

    return property(matrix, doc=f"No {name}: an OptionError.")


@explain_calls
class DelayedSystem(StateSpace):  # type: ignore[misc]
    """A continuous linear system with delays, exact in e^(−sτ), as a `control.StateSpace` without matrices.

    The rest is a state space, and the delays are closed around it (a linear fractional form): its inputs are those of
    the system and then the delays' outputs w, its outputs are those of the system and then the delays' inputs z,
    wᵢ(t) = zᵢ(t − τᵢ). ``system(s)`` evaluates it, so `control.frequency_response`, `control.bode_plot`,
    `control.nyquist_plot` and `control.nichols_plot` are exact. Sums, products and feedback with numbers, state spaces,
    transfer functions and systems with delays are such systems. It has no A, B, C and D: functions of python-control
    that need them, such as `control.step_response` and `control.ss`, raise an OptionError.

    Parameters
    ----------
    rest : control.StateSpace
        The system without its delays.
    delays : array_like
        τ in s, one for each of the last inputs and outputs of the rest.
    names : sequence of str
        Names of the delays.
    name, inputs, outputs
        As of a `control.StateSpace`.

    Attributes
    ----------
    inexactness : float
        Estimated error of the entries of the rest, relative to the largest.
    findings, notes : tuple
        Effects that limit it; see `Linearization.loop`.

    Raises
    ------
    OptionError
        If the rest is sampled, or has fewer inputs or outputs than delays and one more.
    """

    inexactness: float = 0.0
    findings: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ()
    A, B, C, D = (_refuse_matrix(name) for name in "ABCD")
    updfcn, outfcn = (_refuse_matrix(name) for name in ("state function", "output function"))

    def __init__(
        self,
        rest: StateSpace,
        delays: ArrayLike,
        names: Sequence[str] = (),
        *,
        name: str | None = None,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
    ):
        tau = np.atleast_1d(np.asarray(delays, dtype=float)) if np.size(delays) else np.zeros(0)
        m = len(tau)
        if rest.dt != 0 or rest.ninputs <= m or rest.noutputs <= m or np.any(tau <= 0.0):
            raise OptionError(
                f"found {m} delays, the shortest of {float(tau.min(initial=np.inf)):.6g} s, around a rest with "
                f"{rest.ninputs} inputs, {rest.noutputs} outputs and dt={rest.dt}; expected positive delays around a "
                "continuous rest with an input and an output for each, and further ones of the system.",
                block=name or "DelayedSystem",
            )
        self.rest, self.delays = rest, tau
        self.delay_names = tuple(names) or tuple(f"delay_{i + 1}" for i in range(m))
        InputOutputSystem.__init__(
            self,
            inputs=list(inputs) if inputs is not None else rest.ninputs - m,
            outputs=list(outputs) if outputs is not None else rest.noutputs - m,
            states=rest.nstates,
            name=name,
            dt=0,
        )

    def __repr__(self) -> str:
        facts = (
            f"{self.noutputs} × {self.ninputs}",
            count_of(len(self.delays), "delay"),
            count_of(self.rest.nstates, "state"),
        )
        return brief(f"system with delays {self.name!r}", *facts, then=".rest, .delays, margins(…)")

    __str__ = __repr__

    def _repr_html_(self) -> str | None:
        """Return None: a notebook shows the short text."""
        return None

    # --- response -----------------------------------------------------------------------------------------------------

    def __call__(self, x: Any, squeeze: bool | None = None, warn_infinite: bool = True) -> Any:
        """Return the transfer matrix at points s, in the shape that python-control's systems return."""
        from control.lti import _process_frequency_response

        points = np.atleast_1d(np.asarray(x, dtype=complex))
        return _process_frequency_response(self, x, np.moveaxis(self._values(points), 0, -1), squeeze=squeeze)

    def _values(self, s: np.ndarray) -> np.ndarray:
        """Return the transfer matrix at points, shape (points, outputs, inputs); infinite at a pole."""
        (A, B, C, D), late = self.equations()
        n, into = len(A), np.vstack([B, late.F]).astype(complex)
        found = np.empty((len(s), self.noutputs, self.ninputs), dtype=complex)
        for i, at in enumerate(s):
            try:
                v = np.linalg.solve(late.matrix_at(A, at), into)
            except np.linalg.LinAlgError:
                found[i] = np.inf
                continue
            found[i] = D + C @ v[:n] + (late.E * np.exp(-at * late.times)) @ v[n:]
        return found

    def dcgain(self) -> Any:
        """Return the response at s = 0."""
        return self._dcgain(warn_infinite=False)

    def with_rest(self, A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray) -> DelayedSystem:
        """Return the system with other matrices of the rest."""
        labels = {"inputs": self.input_labels, "outputs": self.output_labels}
        return self._made(ss(A, B, C, D, 0, remove_useless_states=False), self.delays, self.delay_names, **labels)

    def characteristic(self) -> DelayMatrices:
        """Return the matrices of the characteristic function."""
        (A, _, _, _), late = self.equations()
        return DelayMatrices.of(A, late)

    def poles(self) -> np.ndarray:
        """Return the poles, the rightmost first.

        Where a delay acts back on itself there are infinitely many, of which those far to the left are left out: all
        beyond the limit of stability are there.

        Raises
        ------
        ConfirmationError
            If the poles that are not stable are not as many as the argument of the characteristic function says.
        """
        return np.array(self.characteristic().poles())

    def zeros(self) -> np.ndarray:
        """Return the zeros where all delays together are one in series; else there are infinitely many.

        Raises
        ------
        NotImplementedError
            If there are infinitely many; python-control's plots do without.
        """
        plain = self.without_delays()
        s = (1.0 + np.max(np.abs(plain.poles()), initial=0.0)) * np.exp(1j * np.array([0.3, 0.9, 1.3, 1.9])) / 3.0
        if self.ninputs == self.noutputs == 1:
            mine, theirs = self._values(s)[:, 0, 0], np.asarray(plain(s))
            theta = float(np.mean(np.log(np.abs(theirs / mine)) / s.real)) if np.all(mine) and np.all(theirs) else 0.0
            if np.max(np.abs(mine * np.exp(s * theta) / theirs - 1.0), initial=0.0) < SERIES:
                return np.asarray(plain.zeros(), dtype=complex)
        raise NotImplementedError("delays in several ways make infinitely many zeros")

    def without_delays(self) -> StateSpace:
        """Return the state space with every delay 0.

        Raises
        ------
        OptionError
            If delays stand in ways without a state that are singular without them.
        """
        (A, B, C, D), late = self.equations()
        if len(self.delays) and np.linalg.cond(np.eye(len(self.delays)) - late.H) > 1e12:
            raise OptionError(
                "found delays in a way without a state that has no unique solution without them; expected one.",
                block=self.name,
            )
        wx, wu = late.settle(late.Z), late.settle(late.F)
        return ss(A + late.G @ wx, B + late.G @ wu, C + late.E @ wx, D + late.E @ wu, 0)

    def pade(self, order: int = 5) -> StateSpace:
        """Return the rational model with each delay replaced by Padé's approximation of an order.

        Its phase is that of the delay up to about ω τ = order; `PadeDelay` has the realization.
        """
        matrices, late = self.equations()
        four = late.approximate(matrices, [order] * len(self.delays))
        labels = {"inputs": self.input_labels, "outputs": self.output_labels}
        made = ss(*four, 0, remove_useless_states=False, name=self.name, **labels)
        made.findings, made.notes, made.inexactness = self.findings, self.notes, self.inexactness
        return made

    def step_response(self, times: ArrayLike, entry: int = 0) -> np.ndarray:
        """Return the outputs after a unit step of one input from rest, by the method of steps; shape (times, outputs).

        Parameters
        ----------
        times : array_like
            Rising times in s, from 0 on.
        entry : int
            Number of the input.

        Raises
        ------
        ConfirmationError
            If the response needs too many elements.
        """
        return respond(*self.equations(), np.eye(self.ninputs)[entry], np.atleast_1d(np.asarray(times, dtype=float)))

    def equations(self) -> tuple[FourMatrices, LinearDelays]:
        """Return A, B, C and D without the delays, and the delays that are closed around them."""
        A, B, C, D = (np.asarray(getattr(self.rest, k), dtype=float) for k in "ABCD")
        return LinearDelays.split((A, B, C, D), self.delays, self.delay_names)

    # --- arithmetic ---------------------------------------------------------------------------------------------------

    def _made(self, rest: StateSpace, delays: np.ndarray, names: Sequence[str], **labels: Any) -> DelayedSystem:
        made = DelayedSystem(rest, delays, names, **labels)
        made.findings, made.notes, made.inexactness = self.findings, self.notes, self.inexactness
        return made

    def __neg__(self) -> DelayedSystem:
        """Return −system."""
        return self._scale(-np.eye(self.noutputs))

    def _scale(self, left: np.ndarray) -> DelayedSystem:
        """Return the system with its outputs multiplied by a matrix."""
        m, p = len(self.delays), self.noutputs
        K = np.eye(p + m)
        K[:p, :p] = left
        r = self.rest
        return self._made(ss(r.A, r.B, K @ r.C, K @ r.D, 0), self.delays, self.delay_names)

    def __add__(self, other: Any) -> DelayedSystem:
        """Return the sum with a system of the same size, or a number."""
        other = _as_delayed(other, self)
        p, q = self.noutputs, self.ninputs
        if (other.noutputs, other.ninputs) != (p, q):
            raise _size_error("+", self, other)
        return _join(self, other, np.zeros((2 * q, 2 * p)), np.vstack([np.eye(q)] * 2), np.hstack([np.eye(p)] * 2))

    __radd__ = __add__

    def __sub__(self, other: Any) -> DelayedSystem:
        """Return the difference to a system of the same size, or a number."""
        return self + -_as_delayed(other, self)

    def __rsub__(self, other: Any) -> DelayedSystem:
        """Return the difference of a system, or a number, to this."""
        return (-self).__add__(other)

    def __mul__(self, other: Any) -> DelayedSystem:
        """Return this system behind another one, or multiplied by a number."""
        if np.isscalar(other):
            return self._scale(float(np.real(other)) * np.eye(self.noutputs))
        other = _as_delayed(other, self)
        if self.ninputs != other.noutputs:
            raise _size_error("*", self, other)
        q1, q2, p1, p2 = self.ninputs, other.ninputs, self.noutputs, other.noutputs
        back = np.zeros((q1 + q2, p1 + p2))
        back[:q1, p1:] = np.eye(q1)
        return _join(self, other, back, np.eye(q1 + q2)[:, q1:], np.eye(p1 + p2)[:p1])

    def __rmul__(self, other: Any) -> DelayedSystem:
        """Return another system, or a number, behind this one."""
        if np.isscalar(other):
            return self * other
        return _as_delayed(other, self).__mul__(self)

    def __truediv__(self, other: Any) -> DelayedSystem:
        """Return the system divided by a number."""
        return self * (1.0 / float(other))

    def feedback(self, other: Any = 1, sign: float = -1) -> DelayedSystem:
        """Return the closed loop with another system, or a number, in the way back."""
        other = _as_delayed(other, self, square=False)
        p, q = self.noutputs, self.ninputs
        if (other.noutputs, other.ninputs) != (q, p):
            raise _size_error("feedback", self, other)
        back = np.zeros((q + p, p + q))
        back[:q, p:], back[q:, :p] = sign * np.eye(q), np.eye(p)
        return _join(self, other, back, np.eye(q + p)[:, :q], np.eye(p + q)[:p])

    def __getitem__(self, key: Any) -> DelayedSystem:
        """Return some outputs and inputs, as ``system[0, 1]``."""
        rows, columns = (
            np.atleast_1d(np.arange(size)[k]) for size, k in zip((self.noutputs, self.ninputs), key, strict=True)
        )
        p, q, m = self.noutputs, self.ninputs, len(self.delays)
        out, into = [*rows, *range(p, p + m)], [*columns, *range(q, q + m)]
        r = self.rest
        names = {"outputs": [self.output_labels[i] for i in rows], "inputs": [self.input_labels[i] for i in columns]}
        return self._made(
            ss(r.A, r.B[:, into], r.C[out], r.D[np.ix_(out, into)], 0), self.delays, self.delay_names, **names
        )

    def sample(self, *args: Any, **kwargs: Any) -> FrequencyResponseData:
        """Refuse to sample: a diagram with a sampled subsystem has the exact model.

        Raises
        ------
        OptionError
            Always.
        """
        raise OptionError(
            "found a system with delays, which is not sampled by itself; expected a diagram with a sampled subsystem, "
            "whose linear model is exact, or .pade(order).",
            block=self.name,
        )


def _size_error(what: str, a: DelayedSystem, b: DelayedSystem) -> OptionError:
    return OptionError(
        f"found systems of {a.noutputs} × {a.ninputs} and {b.noutputs} × {b.ninputs} for {what!r}; expected sizes that "
        "fit. Choose entries, as system[0, 0].",
        block=a.name,
    )


def _as_delayed(system: Any, like: DelayedSystem, *, square: bool = True) -> DelayedSystem:
    """Return a system, or a number on the diagonal of one of the size that fits, as a system with delays."""
    if isinstance(system, DelayedSystem):
        return system
    if np.isscalar(system):
        size = (like.noutputs, like.ninputs) if square else (like.ninputs, like.noutputs)
        return DelayedSystem(ss([], [], [], float(system) * np.eye(*size), 0), [])  # type: ignore[arg-type]
    if isinstance(system, StateSpace | TransferFunction):
        made = ss(system)
        return DelayedSystem(ss(made.A, made.B, made.C, made.D, 0 if made.dt is None else made.dt), [])
    raise OptionError(
        f"found {type(system).__name__}; expected a number, a control.StateSpace or control.TransferFunction in "
        "continuous time, or a system with delays.",
        block=like.name,
    )


def _join(a: DelayedSystem, b: DelayedSystem, back: np.ndarray, into: np.ndarray, out: np.ndarray) -> DelayedSystem:
    """Return two systems side by side, with u = back y + into r, and out y as outputs."""
    from scipy.linalg import block_diag

    (first, one), (second, two) = a.equations(), b.equations()
    A, B, C, D = (block_diag(*pair) for pair in zip(first, second, strict=True))
    G, Z, H, E, F = (block_diag(getattr(one, k), getattr(two, k)) for k in "GZHEF")
    if np.linalg.cond(np.eye(len(D)) - D @ back) > 1e12:
        raise OptionError(
            "found a loop without a state and without a unique solution; expected one. Look at D of both systems.",
            block=a.name,
        )
    both = LinearDelays((), np.concatenate([a.delays, b.delays]), G, Z, H, E, F)
    closed, late = both.feed_back((A, B, C, D), back, into, out)
    rest = ss(*late.join(closed), 0)
    names = [*a.delay_names, *b.delay_names]
    if len(set(names)) < len(names):
        names = []
    made = DelayedSystem(rest, both.times, names)
    made.findings = tuple(dict.fromkeys((*a.findings, *b.findings)))
    made.notes = tuple(dict.fromkeys((*a.notes, *b.notes)))
    made.inexactness = max(a.inexactness, b.inexactness)
    return made
