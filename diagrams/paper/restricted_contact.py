"""Contacts whose forces and motions are along some axes alone: one direction of a robot whose directions are apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..contact import ContactParts, StateMatrices

_NOTHING = 1e-12
"""Size of an entry, relative to others of its row and column, that is rounding."""


def restrict(parts: ContactParts, axes: np.ndarray) -> ContactParts:
    """Return the parts of a contact in one rate with forces and motions along some axes alone.

    States and signals are left out that forces along these axes don't reach, or that don't move the contact along them.
    """
    P, K, many = parts.plant, parts.controller, len(parts.plant.C)
    felt = many + axes
    # signals in one row: states x, inputs u and outputs y of the plant, states k of the controller, forces f
    sizes = {"x": len(P.A), "u": P.B.shape[1], "y": many, "k": len(K.A), "f": len(axes)}
    ends = np.cumsum(list(sizes.values()))
    place = {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends.tolist(), strict=True)}
    leads = np.zeros((ends[-1], ends[-1]), dtype=bool)
    for ways, M in {
        "x from x": P.A,
        "x from u": P.B,
        "x from f": parts.force[:, axes],
        "y from x": P.C,
        "y from u": P.D,
        "y from f": parts.force_shown[:, axes],
        "k from k": K.A,
        "k from y": K.B[:, :many],
        "k from f": K.B[:, felt],
        "u from k": K.C,
        "u from y": K.D[:, :many],
        "u from f": K.D[:, felt],
        # the environment answers a motion by its force
        "f from x": np.abs(parts.position[axes]) + np.abs(parts.velocity[axes]),
    }.items():
        leads[place[ways[0]], place[ways[-1]]] = _acts(M)
    forces = np.arange(ends[-1]) >= place["f"].start
    kept = _reach(leads, forces) & _reach(leads.T, forces)
    x, u, y, k = (np.flatnonzero(kept[place[name]]) for name in "xuyk")
    into = np.concatenate([y, felt])

    def cut(M: StateMatrices) -> StateMatrices:
        return StateMatrices(M.A[np.ix_(x, x)], M.B[np.ix_(x, u)], M.C[np.ix_(y, x)], M.D[np.ix_(y, u)])

    errors, of_contact = parts.errors
    return replace(
        parts,
        plant=cut(P),
        force=parts.force[np.ix_(x, axes)],
        force_shown=parts.force_shown[np.ix_(y, axes)],
        position=parts.position[np.ix_(axes, x)],
        velocity=parts.velocity[np.ix_(axes, x)],
        controller=StateMatrices(K.A[np.ix_(k, k)], K.B[np.ix_(k, into)], K.C[np.ix_(u, k)], K.D[np.ix_(u, into)]),
        errors=(
            cut(errors),
            StateMatrices(
                of_contact.A[np.ix_(x, x)], of_contact.B[np.ix_(x, axes)], *(M[np.ix_(axes, x)] for M in of_contact[2:])
            ),
        ),
        states=(tuple(parts.states[0][i] for i in x), tuple(parts.states[1][i] for i in k)),
    )


def _acts(M: np.ndarray) -> np.ndarray:
    """Return which entries are more than rounding compared with the largest of their row or column."""
    size = np.abs(M)
    largest = np.maximum(size.max(axis=1, initial=0.0)[:, None], size.max(axis=0, initial=0.0))
    return np.asarray(size > _NOTHING * largest)


def _reach(leads: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the entries that a start leads to, itself too; ``leads[i, j]`` is a way from j to i."""
    found, before = start, np.zeros_like(start)
    while (found != before).any():
        found, before = found | leads[:, found].any(axis=1), found
    return found
