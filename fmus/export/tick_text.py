"""C text of one kind of tick: the blocks in their order, the guards, the states, and what it takes over at the end."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ...blocks.core import explain_calls
from .c_expressions import Expressions, NumberText
from .c_text import HELPERS, KEYWORDS, c_constant, distinct, fill_lines, identifier, wrap_statements
from .scalar_operations import ScalarNode
from .target_layout import INPUTS, PARAMETERS, STATES, TargetLayout, is_entry
from .target_members import Member
from .target_spec import TargetSpec

_MOST_TEMPORARIES = 10_000


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


class TickText:
    """A kind of tick, written.

    ``lines``: its statements.
    ``guards``: by block and name, the enumerator that a guard ends the tick with.
    """

    def __init__(
        self,
        spec: TargetSpec,
        kind: int,
        layout: TargetLayout,
        numbers: NumberText,
        guards: Mapping[tuple[str, str], str],
    ):
        self.kind, self.tick = kind, spec.ticks[kind]
        self.lines: list[str] = []
        self._spec, self._layout, self._numbers = spec, layout, numbers
        self._upper = spec.loop.name.upper()
        self._guard_of = guards
        self._scalars = layout.ticks[kind]
        self._next, self._log, self._guards = self._scalars.results[:3]
        self._touched: dict[str, dict[str, None]] = {}  # names in the order in which they are met, by what is done
        self._blocks: list[str] = []
        name = spec.loop.name
        self._taken = {*KEYWORDS, *HELPERS, name, numbers.real, f"{name}_status"}
        self._taken |= {f"t{i}" for i in range(_MOST_TEMPORARIES)}
        self._states, self._written = self._find_states(), self._find_written()
        results = [node for *_, node in (*self._states, *self._written)]
        self._uses = self._scalars.needed([*results, *self._guards])
        self._expressions = Expressions(self._scalars, self._uses, self._read, numbers)
        guarded = zip(self.tick.guards, self._guards, strict=True)
        self._tested = [(guard, node) for guard, node in guarded if not self._expressions.is_positive(node)]
        self._write()

    @property
    def is_empty(self) -> bool:
        """Whether it does nothing."""
        return not (self._states or self._written or self._tested)

    @property
    def reads_time(self) -> bool:
        """Whether the time is in its equations."""
        return "time" in self._touched

    @property
    def facts(self) -> TickFacts:
        """What it touches."""
        touched = {what: tuple(names) for what, names in self._touched.items()}
        return TickFacts(
            self._spec.describe_clocks(self.tick.acting),
            self._spec.acting_at(self.tick.acting),
            tuple(dict.fromkeys(self._blocks)),
            inputs=touched.get("inputs", ()),
            parameters=touched.get("parameters", ()),
            read=touched.get("states", ()),
            states=touched.get("next", ()),
            outputs=touched.get("written", ()),
            operations=self._expressions.operations,
        )

    # --- what it reads and writes -------------------------------------------------------------------------------------

    def _find_states(self) -> list[tuple[Member, int, int]]:
        """Return the states that it changes: member, entry, and the new value."""
        return [
            (member, entry, self._next[place])
            for member in self._layout.members["states"]
            for entry, place in enumerate(member.places)
            if not is_entry(self._scalars, self._next[place], STATES, place)
        ]

    def _find_written(self) -> list[tuple[Member, int, int]]:
        """Return the outputs and signals of the blocks that act, and those that are inputs of the diagram."""
        fresh = {i for output in self.tick.outputs for i in range(output.first, output.first + output.count)}
        fresh |= {i for i, node in enumerate(self._log) if self._is_input(self._scalars.nodes[node], INPUTS)}
        return [
            (member, entry, self._log[place])
            for member in self._layout.all_members(("outputs", "signals"))
            for entry, place in enumerate(member.places)
            if place in fresh
        ]

    @staticmethod
    def _is_input(node: ScalarNode, argument: int) -> bool:
        return node.operation == ca.OP_INPUT and node.place[0] == argument

    def _touch(self, what: str, name: str) -> None:
        self._touched.setdefault(what, {})[name] = None

    def _read(self, argument: int, entry: int, fine: bool) -> str:
        """Return the C text of an entry of an argument of the tick."""
        if argument == 0:
            self._touch("time", "time")
            return "t"
        found = self._layout.place(argument, entry)
        if found is None:
            return self._numbers.bracketed(self._layout.start_value(argument, entry), fine)
        member, which = found
        if member.group == "numbers":
            self._touch("parameters", f"numbers of {member.variable.name}")
        else:
            self._touch(member.group, member.variable.name)
        if not fine:
            return member.access(which)
        # A parameter is of single precision: until it is set, its start value is known in double precision.
        start = float(member.start[which])
        if member.group != "parameters" or float(np.float32(start)) == start:
            return f"(double){member.access(which)}"
        self._numbers.note("exact", fine=True)
        return f"exact({member.access(which)}, {c_constant(start, single=True)}, {c_constant(start)})"

    # --- its statements -----------------------------------------------------------------------------------------------

    def _add(self, *lines: str) -> None:
        self.lines += [f"    {line}" if line else "" for line in lines]

    def _add_statements(self, lines: Iterable[str]) -> None:
        self._add(*wrap_statements(lines))

    def _write(self) -> None:
        self._write_blocks()
        self._write_guards()
        states = self._write_states()
        written = self._write_outputs()
        assigned = [*states, *written]
        # The values are checked before any of them is assigned, so that a tick that fails leaves the struct as it was.
        if checked := list(dict.fromkeys(text for _, text, is_checked in assigned if is_checked)):
            self._add("", "/* Nothing of a tick is taken over whose numbers are not finite. */")
            tests = [f"is_finite({text})" for text in checked]
            self._add(*fill_lines("if (!(", tests, " && ", ")) {"), f"    return {self._upper}_NOT_FINITE;", "}", "")
        self._add(*(f"{target} = {text};" for target, text, _ in assigned))
        self._add(f"return {self._upper}_OK;")

    def _write_blocks(self) -> None:
        """Write the outputs of the blocks in their order, those that something needs."""
        last = None
        for output in self.tick.outputs:
            for entry in range(output.count):
                node = self._log[output.first + entry]
                if self._uses.get(node, 0) == 0:
                    continue
                label = identifier(f"{output.block}_{output.port}") + (f"_{entry}" if output.count > 1 else "")
                lines = self._expressions.compute(node, distinct(label, self._taken))
                if not lines:
                    continue
                if output.block != last:
                    self._add("", f"/* {output.block} ({output.kind}) */")
                    self._blocks.append(output.block)
                    last = output.block
                self._add_statements(lines)

    def _write_guards(self) -> None:
        if self._tested:
            self._add("", "/* Guards: what must be positive. */")
        for guard, node in self._tested:
            self._add_statements(self._expressions.compute(node))
            condition = f"{self._expressions.text(node)} > {self._numbers.bracketed(0.0)}"
            self._add(f"if (!({condition})) {{ /* {guard[0]}: {guard[1]} */")
            self._add(f"    return {self._upper}_{self._guard_of[guard]};", "}")

    def _write_states(self) -> Sequence[tuple[str, str, bool]]:
        """Compute the next states into constants; return what is to be assigned, and whether it is checked."""
        found = []
        if self._states:
            self._add("", "/* States for the next tick. */")
        for member, entry, node in self._states:
            self._touch("next", member.variable.name)
            label = distinct(f"next_{self._label(member, entry)}", self._taken)
            self._add_statements(self._expressions.compute(node, label))
            text, one = self._expressions.text(node), self._scalars.nodes[node]
            is_constant = one.operation == ca.OP_CONST
            named = one.operation != ca.OP_INPUT and not one.is_boolean and re.fullmatch(r"\w+", text)
            if not named and not is_constant:
                text = self._keep(label, text)
            found.append((member.access(entry), text, not is_constant))
        return found

    def _write_outputs(self) -> Sequence[tuple[str, str, bool]]:
        """Compute outputs and signals; return what is to be assigned, and whether it is checked."""
        found = []
        for member, entry, node in self._written:
            self._touch("written", member.variable.name)
            self._add_statements(self._expressions.compute(node))
            text, one = self._expressions.text(node), self._scalars.nodes[node]
            if self._is_input(one, STATES):  # the state is overwritten before
                text = self._keep(distinct(f"now_{self._label(member, entry)}", self._taken), text)
            found.append((member.access(entry), text, one.operation != ca.OP_CONST and not one.is_boolean))
        return found

    def _keep(self, label: str, text: str) -> str:
        self._add_statements([f"const {self._numbers.real} {label} = {text};"])
        return label

    @staticmethod
    def _label(member: Member, entry: int) -> str:
        return member.name + (f"_{entry}" if member.variable.shape else "")


def write_renewal(layout: TargetLayout, numbers: NumberText) -> list[str]:
    """Return the statements that compute numbers again, block by block."""
    lines: list[str] = []
    for one in layout.renewed:
        first = one.spec.first

        def read(_: int, entry: int, fine: bool, first: int = first) -> str:
            found = layout.place(PARAMETERS, first + entry)
            if found is None:
                return numbers.bracketed(layout.start_value(PARAMETERS, first + entry))
            return found[0].access(found[1])

        roots = [one.scalars.results[0][i] for i, _ in one.entries]
        expressions = Expressions(one.scalars, one.scalars.needed(roots), read, numbers, timed=False)
        lines += ["    {", f"        /* {one.spec.block} */"]
        assigned = []
        for (_, place), root in zip(one.entries, roots, strict=True):
            lines += [f"        {line}" for line in wrap_statements(expressions.compute(root))]
            found = layout.place(PARAMETERS, place)
            assert found is not None
            assigned.append(f"        {found[0].access(found[1])} = {expressions.text(root)};")
        lines += [*assigned, "    }"]
    return lines
