"""FMU of a diagram: its C text behind FMI's functions, its descriptions in FMI 3.0 and 2.0, its page of documentation.

The functions of FMI are those of exported models (``runtime/fmi3.c``, ``fmi2.c``), for co-simulation alone; behind them
is the loop of the diagram (``runtime/loop.c``) in place of a model's integrators.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from html import escape

from ...blocks.core import lay_out
from .c_code import ORDER, Entry, Kind, _rate, _starts, _table
from .c_text import c_array
from .elementary_tables import read_runtime
from .html_page import page_of
from .loop_spec import LoopSpec, Placed, write_unit
from .model_spec import Variable, naming_convention
from .quantities import type_names
from .scalars import _elements
from .xml_fmi2 import simple_types
from .xml_fmi3 import (
    _document,
    _element,
    _types,
    _units_and_types,
    describe_entry,
    describe_values,
    log_categories,
    package_version,
)

_COMMON = ("model.h", "core.c", "loop.c")
RUNTIME = {3: (*_COMMON, "fmi3.c", "fmi3_events.c", "fmi3_refused.c"), 2: (*_COMMON, "fmi2.c", "fmi2_refused.c")}


def scalarize_loop(spec: LoopSpec) -> LoopSpec:
    """Return the diagram with every array replaced by its elements."""

    def scalars(group: Iterable[Placed]) -> Iterator[Placed]:
        for one in group:
            if not one.variable.shape:
                yield one
                continue
            rates: list[tuple[int, ...]] = [(rate,) for rate in one.rates]
            each = rates or [()] * len(one.places)
            for element, place, rate in zip(_elements(one.variable), one.places, each, strict=True):
                yield replace(one, variable=element, places=(place,), rates=rate)

    return replace(
        spec,
        inputs=tuple(scalars(spec.inputs)),
        outputs=tuple(scalars(spec.outputs)),
        signals=tuple(scalars(spec.signals)),
        parameters=tuple(scalars(spec.parameters)),
        states=tuple(scalars(spec.states)),
    )


def loop_rows(spec: LoopSpec) -> list[tuple[Kind, Placed]]:
    """Return the variables behind the time, in the order of ``model.h``."""
    rows: list[tuple[Kind, Placed]] = [
        ("tunable" if one.variable.variability == "tunable" else "fixed", one) for one in spec.parameters
    ]
    rows += [("input", one) for one in spec.inputs]
    integrated = [one for one in spec.states if one.rates]
    rows += [("state", one) for one in integrated]
    rows += [("discrete", one) for one in spec.states if one.variable.state and not one.rates]
    rows += [("derivative", _rate_of(one)) for one in integrated]
    rows += [("output", one) for one in (*spec.outputs, *spec.signals)]
    rows += [("output", one) for one in spec.states if not one.variable.state]
    return rows


def _rate_of(one: Placed) -> Placed:
    """Return the rates of a continuous state as a variable."""
    return Placed(_rate(one.variable), "rates", one.rates)


def loop_layout(spec: LoopSpec) -> tuple[Entry, ...]:
    """Return all variables with value references and places among the values, in the order of ``model.h``."""
    time = Variable("t", unit="s", description="Simulation time")
    rows: list[tuple[Kind, Variable, str]] = [("time", time, "time")]
    rows += [(kind, one.variable, one.variable.name) for kind, one in loop_rows(spec)]
    names = iter([f"der({name})" for kind, _, name in rows if kind == "state"])
    rows = [(kind, v, next(names) if kind == "derivative" else name) for kind, v, name in rows]
    places = lay_out(v.size for _, v, _ in rows)
    states = iter([reference for reference, (kind, _, _) in enumerate(rows) if kind == "state"])
    return tuple(
        Entry(reference, kind, variable, name, place.start, next(states) if kind == "derivative" else None)
        for reference, ((kind, variable, name), place) in enumerate(zip(rows, places, strict=True))
    )


@dataclass(frozen=True)
class OfferedClock:
    """A clock of a diagram as a periodic input clock of its FMU (FMI 3.0, 2.2.9).

    ``interval``, ``shift``: seconds between two ticks, and before the first one.
    """

    name: str
    description: str
    reference: int
    interval: Fraction
    shift: Fraction


def offered_clocks(spec: LoopSpec, fmi: int) -> tuple[OfferedClock, ...]:
    """Return the clocks that an FMU of a diagram offers, in the order of `LoopSpec.clocks`; none in FMI 2.0."""
    if fmi != 3 or not spec.offers_clocks:
        return ()
    entries = loop_layout(spec)
    taken = {entry.name for entry in entries}
    found: list[OfferedClock] = []
    for i, ((every, offset), members) in enumerate(zip(spec.clocks, spec.clocked, strict=True)):
        name = "clock" if len(spec.clocks) == 1 else f"clock_{i + 1}"
        while name in taken:
            name += "_"
        taken.add(name)
        about = f"Ticks of {members or spec.name}"
        found.append(OfferedClock(name, about, len(entries) + i, every * spec.base, offset * spec.base))
    return tuple(found)


# ---- C text ----


def generate_loop(spec: LoopSpec, token: str, fmi: int) -> str:
    """Return the text of ``model.c``; see `loopwright.fmus.export.c_code.generate`."""
    entries = loop_layout(spec)
    clocks = offered_clocks(spec, fmi)
    parts = [
        _dimensions(spec, entries, token, fmi, len(clocks)),
        write_unit(spec, own_functions=spec.own_functions),
        *_slopes(spec),
        '#include "model.h"\n',
        _table(entries),
        _starts(entries),
        *_places(spec),
        *_labels(spec),
        c_array("char *const", "lw_clock_names", (f'"{clock.name}"' for clock in clocks)) if clocks else "",
        "static const double lw_nominals[] = {1.0};\n",
        "".join(f'#include "{name}"\n' for name in RUNTIME[fmi][1:]),
    ]
    return "\n".join(parts)


def _dimensions(spec: LoopSpec, entries: tuple[Entry, ...], token: str, fmi: int, clocks: int) -> str:
    def count(*kinds: str) -> int:
        return sum(e.variable.size for e in entries if e.kind in kinds)

    numbers = {"P": count("fixed", "tunable"), "U": count("input"), "X": count("state"), "D": count("discrete")}
    numbers |= {"Y": count("output"), "Z": 0, "J": 0, "VARIABLES": len(entries), "LABELS": len(spec.labels)}
    lines = [
        "#define LW_LOOP 1",
        f'#define LW_MODEL_NAME "{spec.name}"',
        f'#define LW_TOKEN "{token}"',
        f'#define LW_API "fmi{fmi}"',
        f"#define LW_FMI {fmi}",
        f'#define LW_ORDER "{ORDER[fmi]}"',
        f"#define LW_ON_TICKS {int(spec.steps_on_ticks)}",
        f"#define LW_CLOCKS {clocks}",
        f"#define LW_LOGGED {_logged(spec)}",
        f"#define LW_HAS_DERIVATIVES {int(spec.slopes is not None)}",
        *(f"#define LW_N_{letter} {number}" for letter, number in numbers.items()),
        *(f"#define LW_SZ_{kind} 1" for kind in ("ARG", "RES", "IW", "W")),
    ]
    return "\n".join(lines) + "\n"


def _places(spec: LoopSpec) -> Iterator[str]:
    """Yield the tables that say where each value is in the memory."""
    groups = {"p": ("fixed", "tunable"), "u": ("input",), "x": ("state",), "d": ("discrete",)}
    groups |= {"dx": ("derivative",), "y": ("output",)}
    for letter, kinds in groups.items():
        found = [
            _code_of(spec, one, place) if letter == "y" else place
            for kind, one in loop_rows(spec)
            if kind in kinds
            for place in one.places
        ]
        yield c_array("int32_t", f"lw_places_{letter}", found)


def _code_of(spec: LoopSpec, one: Placed, place: int) -> int:
    """Return where the value of an output is, as `runtime/loop.c` reads it."""
    return {"x": -1 - place, "w": _logged(spec) + place}.get(one.vector, place)


def _logged(spec: LoopSpec) -> int:
    return next(one.length for one in spec.memory.fields if one.name == "log")


def _slopes(spec: LoopSpec) -> Iterator[str]:
    """Yield the C text of the derivatives: the functions of each kind of tick, and where the outputs are among them."""
    slopes = spec.slopes
    if slopes is None:
        return
    index = {entry: i for i, entry in enumerate(slopes.entries)}
    outputs = [one for kind, one in loop_rows(spec) if kind == "output"]
    found = [index[place] if one.vector == "log" else -1 - place for one in outputs for place in one.places]
    yield c_array("int32_t", "lw_slope_places", found)
    yield f"#define LW_N_SLOPES {len(slopes.entries) + slopes.rates}"
    yield f"#define LW_FIRST_RATE {len(slopes.entries)}"
    yield f"#define LW_HAS_START_SLOPES {int(bool(slopes.start))}"
    vectors = ("&m->now", "m->x", "m->w", "m->p")
    groups = {"forward": slopes.forward, "reverse": slopes.reverse}
    for name, functions in groups.items():
        yield f"/* The product of the {'transposed ' * (name == 'reverse')}Jacobian with a seed, at a kind of tick. */"
        yield f"static bool lw_{name}_at(const lw_memory *m, int64_t kind, const double *seed, double *found) {{"
        for kind, function in enumerate(functions):
            yield f"    if (kind == {kind}) {{"
            yield from function.call((*vectors, "seed"), "found", " " * 8)
            yield f"        return !{function.name}(arguments, results, iw, w, 0);"
            yield "    }"
        yield "    return (void)m, (void)seed, (void)found, false;"
        yield "}\n"
    for name, function in zip(groups, slopes.start, strict=False):
        yield f"static bool lw_{name}_start(const lw_memory *m, const double *seed, double *found) {{"
        yield from function.call((*vectors, "seed"), "found", " " * 4)
        yield f"    return !{function.name}(arguments, results, iw, w, 0);"
        yield "}\n"
    if slopes.function is not None:
        yield "static bool lw_rates_at(const lw_memory *m, double *found) {"
        yield from slopes.function.call(vectors, "found", " " * 4)
        yield f"    return !{slopes.function.name}(arguments, results, iw, w, 0);"
        yield "}\n"


def _labels(spec: LoopSpec) -> Iterator[str]:
    """Yield the table of the outputs of blocks."""
    yield "typedef struct {\n    const char *block, *port;\n    uint32_t first, size;\n} lw_label;\n"
    rows = [f'{{"{block}", "{port}", {first}, {size}}}' for block, port, first, size in spec.labels]
    yield c_array("lw_label", "lw_labels", rows or ['{"", "", 0, 0}'])


@lru_cache(maxsize=2)
def loop_runtime(fmi: int) -> dict[str, str]:
    """Return the text of the files that ``model.c`` of a diagram includes, by name."""
    return {name: read_runtime(name) for name in RUNTIME[fmi]}


# ---- descriptions ----


def about_steps(spec: LoopSpec, fmi: int) -> str:
    """Return in words when ticks act, which an importer has to know."""
    base = f"{float(spec.base):.9g} s"
    ticks = f"It is sampled (time between two ticks: {base}). " if spec.clocks else ""
    fit = (
        "Communication steps go from tick to tick. "
        if spec.steps_on_ticks
        else "Communication steps may have any length. "
    )
    acts = (
        "A tick acts at the start of a communication step, with the inputs that are set for it: step this FMU before "
        "the plant that it acts on, after its inputs were set from the plant's outputs. An importer that exchanges all "
        "values at once between two steps has one sample more of delay in the loop. "
        if spec.clocks
        else ""
    )
    starts = (
        f"The start of {', '.join(spec.found_at_build)} was found by Python when this was built, for the start values "
        "of the inputs: set it where these start elsewhere. "
        if spec.found_at_build
        else ""
    )
    clocks = [clock.name for clock in offered_clocks(spec, fmi)]
    exact = (
        f"With Event Mode the importer makes the ticks by {'the input clock' if len(clocks) == 1 else 'input clocks,'} "
        f"{', '.join(clocks)}, and values that are exchanged at a tick belong to that tick. "
        if clocks
        else ""
    )
    return f"{ticks}{fit}{acts}{exact}{starts}".strip()


def _variability(kind: str, one: Placed | None) -> str:
    if one is None:
        return "continuous"
    if kind in ("fixed", "tunable"):
        return kind
    return "discrete" if one.sampled and kind != "input" else "continuous"


def describe_loop(spec: LoopSpec, token: str, fmi: int) -> str:
    """Return the text of ``modelDescription.xml`` (FMI 3.0, 2.4; FMI 2.0, 2.2)."""
    return (_describe2 if fmi == 2 else _describe3)(spec, token)


def _attributes(entry: Entry, one: Placed | None) -> dict[str, object]:
    return describe_entry(entry, _variability(entry.kind, one))


def _experiment(spec: LoopSpec) -> str:
    about = {"startTime": 0.0, "stopTime": float(spec.stop_time), "stepSize": float(spec.step_size)}
    return _element("DefaultExperiment", about)


def _dependencies(spec: LoopSpec, entry: Entry, inputs: dict[int, Entry]) -> list[Entry]:
    """Return the inputs that an output or another signal depends on at an instant.

    With derivatives all that it depends on, since an importer takes those as zero that are not listed.
    """
    if spec.slopes is not None:
        return _knowns(spec, entry)
    found = spec.depends.get(entry.name.partition("[")[0], tuple(inputs))
    return [inputs[i] for i in found if i in inputs]


def _knowns(spec: LoopSpec, entry: Entry) -> list[Entry]:
    """Return everything that an output or a rate depends on at an instant: time, parameters, inputs, states."""
    vector_of = {"fixed": "p", "tunable": "p", "input": "w", "state": "x", "discrete": "x"}
    found: list[Entry] = []
    one = next(p for e, p in _rows(spec) if e.reference == entry.reference)
    assert one is not None
    needed = frozenset[tuple[str, int]]().union(*(spec.knowns.get((one.vector, i), frozenset()) for i in one.places))
    for known, placed in _rows(spec):
        vector = "t" if placed is None else vector_of.get(known.kind)
        places = (0,) if placed is None else placed.places
        if any((vector, place) in needed for place in places):
            found.append(known)
    return found


def _inputs(spec: LoopSpec, entries: tuple[Entry, ...]) -> dict[int, Entry]:
    """Return the inputs by the entry of w that they begin with."""
    given = [e for e in entries if e.kind == "input"]
    return {place: e for e, one in zip(given, spec.inputs, strict=True) for place in one.places}


def _rows(spec: LoopSpec) -> list[tuple[Entry, Placed | None]]:
    return [*zip(loop_layout(spec), (None, *(one for _, one in loop_rows(spec))), strict=True)]


def _describe3(spec: LoopSpec, token: str) -> str:
    rows = _rows(spec)
    clocks = offered_clocks(spec, 3)
    entries = tuple(entry for entry, _ in rows)
    types = type_names(entries)
    inputs = _inputs(spec, entries)
    root = {
        "fmiVersion": "3.0",
        "modelName": spec.name,
        "instantiationToken": token,
        "description": f"{spec.description} {about_steps(spec, 3)}".strip(),
        "generationTool": f"Loopwright {package_version()}",
        "variableNamingConvention": naming_convention(e.name for e in entries),
    }
    stepping: dict[str, object] = {
        "modelIdentifier": spec.name,
        "canGetAndSetFMUState": True,
        "canSerializeFMUState": True,
        "canHandleVariableCommunicationStepSize": True,
        "hasEventMode": bool(clocks) or None,
        "mightReturnEarlyFromDoStep": bool(clocks) or None,
        "fixedInternalStepSize": float(spec.base) if spec.steps_on_ticks else None,
        "maxOutputDerivativeOrder": 0,
        "providesDirectionalDerivatives": spec.slopes is not None or None,
        "providesAdjointDerivatives": spec.slopes is not None or None,
    }
    variables = [
        _element(
            "Float64",
            _attributes(entry, one)
            | describe_values(entry.variable, types)
            | {"start": " ".join(map(repr, entry.variable.flat_start)) or None}
            | {"clocks": _clock_of(entry, one, clocks), "derivative": entry.of},
            [_element("Dimension", {"start": n}) for n in entry.variable.shape],
        )
        for entry, one in rows
    ]
    variables += [_element("Clock", _clock_attributes(clock, spec)) for clock in clocks]
    structure = []
    for tag, entry in _unknowns(entries):
        needed = dict.fromkeys(e.reference for e in _dependencies(spec, entry, inputs))
        if entry.is_output:
            needed |= dict.fromkeys(clock.reference for clock in clocks)  # what is held changes at ticks
        about = {
            "valueReference": entry.reference,
            "dependencies": " ".join(map(str, needed)),
            "dependenciesKind": " ".join(["dependent"] * len(needed)),
        }
        structure.append(_element(tag, about))
    structure += [_element("InitialUnknown", {"valueReference": e.reference}) for _, e in _unknowns(entries)]
    children = [
        _element("CoSimulation", stepping),
        *_units_and_types(types, [_element("Float64Type", about) for about in _types(types)]),
        log_categories(3),
        _experiment(spec),
        _element("ModelVariables", {}, variables),
        _element("ModelStructure", {}, structure),
    ]
    return _document("fmiModelDescription", root, children)


def _unknowns(entries: tuple[Entry, ...]) -> list[tuple[str, Entry]]:
    """Return outputs, then derivatives of continuous states, with their elements in FMI 3.0's model structure."""
    outputs = [("Output", entry) for entry in entries if entry.is_output]
    return outputs + [("ContinuousStateDerivative", entry) for entry in entries if entry.kind == "derivative"]


def _clock_of(entry: Entry, one: Placed | None, clocks: tuple[OfferedClock, ...]) -> int | None:
    """Return the clock of a variable that is clocked: local ones. Outputs are held, and can be read at any time."""
    if one is None or one.clock is None or not clocks or entry.is_output or entry.kind not in ("discrete", "output"):
        return None
    return clocks[one.clock].reference


def _clock_attributes(clock: OfferedClock, spec: LoopSpec) -> dict[str, object]:
    resolution = spec.base.denominator
    return {
        "name": clock.name,
        "valueReference": clock.reference,
        "description": clock.description,
        "causality": "input",
        "variability": "discrete",
        "intervalVariability": "constant",
        "intervalDecimal": float(clock.interval),
        "shiftDecimal": float(clock.shift) or None,
        "supportsFraction": True,
        "resolution": resolution,
        "intervalCounter": int(clock.interval * resolution),
        "shiftCounter": int(clock.shift * resolution) or None,
    }


def _describe2(spec: LoopSpec, token: str) -> str:
    rows = _rows(spec)
    entries = tuple(entry for entry, _ in rows)
    types = type_names(entries)
    inputs = _inputs(spec, entries)
    root = {
        "fmiVersion": "2.0",
        "modelName": spec.name,
        "guid": token,
        "description": f"{spec.description} {about_steps(spec, 2)}".strip(),
        "generationTool": f"Loopwright {package_version()}",
        "variableNamingConvention": naming_convention(e.name for e in entries),
        "numberOfEventIndicators": 0,
    }
    stepping: dict[str, object] = {
        "modelIdentifier": spec.name,
        "canHandleVariableCommunicationStepSize": True,
        "canInterpolateInputs": False,
        "maxOutputDerivativeOrder": 0,
        "canRunAsynchronuously": False,
        "canNotUseMemoryManagementFunctions": True,
        "canGetAndSetFMUstate": True,
        "canSerializeFMUstate": True,
        "providesDirectionalDerivative": spec.slopes is not None,
    }
    sources = _element("SourceFiles", {}, [_element("File", {"name": "model.c"})])
    variables = [
        _element(
            "ScalarVariable",
            _attributes(entry, one),
            [
                _element(
                    "Real",
                    describe_values(entry.variable, types)
                    | {"start": entry.variable.flat_start[0] if entry.variable.flat_start else None}
                    | {"derivative": None if entry.of is None else entry.of + 1},
                )
            ],
        )
        for entry, one in rows
    ]
    # FMI 2.0 names variables by their index, which counts from 1, where FMI 3.0 has value references.
    listed: dict[str, list[str]] = {"Output": [], "ContinuousStateDerivative": []}
    for tag, entry in _unknowns(entries):
        known = [e for e in _dependencies(spec, entry, inputs) if e.kind in ("time", "input", "state")]
        needed = dict.fromkeys(e.reference + 1 for e in known)
        about = {
            "index": entry.reference + 1,
            "dependencies": " ".join(map(str, needed)),
            "dependenciesKind": " ".join(["dependent"] * len(needed)),
        }
        listed[tag].append(_element("Unknown", about))
    unknown = [_element("Unknown", {"index": i}) for i in sorted(e.reference + 1 for _, e in _unknowns(entries))]
    outputs, rates = listed.values()
    lists = (("Outputs", outputs), ("Derivatives", rates), ("InitialUnknowns", unknown))
    structure = [_element(tag, {}, items) for tag, items in lists if items]
    children = [
        _element("CoSimulation", stepping, [sources]),
        *_units_and_types(types, simple_types(types)),
        log_categories(2),
        _experiment(spec),
        _element("ModelVariables", {}, variables),
        _element("ModelStructure", {}, structure),
    ]
    return _document("fmiModelDescription", root, children)


def loop_page(spec: LoopSpec, text: str = "", *, fmi: int = 3) -> str:
    """Return the text of ``documentation/index.html``: when ticks act, and the table of variables."""
    steps = [f"<p>{escape(about_steps(spec, fmi))}</p>"]
    return page_of(spec.name, spec.description, text, {"Steps": steps}, loop_layout(spec), fmi=fmi)
