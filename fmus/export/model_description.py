"""Description of an FMU, whatever its version of FMI: what ``modelDescription.xml`` says, before it is written.

It depends on the model only: it has no time stamp and no random identifier.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from ...blocks.core import parse_unit
from .dependencies import Dependency, dependencies, reinitialized_states
from .model_spec import ModelSpec, naming_convention
from .variable_entries import Entry, layout
from .xml_elements import element, package_version, unit_element

Attributes = Mapping[str, object]
_CAUSALITY = {"time": "independent", "fixed": "parameter", "tunable": "parameter", "input": "input"}
_INITIAL = dict.fromkeys(("fixed", "tunable", "state", "discrete"), "exact")
_INITIAL |= dict.fromkeys(("derivative", "output", "indicator"), "calculated")
#: Log categories (FMI 3.0, 2.4.5) that an exported FMU uses.
LOG_CATEGORIES = {
    "logStatusWarning": "Warnings",
    "logStatusError": "Errors, with the value found, the value expected, and the next step",
}


@dataclass(frozen=True)
class DescribedVariable:
    """A variable.

    ``clock``: the value reference of its clock, where it has one.
    ``is_reinitialized``: whether an event may change this state.
    ``is_intermediate``: whether it is set or got within a communication step.
    """

    entry: Entry
    variability: str
    clock: int | None = None
    is_reinitialized: bool = False
    is_intermediate: bool = False

    @property
    def attributes(self) -> dict[str, object]:
        """The attributes that it has in both versions of FMI, whatever its type."""
        e = self.entry
        return {
            "name": e.name,
            "valueReference": e.reference,
            "description": e.variable.description or None,
            "causality": _CAUSALITY.get(e.kind, "output" if e.is_output else "local"),
            "variability": self.variability,
            "initial": _INITIAL.get(e.kind),
        }

    def describe_values(self, types: Mapping[str, str]) -> dict[str, object]:
        """Return the attributes of a real variable in both versions of FMI: type, unit, range, nominal value."""
        v = self.entry.variable
        return {
            "declaredType": types.get(v.unit or ""),
            "unit": v.unit,
            "relativeQuantity": True if v.unit is not None and parse_unit(v.unit).relative else None,
            "min": None if v.minimum is None else float(v.minimum),
            "max": None if v.maximum is None else float(v.maximum),
            "nominal": None if v.nominal is None else float(v.nominal),
        }


@dataclass(frozen=True)
class Unknown:
    """An unknown, and what it depends on; None: on everything."""

    entry: Entry
    knowns: tuple[Dependency, ...] | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelDescription:
    """Description of an FMU.

    ``interfaces``: by interface, the attributes that it has besides those of both versions of FMI; see ``stepping``.
    ``clocks``: attributes of its clocks, in FMI 3.0.
    ``tolerance``: that of the default experiment, where it has one.
    ``outputs``, ``rates``, ``initial``, ``indicators``: unknowns in a run, and at the start.
    """

    name: str
    text: str
    token: str
    variables: tuple[DescribedVariable, ...]
    has_derivatives: bool
    interfaces: Mapping[str, Attributes]
    stop_time: float
    step_size: float
    tolerance: float | None = None
    outputs: tuple[Unknown, ...]
    rates: tuple[Unknown, ...]
    initial: tuple[Unknown, ...]
    indicators: tuple[Unknown, ...] = ()
    clocks: tuple[Attributes, ...] = ()
    types: Mapping[str, str] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "types", type_names(one.entry for one in self.variables))

    def head(self, version: str, token: str) -> dict[str, object]:
        """Return the attributes of the whole; ``token`` names that of the token."""
        return {
            "fmiVersion": version,
            "modelName": self.name,
            token: self.token,
            "description": self.text or None,
            "generationTool": f"Loopwright {package_version()}",
            "variableNamingConvention": naming_convention(one.entry.name for one in self.variables),
        }

    def type_attributes(self) -> list[dict[str, object]]:
        """Return the attributes of each type."""
        return [{"name": name, "quantity": quantity(unit), "unit": unit} for unit, name in self.types.items()]

    def definitions(self, types: Iterable[str]) -> list[str]:
        """Return the elements of units and types; none for a model without units."""
        lists = (("UnitDefinitions", [unit_element(unit) for unit in self.types]), ("TypeDefinitions", [*types]))
        return [element(tag, {}, items) for tag, items in lists if items]

    def log_categories(self, more: Mapping[str, str]) -> str:
        """Return the element of the log categories."""
        rows = [element("Category", {"name": n, "description": d}) for n, d in {**LOG_CATEGORIES, **more}.items()]
        return element("LogCategories", {}, rows)

    def experiment(self) -> str:
        """Return the element of the default experiment."""
        about = {
            "startTime": 0.0,
            "stopTime": float(self.stop_time),
            "tolerance": None if self.tolerance is None else float(self.tolerance),
            "stepSize": float(self.step_size),
        }
        return element("DefaultExperiment", about)


def describe_model(spec: ModelSpec, token: str, *, derivatives: bool, fmi: int) -> ModelDescription:
    """Return the description of a model.

    ``derivatives``: whether the binary has directional and adjoint derivatives.
    """
    entries = layout(spec)
    found, reinitialized = dependencies(spec), reinitialized_states(spec)
    # In a run, unknowns list the knowns that can change between events or communication points.
    frozen = {e.reference for e in entries if e.kind in ("fixed", "discrete")}

    def in_run(chosen: Iterable[Entry]) -> tuple[Unknown, ...]:
        return tuple(Unknown(e, tuple(d for d in found[e.reference] if d.known not in frozen)) for e in chosen)

    def at_start(d: Dependency) -> Dependency:
        return d if d.kind == "constant" else Dependency(d.known, "dependent")

    return ModelDescription(
        name=spec.name,
        text=spec.description,
        token=token,
        variables=tuple(
            DescribedVariable(
                e,
                "continuous" if e.kind in ("time", "derivative") else e.variable.variability,
                is_reinitialized=e.kind == "state" and e.name in reinitialized,
                is_intermediate=(e.kind == "input" or e.is_output) and e.variable.variability == "continuous",
            )
            for e in entries
        ),
        has_derivatives=derivatives,
        interfaces=_model_interfaces(spec, fmi),
        stop_time=spec.stop_time,
        step_size=spec.step_size,
        tolerance=spec.tolerance,
        outputs=in_run(e for e in entries if e.is_output),
        rates=in_run(e for e in entries if e.kind == "derivative"),
        # States have initial = exact: they are knowns.
        initial=tuple(
            Unknown(e, tuple(map(at_start, found[e.reference]))) for e in entries if e.kind in ("derivative", "output")
        ),
        indicators=in_run(e for e in entries if e.kind == "indicator"),
    )


def _model_interfaces(spec: ModelSpec, fmi: int) -> dict[str, Attributes]:
    if fmi == 2:
        stepping: Attributes = {
            "canHandleVariableCommunicationStepSize": True,
            "canInterpolateInputs": True,
            "maxOutputDerivativeOrder": 0,
            "canRunAsynchronuously": False,
        }
        return {"ModelExchange": {"completedIntegratorStepNotNeeded": True}, "CoSimulation": stepping}
    stepping = {
        "canHandleVariableCommunicationStepSize": True,
        "maxOutputDerivativeOrder": 0,
        "providesIntermediateUpdate": True,
        "mightReturnEarlyFromDoStep": bool(spec.events),
        "canReturnEarlyAfterIntermediateUpdate": True,
        "hasEventMode": bool(spec.events),
    }
    return {"ModelExchange": {"needsCompletedIntegratorStep": False}, "CoSimulation": stepping}


# --- quantities -------------------------------------------------------------------------------------------------------


_QUANTITIES = {
    "1": "Number",
    "s": "Time",
    "Hz": "Frequency",
    "kg": "Mass",
    "m": "Length",
    "m/s": "Velocity",
    "m/s2": "Acceleration",
    "N": "Force",
    "N/m": "TranslationalStiffness",
    "N.s/m": "TranslationalDamping",
    "rad": "Angle",
    "rad/s": "AngularVelocity",
    "rad/s2": "AngularAcceleration",
    "kg.m2": "MomentOfInertia",
    "K": "Temperature",
    "W": "Power",
    "Pa": "Pressure",
    "V": "Voltage",
    "A": "Current",
    "Ohm": "Resistance",
    "H": "Inductance",
    "F": "Capacitance",
}


def type_names(entries: Iterable[Entry]) -> dict[str, str]:
    """Return the name of the type of each unit in use, in the order of the units.

    The name is that of the unit's quantity if it is a common one, else the unit's own. A name that a variable has
    already gets an underscore, since the two must differ.
    """
    entries = tuple(entries)
    taken = {e.name for e in entries}
    found = {}
    for unit in sorted({e.variable.unit for e in entries if e.variable.unit is not None}):
        name = quantity(unit) or f"Quantity in {unit}"
        while name in taken:
            name += "_"
        taken.add(name)
        found[unit] = name
    return found


def quantity(unit: str) -> str | None:
    """Return the quantity that a unit measures, by its spelling, else by its dimension; None if unknown."""
    if unit in _QUANTITIES:
        return _QUANTITIES[unit]
    exponents = parse_unit(unit).exponents
    return next((name for known, name in _QUANTITIES.items() if parse_unit(known).exponents == exponents), None)
