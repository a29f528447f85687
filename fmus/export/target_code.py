"""C for a target: one header and one source of standard C99, an example, and what each tick touches."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import casadi as ca
import numpy as np

from ...blocks.core import explain_calls
from .elementary_tables import FUNCTIONS, SINGLE_FUNCTIONS, prepare_functions, prepare_single, read_runtime
from .loop_spec import Placed
from .model_spec import Variable
from .scalar_code import OF_MATH, OF_TIME, Expressions, Scalars, Tables, c_constant
from .target_spec import TargetSpec, TargetTick

Number = Literal["double", "float"]
_WIDTH = 110
_C_KEYWORDS = """auto break case char const continue default do double else enum extern float for goto if inline int
long register restrict return short signed sizeof static struct switch typedef union unsigned void
volatile while bool true false complex imaginary I NULL errno signgam main t c"""
_MACRO = re.compile(
    r"NAN|INFINITY|HUGE_VAL[FL]?|EOF|BUFSIZ|stdin|stdout|stderr|linux|unix|L_tmpnam|(FILENAME|FOPEN|TMP|RAND)_MAX"
    r"|(DBL|FLT|LDBL|FP|DECIMAL|MATH|SEEK|M)_\w+|U?INT\w*_(MAX|MIN)|(SIZE|PTRDIFF|WCHAR|WINT|SIG_ATOMIC)_(MAX|MIN)"
)
"""Macros of the headers that the source, or a program with it, includes: they are no names of members."""
_IN_TWO = ("choose", "sign_of")
_HELPERS = f"is_finite exact choose sign_of start_values {' '.join(f'{one}{OF_TIME}' for one in _IN_TWO)}"
_OF_FILES = f"""{_HELPERS}
math string float stddef stdint stdbool stdio stdlib errno assert time signal ctype limits locale
abs labs div ldiv exit abort atexit system getenv malloc calloc realloc free rand srand qsort bsearch atoi atof atol
strtod strtol strtoul clock difftime mktime raise setjmp longjmp
printf scanf sprintf snprintf fprintf puts putchar getchar gets remove rename tmpfile perror rewind offsetof va_list
memcpy memmove memset memcmp memchr strcpy strcat strcmp strlen strchr strncpy strncat strncmp strstr strtok strerror
sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp log sqrt fabs floor ceil cbrt erf erfc expm1 exp2 log1p
log2 log10 logb ilogb lgamma tgamma rint lrint llrint round lround llround trunc nearbyint fdim fmax fmin fma fmod pow
hypot atan2 remainder remquo copysign nextafter nexttoward ldexp frexp modf scalbn scalbln nan gamma
j0 j1 jn y0 y1 yn index rindex isnan isinf isfinite isnormal signbit fpclassify isgreater isless"""
_FUNCTION = re.compile(r"^static [^\n;=]*\b(lw_\w+)\([^\n]*\) \{(?:[^\n]*\}|\n.*?^\})\n", re.MULTILINE | re.DOTALL)
_KEYWORDS = frozenset(_C_KEYWORDS.split())
_FILE_NAMES = frozenset(_OF_FILES.split())
_FILE_NAME = re.compile(r"(t|(find_in_)?table_|tick_)\d+|(lw|own)_\w+|u?int\w*_t|.*_t")
_INPUTS = 2  # argument w of a tick: the inputs
_GROUPS = ("parameters", "numbers", "inputs", "outputs", "signals", "states")
_KIND = {"inputs": "input", "outputs": "output", "signals": "signal", "parameters": "parameter"}
_ABOUT = {
    "parameters": "Parameters: to be set at any time between two ticks.",
    "numbers": "Numbers that are computed from parameters, by block: not to be written.",
    "inputs": "Inputs: to be set before each tick; they are held until they are set again.",
    "outputs": "Outputs: valid after a tick, until the next one.",
    "signals": "Named signals inside, to be watched: valid after a tick.",
    "states": "States from one tick to the next: saved and restored with the whole struct. "
    "To be written right after init alone, for another start.",
}


@dataclass(frozen=True, eq=False)
class Member:
    """A member of the struct."""

    group: str
    name: str
    variable: Variable
    places: tuple[int, ...]
    start: np.ndarray

    @property
    def count(self) -> int:
        """Number of entries."""
        return len(self.places)

    def access(self, entry: int) -> str:
        """Return the C text of an entry."""
        return f"c->{self.group}.{self.name}" + (f"[{entry}]" if self.variable.shape else "")

    @property
    def declaration(self) -> str:
        """The member's name with its size."""
        return f"{self.name}[{self.count}]" if self.variable.shape else self.name


@explain_calls
@dataclass(frozen=True, eq=False)
class TickFacts:
    """What a kind of tick touches.

    Attributes
    ----------
    when : str
        When it happens.
    subsystems, blocks : tuple of str
        Subsystems that act, and the blocks with code.
    inputs, parameters, read, states, outputs : tuple of str
        Names that it reads, and that it writes: states, outputs and signals.
    operations : Counter
        Operations, each at most once, whatever the data.
    """

    when: str
    subsystems: tuple[str, ...]
    blocks: tuple[str, ...]
    inputs: tuple[str, ...]
    parameters: tuple[str, ...]
    read: tuple[str, ...]
    states: tuple[str, ...]
    outputs: tuple[str, ...]
    operations: Counter[str]


@dataclass(frozen=True, eq=False)
class TargetText:
    """C for a target, as text.

    ``name``: its name: that of the files, and the begin of all names in them.
    ``bytes_of``: bytes of each group of the struct, of the struct, and of constant tables.
    """

    name: str
    number: Number
    members: tuple[Member, ...]
    files: Mapping[str, str]
    ticks: tuple[TickFacts, ...]
    bytes_of: Mapping[str, int]
    platform_functions: tuple[str, ...]
    statuses: tuple[str, ...]


def write_target(spec: TargetSpec, *, number: Number = "double", own_functions: bool = False) -> TargetText:
    """Return a sampled diagram as C.

    ``own_functions``: take sine, cosine, tangent hyperbolic, exponential, exp(x) - 1, logarithm and power from this
    package, with the same bits on every platform, and not from math.h. In ``float`` they compute in single precision.
    """
    return _SourceWriter(spec, number, own_functions).write()


def identifier(name: str) -> str:
    """Return a C identifier that is like a name, and no macro of a header of the standard."""
    found = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or "x"
    found = f"n{found}" if found[0].isdigit() else found
    return f"{found}_" if found in _KEYWORDS or _MACRO.fullmatch(found) else found


def unit_name(name: str) -> str:
    """Return a C identifier that is like a name and may name a type and its files: nothing else there is called so."""
    found = identifier(name)
    single = found[:-1] if found[-1] in "fl" else found  # sinf, sinl
    taken = found in _FILE_NAMES or single in _FILE_NAMES or _FILE_NAME.fullmatch(found)
    return f"{found}_" if taken else found


@dataclass
class _WrittenTick:
    """A tick that is being written."""

    number: int
    tick: TargetTick
    lines: list[str] = field(default_factory=list)
    touched: dict[str, list[str]] = field(default_factory=dict)
    operations: Counter[str] = field(default_factory=Counter)
    blocks: list[str] = field(default_factory=list)

    @property
    def is_empty(self) -> bool:
        """Whether it does nothing."""
        return not any("c->" in line or "if (" in line for line in self.lines)

    def touch(self, kind: str, name: str) -> None:
        names = self.touched.setdefault(kind, [])
        if name not in names:
            names.append(name)

    def add(self, *lines: str, indent: int = 4) -> None:
        self.lines += [f"{' ' * indent}{line}" if line else "" for line in lines]


class _SourceWriter:
    def __init__(self, spec: TargetSpec, number: Number, own_functions: bool):
        self.spec, self.number, self.own = spec, number, own_functions
        self.single = number == "float"
        self.name = spec.loop.name
        self.upper = self.name.upper()
        self.real = f"{self.name}_real"
        self.tables = Tables()
        self.scalars = [Scalars.of(tick.function, tick.lookups, self.tables) for tick in spec.ticks]
        self.numbers = [(one, Scalars.of(one.function, (), self.tables)) for one in spec.numbers]
        self._fold()
        self.called: set[str] = set()
        self.called_fine: set[str] = set()  # of double precision, in a source of single precision
        self.clocks = spec.loop.clocks
        self.counted = self.clocks != ((1, 0),)  # which clocks act has to be counted
        self._labels: dict[tuple[str, str], str] = {}
        self._choose_members()
        self._name_statuses()

    # --- what there is ------------------------------------------------------------------------------------------------

    def _fold(self) -> None:
        """Compute what is constant: of parameters that can't be set, and of states that never change."""
        loop, start = self.spec.loop, self.spec.start
        fixed = {i for first, end in self.spec.fixed for i in range(first, end)}
        self.tunable = [one for one in loop.parameters if not fixed.intersection(one.places)]
        offered = {place for one in self.tunable for place in one.places}
        free = set(offered)
        for one, scalars in self.numbers:
            for i, root in enumerate(scalars.results[0]):
                nodes = (scalars.nodes[node] for node in scalars.needed([root]))
                if any(n.operation == ca.OP_INPUT and one.first + n.place[1] in offered for n in nodes):
                    free.add(one.first + one.parameters + i)
        self.changes = {
            i
            for scalars in self.scalars
            for i, node in enumerate(scalars.results[0])
            if not self._is_entry(scalars, node, 1, i)
        }

        def known(argument: int, entry: int) -> float | None:
            if argument == 1 and entry not in self.changes:
                return float(start["x"][entry])
            return float(start["p"][entry]) if argument == 3 and entry not in free else None

        self.scalars = [scalars.folded(known) for scalars in self.scalars]
        numbers = []
        for one, scalars in self.numbers:

            def given(_: int, entry: int, first: int = one.first) -> float | None:
                return known(3, first + entry)

            numbers.append((one, scalars.folded(given)))
        self.numbers = numbers

    def _choose_members(self) -> None:
        """Keep what is read or written: states that change, parameters that are used, all inputs and outputs."""
        loop, start = self.spec.loop, self.spec.start
        changes, read = self.changes, set[int]()
        for scalars in self.scalars:
            for node in scalars.needed([n for row in scalars.results for n in row]):
                one = scalars.nodes[node]
                if one.operation == ca.OP_INPUT and one.place[0] == 3:
                    read.add(one.place[1])
        computed = self._choose_numbers(read)
        tunable = [one for one in self.tunable if read.intersection(one.places)]
        groups: dict[str, list[tuple[Variable, tuple[int, ...], np.ndarray]]] = {
            "parameters": [(p.variable, p.places, start["p"][list(p.places)]) for p in tunable],
            "numbers": computed,
            "inputs": [(p.variable, p.places, start["w"][list(p.places)]) for p in loop.inputs],
            "outputs": [(p.variable, p.places, self._output_start(p)) for p in loop.outputs],
            "signals": [(p.variable, p.places, self._output_start(p)) for p in loop.signals],
        }
        states = []
        for kept in self.spec.kept:
            places = tuple(range(kept.first, kept.first + kept.variable.size))
            if changes.intersection(places):
                states.append((kept.variable, places, start["x"][list(places)]))
        groups["states"] = states
        self.members: dict[str, list[Member]] = {}
        for group, found in groups.items():
            taken = set[str]()
            self.members[group] = []
            for variable, places, values in found:
                name = distinct(identifier(variable.name), taken)
                self.members[group].append(Member(group, name, variable, places, values))
        vectors = {"parameters": 3, "numbers": 3, "inputs": 2, "states": 1}
        self.places = {
            (vectors[group], place): (member, entry)
            for group in vectors
            for member in self.members[group]
            for entry, place in enumerate(member.places)
        }

    def _choose_numbers(self, read: set[int]) -> list[tuple[Variable, tuple[int, ...], np.ndarray]]:
        """Return the computed numbers that ticks read and that depend on parameters; note the parameters as read."""
        found = []
        self.renewed: list[tuple[int, int, int]] = []  # numbers, result, entry of p
        for which, (one, scalars) in enumerate(self.numbers):
            places, wanted = [], set[int]()
            for i in range(one.count):
                place = one.first + one.parameters + i
                needed = scalars.needed([scalars.results[0][i]]) if place in read else {}
                inputs = {scalars.nodes[n].place[1] for n in needed if scalars.nodes[n].operation == ca.OP_INPUT}
                if inputs:
                    places.append(place)
                    wanted |= inputs
                    self.renewed.append((which, i, place))
            read |= {one.first + i for i in wanted}
            if places:
                variable = Variable("numbers", shape=(len(places),), description=f"of {one.block}")
                object.__setattr__(variable, "name", one.block)
                found.append((variable, tuple(places), self.spec.start["p"][places]))
        return found

    def _output_start(self, placed: Placed) -> np.ndarray:
        values = self.spec.start.get("log", np.zeros(0))
        found = values[list(placed.places)] if values.size else np.zeros(len(placed.places))
        return np.where(np.isfinite(found), found, 0.0)

    @staticmethod
    def _is_entry(scalars: Scalars, node: int, argument: int, entry: int) -> bool:
        one = scalars.nodes[node]
        return one.operation == ca.OP_INPUT and one.place == (argument, entry)

    @staticmethod
    def _is_input(scalars: Scalars, node: int) -> bool:
        one = scalars.nodes[node]
        return one.operation == ca.OP_INPUT and one.place[0] == _INPUTS

    def _name_statuses(self) -> None:
        guards = list(dict.fromkeys(guard for tick in self.spec.ticks for guard in tick.guards))
        taken = set[str]()
        self.guards = {guard: distinct(identifier("_".join(guard)).upper(), taken) for guard in guards}
        self.statuses = [
            ("OK", "the tick is done"),
            ("NOT_FINITE", "a state, an output or a signal would not be a finite number"),
            *((f"GUARD_{label}", f"{block}: {guard} is not positive") for (block, guard), label in self.guards.items()),
        ]

    # --- the files ----------------------------------------------------------------------------------------------------

    def write(self) -> TargetText:
        ticks = [self._tick(i) for i in range(len(self.spec.ticks))]
        self.update = self._update_lines()
        source = self._source(ticks)
        files = {f"{self.name}.h": self._header(), f"{self.name}.c": source, f"{self.name}_example.c": self._example()}
        members = tuple(member for group in _GROUPS for member in self.members[group])
        own, own_fine = ((SINGLE_FUNCTIONS if self.single else FUNCTIONS), FUNCTIONS) if self.own else ((), ())
        platform = {"fabs", *(self.called - {*own}), *(self.called_fine - {*own_fine})} & OF_MATH
        return TargetText(
            self.name,
            self.number,
            members,
            files,
            tuple(self._facts(tick) for tick in ticks),
            self._bytes(),
            tuple(sorted(platform)),
            tuple(text for _, text in self.statuses),
        )

    def _bytes(self) -> dict[str, int]:
        size = 4 if self.single else 8
        found = {group: size * sum(m.count for m in self.members[group]) for group in _GROUPS}
        end = -(-sum(found.values()) // 8) * 8 + 8 + (4 * len(self.clocks) if self.counted else 0)
        found["struct"] = -(-end // 8) * 8
        sizes = [(self.tables.values[i].size, 8 if fine else size) for i, fine in self.tables.read]
        found["tables"] = sum(count * each for count, each in sizes)
        return found

    def _facts(self, tick: _WrittenTick) -> TickFacts:
        bits = tick.tick.acting
        subsystems = [p or "the diagram" for i, paths in enumerate(self.spec.acting) if bits >> i & 1 for p in paths]
        names = {kind: tuple(found) for kind, found in tick.touched.items()}
        return TickFacts(
            self._when(bits),
            tuple(subsystems),
            tuple(dict.fromkeys(tick.blocks)),
            inputs=names.get("inputs", ()),
            parameters=names.get("parameters", ()),
            read=names.get("states", ()),
            states=names.get("next", ()),
            outputs=names.get("written", ()),
            operations=tick.operations,
        )

    def _when(self, bits: int) -> str:
        rates = [self._rate(i) for i in range(len(self.clocks)) if bits >> i & 1]
        return " with ".join(rates) if rates else "at no clock"

    def _rate(self, clock: int) -> str:
        every, offset = self.clocks[clock]
        text = f"every {float(every * self.spec.loop.base):g} s"
        return f"{text} from {float(offset * self.spec.loop.base):g} s on" if offset else text

    # --- a tick -------------------------------------------------------------------------------------------------------

    def _tick(self, number: int) -> _WrittenTick:
        tick, scalars = _WrittenTick(number, self.spec.ticks[number]), self.scalars[number]
        new, log, guards = scalars.results[:3]
        states = [
            (m, e, new[p])
            for m in self.members["states"]
            for e, p in enumerate(m.places)
            if not self._is_entry(scalars, new[p], 1, p)
        ]
        fresh = {i for out in tick.tick.outputs for i in range(out.first, out.first + out.count)}
        fresh |= {i for i, node in enumerate(log) if self._is_input(scalars, node)}  # inputs that are outputs
        written = [
            (m, e, log[p])
            for g in ("outputs", "signals")
            for m in self.members[g]
            for e, p in enumerate(m.places)
            if p in fresh
        ]
        uses = scalars.needed([*(n for *_, n in states), *(n for *_, n in written), *guards])
        expressions = Expressions(
            scalars,
            uses,
            lambda argument, entry, fine: self._read(tick, argument, entry, fine),
            tables=self.tables,
            call=self._call,
            real=self.real,
            single=self.single,
        )
        taken = {*_KEYWORDS, *_HELPERS.split(), self.name, self.real, f"{self.name}_status"}
        taken |= {f"t{i}" for i in range(10_000)}
        self._blocks(tick, expressions, log, uses, taken)
        self._guards(tick, expressions, guards)
        self._take_over(tick, expressions, states, written, scalars, taken)
        tick.operations = expressions.operations
        self.called |= expressions.functions
        self.called_fine |= expressions.fine_functions
        return tick

    def _update_lines(self) -> list[str]:
        """Return the function that computes the numbers again."""
        if not self.renewed:
            return []
        lines = [
            "/* ---- numbers that are computed from parameters ---- */",
            "",
            f"void {self.name}_update({self.name} *c) {{",
        ]
        ready = []
        for which, (one, scalars) in enumerate(self.numbers):
            entries = [(i, place) for w, i, place in self.renewed if w == which]
            if not entries:
                continue
            roots = [scalars.results[0][i] for i, _ in entries]

            def read(argument: int, entry: int, fine: bool, first: int = one.first) -> str:
                found = self.places.get((3, first + entry))
                return (
                    self._constant(self.spec.start["p"][first + entry]) if found is None else found[0].access(found[1])
                )

            expressions = Expressions(
                scalars,
                scalars.needed(roots),
                read,
                tables=self.tables,
                call=self._call,
                real=self.real,
                single=self.single,
                timed=False,
            )
            lines += ["    {", f"        /* {one.block} */"]
            for (_, place), root in zip(entries, roots, strict=True):
                lines += [f"        {line}" for line in _wrap(expressions.compute(root, None))]
                member, entry = self.places[3, place]
                ready.append(f"        {member.access(entry)} = {expressions.text(root)};")
            lines += [*ready, "    }"]
            ready = []
            self.called |= expressions.functions
        return [*lines, "}", ""]

    def _read(self, tick: _WrittenTick, argument: int, entry: int, fine: bool) -> str:
        if argument == 0:
            tick.touch("time", "time")
            return "t"
        found = self.places.get((argument, entry))
        if found is None:
            return self._constant(self.spec.start["p" if argument == 3 else "x"][entry], fine)
        member, which = found
        if member.group == "numbers":
            tick.touch("parameters", f"numbers of {member.variable.name}")
        else:
            tick.touch(member.group, member.variable.name)
        if not fine:
            return member.access(which)
        start = float(member.start[which])
        if member.group != "parameters" or float(np.float32(start)) == start:
            return f"(double){member.access(which)}"
        self.called_fine.add("exact")
        return f"exact({member.access(which)}, {c_constant(start, single=True)}, {c_constant(start)})"

    def _call(self, function: str, fine: bool = False) -> str:
        single = self.single and not fine
        if self.own and function in (SINGLE_FUNCTIONS if single else FUNCTIONS):
            return f"lw_{function}f" if single else f"lw_{function}"
        return f"{function}f" if single else function

    def _constant(self, value: float, fine: bool = False) -> str:
        text = c_constant(float(value), single=self.single and not fine)
        return f"({text})" if text.startswith("-") else text

    def _blocks(
        self, tick: _WrittenTick, expressions: Expressions, log: Sequence[int], uses: Mapping[int, int], taken: set[str]
    ) -> None:
        """Write the outputs of the blocks in their order, those that something needs."""
        last = None
        for output in tick.tick.outputs:
            for entry in range(output.count):
                node = log[output.first + entry]
                if uses.get(node, 0) == 0:
                    continue
                label = identifier(f"{output.block}_{output.port}") + (f"_{entry}" if output.count > 1 else "")
                lines = expressions.compute(node, distinct(label, taken))
                if not lines:
                    continue
                if output.block != last:
                    tick.add("", f"/* {output.block} ({output.kind}) */")
                    tick.blocks.append(output.block)
                    last = output.block
                tick.add(*_wrap(lines))

    def _guards(self, tick: _WrittenTick, expressions: Expressions, guards: Sequence[int]) -> None:
        if not all(map(expressions.is_positive, guards)):
            tick.add("", "/* Guards: what must be positive. */")
        for guard, node in zip(tick.tick.guards, guards, strict=True):
            if expressions.is_positive(node):
                continue
            tick.add(*_wrap(expressions.compute(node, None)))
            text = expressions.text(node)
            tick.add(f"if (!({text} > {self._constant(0.0)})) {{ /* {guard[0]}: {guard[1]} */")
            tick.add(f"    return {self.upper}_GUARD_{self.guards[guard]};", "}")

    def _take_over(
        self,
        tick: _WrittenTick,
        expressions: Expressions,
        states: Sequence[tuple[Member, int, int]],
        written: Sequence[tuple[Member, int, int]],
        scalars: Scalars,
        taken: set[str],
    ) -> None:
        """Write the next states, check that all is finite, and take it over."""
        ready: list[tuple[str, str]] = []
        checked: list[str] = []
        if states:
            tick.add("", "/* States for the next tick. */")
        for member, entry, node in states:
            tick.touch("next", member.variable.name)
            label = distinct(f"next_{member.name}" + (f"_{entry}" if member.variable.shape else ""), taken)
            tick.add(*_wrap(expressions.compute(node, label)))
            text, one = expressions.text(node), scalars.nodes[node]
            named = one.operation != ca.OP_INPUT and not one.is_boolean and re.fullmatch(r"\w+", text)
            if not named and one.operation != ca.OP_CONST:
                tick.add(*_wrap([f"const {self.real} {label} = {text};"]))
                text = label
            ready.append((member.access(entry), text))
            if one.operation != ca.OP_CONST:
                checked.append(text)
        for member, entry, node in written:
            tick.touch("written", member.variable.name)
            tick.add(*_wrap(expressions.compute(node, None)))
            text, one = expressions.text(node), scalars.nodes[node]
            if one.operation == ca.OP_INPUT and one.place[0] == 1:  # the state is overwritten above
                label = distinct(f"now_{member.name}" + (f"_{entry}" if member.variable.shape else ""), taken)
                tick.add(*_wrap([f"const {self.real} {label} = {text};"]))
                text = label
            ready.append((member.access(entry), text))
            if one.operation != ca.OP_CONST and not one.is_boolean:
                checked.append(text)
        checked = list(dict.fromkeys(checked))
        if checked:
            tick.add("", "/* Nothing of a tick is taken over whose numbers are not finite. */")
            first, *others = (f"is_finite({text})" for text in checked)
            tick.add(
                *_fill("if (!(", [first, *others], " && ", ")) {"), f"    return {self.upper}_NOT_FINITE;", "}", ""
            )
        tick.add(*(f"{target} = {text};" for target, text in ready))
        tick.add(f"return {self.upper}_OK;")

    # --- text -----------------------------------------------------------------------------------------------------

    def _header(self) -> str:
        name, upper, loop = self.name, self.upper, self.spec.loop
        base = float(loop.base)
        lines = [
            "/**",
            f" * @file {name}.h",
            f" * {sentence(loop.description) or f'The sampled diagram {name}.'}",
            " *",
            " * Generated by Loopwright. Standard C99; no memory is allocated, nothing is global but constant tables.",
            " *",
            f" * Use: let the caller own one struct {name} for each instance;",
            f" * {name}_init() once; then {name}_tick() every {base:g} s, with the inputs of this instant set before",
            " * it, and the outputs read after it. The struct may be copied: a copy is an instance, or a saved state.",
            " * It is not to be ticked and written by two threads or interrupts at the same time.",
            " *",
            " * Sample times:",
            *(
                f" *   {self._rate(i)}: {', '.join(p or 'the diagram' for p in paths)}"
                for i, paths in enumerate(self.spec.acting)
            ),
            " */",
            f"#ifndef {upper}_H",
            f"#define {upper}_H",
            "",
            "#include <stdbool.h>",
            "#include <stdint.h>",
            "",
            "#ifdef __cplusplus",
            'extern "C" {',
            "#endif",
            "",
            f"/** Type of all numbers. */\ntypedef {self.number} {self.real};",
            "",
            f"/** Seconds between two calls of {name}_tick(). */\n#define {upper}_PERIOD {self._constant(base)}",
            "",
            "/** Outcome of a tick. Any but OK: nothing of it was taken over, outputs and states are those before. */",
            "typedef enum {",
            *(f"    {upper}_{label} = {i}, /**< {text} */" for i, (label, text) in enumerate(self.statuses)),
            f"}} {name}_status;",
            "",
        ]
        for group in _GROUPS:
            if members := self.members[group]:
                lines += [f"/** {_ABOUT[group]} */", "typedef struct {"]
                width = max(len(m.declaration) for m in members)
                lines += [
                    f"    {self.real} {m.declaration + ';':{width + 1}} /**< {about_member(m)} */" for m in members
                ]
                lines += [f"}} {name}_{group};", ""]
        lines += ["/** An instance: all its memory. */", f"typedef struct {name} {{"]
        lines += [f"    {name}_{group} {group};" for group in _GROUPS if self.members[group]]
        lines += ["    int64_t tick; /**< ticks since the start */"]
        if self.counted:
            lines += [f"    uint32_t wait[{len(self.clocks)}]; /**< ticks until each sample time is due */"]
        lines += [f"}} {name};", "", *self._named_header()]
        lines += [
            "/** Put an instance to its start: start values of parameters, inputs and states, time 0. */",
            f"void {name}_init({name} *c);",
            "",
            *(
                [
                    "/** Compute the numbers that depend on parameters, for the next tick. To be called when members",
                    f" * of c->parameters have been written; {name}_set() does it. */",
                    f"void {name}_update({name} *c);",
                    "",
                ]
                if self.renewed
                else []
            ),
            f"/** Act at one instant, and let the time go on by {upper}_PERIOD; call it at this period.",
            f" * @return {upper}_OK, or why nothing of the tick was taken over; then the time stays, too. */",
            f"{name}_status {name}_tick({name} *c);",
            "",
            "/** Return a text of an outcome. */",
            f"const char *{name}_status_text({name}_status status);",
            "",
            "#ifdef __cplusplus",
            "}",
            "#endif",
            "",
            f"#endif /* {upper}_H */",
            "",
        ]
        return "\n".join(lines)

    @property
    def _named(self) -> list[Member]:
        return [m for group in ("parameters", "inputs", "outputs", "signals") for m in self.members[group]]

    def _label(self, member: Member) -> str:
        """Return the enumerator of a member: names that differ in case alone are numbered."""
        if not self._labels:
            taken: dict[str, set[str]] = {group: set() for group in _GROUPS}
            for one in self._named:
                name = distinct(one.name.upper(), taken[one.group])
                self._labels[one.group, one.name] = f"{self.upper}_{_KIND[one.group].upper()}_{name}"
        return self._labels[member.group, member.name]

    def _named_header(self) -> list[str]:
        name, upper = self.name, self.upper
        if not self._named:
            return []
        return [
            f"/** Variables by name, for {name}_set() and {name}_get(). */",
            "typedef enum {",
            *(f"    {self._label(m)}," for m in self._named),
            f"    {upper}_VARIABLES /**< their number */",
            f"}} {name}_id;",
            "",
            "/** A variable: name, unit, place in the struct, number of entries, whether it may be set, range. */",
            "typedef struct {",
            "    const char *name;",
            "    const char *unit;",
            "    uint32_t offset; /**< bytes from the begin of the struct */",
            "    uint32_t count;",
            "    bool settable;",
            f"    {self.real} minimum;",
            f"    {self.real} maximum;",
            f"}} {name}_variable;",
            "",
            f"/** All variables, by {name}_id. */",
            f"extern const {name}_variable {name}_variables[{upper}_VARIABLES];",
            "",
            "/** Set an entry of a parameter or an input; index 0 of a scalar.",
            " * @return false, and nothing is set, if there is no such entry, it isn't to be set, or out of range. */",
            f"bool {name}_set({name} *c, {name}_id id, uint32_t index, {self.real} value);",
            "",
            "/** Get an entry of any variable.",
            " * @return false, and nothing is written, if there is no such entry. */",
            f"bool {name}_get(const {name} *c, {name}_id id, uint32_t index, {self.real} *value);",
            "",
        ]

    def _source(self, ticks: Sequence[_WrittenTick]) -> str:
        name = self.name
        lines = [
            f"/* {name}: see {name}.h. Generated by Loopwright.",
            "",
            "   In double precision its numbers are those of the diagram's run, bit by bit, where nothing is",
            "   contracted to fused operations: gcc needs -std=c99 or -ffp-contract=off, clang has a pragma below.",
            "   Never use -ffast-math. A block's code is below its path. */",
            f'#include "{name}.h"',
            "#include <float.h>",
            "#include <math.h>",
            "#include <stddef.h>",
            "#include <string.h>",
            "",
            "#if defined(__clang__)",
            "#pragma STDC FP_CONTRACT OFF",
            "#endif",
            "",
            *self._own_functions(),
            *self._helpers(),
            *self._table_lines(),
            *self._start_lines(),
        ]
        for tick in ticks:
            bits = tick.tick.acting
            if self.counted and not bits and tick.is_empty:
                continue
            when = self._when(bits)
            lines += [
                f"/* ---- {when[0].upper()}{when[1:]} ---- */",
                "",
                f"static {name}_status tick_{tick.number}({name} *c) {{",
                *(["    (void)c; /* nothing is read or written */"] if tick.is_empty else []),
            ]
            if "time" in tick.touched:
                base = self.spec.loop.base
                whole = f"(double)(c->tick * INT64_C({base.numerator})) / {c_constant(float(base.denominator))}"
                lines += [f"    const double t = {whole}; /* s */"]
            lines += [*tick.lines, "}", ""]
        lines += self._tick_lines(ticks)
        lines += self.update
        lines += self._named_source()
        lines += [
            f"const char *{name}_status_text({name}_status status) {{",
            "    static const char *const texts[] = {",
            *(f'        "{text}",' for _, text in self.statuses),
            "    };",
            f'    return ((uint32_t)status < {len(self.statuses)}u) ? texts[status] : "no such status";',
            "}",
            "",
        ]
        return "\n".join(lines)

    def _own_functions(self) -> list[str]:
        single = [f for f in SINGLE_FUNCTIONS if self.own and self.single and f in self.called]
        double = [f for f in FUNCTIONS if self.own and f in (self.called_fine if self.single else self.called)]
        if not (single or double):
            return []
        texts = []
        if double:
            text = prepare_functions(" ".join(f"{f}(" for f in double)).replace(
                '#include "elementary.c"\n', read_runtime("elementary.c")
            )
            text = re.sub(r"^#define (\w+) lw_\1\n", "", text, flags=re.MULTILINE)
            text = re.sub(
                r"\b0x[0-9a-f.]+p[+-]?\d+\b", lambda found: repr(float.fromhex(found[0])), text
            )  # the same number
            texts.append(re.sub(r"\b(INFINITY|NAN)\b", r"(double)\1", text))  # they are of single precision in C
        if single:
            texts.append(
                prepare_single(single).replace('#include "elementary_single.c"\n', read_runtime("elementary_single.c"))
            )
        wanted = [*(f"lw_{f}" for f in double), *(f"lw_{f}f" for f in single)]
        text = _leave_out_unused("\n".join(texts), wanted)
        return ["/* ---- elementary functions, with the same bits on every platform ---- */", "", text]

    def _helpers(self) -> list[str]:
        real, largest = self.real, "FLT_MAX" if self.single else "DBL_MAX"
        found = [
            f"static inline bool is_finite({real} x) {{ return {self._call('fabs')}(x) <= {largest}; }}",
            "",
        ]
        if "exact" in self.called_fine:
            found += [
                "/* A parameter in double precision: the exact start value until it is set. */",
                "static inline double exact(float value, float start, double exactly) {",
                "    return ((value < start) || (value > start)) ? (double)value : exactly;",
                "}",
                "",
            ]
        for called, type_, end in ((self.called, real, ""), (self.called_fine, "double", OF_TIME)):
            one, zero = (self._constant(value, bool(end)) for value in (1.0, 0.0))
            if "choose" in called:
                found += [
                    "/* a where the condition holds, else b; in a run it is a sum of both, so that -0 becomes 0. */",
                    f"static inline {type_} choose{end}(bool condition, {type_} a, {type_} b) {{",
                    f"    return condition ? a + {zero} : b + {zero};",
                    "}",
                    "",
                ]
            if "sign" in called:
                found += [
                    f"static inline {type_} sign_of{end}({type_} x) {{",
                    f"    return (x < {zero}) ? -{one} : ((x > {zero}) ? {one} : x);",
                    "}",
                    "",
                ]
        return found

    def _table_lines(self) -> list[str]:
        found = ["/* ---- tables ---- */", ""] if self.tables.read else []
        for i, fine in sorted(self.tables.read):
            name, values, type_ = self.tables.name(i, fine), self.tables.values[i], "double" if fine else self.real
            texts = [c_constant(v, single=self.single and not fine) for v in values.tolist()]
            found += [
                f"static const {type_} {name}[{values.size}] = {{",
                *_fill("    ", texts, ", ", ""),
                "};",
                "",
            ]
            if (i, fine) in self.tables.sought:
                found += self._finder(name, values.size - 1, type_)
        return found

    @staticmethod
    def _finder(table: str, pieces: int, type_: str) -> list[str]:
        """Return the function that finds the piece of a table in halves: always as many steps, and no loop."""
        steps = []
        while pieces > 1:
            half = pieces // 2
            steps.append(f"    piece += (x < {table}[piece + {half}u]) ? 0u : {half}u;")
            pieces -= half
        return [
            "/* The piece of a table that x is in: the last breakpoint up to x, or an end piece. */",
            f"static inline {type_} find_in_{table}({type_} x) {{",
            f"    {'uint32_t' if steps else 'const uint32_t'} piece = 0u;",
            *(steps or ["    (void)x;"]),
            f"    return ({type_})piece;",
            "}",
            "",
        ]

    def _start_lines(self) -> list[str]:
        name = self.name
        lines = ["/* ---- start ---- */", "", f"static const {name} start_values = {{"]
        for group in _GROUPS:
            if members := self.members[group]:
                lines.append(f"    .{group} = {{")
                for m in members:
                    texts = [c_constant(v, single=self.single) for v in m.start.tolist()]
                    if m.variable.shape:
                        lines += _fill(f"        .{m.name} = {{", texts, ", ", "},")
                    else:
                        lines.append(f"        .{m.name} = {texts[0]},")
                lines.append("    },")
        lines.append("    .tick = 0,")
        if self.counted:
            lines.append(f"    .wait = {{{', '.join(f'{offset}u' for _, offset in self.clocks)}}},")
        return [*lines, "};", "", f"void {name}_init({name} *c) {{ *c = start_values; }}", ""]

    def _tick_lines(self, ticks: Sequence[_WrittenTick]) -> list[str]:
        name, upper = self.name, self.upper
        lines = ["/* ---- one tick ---- */", "", f"{name}_status {name}_tick({name} *c) {{"]
        if not self.counted:
            lines += [f"    const {name}_status status = tick_0(c);", f"    if (status == {upper}_OK) {{"]
            return [*lines, "        c->tick++;", "    }", "    return status;", "}", ""]
        n = len(self.clocks)
        lines += [
            f"    {name}_status status = {upper}_OK;",
            "    uint32_t acting = 0u; /* bits of the sample times that are due */",
            *(f"    acting |= (c->wait[{i}] == 0u) ? UINT32_C({1 << i}) : 0u; /* {self._rate(i)} */" for i in range(n)),
            "    switch (acting) {",
        ]
        for tick in ticks:
            if bits := tick.tick.acting:
                lines += [
                    f"    case {bits}u: /* {self._when(bits)} */",
                    f"        status = tick_{tick.number}(c);",
                    "        break;",
                ]
        idle = next((t for t in ticks if not t.tick.acting and not t.is_empty), None)
        lines += [
            "    default:" if idle else "    default: /* nothing is due */",
            *([f"        status = tick_{idle.number}(c);"] if idle else []),
            "        break;",
            "    }",
            f"    if (status == {upper}_OK) {{",
            *(
                f"        c->wait[{i}] = ((c->wait[{i}] == 0u) ? {every}u : c->wait[{i}]) - 1u;"
                for i, (every, _) in enumerate(self.clocks)
            ),
            "        c->tick++;",
            "    }",
            "    return status;",
            "}",
            "",
        ]
        return lines

    def _named_source(self) -> list[str]:
        name, upper = self.name, self.upper
        if not self._named:
            return []
        lines = [
            "/* ---- variables by name ---- */",
            "",
            f"const {name}_variable {name}_variables[{upper}_VARIABLES] = {{",
        ]
        for m in self._named:
            settable = m.group in ("parameters", "inputs")
            low, high = self._limits(m.variable)
            place = f"(uint32_t)offsetof({name}, {m.group}.{m.name})"
            lines.append(
                f'    [{self._label(m)}] = {{"{m.variable.name}", "{m.variable.unit or ""}", {place}, {m.count}u, '
                f"{str(settable).lower()}, {low}, {high}}},"
            )
        lines += [
            "};",
            "",
            f"bool {name}_set({name} *c, {name}_id id, uint32_t index, {self.real} value) {{",
            f"    if ((uint32_t)id >= (uint32_t){upper}_VARIABLES) {{",
            "        return false;",
            "    }",
            f"    const {name}_variable *v = &{name}_variables[id];",
            "    if (!v->settable || (index >= v->count) || !(value >= v->minimum) || !(value <= v->maximum)) {",
            "        return false;",
            "    }",
            "    memcpy((unsigned char *)c + v->offset + index * sizeof value, &value, sizeof value);",
            *(
                [
                    f"    if ((uint32_t)id < {len(self.members['parameters'])}u) {{",
                    f"        {name}_update(c);",
                    "    }",
                ]
                if self.renewed
                else []
            ),
            "    return true;",
            "}",
            "",
            f"bool {name}_get(const {name} *c, {name}_id id, uint32_t index, {self.real} *value) {{",
            f"    if (((uint32_t)id >= (uint32_t){upper}_VARIABLES) || (index >= {name}_variables[id].count)) {{",
            "        return false;",
            "    }",
            f"    const size_t place = {name}_variables[id].offset + index * sizeof *value;",
            "    memcpy(value, (const unsigned char *)c + place, sizeof *value);",
            "    return true;",
            "}",
            "",
        ]
        return lines

    def _limits(self, variable: Variable) -> tuple[str, str]:
        largest = "FLT_MAX" if self.single else "DBL_MAX"
        low, high = variable.minimum, variable.maximum
        if low is not None and self.single and low > 0 and np.float32(low) == 0:
            return "FLT_MIN", largest if high is None else self._constant(high)
        return (
            f"-{largest}" if low is None else self._constant(low),
            largest if high is None else self._constant(high),
        )

    def _example(self) -> str:
        name, upper = self.name, self.upper
        inputs, outputs = self.members["inputs"], self.members["outputs"]
        lines = [
            f"/* An example of {name}: a second of it, on a machine with a console.",
            "",
            f"   cc -std=c99 -O2 {name}.c {name}_example.c -lm && ./a.out",
            "",
            f"   On a target a timer calls {name}_tick() every {float(self.spec.loop.base):g} s. */",
            f'#include "{name}.h"',
            "#include <stdio.h>",
            "",
            "int main(void) {",
            f"    {name} c; /* all memory of an instance */",
            f"    {name}_init(&c);",
            f"    const uint32_t count = {max(1, min(1000, round(1 / float(self.spec.loop.base))))}u;",
            "    for (uint32_t k = 0u; k < count; k++) {",
        ]
        for m in inputs:
            for i, value in enumerate(m.start.tolist()):
                member = m.access(i).replace("c->", "c.")
                lines.append(f"        {member} = {c_constant(value, single=self.single)}; /* measured */")
        lines += [
            f"        const {name}_status status = {name}_tick(&c);",
            f"        if (status != {upper}_OK) {{",
            f'            printf("tick %lu: %s\\n", (unsigned long)k, {name}_status_text(status));',
            "            return 1;",
            "        }",
        ]
        shown = [(m, i) for m in outputs for i in range(m.count)][:8]
        formats = " ".join(f"{m.variable.name}{f'[{i}]' if m.variable.shape else ''} %.9g" for m, i in shown)
        values = ", ".join(f"(double){m.access(i).replace('c->', 'c.')}" for m, i in shown)
        lines += [
            f'        printf("{formats}\\n"{f", {values}" if values else ""});',
            "    }",
            "    return 0;",
            "}",
            "",
        ]
        return "\n".join(lines)


def _leave_out_unused(text: str, wanted: Sequence[str]) -> str:
    """Return C text without functions that neither the wanted ones nor others call."""
    while True:
        for found in _FUNCTION.finditer(text):
            name = found[1]
            if name not in wanted and len(re.findall(rf"\b{name}\b", text)) == 1:
                text = text[: found.start()] + text[found.end() :]
                break
        else:
            return text


def distinct(name: str, taken: set[str]) -> str:
    """Return a name that is not taken yet, and take it."""
    found, count = name, 2
    while found in taken:
        found, count = f"{name}_{count}", count + 1
    taken.add(found)
    return found


def sentence(text: str) -> str:
    """Return a text with a full stop, as it may be in a comment."""
    text = text.replace("*/", "* /")
    return text if not text or text.endswith(".") else f"{text}."


def about_member(member: Member) -> str:
    """Return what is said about a member: name, unit, description, range and start value."""
    variable = member.variable
    parts = [variable.name] if variable.name != member.name else []
    if variable.unit:
        parts.append(f"unit {variable.unit}")
    if len(variable.shape) > 1:
        parts.append(f"{' x '.join(map(str, variable.shape))}, row by row")
    if variable.description:
        parts.append(variable.description)
    tiny = float(np.finfo(float).tiny)
    if variable.minimum is not None or variable.maximum is not None:
        low = (
            "above 0"
            if variable.minimum == tiny
            else None
            if variable.minimum is None
            else f"from {variable.minimum:g}"
        )
        high = None if variable.maximum is None else f"to {variable.maximum:g}"
        parts.append(" ".join(t for t in (low, high) if t))
    if member.group in ("parameters", "inputs", "states"):
        values = member.start.tolist()
        parts.append(
            f"start {values[0]:g}"
            if len({*values}) == 1
            else f"start {', '.join(f'{v:g}' for v in values[:4])}{', ...' if len(values) > 4 else ''}"
        )
    return "; ".join(part.replace("*/", "* /").replace("\n", " ") for part in parts)


def _fill(head: str, parts: Sequence[str], between: str, tail: str) -> list[str]:
    """Return parts in as many lines as they need."""
    lines, line, inner = [], head, " " * max(4, len(head) - len(head.lstrip()) + 4)
    for i, part in enumerate(parts):
        piece = part + (between.rstrip() if i < len(parts) - 1 else tail)
        if len(line) + len(piece) > _WIDTH and line.strip() and i:
            lines.append(line.rstrip())
            line = inner
        line += piece + (" " if i < len(parts) - 1 else "")
    return [*lines, line.rstrip()] if parts else [head + tail]


def _wrap(lines: Iterable[str]) -> Iterator[str]:
    """Yield statements, long ones in several lines that are cut at spaces."""
    for line in lines:
        while len(line) > _WIDTH and (cut := line.rfind(" ", 40, _WIDTH)) > 0:
            yield line[:cut]
            line = f"    {line[cut + 1 :]}"
        yield line
