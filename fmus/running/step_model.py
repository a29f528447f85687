"""Linear models of an FMU's communication step, by differences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...blocks.core import FmuError, ParameterError
from ..calls import LoadedFmu
from .derivation import Derivation, DerivativeMethod
from .differences import Column, differentiate
from .fmu_point import FmuLinearization, FmuPoint, LinearizableFmu, initialize_at
from .restored_point import RestoredPoint

STEP = 1e-4
"""Relative distance of differences of steps, which an adaptive solver makes less smooth than equations."""


def step_difference(
    block: LinearizableFmu, h: float, t: float, state: Any, inputs: Any, relative_step: float
) -> FmuLinearization:
    """Linearize a communication step; see `Fmu.step_difference`."""
    for name, value in (("h", h), ("relative_step", relative_step)):
        if not 0 < value < np.inf:
            raise ParameterError(f"found {value!r}; expected a positive number.", block=block.label, port=name)
    point = FmuPoint(block, t, state, inputs)
    about = point.about
    for name in point.states:
        if about.find(name).initial != "exact":
            raise FmuError(
                "its state has no exact start value, and co-simulation allows to set it at the start only. Use "
                "linear_model() through model exchange, or identify it from a run.",
                block=block.label,
                port=name,
            )
    with initialize_at(point, exchange=False) as instance:
        return _linearize_step(point, instance, h, relative_step)


def _linearize_step(point: FmuPoint, instance: LoadedFmu, h: float, relative_step: float) -> FmuLinearization:
    about, known = point.about, [*point.states, *point.inputs]
    instance.begin()
    x, u = instance.values(point.states), instance.values(point.inputs)
    point.check(x)
    at = about.layout(known).split(np.concatenate([x, u]))

    def start_anew(set_before: Mapping[str, Any]) -> None:
        instance.reset()
        instance.initialize(None, start_time=point.t, values={**point.given, **at, **set_before})
        instance.begin()

    back = RestoredPoint(instance, [*known, *point.outputs], lambda: start_anew({}))
    back.save()

    def step_from_point(
        set_before: Mapping[str, Any], set_after: Mapping[str, Any], *, first: bool = False
    ) -> np.ndarray:
        """Take a step from the operating point; states are set by the initialization, inputs in Step Mode."""
        if set_before:
            back.free()
            start_anew(set_before)
        elif not first:
            back.go_back()
        instance.set_values(set_after)
        if instance.call(f"a step by {h:g} s", instance.fmi.do_step, point.t, h, not back.is_restored):
            raise FmuError(
                f"it ends its step from t = {point.t:.9g} s by {h:g} s early, or asks to end the simulation in it "
                "(terminateSimulation), so the step has no derivative. Take a smaller h, or another operating point.",
                block=point.block.label,
            )
        return instance.values([*point.states, *point.outputs])

    try:
        values = step_from_point({}, {}, first=True)
        moved_only = [*point.states, *point.moved]
        start = np.concatenate([np.ravel(at[name]) for name in moved_only]) if moved_only else np.zeros(0)
        column = Column(about, moved_only, start, relative_step)

        def evaluate(name: str, moved: np.ndarray) -> np.ndarray:
            change = {name: column.part(name, moved)}
            return step_from_point(change, {}) if name in point.states else step_from_point({}, change)

        found = differentiate(column, values, evaluate)
    finally:
        back.free()
    way = DerivativeMethod.STEP_DIFFERENCES
    coarseness = found.find_coarseness(point.smooth([*point.states, *point.outputs]))
    derivation = Derivation(way, restarted=back.lied, coarseness=coarseness)
    # a solver's error is relative to the largest values, whichever row it is in
    shared = np.finfo(float).eps * np.max(np.abs(values), initial=0.0) / (relative_step * found.sizes)
    J, uncertainty = point.widen(found.J), point.widen(found.error + shared)
    return point.model(J, x, u, values, h=h, derivation=derivation, uncertainty=uncertainty)


def find_step_gap(
    block: LinearizableFmu, h: float, t: float, state: Any, inputs: Any, A: np.ndarray, B: np.ndarray
) -> tuple[float, float]:
    """Return how far a step is from a linear model of it, in one random direction, and the error of that distance.

    Both are relative to the model's own motion. States that can't be set at the start are not moved.

    Parameters
    ----------
    h, t, state, inputs
        As of `Fmu.step_difference`.
    A, B : ndarray
        States after the step, by states before it and by inputs.

    Raises
    ------
    FmuError
        If the FMU can't take the steps.
    """
    point = FmuPoint(block, t, state, inputs)
    about = point.about
    with initialize_at(point, exchange=False) as instance:
        found, names = {}, [*point.states, *point.inputs]

        def step(moved: Mapping[str, Any]) -> np.ndarray:
            instance.reset()
            values = {n: v for n, v in {**point.given, **moved}.items() if about.find(n).initial == "exact"}
            instance.initialize(None, start_time=point.t, values=values)
            instance.begin()
            instance.call("setting its inputs", instance.set_values, {n: moved[n] for n in point.inputs if n in moved})
            if instance.call(f"a step by {h:g} s", instance.fmi.do_step, point.t, h, True):
                raise FmuError("it ends its step early, so the step has no derivative.", block=block.label)
            return instance.values(point.states)

        at = np.concatenate([instance.values(point.states), instance.values(point.inputs)])
        layout, rng = about.layout(names), np.random.default_rng(0)
        settable = {n for n in names if about.find(n).initial == "exact" and not about.find(n).is_integer}
        sizes = np.concatenate([np.ravel(about.find(n).nominals) * (n in settable or n in point.moved) for n in names])
        v = STEP * np.where(sizes > 0.0, np.maximum(np.abs(at), sizes), 0.0) * rng.choice([-1.0, 1.0], at.size)
        for k in (1, -1, 2, -2):
            moved = layout.split(at + k * v)
            found[k] = step({n: part for n, part in moved.items() if n in settable or n in point.moved})
    near, far = (found[1] - found[-1]) / 2, (found[2] - found[-2]) / 4
    slope, error = (4 * near - far) / 3, np.abs(near - far)
    predicted = np.hstack([A, B]) @ v
    size = float(np.max(np.abs(A) @ np.abs(v[: len(A)]) + np.abs(B) @ np.abs(v[len(A) :]), initial=0.0))
    error += 4.0 * np.finfo(float).eps * np.max(np.abs([found[1], found[2]]), axis=0)
    gap, own = (float(np.max(part, initial=0.0)) for part in (np.abs(slope - predicted), error))
    return (gap / size, own / size) if size else (0.0, 0.0)
