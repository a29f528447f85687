"""Linear models of an FMU at an operating point: of its equations, and of a communication step.

The equations are those of co-simulation at its start, or of model exchange; their derivatives are the FMU's own, held
against differences, or differences. A communication step has differences alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from ...blocks.core import FmuError, ParameterError, Wanted, accepts, kinds
from ...blocks.tracing import extrapolate
from ..archive import FmuVariable
from ..calls import FmuInstance, FmuSetup, ModelExchangeInstance, is_smooth
from .derivation import Derivation, DerivativeMethod
from .difference_quotients import Column, differentiate
from .equation_slopes import EQUATIONS, EquationSlopes, LocalEquations, real_elements
from .fmu_point import (
    FmuLinearization,
    FmuPoint,
    initialize_in_exchange,
    initialize_to_step,
    refuse_end,
    step_from,
    take_step,
)
from .restored_point import RestoredPoint

STEP = 1e-4
"""Relative distance of differences of steps, which an adaptive solver makes less smooth than equations."""


@accepts(
    "{setup.label}",
    ParameterError,
    interface=kinds.choice("model_exchange", "co_simulation")
    .or_none()
    .worded("'model_exchange', 'co_simulation' or None", "Give one."),
)
def linear_model(
    setup: FmuSetup, t: float, state: Any, inputs: Any, interface: str | None, exact: bool | None
) -> FmuLinearization:
    """Linearize an FMU's equations; see `Fmu.linear_model`."""
    point = FmuPoint(setup, t, state, inputs)
    about = point.about
    if not about.states:
        raise FmuError(
            "its model structure lists no derivatives of continuous states that are Float64 variables, so its "
            "equations can't be linearized. Use step_difference(), or identify it from a run.",
            block=setup.label,
        )
    derived_too = not point.sets_parameters  # the standard has directional derivatives by inputs and states alone
    settable = all(about.find(name).initial == "exact" for name in about.states)
    ways = (
        (True, True, derived_too and about.model_exchange_has_derivatives and about.model_exchange is not None),
        (False, True, derived_too and about.has_derivatives and settable),
        (True, False, about.model_exchange is not None),
        (False, False, settable),
    )
    for exchange, derived, possible in ways:
        if possible and exact in (None, derived) and interface in (None, _interface_name(exchange)):
            linearize = _linearize_in_exchange if exchange else _linearize_before_steps
            return linearize(point, derived=derived)
    raise FmuError(
        f"it can't be linearized in this way (interface={interface!r}, exact={exact!r}): it has "
        f"{'' if about.model_exchange else 'no '}model exchange, directional derivatives "
        f"{'there' if about.model_exchange_has_derivatives else 'not there'} and "
        f"{'in' if about.has_derivatives else 'not in'} co-simulation, and states that "
        f"{'can' if settable else 'cannot'} be set at the start. Leave out interface and exact.",
        block=setup.label,
    )


def _interface_name(exchange: bool) -> str:
    return "model_exchange" if exchange else "co_simulation"


def _linearize_in_exchange(point: FmuPoint, *, derived: bool) -> FmuLinearization:
    """Linearize by model exchange in Continuous-Time Mode; by discrete inputs and parameters in Event Mode."""
    with initialize_in_exchange(point) as instance:
        x = _enter_continuous_time(point, instance)
        u, wanted = instance.values(point.inputs), Wanted(tuple(point.setup.output_variables), rates=True)
        values = instance.compute(wanted, point.t, x, u)
        x = instance.values(point.states)  # some FMUs don't take states that are set
        point.check(x, exchange=True)
        slopes = EquationSlopes("model_exchange", has_own=derived, is_built_here=instance.is_built_here)
        equations = LocalEquations.in_exchange(instance, wanted, point.t, x, u)
        J, error = slopes.find(equations, lambda: instance.own_slopes(wanted, point.t, x, u), wanted)
        instance.compute(wanted, point.t, x, u)  # what follows is at the point, not where a difference has ended
        derivation = _find_event_columns(point, instance, slopes.derivation, instance.rows(wanted), J, error)
    rates = np.arange(values.size) >= values.size - x.size
    order = np.concatenate([np.flatnonzero(rates), np.flatnonzero(~rates)])
    return point.model(J[order], x, u, values[order], h=None, derivation=derivation, uncertainty=error[order])


def _enter_continuous_time(point: FmuPoint, instance: ModelExchangeInstance) -> np.ndarray:
    """Settle the events at the start; return the states, with those that initialization computes as they were given.

    They are those without an exact start value, and those that have lost theirs before any event (FMI 3.0, 3.2):
    initial equations of a model may override what its description calls exact, as in FMUs of OpenModelica.
    """
    instance.u = instance.values(point.inputs)
    instance.begin()
    computed = point.lost(instance.values(point.states))
    x = instance.settle()
    refuse_end(instance, point.t)
    where = point.about.layout(point.states).slices
    for name in point.states:
        if name in point.given and (name in computed or point.about.find(name).initial != "exact"):
            x[where[name]] = np.ravel(point.given[name])
    return x


def _find_event_columns(
    point: FmuPoint,
    instance: ModelExchangeInstance,
    derivation: Derivation,
    rows: Sequence[FmuVariable],
    J: np.ndarray,
    error: np.ndarray,
) -> Derivation:
    """Write slopes by inputs that only an event takes over (FMI 2.0, 3.2.3; FMI 3.0, 2.2.11); return their method.

    Discrete states stay: no round of the event iteration is taken before the values are read.
    """
    about, n = point.about, sum(point.about.find(name).size for name in point.states)
    where = about.layout(point.inputs).slices

    def evaluate(name: str, moved: np.ndarray) -> np.ndarray:
        with _event_mode(instance):
            before = instance.values([name])
            try:
                instance.set_values({name: moved})
                return _read(instance, rows)
            finally:
                instance.set_values({name: before})

    for name in point.moved:
        if is_smooth(about.find(name)):
            continue
        columns = slice(n + where[name].start, n + where[name].stop)
        known = np.zeros(len(J), dtype=bool)
        if derivation.method is DerivativeMethod.DIRECTIONAL:
            with _event_mode(instance):
                J[:, columns], known = instance.directional_slopes(rows, [(about.find(name), True)])
        if (others := real_elements(rows) & ~known).any():
            column, values = Column(about, [name], instance.values([name]), EQUATIONS), _read(instance, rows)
            made = differentiate(column, values, evaluate)
            J[others, columns], error[others, columns] = made.J[others], made.error[others]
            worst = max(derivation.coarseness, made.find_coarseness(others))
            derivation = replace(derivation, coarseness=worst)
    return derivation


def _read(instance: ModelExchangeInstance, rows: Sequence[FmuVariable]) -> np.ndarray:
    """Return the values of outputs and rates without setting anything.

    The FMU's function for derivatives is asked: their variables may be those of an earlier call.
    """
    about = instance.description
    order, n = np.array(about.state_order, dtype=int), about.layout(about.states).total
    instance.read_variables(rows)  # the order of questions holds for all FMUs: values, derivatives, values again
    if order.size != n:
        return instance.read_variables(rows)
    rates = instance.call("computing the derivatives", instance.fmi.state_derivatives, n)
    values = instance.read_variables(rows)
    values[len(values) - n + order] = rates
    return values


@contextmanager
def _event_mode(instance: ModelExchangeInstance) -> Iterator[None]:
    """Enter Event Mode, and leave it again."""
    instance.call("entering Event Mode", instance.fmi.enter_event_mode)
    yield
    instance.call("the events", instance.fmi.update_events)
    instance.call("entering Continuous-Time Mode", instance.fmi.enter_continuous_time_mode)


def _linearize_before_steps(point: FmuPoint, *, derived: bool) -> FmuLinearization:
    """Linearize by co-simulation: its own slopes in Step Mode, differences in Initialization Mode (FMI 3.0, 2.3.3)."""
    about = point.about
    with initialize_to_step(point) as instance:
        if derived:
            instance.begin()
        x, u = instance.values(point.states), instance.values(point.inputs)
        point.check(x, exchange=False)
        names = [*point.states, *point.inputs]
        rows = [about.find(name) for name in (*about.states.values(), *point.outputs)]
        layout = about.layout(names)
        moved = [(about.find(name), layout.slices[name]) for name in (*point.states, *point.moved)]
        near = _NearTheStart(point, instance, [v.name for v, _ in moved], np.concatenate([x, u]), rows)
        equations = LocalEquations(about, near.at, moved, near.evaluate, real_elements(rows))
        values = instance.read_variables(rows)
        slopes = EquationSlopes("co_simulation", has_own=derived, is_built_here=instance.is_built_here)
        knowns = [(about.find(name), name in near.names) for name in names]
        J, error = slopes.find(equations, lambda: instance.directional_slopes(rows, knowns), "linear model")
    return point.model(J, x, u, values, h=None, derivation=slopes.derivation, uncertainty=error)


class _NearTheStart:
    """Values of an FMU's equations with states and inputs moved in Initialization Mode, before its first step."""

    def __init__(
        self, point: FmuPoint, instance: FmuInstance, names: list[str], at: np.ndarray, rows: Sequence[FmuVariable]
    ):
        self.point, self.instance, self.names, self.at, self.rows = point, instance, names, at, rows
        self._layout = point.about.layout([*point.states, *point.inputs])
        self._set = self._layout.split(at)

    def evaluate(self, at: np.ndarray) -> np.ndarray:
        """Return the values of the rows; only what has changed is set."""
        if self.instance.is_running:  # it is in Step Mode
            self.instance.reset()
            self.point.initialize(self.instance)
        parts = self._layout.split(at)
        changed = {n: parts[n] for n in self.names if not np.array_equal(parts[n], self._set[n])}
        self.instance.call("setting its values", self.instance.set_values, changed)
        self._set = parts
        return self.instance.read_variables(self.rows)


# --- a communication step ---------------------------------------------------------------------------------------------


@accepts("{setup.label}", ParameterError, h=kinds.positive, relative_step=kinds.positive)
def step_difference(
    setup: FmuSetup, h: float, t: float, state: Any, inputs: Any, relative_step: float
) -> FmuLinearization:
    """Linearize a communication step; see `Fmu.step_difference`."""
    point = FmuPoint(setup, t, state, inputs)
    point.check_states("Use linear_model() through model exchange, or identify it from a run.")
    with initialize_to_step(point) as instance:
        return _linearize_step(point, instance, h, relative_step)


def _linearize_step(point: FmuPoint, instance: FmuInstance, h: float, relative_step: float) -> FmuLinearization:
    about, known = point.about, [*point.states, *point.inputs]
    instance.begin()
    x, u = instance.values(point.states), instance.values(point.inputs)
    point.check(x, exchange=instance.model_exchange)
    at = about.layout(known).split(np.concatenate([x, u]))

    def start_again(set_before: Mapping[str, Any]) -> None:
        instance.reset()
        instance.initialize(None, start_time=point.t, values={**point.given, **at, **set_before})
        instance.begin()

    back = RestoredPoint(instance, [*known, *point.outputs], lambda: start_again({}))
    back.save()

    def step_from_point(
        set_before: Mapping[str, Any], set_after: Mapping[str, Any], *, first: bool = False
    ) -> np.ndarray:
        """Take a step from the operating point; states are set by the initialization, inputs in Step Mode."""
        if set_before:
            back.free()
            start_again(set_before)
        elif not first:
            back.go_back()
        instance.set_values(set_after)
        refusal = (
            f"it ends its step from t = {point.t:.9g} s by {h:g} s early, or asks to end the simulation in it "
            "(terminateSimulation), so the step has no derivative. Take a smaller h, or another operating point."
        )
        take_step(instance, point.t, h, refusal)
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
    setup: FmuSetup, h: float, t: float, state: Any, inputs: Any, A: np.ndarray, B: np.ndarray
) -> tuple[float, float]:
    """Return how far a step is from a linear model of it, in one random direction, and the error of that distance.

    Both are relative to the model's own motion. States that can't be set at the start move as the FMU's initialization
    makes them: one may follow from those that are set. A and B are of the states after the step.
    """
    point = FmuPoint(setup, t, state, inputs)
    about = point.about
    with initialize_to_step(point) as instance:
        found, names = {}, [*point.states, *point.inputs]

        def step(moved: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
            """Return the states and inputs before a step, and the states after it."""
            before = step_from(point, instance, h, moved, "the step has no derivative")
            return before, instance.values(point.states)

        at = np.concatenate([instance.values(point.states), instance.values(point.inputs)])
        layout, rng = about.layout(names), np.random.default_rng(0)
        settable = {n for n in names if about.find(n).initial == "exact" and not about.find(n).is_integer}
        sizes = np.concatenate([np.ravel(about.find(n).nominals) * (n in settable or n in point.moved) for n in names])
        v = STEP * np.where(sizes > 0.0, np.maximum(np.abs(at), sizes), 0.0) * rng.choice([-1.0, 1.0], at.size)
        for k in (1, -1, 2, -2):
            moved = layout.split(at + k * v)
            found[k] = step({n: part for n, part in moved.items() if n in settable or n in point.moved})
    (moved_near, near), (moved_far, far) = (
        tuple((part - other) / (2 * k) for part, other in zip(found[k], found[-k], strict=True)) for k in (1, 2)
    )
    slope, error = extrapolate(near, far), np.abs(near - far)
    moved_by, both = extrapolate(moved_near, moved_far), np.hstack([A, B])
    predicted = both @ moved_by
    size = float(np.max(np.abs(both) @ np.abs(moved_by), initial=0.0))
    error += np.abs(both) @ np.abs(moved_near - moved_far)
    error += 4.0 * np.finfo(float).eps * np.max(np.abs([found[1][1], found[2][1]]), axis=0)
    gap, own = (float(np.max(part, initial=0.0)) for part in (np.abs(slope - predicted), error))
    return (gap / size, own / size) if size else (0.0, 0.0)
