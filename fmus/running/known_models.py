"""Linear models of FMUs that are known: each point of an FMU is linearized once, however many loops are looked at."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import fields
from threading import Lock
from typing import Any

import numpy as np

from ...blocks.core import identity
from .fmu import Fmu
from .fmu_point import FmuLinearization
from .linearization import find_step_gap

MOST = 512
"""Models that are kept at a time."""
_KNOWN: OrderedDict[Any, FmuLinearization] = OrderedDict()
_LOCK = Lock()


_GAPS: OrderedDict[Any, tuple[float, float]] = OrderedDict()


def step_gap(
    block: Fmu, *, t: float, state: Mapping[str, Any], inputs: Mapping[str, Any], h: float, A: np.ndarray, B: np.ndarray
) -> tuple[float, float]:
    """Return how far a step of an FMU is from a linear model of it, and the error of that; see `find_step_gap`."""
    key = identity(block), t, identity(state), identity(inputs), h, A.tobytes(), B.tobytes()
    with _LOCK:
        if key in _GAPS:
            return _GAPS[key]
    found = find_step_gap(block, h, t, state, inputs, A, B)
    with _LOCK:
        _GAPS[key] = found
        while len(_GAPS) > MOST:
            _GAPS.popitem(last=False)
    return found


def linearize_fmu(
    block: Fmu, *, t: float, state: Mapping[str, Any], inputs: Mapping[str, Any], h: float | None = None
) -> FmuLinearization:
    """Return the linear model of an FMU's equations at a point, or of a step of the length ``h`` in s.

    Errors are those of `Fmu.linear_model` and `Fmu.step_difference`; they are not kept. The arrays of a model can't be
    written, as others get it, too.
    """
    _ = block.description  # an FMU whose file has changed is refused
    made_by = (type(block).linear_model, type(block).step_difference)  # a class of users' may have its own
    key = made_by, identity(block), t, identity(state), identity(inputs), h
    with _LOCK:
        found = _KNOWN.get(key)
        if found is not None:
            _KNOWN.move_to_end(key)
            return found
    if h is None:
        found = block.linear_model(t=t, state=state, inputs=inputs)
    else:
        found = block.step_difference(h, t=t, state=state, inputs=inputs)
    for value in (getattr(found, f.name) for f in fields(found)):
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
    with _LOCK:
        _KNOWN[key] = found
        while len(_KNOWN) > MOST:
            _KNOWN.popitem(last=False)
    return found
