"""Linear models of an FMU at an operating point: of its equations, and of a communication step."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ...blocks.core.errors import FmuError, ParameterError, UnknownNameError, near
from ...blocks.core.layout import Layout, elements
from ..archive.description import FmuDescription
from ..calls.fmu_block import FmuBlock
from ..calls.loaded_library import LoadedFmu
from .derivation import Derivation, DerivativeMethod
from .differences import Column, columns

EQUATIONS, STEP = 1e-5, 1e-4
"""Differences, relative to nominal values: of equations, and of steps, where an adaptive solver leaves its traces."""


@dataclass(frozen=True, eq=False)
class FmuLinearization:
    """A linear model of an FMU about an operating point (x0, u0) at the time t.

    Of its equations: dx/dt = f + A (x − x0) + B (u − u0). Of a step of length h, with the inputs held: the states after
    it are f + A (x − x0) + B (u − u0). In both cases y = y0 + C (x − x0) + D (u − u0), after the step where there is
    one. f is zero, or x0, only at an equilibrium.
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
    """Length of the step in s, None for a model of the equations."""
    x0: np.ndarray
    u0: np.ndarray
    f: np.ndarray
    y0: np.ndarray
    derivation: Derivation
    """The way in which the derivatives were found."""
    uncertainty: np.ndarray
    """Of each entry of [[A, B], [C, D]], its estimated error; zero where the FMU computed the derivatives."""

    @property
    def how(self) -> str:
        """The text of `derivation`, such as ``"differences of steps"``."""
        return str(self.derivation)


class LinearizableFmu(FmuBlock, Protocol):
    """The block of an FMU, as its linear model needs it."""

    def start_value(self, description: FmuDescription, name: str, value: Any) -> Any:
        """Return a start value, checked and in the variable's shape."""


class _Point:
    """An operating point, as values of the FMU's variables."""

    def __init__(self, block: LinearizableFmu, t: float, state: Any, inputs: Any):
        self.block, self.about, self.t = block, block.description, float(t)
        about = self.about
        self.states = list(about.states)
        self.inputs, self.outputs = list(about.of("input")), list(about.of("output"))
        if not np.isfinite(self.t):
            raise ParameterError(f"found {t!r}; expected a time in s.", block=block.label, port="t")
        ports = {block.rename.get(name, name): name for name in self.inputs}
        given_state = self._named(
            state, {name: name for name in self.states}, "state", block.description.discrete_states
        )
        given_inputs = self._named(inputs, ports, "inputs", ())
        self.given = {n: block.start_value(about, n, v) for n, v in {**given_state, **given_inputs}.items()}

    def _named(self, given: Any, names: Mapping[str, str], what: str, more: tuple[str, ...]) -> dict[str, Any]:
        if given is None:
            return {}
        if isinstance(given, Mapping):
            known = {**names, **{name: name for name in more}}
            for name in given:
                if name not in known:
                    raise UnknownNameError(f"found {name!r}. {near(name, known)}", block=self.block.label, port=what)
            return {known[name]: value for name, value in given.items()}
        vector, variables = np.ravel(np.asarray(given, dtype=float)), [self.about.variables[n] for n in names.values()]
        sizes = [v.size for v in variables]
        if vector.size != sum(sizes):
            raise ParameterError(
                f"found {vector.size} numbers; expected {sum(sizes)}, the elements of {', '.join(names) or 'nothing'}.",
                block=self.block.label,
                port=what,
            )
        return Layout.of({v.name: v.shape for v in variables}).split(vector)

    def check(self, found: np.ndarray) -> None:
        """Refuse an operating point that the FMU does not take over."""
        for name, part in _layout(self.about, self.states).split(found).items():
            if name in self.given and not np.allclose(part, self.given[name], rtol=1e-9, atol=0.0):
                raise FmuError(
                    f"its state was set to {self.given[name].tolist()}, but is {np.ravel(part).tolist()} when the FMU "
                    f"has initialized at t = {self.t:.9g} s: an event there changes it, or its start value is no more "
                    "than a guess. Choose a point that is not on an event.",
                    block=self.block.label,
                    port=name,
                )

    def elements(self, names: list[str], *, ports: bool = False) -> tuple[str, ...]:
        """Name each element of variables."""
        rename = self.block.rename if ports else {}
        shapes = ((rename.get(n, n), self.about.variables[n].shape) for n in names)
        return tuple(label for name, shape in shapes for label in elements(name, shape, first=1))  # FMI counts from 1

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
    point = _Point(block, t, state, inputs)
    about = point.about
    if not about.states:
        raise FmuError(
            "its model structure lists no derivatives of continuous states that are Float64 variables, so its "
            "equations can't be linearized. Take step_difference(), or identify it from a run.",
            block=block.label,
        )
    settable = all(about.variables[name].initial == "exact" for name in about.states)
    ways = (
        (True, True, about.model_exchange_has_derivatives and about.model_exchange is not None),
        (False, True, about.has_derivatives and settable),
        (True, False, about.model_exchange is not None),
        (False, False, settable),
    )
    for exchange, derived, possible in ways:
        if possible and exact in (None, derived) and interface in (None, _name(exchange)):
            with _initialized(point, exchange) as instance:
                return _directional(point, instance) if derived else _differenced(point, instance)
    raise FmuError(
        f"it can't be linearized in this way (interface={interface!r}, exact={exact!r}): it has "
        f"{'' if about.model_exchange else 'no '}model exchange, directional derivatives "
        f"{'there' if about.model_exchange_has_derivatives else 'not there'} and "
        f"{'in' if about.has_derivatives else 'not in'} co-simulation, and states that "
        f"{'can' if settable else 'cannot'} be set at the start. Leave interface and exact to it.",
        block=block.label,
    )


def _name(exchange: bool) -> str:
    return "model_exchange" if exchange else "co_simulation"


@contextmanager
def _initialized(point: _Point, exchange: bool) -> Iterator[LoadedFmu]:
    """Load the FMU, in Initialization Mode at the operating point."""
    instance = LoadedFmu(point.block, model_exchange=exchange)
    try:
        exact = {n: v for n, v in point.given.items() if point.about.variables[n].initial == "exact"}
        instance.initialize(None, start_time=point.t, values=exact)
        yield instance
    finally:
        instance.close()


def _enter_continuous_time(point: _Point, instance: LoadedFmu) -> None:
    """Settle the events of the start; then states without an exact start value are set (FMI 3.0, 3.2)."""
    instance.begin()
    for _ in range(100):
        if not instance.call("the events at the start", "updateDiscreteStates")[0]:
            break
    else:
        raise FmuError("the events at the start never settle. Choose another operating point.", block=point.block.label)
    instance.call("entering Continuous-Time Mode", "enterContinuousTimeMode")
    guessed = [n for n in point.states if n in point.given and point.about.variables[n].initial != "exact"]
    if guessed:
        x = instance.values(point.states)
        where = _layout(point.about, point.states).slices
        for name in guessed:
            x[where[name]] = np.ravel(point.given[name])
        _set_states(instance, x)


def _set_states(instance: LoadedFmu, x: np.ndarray) -> None:
    vector = (ctypes.c_double * x.size)(*x)
    instance.call("setting the continuous states", "setContinuousStates", vector, x.size)


def _values(point: _Point, instance: LoadedFmu) -> np.ndarray:
    return instance.values([*(point.about.states[n] for n in point.states), *point.outputs])


def _directional(point: _Point, instance: LoadedFmu) -> FmuLinearization:
    """Ask in Continuous-Time Mode or Step Mode; about discrete inputs, in Event Mode (FMI 3.0, 2.2.11)."""
    if instance.model_exchange:
        _enter_continuous_time(point, instance)
    else:
        instance.begin()
    about = point.about
    x, u = instance.values(point.states), instance.values(point.inputs)
    point.check(x)
    values = _values(point, instance)
    unknowns = [*(about.states[n] for n in point.states), *point.outputs]
    found = []
    for name in (*point.states, *point.inputs):
        with _mode_of(point, instance, name):
            size = about.variables[name].size
            found += [instance.directional_derivative(unknowns, [name], seed) for seed in np.eye(size).tolist()]
    J = np.array(found).reshape(len(found), values.size).T
    derivation = Derivation(DerivativeMethod.DIRECTIONAL, _name(instance.model_exchange))
    return point.model(J, x, u, values, h=None, derivation=derivation, uncertainty=np.zeros(J.shape))


@contextmanager
def _mode_of(point: _Point, instance: LoadedFmu, name: str) -> Iterator[None]:
    """Discrete inputs of model exchange belong to Event Mode."""
    discrete = instance.model_exchange and point.about.variables[name].variability == "discrete"
    if discrete:
        instance.call("entering Event Mode", "enterEventMode")
    yield
    if discrete:
        instance.call("the events", "updateDiscreteStates")
        instance.call("entering Continuous-Time Mode", "enterContinuousTimeMode")


def _differenced(point: _Point, instance: LoadedFmu) -> FmuLinearization:
    """Move states and inputs: in Continuous-Time Mode, else in Initialization Mode (FMI 3.0, 3.2 and 2.3.3)."""
    if instance.model_exchange:
        _enter_continuous_time(point, instance)
    x, u = instance.values(point.states), instance.values(point.inputs)
    point.check(x)
    values = _values(point, instance)
    column = Column(point.about, [*point.states, *point.inputs], np.concatenate([x, u]), EQUATIONS)

    def evaluate(name: str, moved: np.ndarray) -> np.ndarray:
        with _mode_of(point, instance, name):
            if instance.model_exchange and name in point.states:
                _set_states(instance, moved[: x.size])
            else:
                instance.set_values({name: column.part(name, moved)})
            found = _values(point, instance)
            if instance.model_exchange and name in point.states:
                _set_states(instance, x)
            else:
                instance.set_values({name: column.part(name, column.at)})
        return found

    J, uncertainty = columns(column, values, evaluate)
    derivation = Derivation(DerivativeMethod.DIFFERENCES, _name(instance.model_exchange))
    return point.model(J, x, u, values, h=None, derivation=derivation, uncertainty=uncertainty)


# ---- of a step ----


def step_difference(
    block: LinearizableFmu, h: float, t: float, state: Any, inputs: Any, relative_step: float
) -> FmuLinearization:
    """Linearize a communication step; see `Fmu.step_difference`."""
    for name, value in (("h", h), ("relative_step", relative_step)):
        if not 0 < value < np.inf:
            raise ParameterError(f"found {value!r}; expected a positive number.", block=block.label, port=name)
    point = _Point(block, t, state, inputs)
    about = point.about
    for name in point.states:
        if about.variables[name].initial != "exact":
            raise FmuError(
                "its state has no exact start value, and co-simulation lets it be set at the start alone. Take "
                "linear_model() through model exchange, or identify it from a run.",
                block=block.label,
                port=name,
            )
    with _initialized(point, exchange=False) as instance:
        return _stepped(point, instance, h, relative_step)


def _stepped(point: _Point, instance: LoadedFmu, h: float, relative_step: float) -> FmuLinearization:
    about, known = point.about, [*point.states, *point.inputs]
    instance.begin()
    x, u = instance.values(point.states), instance.values(point.inputs)
    point.check(x)
    at = _layout(about, known).split(np.concatenate([x, u]))
    saved = instance.call("saving its state", "getFMUState") if about.can_save else None

    def go(set_before: Mapping[str, Any], set_after: Mapping[str, Any], *, first: bool = False) -> np.ndarray:
        """Step from the operating point; states move by the initialization, inputs in Step Mode."""
        if not first and saved is not None and not set_before:
            instance.call("restoring its state", "setFMUState", saved)
        elif not first:
            instance.reset()
            instance.initialize(None, start_time=point.t, values={**point.given, **at, **set_before})
            instance.begin()
        instance.set_values(set_after)
        _, terminate, early, _ = instance.call(f"a step by {h:g} s", "doStep", point.t, h, saved is None)
        if terminate or early:
            raise FmuError(
                f"it ends its step from t = {point.t:.9g} s by {h:g} s early, so that has no derivative. Take a "
                "smaller h.",
                block=point.block.label,
            )
        return instance.values([*point.states, *point.outputs])

    try:
        values = go({}, {}, first=True)
        column = Column(about, known, np.concatenate([x, u]), relative_step)

        def evaluate(name: str, moved: np.ndarray) -> np.ndarray:
            change = {name: column.part(name, moved)}
            return go(change, {}) if name in point.states else go({}, change)

        J, uncertainty = columns(column, values, evaluate)
    finally:
        if saved is not None:
            instance._fmu.freeFMUState(saved)
    derivation = Derivation(DerivativeMethod.STEP_DIFFERENCES)
    return point.model(J, x, u, values, h=h, derivation=derivation, uncertainty=uncertainty)


def _layout(about: FmuDescription, names: list[str]) -> Layout:
    """Return where variables stand that come one after the other."""
    return Layout.of({name: about.variables[name].shape for name in names})
