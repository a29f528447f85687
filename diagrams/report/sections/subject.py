"""The subject of a report: blocks, rates, FMUs, versions; and the operating points."""

from __future__ import annotations

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from ....blocks.core import Block, print_unit
from ....fmus.fmu_block import Fmu
from ...frequency import Number
from ...results import PointOrigin
from ...wiring import Wire
from ..case import Case
from ..pages import Section, Table, TableForm, Texts, plain
from ..variant import AT_REST, Variant

TEXTS = Texts(__package__, "subject")

CONFIRMED = {PointOrigin.RUN: "the run's own next tick and rates", PointOrigin.TRIM: "the trim's equations"}
"""Confirmation of the residual of an operating point."""
VALUES = frozenset({"value", "values", "initial_value", "final_value", "amplitude", "bias"})
"""Parameters of a source that are in the unit of its signal."""
MANY = 36
"""Entries up to which a parameter is shown."""
FEW = 4
"""Entries up to which a parameter is shown with nine digits, else with six."""
SUBJECT_TITLE = "What was analysed"
PACKAGES = ("loopwright", "numpy", "scipy", "casadi", "control", "fmpy", "matplotlib")

OPERATING_POINTS = TableForm(
    "Operating points",
    {
        "variant": "variant",
        "t": "t",
        "how": "how",
        "residual": "residual",
        "largest of": "largest",
        "derivative of FMUs": "plants",
    },
    {"t": "{key}.t", "residual": "{key}.residual", "affine": "{key}.affine"},
)

VARIANTS = TableForm("Variants that were analysed", {"variant": "title", "in paths": "key", "linear model": "model"})
SUBSYSTEMS = TableForm(
    "Subsystems and their rates",
    {
        "subsystem": "name",
        "sample time": "rate",
        "discretization": "method",
        "delay [samples]": "delay",
        "offset": "offset",
    },
)
FMUS = TableForm(
    "FMUs",
    {
        "block": "block",
        "model": "model",
        "version": "version",
        "made by": "tool",
        "FMI": "fmi",
        "gives": "given",
        "SHA-256": "digest",
    },
)
PARAMETERS = TableForm(
    "Parameters", {"block": "block", "type": "type", "parameter": "name", "value": "value", "unit": "unit"}
)
VERSIONS = TableForm("Versions", {"package": "package", "version": "version"}, details=True)
NAMED_WIRES = TableForm("Named wires there ({variant})", {"wire": "wire", "value": "value"}, details=True)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that computed the report."""
    return {"python": platform.python_version(), **{name: _version_of(name) for name in PACKAGES}}


@cache  # to read the description of a package takes a tenth of a small report
def _version_of(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed as a package"


def subject(case: Case) -> Section:
    """Return the section about the diagram itself."""
    diagram = case.diagram
    numbers: dict[str, Number] = {}
    subsystems, parameters, plants = [], [], []
    for path, subsystem in sorted(diagram.subsystems.items()):
        rate = diagram.structure.rate(path)
        name = path or diagram.name
        if rate is not None and subsystem.sample_time is not None:
            numbers[f"{path or 'diagram'}.sample_time"] = Number(float(rate), "s", 0.0, "given, exact", given=True)
        rated = "continuous" if rate is None else f"{float(rate):g} s"
        sampled = {
            "method": subsystem.method,
            "delay": subsystem.delay,
            "offset": f"{float(subsystem.offset):g} s",
        }
        held = {"method": "", "delay": "–", "offset": "–"} if rate is None else sampled
        subsystems.append({"name": name, "rate": rated, **held})
    for path, block in sorted(diagram.blocks.items()):
        rows = list(_fmu_parameters(block) if isinstance(block, Fmu) else _parameters(block))
        for name, shown, unit, value in rows:
            # Parameters without effect are listed in one line below the table; their numbers stay in the JSON.
            if name not in block.idle_parameters:
                facts = {"block": path, "type": type(block).__name__, "name": name}
                parameters.append({**facts, "value": shown, "unit": print_unit(unit)})
            if isinstance(value, float) and np.isfinite(value):
                numbers[f"{path}.{name}"] = Number(value, unit or "1", 0.0, "given", given=True)
        if isinstance(block, Fmu):
            plants.append(_plant(path, block))
    tables = [_variants(case), SUBSYSTEMS.fill(subsystems), *([FMUS.fill(plants)] if plants else [])]
    found = [(path, block, name) for path, block in sorted(diagram.blocks.items()) for name in block.idle_parameters]
    idle = sorted(f"{path}.{name}" for path, block, name in found if getattr(block, name) is not None)
    said = (TEXTS.line("idle", names=idle),) if idle else ()
    listed = (PARAMETERS.fill(parameters),)
    parts = (Section("parameters", "Parameters", said, tables=listed),) if parameters else ()
    tables.append(VERSIONS.fill({"package": name, "version": number} for name, number in versions().items()))
    text = [TEXTS.line("diagram", name=diagram.name, blocks=len(diagram.blocks), wires=len(diagram.names))]
    if case.experiment is not None:
        name = case.experiment.diagram.name.replace("_", " ")
        text.append(TEXTS.line("experiment", letter=case.experiment.letter, name=name))
    return Section("subject", SUBJECT_TITLE, tuple(text), tuple(tables), (), numbers, parts)


def remarks(case: Case) -> Section | None:
    """Return the remarks on how the variants were made, None where there are none."""
    return Section("subject", SUBJECT_TITLE, tuple(case.notes)) if case.notes else None


def _parameters(block: Block) -> Any:
    for name, spec in block.parameter_specs.items():
        value = getattr(block, name)
        if name == "unit" and isinstance(value, str):
            continue  # it is next to the value
        if hasattr(value, "parameter_specs"):
            inner = ", ".join(f"{n} = {_shown(getattr(value, n))}" for n in value.parameter_specs if n[:6] != "start_")
            yield name, f"{type(value).__name__}({inner})", "", value
        elif value is not None and not (isinstance(value, dict) and not value):
            own = getattr(block, "unit", None)
            yield name, _shown(value), spec.unit or (str(own) if own and name in VALUES else ""), value


def _fmu_parameters(block: Fmu) -> Any:
    """Yield the FMU's parameters with the values that they have here, and the block's own options."""
    for name, variable in sorted(block.description.variables.items()):
        value = block.start.get(name, variable.start)
        if variable.causality == "parameter" and value is not None and np.size(value) <= MANY:
            yield name, _shown(np.asarray(value, dtype=float)), variable.unit or "", value
    for name in sorted(set(block.start) - set(block.description.of("parameter"))):
        yield f"start.{name}", _shown(block.start[name]), "", None
    if block.rename:
        yield "rename", _shown(block.rename), "", None


def _variants(case: Case) -> Table:
    """Return the table of the variants: their names, and their parts of dotted paths."""
    rows = []
    for v in case.variants.values():
        rate = "sampled" if not v.problem and v.model.dt else "–" if v.problem else "continuous"
        model = "left out" if v.problem else f"{rate}, order {len(v.model.states)}"
        rows.append({"title": v.title, "key": v.key, "model": model})
    return VARIANTS.fill(rows)


def _shown(value: Any) -> str:
    if isinstance(value, float | np.ndarray) and np.ndim(value) == 0:
        return plain(float(value), 9)
    if isinstance(value, np.ndarray):
        if value.size > MANY:
            return "array of " + " × ".join(map(str, value.shape))
        digits = 9 if value.size <= FEW else 6
        if value.ndim == 2:
            return "(" + "; ".join(", ".join(plain(float(v), digits) for v in row) for row in value) + ")"
        return "(" + ", ".join(plain(float(v), digits) if np.ndim(v) == 0 else _shown(v) for v in value) + ")"
    if callable(value):
        return str(getattr(value, "__name__", type(value).__name__))  # no address in memory
    if hasattr(value, "items"):
        return ", ".join(f"{k} = {_shown(v)}" for k, v in value.items())
    return str(value)


def _plant(path: str, block: Fmu) -> dict[str, Any]:
    """Return the facts of `FMUS` of a block."""
    d = block.description
    given = [
        name
        for name, has in (
            ("derivatives in co-simulation", d.has_derivatives),
            ("derivatives in model exchange", d.model_exchange_has_derivatives),
            ("saving of its state", d.can_save),
        )
        if has
    ]
    facts = {"block": path, "model": d.model_name, "version": d.model_version or "–", "tool": d.generation_tool or "–"}
    return {**facts, "fmi": d.fmi, "given": ", ".join(given) or "–", "digest": d.digest}


def operating_points(case: Case) -> Section:
    """Return the section about where the linear models were made."""
    rows, notes = [], []
    for v in case.usable():
        point, model = v.point, v.model
        how = CONFIRMED.get(point.how, str(point.how))
        worst = float(np.max(np.abs(model.affine), initial=0.0))
        rows.append(
            {
                "variant": v.title,
                "key": v.key,
                "t": Number(point.t, "s", 0.0, "given", given=True),
                "how": point.how,
                "residual": Number(point.residual, "1", 1e-15, how),
                "largest": point.largest,
                "affine": Number(worst, "1", 1e-12 * (1 + worst), "the linear model's affine term"),
                "plants": "; ".join(f"{p}: {h}" for p, h in model.how.items()),
            }
        )
        if not point.residual < AT_REST:
            notes.append(_moving(v))
        hidden = [p for p, b in v.diagram.blocks.items() if isinstance(b, Fmu) and not b.description.states]
        if hidden:
            notes.append(TEXTS.line("hidden_states", variant=v.title, plants=sorted(hidden)))
        notes += [f"{v.title}: {finding}" for finding in model.findings]
    tables = [OPERATING_POINTS.fill(rows)]
    first = next(case.usable(), None)
    if first is not None:
        values = (
            {"wire": name, "value": _shown(_rounded(_value(first, wire)))}
            for name, wire in sorted(first.diagram.names.items())
            if f"{wire.block}.{wire.port}" in first.point.values
        )
        tables.append(NAMED_WIRES.fill(values, variant=first.title))
    text = (*TEXTS.paragraphs("operating_points"), *notes)
    return Section("operating_points", "Operating points", text, tuple(tables))


def _moving(v: Variant) -> str:
    """Return the notes on an operating point that is no equilibrium."""
    return TEXTS.line("moving", variant=v.title, point=v.point, alone=v.moving_alone)


def _rounded(value: Any) -> Any:
    """Return a value without rounding errors: entries below 1e-12 of the largest, or of 1, are 0; nine digits."""
    data = np.asarray(value, dtype=float)
    small = np.abs(data) <= 1e-12 * max(1.0, float(np.max(np.abs(data), initial=0.0)))
    return np.where(small, 0.0, data)


def _value(v: Variant, wire: Wire) -> Any:
    value = np.asarray(v.point.values[f"{wire.block}.{wire.port}"])
    return value if wire.index is None else np.asarray(value[wire.index])
