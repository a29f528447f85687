"""C for a target with the loop of runs inside: continuous states, events and algebraic loops between ticks.

The source is that of an FMU without FMI: the loop's files and the diagram's functions (`write_unit`), behind the
functions ``init``, ``tick``, ``set`` and ``get`` that C for a target has.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from ...blocks.core import OptionError, count_of
from .elementary_tables import FUNCTIONS
from .loop_spec import LoopSpec, Placed, write_unit
from .scalar_code import OF_MATH, c_constant
from .target_code import Member, about_member, distinct, identifier, sentence
from .target_files import TargetCode

_VECTORS = {"p": 0, "w": 1, "x": 2, "log": 3}
_GROUPS = ("parameters", "inputs", "outputs", "signals")
_SPARE = 64
"""Bytes of a memory beyond those of its members: the count of ticks, and what a compiler puts between members."""


class LoopCode(TargetCode):
    """C for a target with the loop of runs inside: its files, and a report."""

    def __init__(self, spec: LoopSpec, folder: Path, own_functions: bool):
        self._loop, self._own = spec, own_functions
        self.name, self.number, self.folder = spec.name, "double", folder
        self.ticks, self.measured = (), None
        self.bytes_of: Mapping[str, int] = {"struct": spec.memory.bytes + _SPARE}
        self._files = _LoopWriter(spec, own_functions, self.bytes_of["struct"]).files()
        self.files = tuple(folder / name for name in (*self._files, f"{spec.name}_report.txt"))

    def _contents(self) -> Mapping[str, str]:
        return self._files

    def measure(self, inputs: Mapping[str, Any] | None = None, **options: Any) -> NoReturn:
        """Refuse to count instructions: how many a tick has depends on its events and equations.

        Raises `OptionError`: always.
        """
        raise OptionError(
            "instructions are counted of sampled diagrams alone; this one has a solver inside, whose steps and "
            "iterations depend on the data. Measure a tick on the target.",
            block=self.name,
            port="measure",
        )

    @property
    def report(self) -> str:
        """Memory, and what is in it, as text."""
        return "\n".join(self._report()) + "\n"

    def _report(self) -> Iterator[str]:
        spec, source = self._loop, self._files[f"{self.name}.c"]
        own = FUNCTIONS if self._own else ()
        called = {f for f in OF_MATH if f not in own and re.search(rf"\b{f}\(", source)}
        yield f"{spec.name}: C for a target, numbers in double precision"
        yield ""
        yield f"Call {spec.name}_tick() every {float(spec.base):g} s."
        if spec.hybrid:
            yield "Between ticks the classical Runge-Kutta method (rk4) makes one step a period, or several where an"
            yield "event is in it."
        yield f"Functions of math.h, at most: {', '.join(sorted(called)) or 'none'}."
        yield "No memory is allocated. How long a tick takes depends on the events and equations in it: measure it."
        yield ""
        yield f"An instance has {self.bytes_of['struct']} bytes, {spec.name.upper()}_BYTES."
        states = sum(one.variable.size for one in spec.states)
        yield f"It has {count_of(states, 'state')}, {count_of(len(spec.events), 'event')}."
        for group in _GROUPS:
            names = [one.variable.name for one in getattr(spec, group)]
            yield f"{group}: {', '.join(names) or 'none'}"


def write_loop_c(spec: LoopSpec, folder: Path, *, own_functions: bool = False) -> LoopCode:
    """Write C for a target to a folder: header, source, example and report.

    Raises `DiskError` if it can't be written.
    """
    code = LoopCode(spec, folder, own_functions)
    code._write()
    return code


class _LoopWriter:
    def __init__(self, spec: LoopSpec, own_functions: bool, size: int):
        self.spec, self.own, self.size = spec, own_functions, size
        self.name, self.upper = spec.name, spec.name.upper()
        taken = set[str]()
        self.variables: list[tuple[str, Placed, str]] = []
        for group in _GROUPS:
            for one in getattr(spec, group):
                label = f"{group[:-1].upper()}_{identifier(one.variable.name).upper()}"
                self.variables.append((group, one, f"{self.upper}_{distinct(label, taken)}"))
        guards = list(dict.fromkeys(name for found in spec.guards for name in found.names))
        labels = set[str]()
        self.guards = {
            guard: f"{self.upper}_GUARD_{distinct(identifier('_'.join(guard)).upper(), labels)}" for guard in guards
        }

    def files(self) -> dict[str, str]:
        """Return the text of each file."""
        return {
            f"{self.name}.h": "\n".join(self._header()),
            f"{self.name}.c": "\n".join(self._source()),
            f"{self.name}_example.c": "\n".join(self._example()),
        }

    def _statuses(self) -> list[tuple[str, str]]:
        return [
            (f"{self.upper}_OK", "the tick is done"),
            (f"{self.upper}_NO_VALUE", "a number is not finite, an equation has no solution, or events don't end"),
            *((label, f"{block}: {guard} is not positive") for (block, guard), label in self.guards.items()),
        ]

    def _header(self) -> Iterator[str]:
        name, upper, base = self.name, self.upper, float(self.spec.base)
        yield "/**"
        yield f" * @file {name}.h"
        yield f" * {sentence(self.spec.description) or f'The diagram {name}.'}"
        yield " *"
        yield " * Generated by Loopwright. Standard C99; no memory is allocated, nothing is global but constant tables."
        yield " *"
        yield f" * Use: let the caller own one {name} for each instance; {name}_init() once; then every {base:g} s"
        yield f" * {name}_set() of the inputs of this instant, {name}_tick(), {name}_get() of the outputs. Outputs in"
        yield " * continuous time are those at the end of the period. An instance may be copied: a copy is another"
        yield " * instance, or a saved state. It is not to be used by two threads or interrupts at the same time."
        yield " */"
        yield f"#ifndef {upper}_H"
        yield f"#define {upper}_H"
        yield ""
        yield "#include <stdbool.h>"
        yield "#include <stdint.h>"
        yield ""
        yield "#ifdef __cplusplus"
        yield 'extern "C" {'
        yield "#endif"
        yield ""
        yield f"/** Type of all numbers. */\ntypedef double {name}_real;"
        yield ""
        yield f"/** Seconds between two calls of {name}_tick(). */\n#define {upper}_PERIOD {c_constant(base)}"
        yield ""
        yield f"/** Bytes of an instance. */\n#define {upper}_BYTES {self.size}"
        yield ""
        yield "/** An instance: all its memory. */"
        yield f"typedef union {name} {{"
        yield f"    unsigned char bytes[{upper}_BYTES];"
        yield "    int64_t whole; /* these align it */"
        yield "    double number;"
        yield "    void *pointer;"
        yield f"}} {name};"
        yield ""
        yield "/** Outcome of a tick. After any but OK put the instance to its start, or to a copy of before. */"
        yield "typedef enum {"
        yield from (f"    {label} = {i}, /**< {text} */" for i, (label, text) in enumerate(self._statuses()))
        yield f"}} {name}_status;"
        yield ""
        yield f"/** Variables, for {name}_set() and {name}_get(). */"
        yield "typedef enum {"
        for group, one, label in self.variables:
            member = Member(group, "", one.variable, one.places, np.array(one.variable.flat_start))
            yield f"    {label}, /**< {about_member(member)} */"
        yield f"    {upper}_VARIABLES /**< their number */"
        yield f"}} {name}_id;"
        yield ""
        yield "/** Name, unit, number of entries, whether it may be set, and range of a variable. */"
        yield "typedef struct {"
        yield "    const char *name;"
        yield "    const char *unit;"
        yield "    uint32_t count;"
        yield "    bool settable;"
        yield f"    {name}_real minimum;"
        yield f"    {name}_real maximum;"
        yield f"}} {name}_variable;"
        yield ""
        yield f"/** All variables, by {name}_id. */"
        yield f"extern const {name}_variable {name}_variables[];"
        yield ""
        yield "/** Put an instance to its start: start values of parameters, inputs and states, time 0. */"
        yield f"void {name}_init({name} *c);"
        yield ""
        yield "/** Set an entry of a parameter or an input; index 0 of a scalar. States that begin with inputs"
        yield " * and parameters are computed by the first tick."
        yield " * @return false, and nothing is set, if there is no such entry, it isn't to be set, or out of range. */"
        yield f"bool {name}_set({name} *c, {name}_id id, uint32_t index, {name}_real value);"
        yield ""
        yield "/** Get an entry of any variable."
        yield " * @return false, and nothing is written, if there is no such entry. */"
        yield f"bool {name}_get({name} *c, {name}_id id, uint32_t index, {name}_real *value);"
        yield ""
        yield f"/** Act at one instant, and go on to the next, {upper}_PERIOD later; call it at this period. */"
        yield f"{name}_status {name}_tick({name} *c);"
        yield ""
        yield "/** Return a text of an outcome. */"
        yield f"const char *{name}_status_text({name}_status status);"
        yield ""
        yield "#ifdef __cplusplus"
        yield "}"
        yield "#endif"
        yield ""
        yield f"#endif /* {upper}_H */"
        yield ""

    def _source(self) -> Iterator[str]:
        name, upper = self.name, self.upper
        yield f"/* {name}: see {name}.h. Generated by Loopwright."
        yield ""
        yield "   The loop of the diagram's runs, its functions, and behind them the functions of the header. In double"
        yield "   precision its numbers are those of the run with solver='rk4' where nothing is contracted to fused"
        yield "   operations: gcc needs -std=c99 or -ffp-contract=off. Never use -ffast-math. */"
        yield f'#include "{name}.h"'
        yield "#if defined(__GNUC__)"
        unused = ("unused-parameter", "unused-function", "unused-const-variable")
        warnings = ("pedantic", *unused, "conversion", "sign-conversion")
        yield from (f'#pragma GCC diagnostic ignored "-W{warning}"' for warning in warnings)
        yield "#endif"
        yield "#if defined(__clang__)"
        yield "#pragma STDC FP_CONTRACT OFF"
        yield "#endif"
        yield write_unit(self.spec, own_functions=self.own)
        yield ""
        yield f"/* ---- {name}.h ---- */"
        yield ""
        yield "typedef struct {"
        yield "    lw_memory memory;"
        yield "    int64_t calls; /* of tick; -1: everything begins with the next one */"
        yield "} lw_instance_of_target;"
        yield ""
        yield f"typedef char lw_it_fits[(sizeof(lw_instance_of_target) <= {upper}_BYTES) ? 1 : -1];"
        yield ""
        yield "static const struct {"
        yield "    int32_t vector, first; /* 0: p, 1: w, 2: x, 3: log; its first place in lw_target_places */"
        yield "} lw_target_table[] = {"
        places: list[int] = []
        for _, one, label in self.variables:
            yield f"    {{{_VECTORS[one.vector]}, {len(places)}}}, /* {label} */"
            places += one.places
        yield "    {0, 0},"
        yield "};"
        yield f"static const int32_t lw_target_places[] = {{{', '.join(map(str, places or [0]))}}};"
        yield ""
        yield f"const {name}_variable {name}_variables[] = {{"
        for group, one, _ in self.variables:
            v = one.variable
            low = "-DBL_MAX" if v.minimum is None else c_constant(float(v.minimum))
            high = "DBL_MAX" if v.maximum is None else c_constant(float(v.maximum))
            settable = str(group in ("parameters", "inputs")).lower()
            yield f'    {{"{v.name}", "{v.unit or ""}", {len(one.places)}u, {settable}, {low}, {high}}},'
        yield '    {"", "", 0u, false, 0.0, 0.0},'
        yield "};"
        yield ""
        yield f"static lw_instance_of_target *lw_instance_at({name} *c) {{"
        yield "    lw_instance_of_target *self = (lw_instance_of_target *)(void *)c;"
        yield "    lw_bind(&self->memory); /* it may be a copy */"
        yield "    return self;"
        yield "}"
        yield ""
        yield f"static double *lw_value_at(lw_instance_of_target *self, {name}_id id, uint32_t index) {{"
        yield f"    if ((uint32_t)id >= (uint32_t){upper}_VARIABLES) return NULL;"
        yield f"    if (index >= {name}_variables[id].count) return NULL;"
        yield "    lw_memory *m = &self->memory;"
        yield "    double *const vectors[] = {m->p, m->w, m->x, m->log};"
        yield "    const int32_t place = lw_target_places[lw_target_table[id].first + (int32_t)index];"
        yield "    return &vectors[lw_target_table[id].vector][place];"
        yield "}"
        yield ""
        yield f"void {name}_init({name} *c) {{"
        yield "    lw_instance_of_target *self = (lw_instance_of_target *)(void *)c;"
        yield "    lw_fill(&self->memory);"
        yield "    self->calls = -1;"
        yield "}"
        yield ""
        yield f"bool {name}_set({name} *c, {name}_id id, uint32_t index, {name}_real value) {{"
        yield "    lw_instance_of_target *self = lw_instance_at(c);"
        yield "    double *place = lw_value_at(self, id, index);"
        yield f"    if (!place || !{name}_variables[id].settable) return false;"
        yield f"    if (!(value >= {name}_variables[id].minimum)) return false;"
        yield f"    if (!(value <= {name}_variables[id].maximum)) return false;"
        yield "    *place = value;"
        yield "    if (lw_target_table[id].vector == 0) lw_renew(&self->memory);"
        yield "    return true;"
        yield "}"
        yield ""
        yield f"bool {name}_get({name} *c, {name}_id id, uint32_t index, {name}_real *value) {{"
        yield "    const double *place = lw_value_at(lw_instance_at(c), id, index);"
        yield "    if (!place) return false;"
        yield "    *value = *place;"
        yield "    return true;"
        yield "}"
        yield ""
        yield f"{name}_status {name}_tick({name} *c) {{"
        yield "    lw_instance_of_target *self = lw_instance_at(c);"
        yield "    lw_memory *m = &self->memory;"
        yield "    bool done = true;"
        yield "    if (self->calls < 0) {"
        yield "        done = lw_begin(m, 0.0);"
        yield "        self->calls = 0;"
        yield "    }"
        yield "    done = done && lw_go(m, lw_time_of(self->calls + 1));"
        yield "    if (done) {"
        yield "        self->calls++;"
        yield f"        return {upper}_OK;"
        yield "    }"
        every = [label for found in self.spec.guards for label in (self.guards[guard] for guard in found.names)]
        yield f"    static const {name}_status guards[] = {{{', '.join(every or [f'{upper}_NO_VALUE'])}}};"
        yield "    const int guard = lw_find_guard(m);"
        yield f"    return (guard < 0) ? {upper}_NO_VALUE : guards[guard];"
        yield "}"
        yield ""
        yield f"const char *{name}_status_text({name}_status status) {{"
        yield "    static const char *const texts[] = {"
        yield from (f'        "{text}",' for _, text in self._statuses())
        yield "    };"
        yield f'    return ((uint32_t)status < {len(self._statuses())}u) ? texts[status] : "no such status";'
        yield "}"
        yield ""

    def _example(self) -> Iterator[str]:
        name, upper = self.name, self.upper
        shown = [(one, label) for group, one, label in self.variables if group == "outputs"][:8]
        yield f"/* An example of {name}: a second of it, on a machine with a console."
        yield ""
        yield f"   cc -std=c99 -O2 {name}.c {name}_example.c -lm && ./a.out */"
        yield f'#include "{name}.h"'
        yield "#include <stdio.h>"
        yield ""
        yield "int main(void) {"
        yield f"    static {name} c; /* all memory of an instance */"
        yield f"    {name}_init(&c);"
        yield f"    for (int k = 0; k < {max(1, min(1000, round(1 / float(self.spec.base))))}; k++) {{"
        for group, one, label in self.variables:
            if group == "inputs":
                for i, value in enumerate(one.variable.flat_start):
                    yield f"        {name}_set(&c, {label}, {i}u, {c_constant(float(value))}); /* measured */"
        yield f"        const {name}_status status = {name}_tick(&c);"
        yield f"        if (status != {upper}_OK) {{"
        yield f'            printf("tick %d: %s\\n", k, {name}_status_text(status));'
        yield "            return 1;"
        yield "        }"
        yield f"        {name}_real value = 0.0;"
        for one, label in shown:
            yield f"        {name}_get(&c, {label}, 0u, &value);"
            yield f'        printf("{one.variable.name} %.9g  ", value);'
        yield '        puts("");'
        yield "    }"
        yield "    return 0;"
        yield "}"
        yield ""
