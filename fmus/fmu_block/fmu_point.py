"""An operating point of an FMU, and its linear model there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from ...blocks.core import (
    FmuError,
    FmuRuntimeError,
    Layout,
    ParameterError,
    UnknownNameError,
    brief,
    elements,
    explain_calls,
    near,
)
from ..calls import FmuInstance, FmuSetup, LoadedFmu, ModelExchangeInstance, is_kept
from .derivation import Derivation
from .fmu_start_values import check_state, check_value

_KEPT, _ROUNDING = 1e-9, 1e-12
"""A state counts as set within these: relative to its value, and to its nominal value."""


@explain_calls
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
    """Estimated error of each entry of [[A, B], [C, D]]; zero if the FMU computed it, and differences agree;
    NaN if these are no evidence."""

    def __repr__(self) -> str:
        facts = f"{len(self.states)} states", f"{len(self.inputs)} inputs", f"{len(self.outputs)} outputs", self.how
        return brief(f"linear model of an FMU at t = {self.t:.9g} s", *facts, then=".A, .B, .C, .D, .uncertainty")

    @property
    def how(self) -> str:
        """Text of `derivation`, such as ``"differences of steps"``."""
        return str(self.derivation)


class FmuPoint:
    """An operating point, as values of the FMU's variables."""

    def __init__(self, setup: FmuSetup, t: float, state: Any, inputs: Any):
        self.setup, self.about, self.t = setup, setup.description, float(t)
        about = self.about
        self.states = list(about.states)
        self.port_of = {v.name: port for port, v in {**setup.input_variables, **setup.output_variables}.items()}
        self.inputs, self.outputs = (
            [v.name for v in chosen.values()] for chosen in (setup.input_variables, setup.output_variables)
        )
        self.moved = [n for n in self.inputs if not about.find(n).is_integer]
        self.sets_parameters = any(about.find(n).causality == "parameter" for n in self.inputs)
        if not np.isfinite(self.t):
            raise ParameterError(f"found {t!r}; expected a time in s.", block=setup.label, port="t")
        ports = {self.port_of[name]: name for name in self.inputs}
        given_state = self._match_names(
            state, {name: name for name in self.states}, "state", setup.description.discrete_states
        )
        given_inputs = self._match_names(inputs, ports, "inputs", ())
        # model exchange sets states that have no start value of their own, as those that other tools compute
        self.given = {
            n: check_state(about.find(n), v, setup.label)
            if n in about.states and about.find(n).start is None
            else check_value(about, n, v, setup.label)
            for n, v in {**given_state, **given_inputs}.items()
        }

    def _match_names(self, given: Any, names: Mapping[str, str], port: str, more: tuple[str, ...]) -> dict[str, Any]:
        if given is None:
            return {}
        if isinstance(given, Mapping):
            known = {**names, **{name: name for name in more}}
            for name in given:
                if name not in known:
                    raise UnknownNameError(f"found {name!r}. {near(name, known)}", block=self.setup.label, port=port)
            return {known[name]: value for name, value in given.items()}
        vector, variables = np.ravel(np.asarray(given, dtype=float)), [self.about.find(n) for n in names.values()]
        sizes = [v.size for v in variables]
        if vector.size != sum(sizes):
            raise ParameterError(
                f"found {vector.size} numbers; expected {sum(sizes)}, the elements of {', '.join(names) or 'nothing'}.",
                block=self.setup.label,
                port=port,
            )
        return Layout.of({v.name: v.shape for v in variables}).split(vector)

    def check_states(self, step: str) -> None:
        """Refuse a state that a step of co-simulation can't begin from; ``step`` is the next one in the error."""
        for name in self.states:
            if self.about.find(name).initial != "exact":
                raise FmuError(
                    "its state has no exact start value, and co-simulation allows to set it at the start only. " + step,
                    block=self.setup.label,
                    port=name,
                )

    def initialize(self, instance: LoadedFmu, moved: Mapping[str, Any] = MappingProxyType({})) -> None:
        """Enter Initialization Mode at the point with some values moved; it sets those with an exact start value."""
        given = {n: v for n, v in {**self.given, **moved}.items() if self.about.find(n).initial == "exact"}
        instance.initialize(None, start_time=self.t, values=given)

    def lost(self, found: np.ndarray) -> dict[str, np.ndarray]:
        """Return the states that were set, and are others now by more than rounding, with their values."""
        parts = self.about.layout(self.states).split(found).items()
        return {n: part for n, part in parts if n in self.given and not self._is_kept(n, part)}

    def _is_kept(self, name: str, part: np.ndarray) -> bool:
        given, nominals = np.ravel(self.given[name]).astype(float), np.abs(np.ravel(self.about.find(name).nominals))
        rounded = np.abs(np.ravel(part) - given) <= _ROUNDING * nominals
        return is_kept(part, given, tolerance=_KEPT) or bool(np.all(rounded))

    def check(self, found: np.ndarray, *, exchange: bool) -> None:
        """Refuse an operating point that the FMU does not accept; ``exchange``: it was asked in model exchange."""
        for name, part in self.lost(found).items():
            raise FmuError(
                f"its state was set to {self.given[name].tolist()}, but is {np.ravel(part).tolist()} when the FMU "
                f"has initialized at t = {self.t:.9g} s: an event there changes it, or its start value is only a "
                f"guess. {self._next_step(exchange)}",
                block=self.setup.label,
                port=name,
            )

    def _next_step(self, exchange: bool) -> str:
        if exchange or self.about.model_exchange is None:
            return "Choose a point that is not on an event."
        return "Choose a point that is not on an event, or take Fmu(…, interface='model_exchange'), which sets states."

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
            A=J[:n, :n],
            B=J[:n, n:],
            C=J[n:, :n],
            D=J[n:, n:],
            states=self.elements(self.states),
            inputs=inputs,
            outputs=outputs,
            t=self.t,
            x0=x,
            u0=u,
            f=values[:n],
            y0=values[n:],
            **more,
        )


def refuse_end(instance: ModelExchangeInstance, t: float) -> None:
    """Refuse an operating point at whose events the FMU asks to end the simulation, at the time t in s."""
    if instance.ends_run:
        raise FmuError(
            f"the FMU asks to end the simulation (terminateSimulation) at t = {t:.9g} s, so it has no linear model "
            "there. Choose another operating point.",
            block=instance.setup.label,
        )


@contextmanager
def initialize_in_exchange(point: FmuPoint) -> Iterator[ModelExchangeInstance]:
    """Load the FMU for model exchange, and enter Initialization Mode at the operating point."""
    instance = ModelExchangeInstance(point.setup, [*point.setup.input_variables])
    try:
        point.initialize(instance)
        yield instance
    finally:
        instance.close()


@contextmanager
def initialize_to_step(point: FmuPoint) -> Iterator[FmuInstance]:
    """Load the FMU for co-simulation, and enter Initialization Mode at the operating point."""
    instance = open_to_step(point.setup)
    try:
        point.initialize(instance)
        yield instance
    finally:
        instance.close()


def open_to_step(setup: FmuSetup) -> FmuInstance:
    """Load an FMU for steps to which no wire leads; its variables are set and read by their names."""
    instance = FmuInstance(replace(setup, output_variables={}, text_variables={}), [])
    try:
        instance.bind(np.zeros(0), np.zeros(0))
    except BaseException:
        instance.close()
        raise
    return instance


def take_step(instance: FmuInstance, t: float, h: float, refusal: str) -> None:
    """Take a step from t over h, both in s; where the FMU asks to end the simulation in it, that is refused."""
    try:
        instance.step(t, h)
    except FmuRuntimeError as error:
        if not instance.ends_run:
            raise
        raise FmuError(refusal, block=instance.setup.label) from error


def step_from(point: FmuPoint, instance: FmuInstance, h: float, moved: Mapping[str, Any], lost: str) -> np.ndarray:
    """Take a step of h seconds from a point's start with some values moved; return states and inputs before it.

    Exact start values are set by the initialization, inputs in Step Mode. ``lost`` says in an error what there is not
    if the step ends early.
    """
    instance.reset()
    point.initialize(instance, moved)
    instance.begin()
    instance.call("setting its inputs", instance.set_values, {n: moved[n] for n in point.inputs if n in moved})
    before = np.concatenate([instance.values(point.states), instance.values(point.inputs)])
    take_step(instance, point.t, h, f"it ends its step early, so {lost}.")
    return before
