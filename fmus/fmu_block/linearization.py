"""Linear models of an FMU at an operating point: of its equations, and of a communication step.

The equations are those of co-simulation at its start, or of model exchange; their derivatives are the FMU's own, held
against differences, or differences. A communication step has differences alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np

from ...blocks.core import FmuError, ParameterError, accepts, kinds
from ...blocks.tracing import extrapolate
from ..calls import FmuInstance, FmuSetup, LoadedFmu, order_questions
from .derivation import Derivation, DerivativeMethod
from .difference_quotients import Column, Differences, differentiate
from .fmu_point import FmuLinearization, FmuPoint, initialize_in_exchange, initialize_to_step, step_from, take_step
from .restored_point import RestoredPoint
from .slope_check import SlopeCheck, check_slopes

EQUATIONS = 1e-5
"""Relative distance of differences of equations."""
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
            with initialize_in_exchange(point) if exchange else initialize_to_step(point) as instance:
                return (
                    _linearize_by_directions(point, instance) if derived else _linearize_by_differences(point, instance)
                )
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


def _enter_continuous_time(point: FmuPoint, instance: LoadedFmu) -> None:
    """Settle the events at the start, then set the states that initialization computes (FMI 3.0, 3.2).

    They are those without an exact start value, and those that have lost theirs before any event: initial equations
    of a model may override what its description calls exact, as in FMUs of OpenModelica.
    """
    instance.begin()
    computed = point.lost(instance.values(point.states))
    found = instance.call("the events at the start", instance.fmi.iterate_events)
    if found.terminate:
        raise FmuError(
            f"the FMU asks to end the simulation (terminateSimulation) at t = {point.t:.9g} s, in an event there, so "
            "it has no linear model there. Choose another operating point.",
            block=point.setup.label,
        )
    if found.again:
        raise FmuError(
            "the events at the start don't settle in 100 rounds. Choose another operating point.",
            block=point.setup.label,
        )
    instance.call("entering Continuous-Time Mode", instance.fmi.enter_continuous_time_mode)
    guessed = [
        n for n in point.states if n in point.given and (n in computed or point.about.find(n).initial != "exact")
    ]
    if guessed:
        x = instance.values(point.states)
        where = point.about.layout(point.states).slices
        for name in guessed:
            x[where[name]] = np.ravel(point.given[name])
        _set_states(point, instance, x)


def _set_states(point: FmuPoint, instance: LoadedFmu, x: np.ndarray) -> None:
    """Set all continuous states in model exchange."""
    in_order = x[np.array(point.about.state_order, dtype=int)]
    instance.call("setting the continuous states", instance.fmi.set_continuous_states, in_order)


def _values(point: FmuPoint, instance: LoadedFmu) -> np.ndarray:
    """Return the derivatives of the states and the outputs.

    In model exchange the FMU's function for derivatives is asked: their variables may be those of an earlier call.
    """
    order = np.array(point.about.state_order, dtype=int)
    rates = [point.about.states[n] for n in point.states]
    if not instance.model_exchange or len(order) != point.about.layout(point.states).total:
        return instance.values([*rates, *point.outputs])
    found = {"rates": np.zeros(order.size)}

    def read() -> None:
        found["values"] = instance.values(point.outputs or rates)

    def derive() -> None:
        found["rates"][order] = instance.call("computing the derivatives", instance.fmi.state_derivatives, order.size)

    for ask in order_questions([read], [derive], [read]):
        ask()
    return np.concatenate([found["rates"], found["values"] if point.outputs else np.zeros(0)])


def _linearize_by_directions(point: FmuPoint, instance: LoadedFmu) -> FmuLinearization:
    """Linearize by directional derivatives in Continuous-Time or Step Mode, for discrete inputs in Event Mode."""
    if instance.model_exchange:
        _enter_continuous_time(point, instance)
    else:
        instance.begin()
    about = point.about
    x, u = instance.values(point.states), instance.values(point.inputs)
    point.check(x, exchange=instance.model_exchange)
    values = _values(point, instance)
    unknowns = [*(about.states[n] for n in point.states), *point.outputs]
    variables = [about.find(n) for n in unknowns]
    asked = [not v.is_integer and about.has_slopes(v) and about.find_state(v) is None for v in variables]
    smooth = [n for n, is_asked in zip(unknowns, asked, strict=True) if is_asked]
    found = []
    for name in (*point.states, *point.moved):
        with _mode_of(point, instance, name):
            size = about.find(name).size
            found += [instance.directional_derivative(smooth, [name], seed) for seed in np.eye(size).tolist()]
    sizes = [about.find(n).size for n in unknowns]
    rows = np.repeat(asked, sizes)
    part = np.zeros((values.size, len(found)))
    part[rows] = np.array(found).reshape(len(found), -1).T if found else 0.0
    derivation = Derivation(DerivativeMethod.DIRECTIONAL, _interface_name(instance.model_exchange))
    uncertainty = np.zeros(part.shape)
    if not instance.is_built_here:
        checked = _check(point, instance, part[rows], rows)
        part[rows], uncertainty[rows] = checked.J, checked.error
        derivation = checked.describe(derivation)
    others = point.smooth(unknowns) & ~rows
    first, where = 0, about.layout(point.states).slices
    for name, size in zip(unknowns, sizes, strict=True):
        state = about.find_state(about.find(name))
        if state is not None and others[first]:
            part[first : first + size, where[state]] = np.eye(size)
            others[first : first + size] = False
        first += size
    if others.any():  # local variables
        if not instance.model_exchange:
            _initialize_again(point, instance)
        found_too = _differences(point, instance, values)
        part[others], uncertainty[others] = found_too.J[others], found_too.error[others]
        derivation = replace(derivation, coarseness=found_too.find_coarseness(others))
    J = point.widen(part)
    return point.model(J, x, u, values, h=None, derivation=derivation, uncertainty=point.widen(uncertainty))


def _check(point: FmuPoint, instance: LoadedFmu, J: np.ndarray, rows: np.ndarray) -> SlopeCheck:
    """Hold directional derivatives against differences, in Continuous-Time Mode, or in Initialization Mode again.

    Discrete inputs of model exchange are left out: to move them is an event.
    """
    about, names = point.about, [*point.states, *point.moved]
    variables = [about.find(name) for name in names]
    moved = [
        np.full(v.size, not instance.model_exchange or v.name in point.states or v.variability == "continuous")
        for v in variables
    ]
    layout = about.layout(names)

    def values(moved: np.ndarray) -> np.ndarray:
        parts = layout.split(moved)
        if instance.model_exchange:
            _set_states(point, instance, moved[: sum(about.find(n).size for n in point.states)])
            parts = {n: part for n, part in parts.items() if about.find(n).variability == "continuous"}
            parts = {n: part for n, part in parts.items() if n in point.moved}
        instance.call("setting its values", instance.set_values, parts)
        return np.asarray(_values(point, instance)[rows])

    try:
        at = np.concatenate([instance.values(point.states), instance.values(point.moved)])
        if not instance.model_exchange:
            _initialize_again(point, instance)
    except FmuError:
        return SlopeCheck(J, np.full(J.shape, np.nan), np.nan, is_wrong=False)
    limits = [np.concatenate([np.ravel(v.limits[side]) for v in variables]) for side in (0, 1)]
    nominals = np.concatenate([np.ravel(v.nominals) for v in variables])
    found = check_slopes(J, values, at, nominals, (limits[0], limits[1]), np.concatenate(moved))
    with suppress(FmuError):
        values(at)  # further derivatives are those of the point, not of where the check has ended
    return found


def _initialize_again(point: FmuPoint, instance: LoadedFmu) -> None:
    """Go back to Initialization Mode at the operating point."""
    instance.reset()
    point.initialize(instance)


@contextmanager
def _mode_of(point: FmuPoint, instance: LoadedFmu, name: str) -> Iterator[None]:
    """Enter Event Mode for a discrete input or a parameter of model exchange, and leave it again.

    Clauses are FMI 2.0, 3.2.3, and FMI 3.0, 2.2.11.
    """
    discrete = instance.model_exchange and point.about.find(name).variability in ("discrete", "tunable")
    if discrete:
        instance.call("entering Event Mode", instance.fmi.enter_event_mode)
    yield
    if discrete:
        instance.call("the events", instance.fmi.update_events)
        instance.call("entering Continuous-Time Mode", instance.fmi.enter_continuous_time_mode)


def _linearize_by_differences(point: FmuPoint, instance: LoadedFmu) -> FmuLinearization:
    """Linearize by differences in Continuous-Time Mode or Initialization Mode (FMI 3.0, 3.2 and 2.3.3)."""
    if instance.model_exchange:
        _enter_continuous_time(point, instance)
    x, u = instance.values(point.states), instance.values(point.inputs)
    point.check(x, exchange=instance.model_exchange)
    values = _values(point, instance)
    made = _differences(point, instance, values)
    J, uncertainty = point.widen(made.J), point.widen(made.error)
    interface = _interface_name(instance.model_exchange)
    coarseness = made.find_coarseness(point.smooth([*point.states, *point.outputs]))
    derivation = Derivation(DerivativeMethod.DIFFERENCES, interface, coarseness=coarseness)
    return point.model(J, x, u, values, h=None, derivation=derivation, uncertainty=uncertainty)


def _differences(point: FmuPoint, instance: LoadedFmu, values: np.ndarray) -> Differences:
    """Return the derivatives of `_values` by states and inputs, by differences."""
    x = instance.values(point.states)
    at = np.concatenate([x, instance.values(point.moved)])
    column = Column(point.about, [*point.states, *point.moved], at, EQUATIONS)

    def move(name: str, to: np.ndarray) -> None:
        if instance.model_exchange and name in point.states:
            _set_states(point, instance, to[: x.size])
        else:
            instance.set_values({name: column.part(name, to)})

    def evaluate(name: str, moved: np.ndarray) -> np.ndarray:
        with _mode_of(point, instance, name):
            try:
                move(name, moved)
                return _values(point, instance)
            finally:
                move(name, column.at)

    return differentiate(column, values, evaluate)


# --- a communication step ---------------------------------------------------------------------------------------------


@accepts("{setup.label}", ParameterError, h=kinds.positive, relative_step=kinds.positive)
def step_difference(
    setup: FmuSetup, h: float, t: float, state: Any, inputs: Any, relative_step: float
) -> FmuLinearization:
    """Linearize a communication step; see `Fmu.step_difference`."""
    point = FmuPoint(setup, t, state, inputs)
    about = point.about
    for name in point.states:
        if about.find(name).initial != "exact":
            raise FmuError(
                "its state has no exact start value, and co-simulation allows to set it at the start only. Use "
                "linear_model() through model exchange, or identify it from a run.",
                block=setup.label,
                port=name,
            )
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
