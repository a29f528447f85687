"""C code over vectors of ticks: small ones as one function of scalar operations, others as groups of blocks."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from ...fmus.export import c_number
from ..compiled import LARGEST, ExpandedFunctions, Kernel, make_tables
from ..flat import AND, CHOOSE, COPY, LESS, NOT, OR, TRUE_OF, FlatDiagram, TickPattern, TickProgram
from .vector_code import ScalarFunctions, VectorCode, write_vectors

_ARGUMENTS = ("t", "x", "w", "p")
_SINGLE = {
    COPY: "a[0]",
    TRUE_OF: "one_where(a[0] > TRUTH)",
    LESS: "a[0] - TRUTH",
    AND: "one_where((a[0] != 0.0) & (b[0] != 0.0))",
    OR: "one_where((a[0] != 0.0) | (b[0] != 0.0))",
    NOT: "one_where(a[0] == 0.0)",
    CHOOSE: "where(a[0] != 0.0, b[0]) + where(a[0] == 0.0, c[0])",  # as of a single run: no zero is negative
}
_INLINED = 100
"""Operations of a block's function up to which it is inlined: a compiler takes long for large ones."""
_KERNEL = """
static void lane_kernel{place}(int32_t n, const int32_t *o, vec *v, const vec *p) {{
    vec kept[AT_LEAST_1({kept})];
    (void)p;
    block{place}_prepare(kept);
    for (; n > 0; n--, o += {width}) block{place}({arguments}, kept, {results});
}}
"""
_SINGLE_KERNEL = """
static void lane_kernel{place}(int32_t n, const int32_t *o, vec *v, const vec *p) {{
    (void)p;
    for (; n > 0; n--, o += {width}) {{
        const vec {arguments};
        v[o[{last}]] = {value};
    }}
}}
"""
_GROUPED_TICK = """
{tables}
static void {name}_prepare(const vec *p, vec *kept) {{
    (void)p;
    for (int32_t i = 0; i < {count}; i++) kept[i] = splat(0.0);
    for (int32_t i = 0; i < {constants}; i++) kept[{name}_places[i]] = splat({name}_numbers[i]);
}}

static void {name}(const vec *t, const vec *x, const vec *w, const vec *p, vec *kept, vec *x_next, vec *z, vec *log,
                   vec *ok) {{
    static const lane_group group = {{
        .runs = {name}_runs, .rows = {name}_rows, .inputs = {name}_inputs, .guards = {name}_guards, .made = {name}_made,
        .taken = {name}_taken, .count = {runs}, .log = {log}, .next = {next}, .n_guards = {guards}, .n_loops = {loops},
        .residual = {residual}
    }};
    go_over_groups(&group, t, x, w, p, kept, x_next, z, log, ok);
}}
"""


class TickSources:
    """The ticks of a diagram, to be written as C over vectors: ``NAME(t, x, w, p, kept, x_next, z, log, ok)``.

    ``text`` comes before them; ``is_grouped``: they are groups of equal blocks, whose values need memory.
    """

    def __init__(self, flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], scalars: ScalarFunctions):
        kinds = [*dict.fromkeys(acting)]
        expanded = None if flat.by_block else ExpandedFunctions(flat, kinds)
        self.is_grouped, self.text = True, ""
        if expanded is not None and expanded.exact and expanded.operations <= LARGEST:
            self.is_grouped, self._expanded = False, dict(zip(kinds, expanded.functions, strict=True))
        else:
            self._programs = {clocks: flat.program_at(clocks) for clocks in kinds}
            self._code = _GroupedCode([*self._programs.values()], scalars, read_source("grouped_lanes.c"))
            self.text = self._code.text

    def write(self, name: str, clocks: frozenset[TickPattern]) -> VectorCode:
        """Write the tick at which some clocks act, under a name."""
        if self.is_grouped:
            return self._code.write(name, self._programs[clocks])
        return write_vectors(name, self._expanded[clocks], _ARGUMENTS, {3})


def read_source(name: str) -> str:
    """Return a C source of this package."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


class _GroupedCode:
    """The C code of ticks as runs of equal blocks, which share their functions; ``text`` comes before the ticks."""

    def __init__(self, programs: Sequence[TickProgram], scalars: ScalarFunctions, driver: str):
        self._of: dict[int | str, Kernel] = {}
        self._known: dict[str, Kernel] = {}
        self._texts: list[str] = []
        for name, value in _SINGLE.items():
            self._add_single(name, value)
        functions = {key: f for tick in programs for key, f in tick.program.functions.items()}
        for key in sorted(functions, key=lambda key: str(functions[key])):
            self._add(key, functions[key], scalars)
        table = ", ".join(f"lane_kernel{i}" for i in range(len(self._known)))
        kind = "typedef void (*lane_kernel)(int32_t, const int32_t *, vec *, const vec *);\n"
        self.text = "".join([*self._texts, kind, f"static const lane_kernel lane_kernels[] = {{{table}}};\n", driver])

    def _add_single(self, name: str, value: str) -> None:
        given = len(set(re.findall(r"\b[abc](?=\[)", value)))
        kernel = Kernel(len(self._known), (*((False, 1 + k) for k in range(given)), (True, 0)))
        self._known[name] = self._of[name] = kernel
        arguments = ", ".join(f"*{'abc'[k]} = v + o[{k}]" for k in range(given))
        self._texts.append(
            _SINGLE_KERNEL.format(place=kernel.place, width=given + 1, arguments=arguments, last=given, value=value)
        )

    def _add(self, key: int, function: Any, scalars: ScalarFunctions) -> None:
        place, last = len(self._known), function.n_in() - 1
        names = [f"i{k}" for k in range(function.n_in())]
        inlined = function.n_instructions() <= _INLINED
        code = scalars.write_calls("BLOCK", function, names, (), inlined=inlined)
        if code.text in self._known:
            self._of[key] = self._known[code.text]
            return
        given = [(False, k) for k in range(1, last + 1) if function.numel_in(k)]
        columns = [*given, *((True, k) for k in range(function.n_out()) if function.numel_out(k))]
        at = {column: j for j, column in enumerate(columns)}
        of = [
            "v",
            *(
                f"{'p' if k == last else 'v'} + o[{at[False, k]}]" if (False, k) in at else "v"
                for k in range(1, last + 1)
            ),
        ]
        to = [f"v + o[{at[True, k]}]" if (True, k) in at else "v" for k in range(function.n_out())]
        self._known[code.text] = self._of[key] = Kernel(place, tuple(columns))
        text = re.sub(r"\bBLOCK(?=_prepare\b|\()", f"block{place}", code.text)
        self._texts.append(text)
        self._texts.append(
            _KERNEL.format(
                place=place, kept=code.kept, width=len(columns), arguments=", ".join(of), results=", ".join(to)
            )
        )

    def write(self, name: str, tick: TickProgram) -> VectorCode:
        """Return the C code of one of the ticks, ``(t, x, w, p, kept, x_next, z, log, ok)``."""
        found = make_tables(tick, self._of)
        places = np.flatnonzero((found.memory != 0.0) | np.signbit(found.memory))
        lists: Mapping[str, np.ndarray] = {
            "runs": found.calls.runs.ravel(),
            "rows": found.calls.rows,
            "inputs": found.inputs,
            "guards": found.guards,
            "made": found.made,
            "taken": found.taken,
            "places": places,
        }
        tables = [f"static const int32_t {name}_{key}[] = {{{_list(values)}}};" for key, values in lists.items()]
        tables.append(f"static const double {name}_numbers[] = {{{_list(found.memory[places])}}};")
        text = _GROUPED_TICK.format(
            name=name,
            tables="\n".join(tables),
            count=found.memory.size,
            constants=len(places),
            runs=len(found.calls.runs),
            log=found.log,
            next=found.next,
            guards=found.guards.size,
            loops=found.made.size,
            residual=int(found.residual),
        )
        return VectorCode(text, found.memory.size)


def _list(values: np.ndarray) -> str:
    return ", ".join(map(c_number, values.tolist())) or "0"
