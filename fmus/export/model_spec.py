"""Model to export: its variables, its events, and its equations as CasADi functions.

It connects the tracing of Python equations with the writing of FMUs. It depends on no version of FMI; a `ModelSpec` can
be exported in any version and interface type.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi as ca
import numpy as np

from ...blocks.core import DefinitionError, ParameterError, brief, explain_calls, kinds, parse_unit

Causality = Literal["input", "output", "parameter", "local"]
Variability = Literal["continuous", "discrete", "fixed", "tunable"]
Integrator = Literal["rk4", "dopri5", "rodas"]

#: Names that the exporter uses itself (FMI 3.0, 2.4.7: names are unique).
RESERVED = ("time", "internal_step", "integrator", "tolerance")
#: Values of the FMU's parameter ``integrator``.
INTEGRATORS: dict[str, int] = {"rk4": 1, "dopri5": 2, "rodas": 3}
DIRECTIONS: dict[str, int] = {"both": 0, "rising": 1, "falling": -1}
_NAME = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
_ALLOWED: dict[str, tuple[str, ...]] = {
    "input": ("continuous", "discrete"),
    "output": ("continuous", "discrete"),
    "parameter": ("fixed", "tunable"),
    "local": ("continuous", "discrete"),
}


@explain_calls
@dataclass(frozen=True, eq=False)
class Variable:
    """Variable of a model (FMI 3.0, 2.4.7): Float64, scalar or array.

    Parameters
    ----------
    name : str
        An identifier, or several joined by dots (``controller.gain``).
    causality : {"input", "output", "parameter", "local"}
        FMI's causality. A state is "local", or "output" if it is one of the model's outputs.
    variability : {"continuous", "discrete", "fixed", "tunable"}
        A parameter is fixed or tunable, an input continuous or discrete, a state continuous or, if it is constant
        between events, discrete; anything else is continuous.
    shape : tuple of int
        ``()`` for a scalar. Arrays are flattened row by row, as NumPy does.
    unit : str, optional
        Unit, such as ``"m/s2"``, or ``"1"`` for none. Either all variables of a model have one, or no variable.
    description : str
        One line.
    start : array_like or float, optional
        Start value: required for parameters and states, 0 by default for inputs, none for computed outputs. A single
        number fills an array.
    minimum, maximum : float, optional
        Range; the FMU refuses to set a value outside.
    state : bool
        Whether this is a state.
    nominal : float, optional
        Usual size, positive; 1 if not given. A state's nominal value times the tolerance is its absolute tolerance.
    """

    name: str
    causality: Causality = "local"
    variability: Variability = "continuous"
    shape: tuple[int, ...] = ()
    unit: str | None = None
    description: str = ""
    start: np.ndarray[Any, Any] | float | None = None
    minimum: float | None = None
    maximum: float | None = None
    state: bool = False
    nominal: float | None = None

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise DefinitionError(
                f"the variable name {self.name!r} is not made of identifiers. Use letters, digits, _ and dots."
            )
        if self.name in RESERVED:
            raise DefinitionError(f"the variable name {self.name!r} is reserved. Choose another, such as {self.name}_.")
        if self.variability not in _ALLOWED.get(self.causality, ()):
            pairs = "; ".join(f"{c}: {', '.join(v)}" for c, v in _ALLOWED.items())
            raise DefinitionError(
                f"{self.name} has causality {self.causality!r} and variability {self.variability!r}, "
                f"expected one of {pairs}."
            )
        if self.variability == "discrete" and self.causality != "input" and not self.state:
            raise DefinitionError(
                f"{self.name} is discrete, but neither input nor state. Make it a state (state=True), or continuous."
            )
        if self.nominal is not None and not (math.isfinite(self.nominal) and self.nominal > 0):
            raise ParameterError(f"{self.name} has nominal {self.nominal!r}, expected a positive number.")
        if any(not isinstance(n, int) or n < 1 for n in self.shape):
            raise DefinitionError(
                f"{self.name} has shape {self.shape}, expected positive integers: (2,), or () for a scalar."
            )
        if self.unit is not None:
            parse_unit(self.unit)
        object.__setattr__(self, "start", self._check_start())

    def _check_start(self) -> np.ndarray[Any, Any] | None:
        if not (self.causality in ("input", "parameter") or self.state):
            if self.start is not None:
                raise ParameterError(f"{self.name} is computed, but has the start value {self.start}. Leave start out.")
            return None
        if self.start is None and self.causality != "input":
            kind = "state" if self.state else "parameter"
            raise ParameterError(f"{self.name} is a {kind} without a start value. Give start=.")
        try:
            start = np.asarray(0.0 if self.start is None else self.start, float)
            start = np.array(np.broadcast_to(start, self.shape))
        except (TypeError, ValueError):
            raise ParameterError(
                f"{self.name} has the start value {self.start!r}, expected numbers of shape {self.shape}."
            ) from None
        if not np.isfinite(start).all():
            raise ParameterError(f"{self.name} has the start value {start}, expected finite numbers.")
        low = -math.inf if self.minimum is None else self.minimum
        high = math.inf if self.maximum is None else self.maximum
        if not low <= high:
            raise ParameterError(f"{self.name} has minimum {low} above maximum {high}. Exchange them.")
        if (start < low).any() or (start > high).any():
            raise ParameterError(f"{self.name} has the start value {start}, expected it within [{low}, {high}].")
        start.setflags(write=False)
        return start

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    @property
    def flat_start(self) -> list[float]:
        """Start values, flattened row by row; empty if there are none."""
        return [] if self.start is None else [float(value) for value in np.ravel(np.asarray(self.start))]


@dataclass(frozen=True)
class EventSpec:
    """Event of a model to export: its indicator z changes its domain, from z <= 0 to z > 0 or back.

    The FMU's own integrators find a change that lasts over a quarter of a step, and a shorter one if the rate of z
    shows it. Several changes within one integrator step can be missed: take shorter communication steps there.

    ``name``: name, like a `Variable`'s; the indicator's name in the FMU is ``<name>.indicator``.
    ``direction``: direction of the changes that fire it; rising is from z <= 0 to z > 0.
    """

    name: str
    direction: Literal["both", "rising", "falling"] = "both"
    description: str = ""
    nominal: float = 1.0

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise DefinitionError(
                f"the event name {self.name!r} is not made of identifiers. Use letters, digits, _ and dots."
            )
        if self.direction not in DIRECTIONS:
            raise DefinitionError(
                f"the event {self.name} has direction {self.direction!r}, expected one of {', '.join(DIRECTIONS)}."
            )
        if not (math.isfinite(self.nominal) and self.nominal > 0):
            raise ParameterError(f"the event {self.name} has nominal {self.nominal!r}, expected a positive number.")

    @property
    def indicator(self) -> str:
        """Name of the indicator in the FMU."""
        return f"{self.name}.indicator"


def naming_convention(names: Iterable[str]) -> str:
    """Return the convention of some names: other letters than A to Z are for flat names alone (FMI 3.0, 2.4.7.5.1)."""
    return "structured" if all(map(str.isascii, names)) else "flat"


def check_ascii(names: Iterable[str]) -> None:
    """Refuse names with letters that C's identifiers don't have; FMUs and web pages have them."""
    for name in names:
        if not name.isascii():
            raise DefinitionError(
                f"the variable name {name!r} is not made of identifiers. Use letters, digits, _ and dots; letters are "
                "those from A to Z here."
            )


def check_file_name(name: str) -> None:
    """Refuse a model name that no file can have on Windows: that of a device, such as con or lpt1."""
    if re.fullmatch(r"con|prn|aux|nul|(com|lpt)\d", name, re.IGNORECASE):
        raise DefinitionError(
            f"the model name {name!r} is that of a device on Windows, where no file {name}.fmu can be. Choose another, "
            f"such as {name}_.",
            block=name,
        )


@explain_calls
@dataclass(frozen=True, eq=False)
class ModelSpec:
    """Model to export: x' = derivative(t, x, u, p), y = output(t, x, u, p); at events x = jump(t, x, u, p, fired).

    All vectors are flat columns: the concatenation, in the order of the tuples, of each variable flattened row by row.
    x holds all states, the continuous ones first; x' holds the rates of the continuous ones only.

    Parameters
    ----------
    name : str
        A C identifier, used as FMI's modelName and modelIdentifier.
    description : str
        One line.
    inputs, outputs, parameters, states : tuple of Variable
        ``outputs`` are the computed ones. A state that is also an output is listed once, in ``states``, with causality
        "output". Discrete states follow the continuous ones.
    derivative : casadi.Function
        (t, x, u, p) -> (dx,).
    output : casadi.Function
        (t, x, u, p) -> (y,).
    internal_step : float
        Start value of the parameter ``internal_step``: longest step of the FMU's own integrator, s.
    stop_time, step_size : float
        Default experiment, s.
    events : tuple of EventSpec
        The events. Without events, ``indicators`` and ``jump`` are None, and there are no discrete states.
    indicators : casadi.Function, optional
        (t, x, u, p) -> (z,), one for each event.
    jump : casadi.Function, optional
        (t, x, u, p, fired) -> (x,): all states after the events whose element of ``fired`` is 1 have fired at once.
    integrator : {"rk4", "dopri5", "rodas"}
        Start value of the parameter ``integrator``: explicit Runge-Kutta of order 4 with the fixed ``internal_step``;
        explicit, adaptive, order 5(4); implicit, adaptive, order 4(3), for stiff models.
    tolerance : float
        Start value of the parameter ``tolerance`` of the adaptive integrators: relative; times ``nominal``, absolute.
    step_note : str
        End of the description of the parameter ``internal_step``.
    """

    name: str
    description: str
    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    parameters: tuple[Variable, ...]
    states: tuple[Variable, ...]
    derivative: ca.Function
    output: ca.Function
    internal_step: float = 1e-3
    stop_time: float = 1.0
    step_size: float = 1e-3
    events: tuple[EventSpec, ...] = ()
    indicators: ca.Function | None = None
    jump: ca.Function | None = None
    integrator: Integrator = "rk4"
    tolerance: float = 1e-8
    step_note: str = ""

    def __repr__(self) -> str:
        facts = f"{len(self.states)} states", f"{len(self.inputs)} inputs", f"{len(self.outputs)} outputs"
        return brief(f"model {self.name!r} for an FMU", *facts, then="build(model, out=…)")

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z_]\w*", self.name, re.ASCII) or len(self.name) > 100:
            raise DefinitionError(
                f"the model name {self.name!r} is no C identifier. Use letters, digits and _.", block=self.name
            )
        check_file_name(self.name)
        for field in ("internal_step", "stop_time", "step_size"):
            value = getattr(self, field)
            if not kinds.finite.holds(value) or not value > 0:
                raise ParameterError(
                    f"found {value!r}, expected a positive number of seconds.", block=self.name, port=field
                )
        if not isinstance(self.integrator, str) or self.integrator not in INTEGRATORS:
            raise ParameterError(
                f"found {self.integrator!r}, expected one of {', '.join(INTEGRATORS)}.",
                block=self.name,
                port="integrator",
            )
        if not kinds.finite.holds(self.tolerance) or not 1e-14 <= self.tolerance <= 0.1:
            raise ParameterError(
                f"found {self.tolerance!r}, expected a number from 1e-14 to 0.1.", block=self.name, port="tolerance"
            )
        self._check_kinds()
        self._check_names()
        self._check_function(
            "derivative",
            sum(v.size for v in self.continuous),
            "one derivative for each continuous state",
        )
        self._check_function("output", sum(v.size for v in self.outputs), "each element of the outputs")
        if self.events:
            self._check_function("indicators", len(self.events), "one for each event")
            self._check_function("jump", sum(v.size for v in self.states), "all states", fired=len(self.events))

    @property
    def continuous(self) -> tuple[Variable, ...]:
        """Continuous states."""
        return tuple(v for v in self.states if v.variability != "discrete")

    @property
    def discrete(self) -> tuple[Variable, ...]:
        """Discrete states."""
        return tuple(v for v in self.states if v.variability == "discrete")

    def __iter__(self) -> Iterator[Variable]:
        """Yield all variables: parameters, inputs, states, computed outputs."""
        yield from (*self.parameters, *self.inputs, *self.states, *self.outputs)

    def _check_kinds(self) -> None:
        expected: tuple[tuple[str, tuple[Variable, ...], tuple[str, ...], bool], ...] = (
            ("inputs", self.inputs, ("input",), False),
            ("outputs", self.outputs, ("output",), False),
            ("parameters", self.parameters, ("parameter",), False),
            ("states", self.states, ("local", "output"), True),
        )
        for group, variables, causalities, state in expected:
            for v in variables:
                if v.causality not in causalities or v.state != state:
                    raise DefinitionError(
                        f"found causality={v.causality!r}, state={v.state} in {group}, "
                        f"expected causality={' or '.join(map(repr, causalities))}, state={state}.",
                        block=self.name,
                        port=v.name,
                    )

        if self.states != (*self.continuous, *self.discrete):
            raise DefinitionError(
                f"found the states {', '.join(v.name for v in self.states)}, expected the discrete ones "
                f"({', '.join(v.name for v in self.discrete)}) after all others. Reorder them.",
                block=self.name,
            )
        given = {"indicators": self.indicators, "jump": self.jump, "discrete states": self.discrete or None}
        if not self.events and (found := [name for name, value in given.items() if value is not None]):
            raise DefinitionError(
                f"found {' and '.join(found)}, but no events. Give events=, or leave them out.", block=self.name
            )

    def _check_names(self) -> None:
        names = [*(v.name for v in self), *(e.indicator for e in self.events)]
        for name in names:
            if names.count(name) > 1:
                raise DefinitionError(
                    f"{name!r} names {names.count(name)} variables. Rename all but one.", block=self.name
                )
        without = [v.name for v in self if v.unit is None]
        if 0 < len(without) < len([*self]):
            raise DefinitionError(
                f"{', '.join(without)} without a unit, where others have one. Give unit=, '1' for no dimension.",
                block=self.name,
            )

    def _check_function(self, field: str, n_out: int, contents: str, *, fired: int | None = None) -> None:
        f = getattr(self, field)
        letters = ["t", "x", "u", "p"] if fired is None else ["t", "x", "u", "p", "fired"]
        if not isinstance(f, ca.Function) or f.n_in() != len(letters) or f.n_out() != 1:
            raise DefinitionError(
                f"found {f!r}, expected a casadi.Function ({', '.join(letters)}) -> one vector.",
                block=self.name,
                port=field,
            )
        groups = (self.states, self.inputs, self.parameters)
        sizes = [1, *(sum(v.size for v in group) for group in groups), fired or 0]
        for i, (letter, size) in enumerate(zip(letters, sizes, strict=False)):
            if f.numel_in(i) != size or (size and (f.size2_in(i) != 1 or f.nnz_in(i) != size)):
                found = f.sparsity_in(i).dim(True)
                raise DefinitionError(
                    f"found {letter} of {found}, expected a dense column of {size}.", block=self.name, port=field
                )
        if f.numel_out(0) != n_out or (n_out and f.size2_out(0) != 1):
            raise DefinitionError(
                f"found {f.size_out(0)[0]} x {f.size_out(0)[1]}, expected a column of {n_out}: {contents}.",
                block=self.name,
                port=field,
            )


def elements_of(variable: Variable) -> Iterator[Variable]:
    """Yield each element, row by row: ``s[1]``, ``s[2]``; ``m[1,2]``. FMI counts from 1 (FMI 2.0, 2.2.9)."""
    for index in np.ndindex(variable.shape):
        start = None if variable.start is None else float(np.asarray(variable.start)[index])
        element = replace(variable, shape=(), start=start)
        # This bypasses the check of names, since users may give no name with an index.
        object.__setattr__(element, "name", f"{variable.name}[{','.join(str(i + 1) for i in index)}]")
        yield element


def _scalars(variables: Iterable[Variable]) -> tuple[Variable, ...]:
    return tuple(e for v in variables for e in (elements_of(v) if v.shape else (v,)))


def scalarize(spec: ModelSpec) -> ModelSpec:
    """Return the model with every array replaced by its elements; the flat vectors, and so the equations, are the same.

    Returns: the model, with all variables of shape ``()``.
    """
    return replace(
        spec,
        inputs=_scalars(spec.inputs),
        outputs=_scalars(spec.outputs),
        parameters=_scalars(spec.parameters),
        states=_scalars(spec.states),
    )
