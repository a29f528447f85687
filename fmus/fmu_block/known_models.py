"""Linear models of FMUs that are known: each point of an FMU is linearized once, however many loops are looked at."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import fields
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from ...blocks.core import identity
from .fmu import Fmu, setup_of
from .fmu_point import FmuLinearization
from .linearization import find_step_gap

MOST = 512
"""Models, and gaps, that are kept at a time."""
_MODELS: OrderedDict[Hashable, FmuLinearization] = OrderedDict()
_GAPS: OrderedDict[Hashable, tuple[float, float]] = OrderedDict()
_LOCK = Lock()
R = TypeVar("R")


def _recall(known: OrderedDict[Hashable, R], key: Hashable, make: Callable[[], R]) -> R:
    """Return what is known under a key, or make it; the one that was asked for longest ago is forgotten first."""
    with _LOCK:
        if key in known:
            known.move_to_end(key)
            return known[key]
    found = make()  # without the lock: two threads may make the same, and neither waits for the other's FMU
    with _LOCK:
        known[key] = found
        while len(known) > MOST:
            known.popitem(last=False)
    return found


def step_gap(
    block: Fmu, *, t: float, state: Mapping[str, Any], inputs: Mapping[str, Any], h: float, A: np.ndarray, B: np.ndarray
) -> tuple[float, float]:
    """Return how far a step of an FMU is from a linear model of it, and the error of that; see `find_step_gap`."""
    key = identity(block), t, identity(state), identity(inputs), h, A.tobytes(), B.tobytes()
    return _recall(_GAPS, key, lambda: find_step_gap(setup_of(block), h, t, state, inputs, A, B))


def linearize_fmu(
    block: Fmu, *, t: float, state: Mapping[str, Any], inputs: Mapping[str, Any], h: float | None = None
) -> FmuLinearization:
    """Return the linear model of an FMU's equations at a point, or of a step of the length ``h`` in s.

    Errors are those of `Fmu.linear_model` and `Fmu.step_difference`; they are not kept. The arrays of a model can't be
    written, as others get it, too.
    """
    _ = block.description  # an FMU whose file has changed is refused
    made_by = (type(block).linear_model, type(block).step_difference)  # a class of users' may have its own

    def make() -> FmuLinearization:
        if h is None:
            found = block.linear_model(t=t, state=state, inputs=inputs)
        else:
            found = block.step_difference(h, t=t, state=state, inputs=inputs)
        for value in (getattr(found, f.name) for f in fields(found)):
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
        return found

    return _recall(_MODELS, (made_by, identity(block), t, identity(state), identity(inputs), h), make)
