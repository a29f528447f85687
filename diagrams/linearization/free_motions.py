"""Free motions of a diagram: integrators that nothing feeds back, and linear models without them.

The angle of a speed drive runs on, and its pole at 0 is no instability. A motion is free along an eigenvector v of the
eigenvalue 0, or of z = 1, if nothing notices a shift along it:

- v has no Jordan chain: an angle with its integral is a ramp;
- finite shifts along v, to both sides and of several sizes, change no derivative, no other next state, no indicator of
  an event, no wire on a loop of the port graph and no required signal. The diagram's own functions are evaluated at
  every tick of the period, and between the ticks. Their slopes may not change either: a loop that is stable at one
  angle alone is not stable at all of them. A wire on a loop may shift where it leads into a block with states that
  answers such a shift alike at every point (`absorbed_shifts`), as an encoder of which the speed is taken.

The linear model alone would not do: an actuator at its limit, a dead zone, x³ at 0 or stuck friction hide a feedback at
one point. An oscillation with the frequency 2π/T has z = 1 as well, but it changes derivatives between the ticks.

Free motions are deflated: in coordinates of which the first ones are along them, A is block triangular, and the rest is
the model of everything else. No pole is left out because it is near 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...blocks.core import enumerate_some, explain_calls
from .null_directions import deflate, find_null_space, find_null_spaces, find_scales, leave_out_chains, localize
from .shifted_diagram import ClosedModel, ShiftedDiagram

NOISE = 1e-12
"""Part of a signal, relative to that of all states in balanced units, that is rounding of a direction."""


@explain_calls
@dataclass(frozen=True)
class FreeMotion:
    """A motion that nothing in a diagram notices, such as that of an angle that nothing feeds back.

    Attributes
    ----------
    state : str
        The state that integrates, such as ``"motor.angle"``.
    entries : tuple of (str, float)
        All states that are shifted together, with their shares; that of ``state`` is 1.
    by_model_alone : tuple of str
        FMUs whose states can't be set to other values: the linear model alone says that the motion is free.
    """

    state: str
    entries: tuple[tuple[str, float], ...]
    by_model_alone: tuple[str, ...] = ()

    def __str__(self) -> str:
        text = f"{self.state} drifts: nothing feeds it back"
        if self.by_model_alone:
            who = enumerate_some(self.by_model_alone)
            text += f" (by the linear model alone: the states of {who} can't be shifted)"
        return text


@explain_calls
@dataclass(frozen=True, eq=False)
class FreeMotions:
    """The free motions of a linear model, and the model without them.

    Attributes
    ----------
    motions : tuple of FreeMotion
        The motions; none for a diagram whose eigenvalues at 0 are all noticed by something.
    V : ndarray, shape (n, m)
        Their directions in the model's states: A V = 0, or A V = V of a sampled model.
    Q : ndarray, shape (n, n − m)
        Coordinates of the rest: all states but one for each motion.
    P : ndarray, shape (n − m, n)
        Inverse of Q on the rest: P Q = 1 and P V = 0.
    """

    motions: tuple[FreeMotion, ...]
    V: np.ndarray = field(repr=False)
    Q: np.ndarray = field(repr=False)
    P: np.ndarray = field(repr=False)

    @classmethod
    def none(cls, n: int) -> FreeMotions:
        """Return no free motions of a model with n states."""
        return cls((), np.zeros((n, 0)), np.eye(n), np.eye(n))

    def __bool__(self) -> bool:
        return bool(self.motions)

    def reduce(self, A: np.ndarray) -> np.ndarray:
        """Return a model's A without the free motions: its eigenvalues are those of A, less one 0 for each of them."""
        return np.asarray(self.P @ A @ self.Q) if self.motions else A

    def reduce_inputs(self, B: np.ndarray) -> np.ndarray:
        """Return B of the reduced model."""
        return np.asarray(self.P @ B) if self.motions else B

    def reduce_outputs(self, C: np.ndarray) -> np.ndarray:
        """Return C of the reduced model, for outputs that don't see the free motions (C V = 0)."""
        return np.asarray(C @ self.Q) if self.motions else C


def find_free_motions(model: ClosedModel, required: Iterable[str] = ()) -> FreeMotions:
    """Return the free motions of a linear model: they change no wire or port on which something is required."""
    none = FreeMotions.none(len(model.A))
    kept = [i for i, name in enumerate(model.states) if name not in model.memory]
    A = model.A[np.ix_(kept, kept)]
    M = A - np.eye(len(A)) if model.dt else A
    uncertainty = 0.0 if np.isnan(model.uncertainty) else model.uncertainty
    right, left, rest = find_null_spaces(M, uncertainty)
    if not right.shape[1]:
        return none
    if model.delays is not None:  # a Jordan chain may go through a delay
        late = model.delays
        left = find_null_spaces(M + late.G[kept] @ late.settle(late.Z[:, kept]), uncertainty)[1]
    noise = max(NOISE, 100.0 * uncertainty / (float(np.max(np.abs(A))) or 1.0))
    shifted = ShiftedDiagram.of(model, required, kept, noise)
    V = localize(right, M, rest)
    V = localize(V @ find_null_space(shifted.seen(V, find_scales(M))), M, rest)
    found: list[tuple[np.ndarray, tuple[str, ...]]] = []
    for v in V.T:
        holds, alone = shifted.holds(v)
        if holds:
            found.append((v, alone))
    if len(found) > 1:  # two motions may act together: on a product of two angles, say
        weights = np.random.default_rng(0).uniform(0.5, 1.5, len(found))
        if not shifted.holds(np.column_stack([v for v, _ in found]) @ weights)[0]:
            return none
    found = leave_out_chains(found, left, find_scales(M))
    if not found:
        return none
    V = np.column_stack([v for v, _ in found])
    names, flat = [model.states[i] for i in kept], shifted.flat
    sampled = {label for i, label in enumerate(flat.states.labels) if i not in flat.continuous}
    follows = np.array([name in sampled for name in names])
    motions = tuple(_describe(v, left, names, follows, alone) for v, alone in found)
    Q, P = deflate(M, V)
    return FreeMotions(motions, *(_spread(X, kept, model, axis) for X, axis in ((V, 0), (Q, 0), (P, 1))))


def _spread(X: np.ndarray, kept: list[int], model: ClosedModel, axis: int) -> np.ndarray:
    """Return a matrix for all states of a model from one for those that are no memory."""
    n = len(model.states)
    if axis:
        return _spread(X.T, kept, model, 0).T
    whole = np.zeros((n, X.shape[1]))
    whole[kept] = X
    return whole


def _describe(
    v: np.ndarray, left: np.ndarray, names: Sequence[str], follows: np.ndarray, alone: tuple[str, ...]
) -> FreeMotion:
    """Return a motion with its states: the one that integrates has the largest participation.

    States of sampled blocks (``follows``), such as the last angle of an encoder, name it only without others.
    """
    weight = np.abs(v) * np.linalg.norm(left, axis=1)
    if np.any(weight[~follows]):
        weight[follows] = 0.0
    first = int(np.argmax(weight >= 0.5 * np.max(weight)))
    shares = v / v[first]
    entries = tuple((names[int(i)], float(shares[i])) for i in np.flatnonzero(v))
    return FreeMotion(names[first], tuple(sorted(entries, key=lambda e: e[0] != names[first])), alone)
