"""The controller of a contact at the ticks of a period: the signals that it holds in between are states of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..frequency import FourMatrices
from ..linearization import TickModel


class StateMatrices(NamedTuple):
    """State-space matrices; axes in front of the last two are those of a batch."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray


class ControllerTick(NamedTuple):
    """Controller at one tick of a period, and the time in s to the next one."""

    matrices: StateMatrices
    duration: float


def hold_signals(
    models: Sequence[TickModel],
    cut: Callable[[FourMatrices], StateMatrices],
    shown: int,
    felt_wire: int | None,
    *,
    inside: bool,
) -> tuple[ControllerTick, ...]:
    """Return the controllers of all ticks, with the signals that are held as states.

    ``felt_wire`` is the number of the injected wire of the measured force, None if nothing renews or holds it by
    itself. With ``inside`` the plant measures the force itself, and shows it at its communication points.
    """
    matrices = [cut(model.matrices) for model in models]
    many, entries = len(matrices[0].C), matrices[0].B.shape[1]
    renewed = []
    for model in models:
        felt = model.steps if inside else felt_wire is None or model.renews[felt_wire]
        renewed.append(np.array([model.steps] * shown + [felt] * (entries - shown)))
    held = [i for i in range(entries) if not all(r[i] for r in renewed)]
    keeps = [not model.steps for model in models]
    found = []
    for model, K, r, keep in zip(models, matrices, renewed, keeps, strict=True):
        found.append(ControllerTick(_hold(K, r, held, any(keeps), keep, many), model.duration))
    return tuple(found)


def _hold(
    K: StateMatrices, renewed: np.ndarray, held: list[int], has_kept: bool, keep: bool, many: int
) -> StateMatrices:
    """Return a controller with further states: held inputs, and the plant's inputs where it doesn't take new ones."""
    n, entries, kept = len(K.A), len(renewed), many if has_kept else 0
    now = np.diag(renewed.astype(float))  # the inputs as the controller sees them: now h + last held
    last = np.zeros((entries, len(held)))
    last[held, range(len(held))] = ~renewed[held]
    on_s = np.hstack([K.C, K.D @ last, np.zeros((many, kept))])
    on_h = K.D @ now
    if keep:
        on_s, on_h = np.hstack([np.zeros((many, n + len(held))), np.eye(many)]), np.zeros((many, entries))
    rows_s = [
        np.hstack([K.A, K.B @ last, np.zeros((n, kept))]),
        np.hstack([np.zeros((len(held), n)), last[held], np.zeros((len(held), kept))]),
    ]
    rows_h = [K.B @ now, now[held]]
    if has_kept:
        rows_s.append(on_s)
        rows_h.append(on_h)
    return StateMatrices(np.vstack(rows_s), np.vstack(rows_h), on_s, on_h)
