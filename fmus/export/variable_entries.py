"""Variables of an FMU in the order of ``model.h``: kind, value reference, and place among the values of an instance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from ...blocks.core import lay_out, rate_of
from .model_spec import INTEGRATORS, ModelSpec, Variable

Kind = Literal["time", "fixed", "tunable", "input", "state", "discrete", "derivative", "output", "indicator"]
_STEP_DESCRIPTION = (
    "Longest step of the explicit Runge-Kutta method of order 4 (integrator = 1); a communication step h, or its "
    "remainder after an event, takes ceil(h / internal_step) equal substeps, at least one"
)
_INTEGRATOR_DESCRIPTION = (
    "Integrator of Co-Simulation. 1: explicit Runge-Kutta, order 4, fixed step; 2: explicit Runge-Kutta, order 5(4), "
    "adaptive; 3: implicit (Rosenbrock), order 4(3), adaptive, for stiff models"
)
_TOLERANCE_DESCRIPTION = (
    "Relative tolerance of the adaptive integrators; times a state's nominal value, its absolute one"
)


@dataclass(frozen=True, eq=False)
class Entry:
    """Variable of the FMU; its value reference is its index in the table of variables.

    ``kind``: one of time, fixed, tunable, input, state, discrete (state), derivative, output, (event) indicator.
    ``variable``: the model's variable; of time and of derivatives only name, unit, shape and description count.
    ``name``: name in the FMU: ``der(x)`` for the derivative of ``x``.
    ``first``: index of its first element in the values of an instance.
    """

    reference: int
    kind: Kind
    variable: Variable
    name: str
    first: int
    of: int | None = None

    @property
    def is_output(self) -> bool:
        """Whether it is an output, computed or a state."""
        return self.variable.causality == "output" and self.kind in ("state", "discrete", "output")

    @property
    def last(self) -> int:
        """One past the index of its last element."""
        return self.first + self.variable.size


def rate_variable(state: Variable) -> Variable:
    """Return the rate of a continuous state as a variable."""
    unit = None if state.unit is None else rate_of(state.unit)
    return Variable("der", shape=state.shape, unit=unit, description=f"Time derivative of {state.name}")


def _settings(spec: ModelSpec) -> list[tuple[Kind, Variable, str]]:
    """Return the parameters of the FMU's own integrator."""
    described = _STEP_DESCRIPTION + spec.step_note
    step = Variable("v", "parameter", "tunable", description=described, start=spec.internal_step, unit="s", minimum=0.0)
    integrator = Variable(
        *("v", "parameter", "fixed"),
        description=_INTEGRATOR_DESCRIPTION,
        start=INTEGRATORS[spec.integrator],
        unit="1",
        minimum=1.0,
        maximum=3.0,
    )
    tolerance = Variable(
        *("v", "parameter", "tunable"),
        description=_TOLERANCE_DESCRIPTION,
        start=spec.tolerance,
        unit="1",
        minimum=1e-14,
        maximum=0.1,
    )
    return [
        ("tunable", step, "internal_step"),
        ("fixed", integrator, "integrator"),
        ("tunable", tolerance, "tolerance"),
    ]


def _indicators(spec: ModelSpec) -> list[tuple[Kind, Variable, str]]:
    about = "Event indicator"
    return [
        (
            "indicator",
            Variable("z", description=f"{about}: {e.description}" if e.description else about, nominal=e.nominal),
            e.indicator,
        )
        for e in spec.events
    ]


def layout(spec: ModelSpec) -> tuple[Entry, ...]:
    """Return all variables of a model."""
    rows: list[tuple[Kind, Variable, str]] = [
        ("tunable" if v.variability == "tunable" else "fixed", v, v.name) for v in spec.parameters
    ]
    rows += [("input", v, v.name) for v in spec.inputs]
    rows += [("state", v, v.name) for v in spec.continuous]
    rows += [("discrete", v, v.name) for v in spec.discrete]
    rows += [("derivative", rate_variable(v), f"der({v.name})") for v in spec.continuous]
    rows += [("output", v, v.name) for v in spec.outputs]
    rows += _indicators(spec)
    rows += _settings(spec)
    return place_entries(rows)


def place_entries(rows: Iterable[tuple[Kind, Variable, str]]) -> tuple[Entry, ...]:
    """Return the time and variables, given by kind, variable and name, with value references and places.

    Derivatives are those of the states, in the same order.
    """
    every: list[tuple[Kind, Variable, str]] = [
        ("time", Variable("t", unit="s", description="Simulation time"), "time"),
        *rows,
    ]
    states = iter([reference for reference, (kind, _, _) in enumerate(every) if kind == "state"])
    places = lay_out(v.size for _, v, _ in every)
    return tuple(
        Entry(reference, kind, variable, name, place.start, next(states) if kind == "derivative" else None)
        for reference, ((kind, variable, name), place) in enumerate(zip(every, places, strict=True))
    )
