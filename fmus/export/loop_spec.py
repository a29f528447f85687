"""A diagram to export: its variables, its clocks, the memory of its loop and the C code of its functions.

It connects diagrams with what is made of them: an FMU, C for a target, a web page. It is plain data, which knows no
diagram. `ModelSpec` is the same for a single continuous model, whose equations FMI's solvers take as they are.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

from ...blocks.core import brief, count_of
from ..runtime import read_sources
from .c_text import c_number, c_text
from .elementary_tables import prepare_functions, read_fmu_source, restore_functions
from .loop_memory import LoopMemory
from .merged_plants import MergedPlant, describe_plants, plant_fields, write_plants
from .model_spec import Variable

ROOM_FOR_EDGES = 64
"""Discontinuities of sources in a stretch of a loop with continuous states."""
_TICKS = ("newton.c", "alone.c", "loop_over_ticks.c")
_BETWEEN = ("problem.c", "delays.c", "methods.c", "radau.c", "event_search.c", "instants.c", "loop_over_time.c")


@dataclass(frozen=True, eq=False)
class Placed:
    """A variable, and where its values are.

    ``vector``: member of the memory that holds its values: parameters, inputs and outputs of plants, states, or all
    outputs of blocks.
    ``sampled``: whether it changes at ticks and events only.
    ``clock``: the clock that its block acts at, among `LoopSpec.clocks`; None in continuous time and for a triggered
    block.
    ``rates``: of a continuous state with slopes: the entries of its rates.
    """

    variable: Variable
    vector: str
    places: tuple[int, ...]
    sampled: bool = False
    clock: int | None = None
    rates: tuple[int, ...] = ()


@dataclass(frozen=True)
class CFunction:
    """A function in the code, as CasADi writes it.

    ``sizes``: entries of its lists of arguments and results, and of its memory of integers and numbers.
    """

    name: str
    sizes: tuple[int, int, int, int]

    @classmethod
    def of(cls, function: Any) -> CFunction:
        """Return a CasADi function as it is in the code."""
        return cls(function.name(), (function.sz_arg(), function.sz_res(), function.sz_iw(), function.sz_w()))

    def call(self, arguments: Iterable[str], result: str, indent: str) -> Iterator[str]:
        """Yield C text that declares all that a call needs, up to the call itself."""
        count, results, integers, numbers = self.sizes
        given = ", ".join(arguments)
        yield f"{indent}const double *arguments[{max(4, count)}] = {{{given}}};"
        yield f"{indent}double *results[{max(1, results)}] = {{{result}}}, w[{numbers + 1}];"
        yield f"{indent}long long iw[{integers + 1}];"


@dataclass(frozen=True)
class Guards:
    """What must stay positive at a kind of tick.

    ``function``: the function of (t, x, w, p) that has their values; None without any.
    """

    names: tuple[tuple[str, str], ...] = ()
    function: CFunction | None = None
    texts: tuple[str, ...] = ()


@dataclass(frozen=True)
class LoopSlopes:
    """Derivatives of a diagram: of some entries of the log, and of the rates of all continuous states behind these.

    ``forward``, ``reverse``: by kind of tick: of (t, x, w, p) and a seed, the product with the Jacobian by (t, x, w,
    p), or its transpose.
    ``start``: forward and reverse of the states at the start; none where none are computed.
    ``function``: the rates, as a function of (t, x, w, p).
    """

    forward: tuple[CFunction, ...]
    reverse: tuple[CFunction, ...]
    start: tuple[CFunction, ...]
    entries: tuple[int, ...]
    rates: int
    function: CFunction | None = None


@dataclass(frozen=True)
class ComputedNumbers:
    """Numbers that are computed from the parameters of a block, behind these.

    ``first``, ``parameters``, ``count``: entry of p with which the block's parameters begin, their number, and that of
    the computed numbers.
    """

    first: int
    parameters: int
    count: int
    function: CFunction


@dataclass(frozen=True, eq=False, kw_only=True)
class LoopSpec:
    """A diagram to export.

    ``inputs``, ``outputs``, ``signals``, ``parameters``, ``states``: its variables: ``signals`` are named wires and
    outputs of blocks that are no outputs of the diagram.
    ``clocks``: ticks at which sampled subsystems act: every so many ticks, from an offset on.
    ``offers_clocks``: whether an FMU of FMI 3.0 has its clocks as input clocks.
    ``sets``: sets of clocks that act together, as bits, in the order of the loop's kinds of ticks.
    ``hybrid``: whether anything happens between ticks.
    ``code``: C code of the functions that the memory points to.
    ``labels``: outputs of blocks in the order of evaluation: block, port, first entry of the log, number of entries.
    ``guards``: what must stay positive at each kind of tick.
    ``start``: the states at the start, of (t, x, w, p); None where none are computed.
    ``start_kind``: kind of the tick at which all clocks act, by which algebraic loops are solved at the start; -1:
    there are none.
    ``events``: events between ticks: block, name, whether it enables or triggers a subsystem.
    ``left``: the indicators of all events just before the start, then at it, where sources jump at the start; else
    None.
    ``edges``: discontinuities of sources, s: each with the time at which it is seen there, which may be just after it.
    ``periodic``: discontinuities of sources that repeat without end: the first one and the period, s.
    ``depends``: entries of w on which each output and each signal depends at an instant; all where it is missing.
    ``slopes``: derivatives; None where there are none.
    ``knowns``: with slopes: by "log" or "rates" and an entry, the entries of t, x, w and p that it depends on at an
    instant.
    ``found_at_build``: states whose start the blocks' Python code has found when it was exported: start values, which
    can be set.
    ``plants``: FMUs of our own that are merged into it.
    ``steps_on_ticks``: whether communication steps must go from tick to tick.
    """

    name: str
    description: str
    inputs: tuple[Placed, ...]
    outputs: tuple[Placed, ...]
    signals: tuple[Placed, ...]
    parameters: tuple[Placed, ...]
    states: tuple[Placed, ...]
    base: Fraction
    clocks: tuple[tuple[int, int], ...]
    sets: tuple[int, ...]
    hybrid: bool
    memory: LoopMemory
    code: str
    labels: tuple[tuple[str, str, int, int], ...]
    guards: tuple[Guards, ...] = ()
    start: CFunction | None = None
    start_kind: int = -1
    numbers: tuple[ComputedNumbers, ...] = ()
    events: tuple[tuple[str, str, bool], ...] = ()
    left: CFunction | None = None
    edges: tuple[tuple[float, float], ...] = ()
    periodic: tuple[tuple[float, float], ...] = ()
    depends: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    slopes: LoopSlopes | None = None
    knowns: Mapping[tuple[str, int], frozenset[tuple[str, int]]] = field(default_factory=dict)
    clocked: tuple[str, ...] = ()
    offers_clocks: bool = False
    found_at_build: tuple[str, ...] = ()
    plants: tuple[MergedPlant, ...] = ()
    steps_on_ticks: bool = False
    own_functions: bool = False
    step_size: float = 1e-3
    stop_time: float = 1.0

    def __repr__(self) -> str:
        facts = (
            count_of(len(self.inputs), "input"),
            count_of(len(self.outputs), "output"),
            count_of(len(self.parameters), "parameter"),
            f"base {float(self.base):g} s",
        )
        return brief(f"diagram {self.name!r} to export", *facts)


def write_unit(spec: LoopSpec, *, own_functions: bool = False) -> str:
    """Return the C text of an exported diagram: its loop, its functions and its memory, all of it static.

    What it offers is in ``fmus/runtime/exported.c``: ``lw_memory``, ``lw_fill``, ``lw_bind``, ``lw_begin``,
    ``lw_go``.

    ``own_functions``: take sine, exponential and so on from this package, with the same bits on every platform, and not
    from the platform's library, with the bits of a run here.
    """
    code = spec.code
    if own_functions:
        before = prepare_functions(code).replace('#include "elementary.c"\n', read_fmu_source("elementary.c"))
        code = before + code + restore_functions()
    plants = write_plants(spec.plants)
    return "\n".join([_HEAD, plants, code, read_sources(*_TICKS, *(_BETWEEN if spec.hybrid else ())), *_describe(spec)])


_HEAD = """/* Generated by Loopwright. */
#include <float.h>
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#define VISIBLE static
#define CASADI_SYMBOL_EXPORT static
"""


def _describe(spec: LoopSpec) -> Iterator[str]:
    """Yield the C text of the diagram's own numbers, then of what goes over them."""
    yield f"#define LW_HYBRID {int(spec.hybrid)}"
    yield f"#define LW_BASE_NUMERATOR INT64_C({spec.base.numerator})"
    yield f"#define LW_BASE_DENOMINATOR INT64_C({spec.base.denominator})"
    yield f"#define LW_N_CLOCKS {len(spec.clocks)}"
    yield f"#define LW_N_SETS {len(spec.sets)}"
    clocks = ", ".join(f"{{{every}, {offset}}}" for every, offset in spec.clocks) or "{1, 0}"
    yield f"static const struct {{\n    int64_t every, offset;\n}} lw_clocks[] = {{{clocks}}};"
    yield f"static const uint64_t lw_sets[] = {{{', '.join(map(str, spec.sets)) or 0}}};"
    yield f"#define LW_START_KIND {spec.start_kind}"
    fields, pointers = plant_fields(spec.plants, _size(spec.memory, "z"))
    memory = replace(spec.memory, fields=(*spec.memory.fields, *fields), pointers=(*spec.memory.pointers, *pointers))
    yield memory.write()
    yield describe_plants(spec.plants)
    yield from _start(spec)
    yield from _numbers(spec)
    if spec.hybrid:
        yield from _between_ticks(spec)
    yield read_sources("exported.c", "exported_plants.c")
    yield from _guards(spec)


def _between_ticks(spec: LoopSpec) -> Iterator[str]:
    """Yield the C text of events, and of discontinuities of sources."""
    yield f"#define LW_N_EVENTS {len(spec.events)}"
    yield f"#define LW_N_EDGES {len(spec.edges)}"
    yield f"#define LW_N_PERIODIC {len(spec.periodic)}"
    yield f"#define LW_ROOM_FOR_EDGES {ROOM_FOR_EDGES}"
    yield f"#define LW_HAS_LEFT {int(spec.left is not None)}"
    yield "static const struct {\n    const char *block, *name;\n    bool subsystem;\n} lw_events_of[] = {"
    rows = [f'    {{"{block}", "{name}", {str(gate).lower()}}},' for block, name, gate in spec.events]
    yield "\n".join(rows or ['    {"", "", false},']) + "\n};"
    for name, members, values in (("edges", "t, late", spec.edges), ("periodic", "t, period", spec.periodic)):
        yield f"static const struct {{\n    double {members};\n}} lw_{name}[] = {{"
        yield "\n".join(f"    {{{c_number(a)}, {c_number(b)}}}," for a, b in values or [(0.0, 1.0)]) + "\n};"
    if spec.left is not None:
        yield "static bool lw_compute_left(lw_memory *m, double *found) {"
        yield from spec.left.call(("m->t", "m->x", "m->w", "m->p"), "found", " " * 4)
        yield f"    return !{spec.left.name}(arguments, results, iw, w, 0);"
        yield "}\n"


def _start(spec: LoopSpec) -> Iterator[str]:
    """Yield the C text that computes the states at the start into m->x_next."""
    yield f"#define LW_HAS_START {int(spec.start is not None)}"
    if spec.start is not None:
        yield "static bool lw_compute_start(lw_memory *m) {"
        yield from spec.start.call(("m->t", "m->x", "m->w", "m->p"), "m->x_next", " " * 4)
        yield f"    return !{spec.start.name}(arguments, results, iw, w, 0);"
        yield "}\n"


def _numbers(spec: LoopSpec) -> Iterator[str]:
    """Yield the C text of ``lw_renew``, which computes the numbers of blocks whose parameters have been set."""
    yield "/* Compute the numbers that depend on parameters of blocks; to be called when some of m->p have been set. */"
    yield "static void lw_renew(lw_memory *m) {"
    yield "    (void)m;"
    for one in spec.numbers:
        first, size = one.first, f"{one.parameters} * sizeof(double)"
        yield f"    if (memcmp(m->p + {first}, m->seen_p + {first}, {size})) {{"
        yield from one.function.call((f"m->p + {first}",), f"m->p + {first + one.parameters}", " " * 8)
        yield f"        memcpy(m->seen_p + {first}, m->p + {first}, {size});"
        yield f"        {one.function.name}(arguments, results, iw, w, 0);"
        yield "    }"
    for j in range(len(spec.plants)):
        yield f"    lw_merged[{j}].tune((char *)m + lw_merged[{j}].place, m->p);"
    yield "}\n"


def _size(memory: LoopMemory, name: str) -> int:
    """Return the number of entries of a vector."""
    return next((one.length for one in memory.fields if one.name == name), 0)


def _guards(spec: LoopSpec) -> Iterator[str]:
    """Yield the C text that finds a guard that fails: a table of them, and a search after a tick that has failed."""
    yield "typedef struct {\n    const char *block, *name, *text;\n} lw_guard;"
    rows = [
        f'    {{"{block}", "{name}", {c_text(text)}}},'
        for guards in spec.guards
        for (block, name), text in zip(guards.names, guards.texts, strict=True)
    ]
    yield "static const lw_guard lw_guards[] = {\n" + "\n".join(rows or ['    {"", "", ""},']) + "\n};"
    yield "/* Return the first guard that is not positive where the last evaluation has failed; -1: there is none. */"
    yield "static int lw_find_guard(lw_memory *m) {"
    first = 0
    for kind, guards in enumerate(spec.guards):
        count = len(guards.names)
        if guards.function is not None:
            yield f"    if (m->lost == {kind}) {{"
            yield f"        double found[{count}];"
            yield from guards.function.call(("m->t", "m->x", "m->w", "m->p"), "found", " " * 8)
            yield f"        if ({guards.function.name}(arguments, results, iw, w, 0)) return -1;"
            yield f"        for (int i = 0; i < {count}; i++)"
            yield f"            if (!(found[i] > 0.0)) return {first} + i;"
            yield "    }"
        first += count
    yield "    return (void)m, -1;"
    yield "}"
