"""XML files of an FMI 3.0 FMU: ``modelDescription.xml`` and ``sources/buildDescription.xml``.

Both depend on the model only: they have no time stamp and no random identifier.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any
from xml.sax.saxutils import quoteattr

import casadi as ca

from ...blocks.core import BASE_UNITS, Layout, parse_unit
from .c_code import Entry, expand_scalar, layout, to_symbols
from .model_spec import ModelSpec, Variable, naming_convention
from .quantities import quantity, type_names

#: Log categories (FMI 3.0, 2.4.5) that the runtime uses.
LOG_CATEGORIES = {
    "logStatusWarning": "Warnings",
    "logStatusError": "Errors, with the value found, the value expected, and the next step",
}
# Operations whose derivative is zero almost everywhere: with them, a constant derivative means no linear equation.
_STEP_LIKE = {ca.OP_FLOOR, ca.OP_CEIL, ca.OP_SIGN, ca.OP_COPYSIGN, ca.OP_FMOD, ca.OP_REMAINDER, ca.OP_IF_ELSE_ZERO}
_STEP_LIKE |= {ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR}


@lru_cache(maxsize=1)
def package_version() -> str:
    """Return the version of this package; ``0`` if it is not installed."""
    try:
        return importlib.metadata.version("loopwright")
    except importlib.metadata.PackageNotFoundError:
        return "0"


@dataclass(frozen=True)
class Dependency:
    """Dependency of an unknown on a known (FMI 3.0, 2.4.8)."""

    known: int
    kind: str


def _element(tag: str, attributes: Mapping[str, object], children: Iterable[str] = ()) -> str:
    text = "".join(f" {name}={quoteattr(_text(value))}" for name, value in attributes.items() if value is not None)
    inner = [f"  {line}" for child in children for line in child.splitlines()]
    return "\n".join([f"<{tag}{text}>", *inner, f"</{tag}>"]) if inner else f"<{tag}{text}/>"


def _document(tag: str, attributes: Mapping[str, object], children: Iterable[str]) -> str:
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{_element(tag, attributes, children)}\n'


def log_categories(fmi: int) -> str:
    """Return the element of the log categories; FMI 2.0 has one for all of them, too."""
    found = LOG_CATEGORIES | ({"logAll": "All of them"} if fmi == 2 else {})
    return _element(
        "LogCategories", {}, [_element("Category", {"name": n, "description": d}) for n, d in found.items()]
    )


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


# ---- dependencies, from the traced sparsity ----


def _pairs(sparsity: Any) -> list[tuple[int, int]]:
    return list(zip(*sparsity.get_triplet(), strict=True)) if sparsity.nnz() else []


def _entry_at(entries: tuple[Entry, ...]) -> list[Entry]:
    return [e for e in entries for _ in range(e.variable.size)]


def _second_order(knowns: Any, unknowns: Any) -> dict[tuple[int, int], set[int]] | None:
    """Return the knowns on which each element (unknown, known) of the Jacobian depends; None if they can't be found."""
    try:
        f = ca.Function("f", [knowns], [unknowns]).expand()
    except RuntimeError:  # interpolation tables and the like have no scalar expansion
        return None
    if any(f.instruction_id(k) in _STEP_LIKE for k in range(f.n_instructions())):
        return None
    v = f.sx_in(0)
    jacobian = ca.jacobian(f(v), v)
    elements = ca.sparsity_cast(jacobian, ca.Sparsity.dense(jacobian.nnz(), 1))
    found: dict[tuple[int, int], set[int]] = {pair: set() for pair in _pairs(jacobian.sparsity())}
    order = list(found)
    for row, known in _pairs(ca.Function("elements", [v], [elements]).jac_sparsity(0, 0)):
        found[order[row]].add(known)
    return found


def _kind(of: Iterable[set[int] | None], at: list[Entry]) -> str:
    """Return the kind of a dependency, from the knowns on which its Jacobian's elements depend (None: not found)."""
    kinds: set[str] = set()
    for elements in of:
        if elements is None:
            return "dependent"
        kinds |= {at[i].kind for i in elements}
    if kinds - {"fixed", "tunable", "discrete"}:
        return "dependent"
    return next((kind for kind in ("discrete", "tunable", "fixed") if kind in kinds), "constant")


def dependencies(spec: ModelSpec) -> dict[int, tuple[Dependency, ...]]:
    """Return the dependencies of outputs, derivatives and event indicators on time, parameters, inputs and states.

    Returns: dependencies by the value reference of the unknown, in the order of value references.
    """
    entries = layout(spec)
    at = _entry_at(entries)
    knowns, unknowns = to_symbols(spec)
    calculated = ("derivative", "output", "indicator")
    first = next((e.first for e in entries if e.kind in calculated), 0)
    second = _second_order(knowns, unknowns)
    blocks: dict[tuple[int, int], list[set[int] | None]] = {}
    for row, column in _pairs(ca.Function("f", [knowns], [unknowns]).jac_sparsity(0, 0)):
        pair = (at[first + row].reference, at[column].reference)
        blocks.setdefault(pair, []).append(None if second is None else second.get((row, column)))
    found: dict[int, list[Dependency]] = {e.reference: [] for e in entries if e.kind in calculated}
    for unknown, known in sorted(blocks):
        found[unknown].append(Dependency(known, _kind(blocks[unknown, known], at)))
    for e in entries:
        if e.kind == "state" and e.is_output:  # a state is its own known
            found[e.reference] = [Dependency(e.reference, "constant")]
        if e.kind == "discrete" and e.is_output:  # it changes only between two iterations of an event
            found[e.reference] = []
    return {reference: tuple(items) for reference, items in found.items()}


def _unknown(tag: str, reference: int, items: Iterable[Dependency]) -> str:
    items = list(items)
    attributes = {
        "valueReference": reference,
        "dependencies": " ".join(str(d.known) for d in items),
        "dependenciesKind": " ".join(d.kind for d in items),
    }
    return _element(tag, attributes)


def _structure(spec: ModelSpec, entries: tuple[Entry, ...]) -> list[str]:
    """Return the elements of the model structure (FMI 3.0, 2.4.8).

    Outputs, derivatives and event indicators list the knowns that can change between events or communication points;
    fixed parameters and discrete states are constant there. Initial unknowns are computed outputs and derivatives;
    states have initial = exact and are knowns.
    """
    found = dependencies(spec)
    frozen = {e.reference for e in entries if e.kind in ("fixed", "discrete")}
    rows = []
    for tag, chosen in (
        ("Output", [e for e in entries if e.is_output]),
        ("ContinuousStateDerivative", [e for e in entries if e.kind == "derivative"]),
    ):
        rows += [_unknown(tag, e.reference, [d for d in found[e.reference] if d.known not in frozen]) for e in chosen]
    for e in entries:
        if e.kind in ("derivative", "output"):
            items = [Dependency(d.known, d.kind if d.kind == "constant" else "dependent") for d in found[e.reference]]
            rows.append(_unknown("InitialUnknown", e.reference, items))
    for e in entries:
        if e.kind == "indicator":
            items = [d for d in found[e.reference] if d.known not in frozen]
            rows.append(_unknown("EventIndicator", e.reference, items))
    return rows


def _reinitialized_states(spec: ModelSpec) -> set[str]:
    """Return the names of the continuous states that a jump may change (FMI 3.0, 2.4.7.4: reinit)."""
    if spec.jump is None:
        return set()
    jump = expand_scalar(spec.jump)
    if not jump.is_a("SXFunction"):
        return {v.name for v in spec.continuous}
    args = jump.sx_in()
    after = ca.densify(ca.reshape(jump.call(args, True, False)[0], jump.numel_out(0), 1))
    changed = [not ca.is_equal(after[i], args[1][i], 2) for i in range(after.numel())]
    places = Layout.of({v.name: v.shape for v in spec.continuous})
    return {name for name, where in places.slices.items() if any(changed[where])}


# ---- variables and units ----

_CAUSALITY = {"time": "independent", "fixed": "parameter", "tunable": "parameter", "input": "input"}
_INITIAL = dict.fromkeys(("fixed", "tunable", "state", "discrete"), "exact")
_INITIAL |= dict.fromkeys(("derivative", "output", "indicator"), "calculated")


def describe_entry(e: Entry, variability: str) -> dict[str, object]:
    """Return the attributes that a variable has in both versions of FMI, whatever its type."""
    return {
        "name": e.name,
        "valueReference": e.reference,
        "description": e.variable.description or None,
        "causality": _CAUSALITY.get(e.kind, "output" if e.is_output else "local"),
        "variability": variability,
        "initial": _INITIAL.get(e.kind),
    }


def describe_values(v: Variable, types: Mapping[str, str]) -> dict[str, object]:
    """Return the attributes of a real variable in both versions of FMI: type, unit, range, nominal value."""
    return {
        "declaredType": types.get(v.unit or ""),
        "unit": v.unit,
        "min": None if v.minimum is None else float(v.minimum),
        "max": None if v.maximum is None else float(v.maximum),
        "nominal": None if v.nominal is None else float(v.nominal),
    }


def _variable(e: Entry, reinitialized: set[str], types: Mapping[str, str]) -> str:
    v = e.variable
    variability = "continuous" if e.kind in ("time", "derivative") else v.variability
    attributes = describe_entry(e, variability) | {
        "intermediateUpdate": True if (e.kind == "input" or e.is_output) and v.variability == "continuous" else None,
    }
    attributes |= describe_values(v, types) | {
        "start": " ".join(map(repr, v.flat_start)) or None,
        "derivative": e.of,
        "reinit": True if e.kind == "state" and e.name in reinitialized else None,
    }
    return _element("Float64", attributes, [_element("Dimension", {"start": n}) for n in v.shape])


def _unit(text: str) -> str:
    unit = parse_unit(text)
    base: dict[str, object] = {name: n for name, n in zip(BASE_UNITS, unit.exponents, strict=True) if n}
    if unit.factor != 1:
        base["factor"] = unit.factor
    if unit.offset:
        base["offset"] = unit.offset
    return _element("Unit", {"name": text}, [_element("BaseUnit", base)])


def _types(types: Mapping[str, str]) -> list[dict[str, object]]:
    """Return the attributes of each type."""
    return [{"name": name, "quantity": quantity(unit), "unit": unit} for unit, name in types.items()]


def _units_and_types(units: Iterable[str], types: Iterable[str]) -> list[str]:
    """Return the elements of both lists of definitions; none for a model without units."""
    lists = (("UnitDefinitions", [_unit(unit) for unit in units]), ("TypeDefinitions", list(types)))
    return [_element(tag, {}, items) for tag, items in lists if items]


# ---- the files ----


def model_description(spec: ModelSpec, token: str, *, derivatives: bool) -> str:
    """Return the text of ``modelDescription.xml`` (FMI 3.0, 2.4).

    ``derivatives``: whether the binary has directional and adjoint derivatives.
    """
    entries = layout(spec)
    root = {
        "fmiVersion": "3.0",
        "modelName": spec.name,
        "instantiationToken": token,
        "description": spec.description or None,
        "generationTool": f"Loopwright {package_version()}",
        "variableNamingConvention": naming_convention(e.name for e in entries),
    }
    both: dict[str, object] = {
        "modelIdentifier": spec.name,
        "canGetAndSetFMUState": True,
        "canSerializeFMUState": True,
        "providesDirectionalDerivatives": derivatives,
        "providesAdjointDerivatives": derivatives,
    }
    stepping = {
        "canHandleVariableCommunicationStepSize": True,
        "maxOutputDerivativeOrder": 0,
        "providesIntermediateUpdate": True,
        "mightReturnEarlyFromDoStep": bool(spec.events),
        "canReturnEarlyAfterIntermediateUpdate": True,
        "hasEventMode": bool(spec.events),
    }
    experiment = {
        "startTime": 0.0,
        "stopTime": float(spec.stop_time),
        "tolerance": float(spec.tolerance),
        "stepSize": float(spec.step_size),
    }
    reinitialized = _reinitialized_states(spec)
    types = type_names(entries)
    children = [
        _element("ModelExchange", both | {"needsCompletedIntegratorStep": False}),
        _element("CoSimulation", both | stepping),
        *_units_and_types(types, [_element("Float64Type", about) for about in _types(types)]),
        log_categories(3),
        _element("DefaultExperiment", experiment),
        _element("ModelVariables", {}, [_variable(e, reinitialized, types) for e in entries]),
        _element("ModelStructure", {}, _structure(spec, entries)),
    ]
    return _document("fmiModelDescription", root, children)


def build_description(name: str) -> str:
    """Return the text of ``sources/buildDescription.xml`` (FMI 3.0, 2.5.1.3) of a model, with one file to compile."""
    files = _element("SourceFileSet", {"language": "C11"}, [_element("SourceFile", {"name": "model.c"})])
    configuration = _element("BuildConfiguration", {"modelIdentifier": name}, [files])
    return _document("fmiBuildDescription", {"fmiVersion": "3.0"}, [configuration])
