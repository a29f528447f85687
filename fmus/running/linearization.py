"""Linear models of an FMU at an operating point: of its equations, and of a communication step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ...blocks.core import FmuError, Layout, ParameterError, UnknownNameError, brief, elements, near
from ..archive import FmuDescription
from ..calls import FmuBlock, LoadedFmu
from ..isolation import open_fmu
from .derivation import Derivation, DerivativeMethod
from .differences import Column, differentiate
from .restored_point import RestoredPoint
from .start_values import check_state

EQUATIONS, STEP = 1e-5, 1e-4
"""Relative distances of differences: of equations, and of steps, which an adaptive solver makes less smooth."""


@dataclass(frozen=True, eq=False)
class FmuLinearization:
    """Linear model of an FMU about an operating point (x0, u0) at the time t.

    Ports of integers, Booleans and enumerations have no derivatives: their rows and columns are zero.

    For the equations dx/dt = f + A (x − x0) + B (u − u0). For a step of length h with held inputs, the states after it
    are f + A (x − x0) + B (u − u0). In both cases y = y0 + C (x − x0) + D (u − u0), for a step after it. At an
    equilibrium f is zero, or x0 for a step.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    states: tuple[str, ...]
    """Names of the states' elements, such as ``position[1]``."""
    inputs: tuple[str, ...]
    """Names of the elements of the input ports."""
    outputs: tuple[str, ...]
    """Names of the elements of the output ports."""
    t: float
    h: float | None
    """Length of the step in s; None for a model of the equations."""
    x0: np.ndarray
    u0: np.ndarray
    f: np.ndarray
    y0: np.ndarray
    derivation: Derivation
    """Method by which the derivatives were computed."""
    uncertainty: np.ndarray
    """Estimated error of each entry of [[A, B], [C, D]]; zero if the FMU computed the derivatives."""

    def __repr__(self) -> str:
        facts = f"{len(self.states)} states", f"{len(self.inputs)} inputs", f"{len(self.outputs)} outputs", self.how
        return brief(f"linear model of an FMU at t = {self.t:.9g} s", *facts, then=".A, .B, .C, .D, .uncertainty")

    @property
    def how(self) -> str:
        """Text of `derivation`, such as ``"differences of steps"``."""
        return str(self.derivation)


class LinearizableFmu(FmuBlock, Protocol):
    """Members of an FMU's block that its linear model needs."""

    def start_value(self, description: FmuDescription, name: str, value: Any) -> Any:
        """Return a start value in the variable's shape, after checking it."""


class _OperatingPoint:
    """An operating point, as values of the FMU's variables."""

    def __init__(self, block: LinearizableFmu, t: float, state: Any, inputs: Any):
        self.block, self.about, self.t = block, block.description, float(t)
        about = self.about
        self.states = list(about.states)
        self.port_of = {v.name: port for port, v in {**block.input_variables, **block.output_variables}.items()}
        self.inputs, self.outputs = (
            [v.name for v in chosen.values()] for chosen in (block.input_variables, block.output_variables)
        )
        self.moved = [n for n in self.inputs if not about.find(n).is_integer]
        self.sets_parameters = any(about.find(n).causality == "parameter" for n in self.inputs)
        if not np.isfinite(self.t):
            raise ParameterError(f"found {t!r}; expected a time in s.", block=block.label, port="t")
        ports = {self.port_of[name]: name for name in self.inputs}
        given_state = self._match_names(
            state, {name: name for name in self.states}, "state", block.description.discrete_states
        )
        given_inputs = self._match_names(inputs, ports, "inputs", ())
        # model exchange sets states that have no start value of their own, as those that other tools compute
        self.given = {
            n: check_state(about.find(n), v, block.label)
            if n in about.states and about.find(n).start is None
            else block.start_value(about, n, v)
            for n, v in {**given_state, **given_inputs}.items()
        }

    def _match_names(self, given: Any, names: Mapping[str, str], port: str, more: tuple[str, ...]) -> dict[str, Any]:
        if given is None:
            return {}
        if isinstance(given, Mapping):
            known = {**names, **{name: name for name in more}}
            for name in given:
                if name not in known:
                    raise UnknownNameError(f"found {name!r}. {near(name, known)}", block=self.block.label, port=port)
            return {known[name]: value for name, value in given.items()}
        vector, variables = np.ravel(np.asarray(given, dtype=float)), [self.about.find(n) for n in names.values()]
        sizes = [v.size for v in variables]
        if vector.size != sum(sizes):
            raise ParameterError(
                f"found {vector.size} numbers; expected {sum(sizes)}, the elements of {', '.join(names) or 'nothing'}.",
                block=self.block.label,
                port=port,
            )
        return Layout.of({v.name: v.shape for v in variables}).split(vector)

    def check(self, found: np.ndarray) -> None:
        """Refuse an operating point that the FMU does not accept."""
        for name, part in self.about.layout(self.states).split(found).items():
            if name in self.given and not np.allclose(part, self.given[name], rtol=1e-9, atol=0.0):
                raise FmuError(
                    f"its state was set to {self.given[name].tolist()}, but is {np.ravel(part).tolist()} when the FMU "
                    f"has initialized at t = {self.t:.9g} s: an event there changes it, or its start value is only a "
                    "guess. Choose a point that is not on an event.",
                    block=self.block.label,
                    port=name,
                )

    def elements(self, names: list[str], *, ports: bool = False) -> tuple[str, ...]:
        """Return the names of all elements of variables."""
        shapes = ((self.port_of[n] if ports else n, self.about.find(n).shape) for n in names)
        return tuple(label for name, shape in shapes for label in elements(name, shape))

    def widen(self, J: np.ndarray) -> np.ndarray:
        """Return the matrix for all ports: rows and columns of integers are zero, as they have no derivatives."""
        columns, rows = self.smooth([*self.states, *self.inputs]), self.smooth([*self.states, *self.outputs])
        found = np.zeros((len(rows), len(columns)))
        found[:, columns] = J
        found[~rows] = 0.0
        return found

    def smooth(self, names: list[str]) -> np.ndarray:
        """Return which elements of variables are real numbers."""
        kinds = [np.full(v.size, not v.is_integer) for v in map(self.about.find, names)]
        return np.concatenate(kinds) if kinds else np.zeros(0, dtype=bool)

    def model(self, J: np.ndarray, x: np.ndarray, u: np.ndarray, values: np.ndarray, **more: Any) -> FmuLinearization:
        """Return the linear model with this matrix [[A, B], [C, D]]."""
        n = x.size
        inputs, outputs = (self.elements(names, ports=True) for names in (self.inputs, self.outputs))
        return FmuLinearization(
            J[:n, :n], J[:n, n:], J[n:, :n], J[n:, n:], self.elements(self.states), inputs, outputs, self.t,
            x0=x, u0=u, f=values[:n], y0=values[n:], **more,
        )  # fmt: skip


# ---- of the equations ----


def linear_model(
    block: LinearizableFmu, t: float, state: Any, inputs: Any, interface: str | None, exact: bool | None
) -> FmuLinearization:
    """Linearize an FMU's equations; see `Fmu.linear_model`."""
    if interface not in (None, "model_exchange", "co_simulation"):
        raise ParameterError(
            f"found {interface!r}; expected 'model_exchange', 'co_simulation' or None.",
            block=block.label,
            port="interface",
        )
    point = _OperatingPoint(block, t, state, inputs)
    about = point.about
    if not about.states:
        raise FmuError(
            "its model structure lists no derivatives of continuous states that are Float64 variables, so its "
            "equations can't be linearized. Use step_difference(), or identify it from a run.",
            block=block.label,
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
            with _initialize(point, exchange) as instance:
                return (
                    _linearize_by_directions(point, instance) if derived else _linearize_by_differences(point, instance)
                )
    raise FmuError(
        f"it can't be linearized in this way (interface={interface!r}, exact={exact!r}): it has "
        f"{'' if about.model_exchange else 'no '}model exchange, directional derivatives "
        f"{'there' if about.model_exchange_has_derivatives else 'not there'} and "
        f"{'in' if about.has_derivatives else 'not in'} co-simulation, and states that "
        f"{'can' if settable else 'cannot'} be set at the start. Leave out interface and exact.",
        block=block.label,
    )


def _interface_name(exchange: bool) -> str:
    return "model_exchange" if exchange else "co_simulation"


@contextmanager
def _initialize(point: _OperatingPoint, exchange: bool) -> Iterator[LoadedFmu]:
    """Load the FMU and enter Initialization Mode at the operating point."""
    instance = open_fmu(LoadedFmu, point.block, model_exchange=exchange)
    try:
        exact = {n: v for n, v in point.given.items() if point.about.find(n).initial == "exact"}
        instance.initialize(None, start_time=point.t, values=exact)
        yield instance
    finally:
        instance.close()


def _enter_continuous_time(point: _OperatingPoint, instance: LoadedFmu) -> None:
    """Settle the events at the start, then set the states without an exact start value (FMI 3.0, 3.2)."""
    instance.begin()
    for _ in range(100):
        found = instance.call("the events at the start", instance.fmi.update_events)
        if found.terminate:
            raise _end_error(point, "in an event there")
        if not found.again:
            break
    else:
        raise FmuError(
            "the events at the start don't settle in 100 rounds. Choose another operating point.",
            block=point.block.label,
        )
    instance.call("entering Continuous-Time Mode", instance.fmi.enter_continuous_time_mode)
    guessed = [n for n in point.states if n in point.given and point.about.find(n).initial != "exact"]
    if guessed:
        x = instance.values(point.states)
        where = point.about.layout(point.states).slices
        for name in guessed:
            x[where[name]] = np.ravel(point.given[name])
        instance.set_continuous_states(x)


def _end_error(point: _OperatingPoint, place: str) -> FmuError:
    return FmuError(
        f"the FMU asks to end the simulation (terminateSimulation) at t = {point.t:.9g} s, {place}, so it has no "
        "linear model there. Choose another operating point.",
        block=point.block.label,
    )


def _values(point: _OperatingPoint, instance: LoadedFmu) -> np.ndarray:
    return instance.values([*(point.about.states[n] for n in point.states), *point.outputs])


def _linearize_by_directions(point: _OperatingPoint, instance: LoadedFmu) -> FmuLinearization:
    """Linearize by directional derivatives in Continuous-Time or Step Mode, for discrete inputs in Event Mode."""
    if instance.model_exchange:
        _enter_continuous_time(point, instance)
    else:
        instance.begin()
    about = point.about
    x, u = instance.values(point.states), instance.values(point.inputs)
    point.check(x)
    values = _values(point, instance)
    unknowns = [*(about.states[n] for n in point.states), *point.outputs]
    smooth = [n for n in unknowns if not about.find(n).is_integer]
    found = []
    for name in (*point.states, *point.moved):
        with _mode_of(point, instance, name):
            size = about.find(name).size
            found += [instance.directional_derivative(smooth, [name], seed) for seed in np.eye(size).tolist()]
    part = np.zeros((values.size, len(found)))
    part[point.smooth(unknowns)] = np.array(found).reshape(len(found), -1).T if found else 0.0
    J = point.widen(part)
    derivation = Derivation(DerivativeMethod.DIRECTIONAL, _interface_name(instance.model_exchange))
    return point.model(J, x, u, values, h=None, derivation=derivation, uncertainty=np.zeros(J.shape))


@contextmanager
def _mode_of(point: _OperatingPoint, instance: LoadedFmu, name: str) -> Iterator[None]:
    """Enter Event Mode for a discrete input or a parameter of model exchange, and leave it again.

    Clauses are FMI 2.0, 3.2.3, and FMI 3.0, 2.2.11.
    """
    discrete = instance.model_exchange and point.about.find(name).variability in ("discrete", "tunable")
    if discrete:
        instance.call("entering Event Mode", instance.fmi.enter_event_mode)
    yield
    if discrete:
        instance.call("the events", instance.fmi.update_discrete_states)
        instance.call("entering Continuous-Time Mode", instance.fmi.enter_continuous_time_mode)


def _linearize_by_differences(point: _OperatingPoint, instance: LoadedFmu) -> FmuLinearization:
    """Linearize by differences in Continuous-Time Mode or Initialization Mode (FMI 3.0, 3.2 and 2.3.3)."""
    if instance.model_exchange:
        _enter_continuous_time(point, instance)
    x, u = instance.values(point.states), instance.values(point.inputs)
    point.check(x)
    values = _values(point, instance)
    at = np.concatenate([x, instance.values(point.moved)])
    column = Column(point.about, [*point.states, *point.moved], at, EQUATIONS)

    def evaluate(name: str, moved: np.ndarray) -> np.ndarray:
        with _mode_of(point, instance, name):
            if instance.model_exchange and name in point.states:
                instance.set_continuous_states(moved[: x.size])
            else:
                instance.set_values({name: column.part(name, moved)})
            found = _values(point, instance)
            if instance.model_exchange and name in point.states:
                instance.set_continuous_states(x)
            else:
                instance.set_values({name: column.part(name, column.at)})
        return found

    J, uncertainty = map(point.widen, differentiate(column, values, evaluate))
    derivation = Derivation(DerivativeMethod.DIFFERENCES, _interface_name(instance.model_exchange))
    return point.model(J, x, u, values, h=None, derivation=derivation, uncertainty=uncertainty)


# ---- of a step ----


def step_difference(
    block: LinearizableFmu, h: float, t: float, state: Any, inputs: Any, relative_step: float
) -> FmuLinearization:
    """Linearize a communication step; see `Fmu.step_difference`."""
    for name, value in (("h", h), ("relative_step", relative_step)):
        if not 0 < value < np.inf:
            raise ParameterError(f"found {value!r}; expected a positive number.", block=block.label, port=name)
    point = _OperatingPoint(block, t, state, inputs)
    about = point.about
    for name in point.states:
        if about.find(name).initial != "exact":
            raise FmuError(
                "its state has no exact start value, and co-simulation allows to set it at the start only. Use "
                "linear_model() through model exchange, or identify it from a run.",
                block=block.label,
                port=name,
            )
    with _initialize(point, exchange=False) as instance:
        return _linearize_step(point, instance, h, relative_step)


def _linearize_step(point: _OperatingPoint, instance: LoadedFmu, h: float, relative_step: float) -> FmuLinearization:
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

        J, uncertainty = map(point.widen, differentiate(column, values, evaluate))
    finally:
        back.free()
    derivation = Derivation(DerivativeMethod.STEP_DIFFERENCES, restarted=back.lied)
    return point.model(J, x, u, values, h=h, derivation=derivation, uncertainty=uncertainty)
