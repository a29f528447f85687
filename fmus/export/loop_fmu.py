"""C text of the FMU of a diagram: its loop behind FMI's functions.

The functions of FMI are those of exported models (``fmu_sources/fmi3.c``, ``fmi2.c``), for co-simulation alone; behind
them is the loop of the diagram (``fmu_sources/loop.c``) in place of a model's integrators.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

from .c_code import OF_FMI, ORDER, start_table, variable_table
from .c_text import c_array
from .elementary_tables import read_fmu_source
from .loop_description import loop_layout, loop_rows, offered_clocks
from .loop_spec import LoopSpec, Placed, write_unit
from .variable_entries import Entry

_COMMON = ("model.h", "core.c", "loop.c")
_FILES = {fmi: (*_COMMON, *files) for fmi, files in OF_FMI.items()}


def generate_loop(spec: LoopSpec, token: str, fmi: int) -> str:
    """Return the text of ``model.c``; see `loopwright.fmus.export.c_code.generate`."""
    entries = loop_layout(spec)
    clocks = offered_clocks(spec, fmi)
    parts = [
        _dimensions(spec, entries, token, fmi, len(clocks)),
        write_unit(spec, own_functions=spec.own_functions),
        *_slopes(spec),
        '#include "model.h"\n',
        variable_table(entries),
        start_table(entries),
        *_places(spec),
        *_labels(spec),
        c_array("char *const", "lw_clock_names", (f'"{clock.name}"' for clock in clocks)) if clocks else "",
        "static const double lw_nominals[] = {1.0};\n",
        "".join(f'#include "{name}"\n' for name in _FILES[fmi][1:]),
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
    """Return where the value of an output is, as `fmu_sources/loop.c` reads it."""
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
def read_loop_sources(fmi: int) -> dict[str, str]:
    """Return the text of the files that ``model.c`` of a diagram includes, by name."""
    return {name: read_fmu_source(name) for name in _FILES[fmi]}
