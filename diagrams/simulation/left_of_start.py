"""The instant before t = 0: sources that jump there have their values from the left.

A jump of a source at t = 0 is then a jump as at any later time: a derivative answers it, an edge of it counts.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ...blocks.core import Block
from ..flat import NONE, evaluate, evaluate_apart, indicators_of
from .workspace import Workspace

_BEFORE_START = -1e-300  # s; nearer to 0 than any time of a source that is not 0

Taps = dict[tuple[str, str], Callable[[Any], Any]]


def values_from_left(workspace: Workspace) -> Taps:
    """Return, as the taps of `evaluate`, the values just before t = 0 of the sources that announce an instant there."""
    flat = workspace.flat
    early = {
        path for path, block in flat.table.blocks.items() if path in flat.checked.traced and _jumps_at_start(block)
    }
    if not early:
        return {}
    here, apart = workspace.here, evaluate_apart(workspace.evaluators)
    order = [step for step in flat.start_order.steps if step[0] in early]
    found = evaluate(
        flat, flat.blocks, NONE, _BEFORE_START, here.x, here.w, here.p, opened=True, apart=apart, order=order
    )
    taps: Taps = {}
    for port, column in found.values.items():
        left = np.ravel(np.array(column, dtype=float))
        if port[0] in early and np.all(np.isfinite(left)):  # else it is not defined before t = 0, and begins there
            taps[port] = partial(_replace, left)
    return taps


def _replace(value: np.ndarray, _: Any) -> np.ndarray:
    return value


def _jumps_at_start(block: Block) -> bool:
    """Whether a block without inputs announces an instant at t = 0."""
    if block.inputs or type(block).next_instant is Block.next_instant:
        return False
    try:
        return block.next_instant(_BEFORE_START) == 0.0
    except Exception:  # it is not defined before t = 0; the run itself tells of one that fails after it
        return False


def domains_from_left(workspace: Workspace, domains: np.ndarray) -> np.ndarray:
    """Return the domains of the indicators of all events just before t = 0: 1 above 0, −1 below, 0 on the border.

    Parameters
    ----------
    domains : ndarray of int
        Those at t = 0: the answer for those that no jump of a source changes.
    """
    taps = values_from_left(workspace)
    if not taps:
        return domains
    flat, here, apart = workspace.flat, workspace.here, evaluate_apart(workspace.evaluators)

    def at(taps: Taps) -> np.ndarray:
        instant = evaluate(flat, flat.blocks, NONE, 0.0, here.x, here.w, here.p, apart=apart, taps=taps)
        return np.array([float(np.ravel(np.array(g))[0]) for g in indicators_of(instant)[0]])

    left, right = at(taps), at({})
    return np.where((left == right) | ~np.isfinite(left), domains, np.where(left > 0.0, 1, -1))
