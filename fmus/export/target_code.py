"""C for a target: a sampled diagram as one header and one source of standard C99; their text is in ``templates/``."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from .c_expressions import OF_TIME, NumberText
from .c_text import c_constant, fill_lines, fill_template
from .elementary_tables import prepare_functions, prepare_single, read_fmu_source
from .model_spec import Variable
from .scalar_operations import Tables
from .target_layout import TargetLayout
from .target_members import GROUPS, NAMED, Group, Member, Number, Status, label_members, list_statuses
from .target_spec import TargetSpec
from .target_text import MOST_SHOWN, TargetText, frame_facts
from .tick_text import TickText, write_renewal

_FUNCTION = re.compile(r"^static [^\n;=]*\b(lw_\w+)\([^\n]*\) \{(?:[^\n]*\}|\n.*?^\})\n", re.MULTILINE | re.DOTALL)
_GROUP_TEXTS: Mapping[Group, str] = {
    "parameters": "Parameters: to be set at any time between two ticks.",
    "numbers": "Numbers that are computed from parameters, by block: not to be written.",
    "inputs": "Inputs: to be set before each tick; they are held until they are set again.",
    "outputs": "Outputs: valid after a tick, until the next one.",
    "signals": "Named signals inside, to be watched: valid after a tick.",
    "states": "States from one tick to the next: saved and restored with the whole struct. "
    "To be written right after init alone, for another start.",
}


def write_target(spec: TargetSpec, *, number: Number = "double", own_functions: bool = False) -> TargetText:
    """Return a sampled diagram as C.

    ``own_functions``: take sine, cosine, tangent hyperbolic, exponential, exp(x) - 1, logarithm and power from this
    package, with the same bits on every platform, and not from math.h. In ``float`` they compute in single precision.
    """
    name = spec.loop.name
    numbers = NumberText(f"{name}_real", single=number == "float", own_functions=own_functions)
    tables = Tables()
    layout = TargetLayout(spec, tables)
    statuses, guards = list_statuses(
        (guard for tick in spec.ticks for guard in tick.guards),
        Status("NOT_FINITE", "a state, an output or a signal would not be a finite number"),
    )
    # The ticks are written first: what they call decides which functions and tables the source has.
    ticks = [TickText(spec, kind, layout, numbers, guards) for kind in range(len(spec.ticks))]
    facts = frame_facts(
        spec.loop,
        about=f"The sampled diagram {name}.",
        period=numbers.constant(float(spec.loop.base)),
        statuses=statuses,
    )
    facts |= {"number": number, "renewal": "\n".join(write_renewal(layout, numbers))}
    facts |= _layout_facts(spec, layout, numbers)
    source = _number_facts(numbers, tables) | _tick_facts(spec, ticks)
    files = {
        f"{name}.h": fill_template("target.h", **facts),
        f"{name}.c": fill_template("target.c", **facts, **source),
        f"{name}_example.c": fill_template("target_example.c", **facts, **_example_facts(layout, numbers)),
    }
    return TargetText(
        name,
        number,
        tuple(layout.all_members()),
        files,
        tuple(tick.facts for tick in ticks),
        _count_bytes(spec, layout, numbers, tables),
        numbers.platform_functions,
        tuple(status.text for status in statuses),
    )


def _count_bytes(spec: TargetSpec, layout: TargetLayout, numbers: NumberText, tables: Tables) -> dict[str, int]:
    size = 4 if numbers.single else 8
    found: dict[str, int] = {group: size * sum(m.count for m in layout.members[group]) for group in GROUPS}
    waits = 4 * len(spec.loop.clocks) if spec.counts_clocks else 0
    # Behind the numbers is the count of ticks, which is aligned to eight bytes, as the struct is.
    found["struct"] = _align(_align(sum(found.values())) + 8 + waits)
    found["tables"] = sum(tables.values[i].size * (8 if fine else size) for i, fine in numbers.tables_read)
    return found


def _align(count: int) -> int:
    return -(-count // 8) * 8


# --- facts of the templates -------------------------------------------------------------------------------------------


def _layout_facts(spec: TargetSpec, layout: TargetLayout, numbers: NumberText) -> dict[str, Any]:
    """Return clocks, members of the struct, and variables by name."""
    named = layout.all_members(NAMED)
    labels = label_members(named)
    clocks = [
        {
            "when": spec.describe_clock(i),
            "subsystems": ", ".join(path or "the diagram" for path in paths),
            "bit": 1 << i,
            "every": every,
            "offset": offset,
        }
        for i, (paths, (every, offset)) in enumerate(zip(spec.acting, spec.loop.clocks, strict=True))
    ]
    return {
        "clocks": clocks,
        "counted": spec.counts_clocks,
        "groups": [(group, members) for group in GROUPS if (members := layout.members[group])],
        "group_texts": _GROUP_TEXTS,
        "named": [(member, labels[member], *_write_range(member.variable, numbers)) for member in named],
        "start_of": lambda member: _write_start(member, numbers),
        "parameters": len(layout.members["parameters"]),
    }


def _write_start(member: Member, numbers: NumberText) -> str:
    texts = [numbers.constant(value) for value in member.start.tolist()]
    if not member.variable.shape:
        return f"        .{member.name} = {texts[0]},"
    return "\n".join(fill_lines(f"        .{member.name} = {{", texts, ", ", "},"))


def _write_range(variable: Variable, numbers: NumberText) -> tuple[str, str]:
    low, high = variable.minimum, variable.maximum
    most = "FLT_MAX" if numbers.single else "DBL_MAX"
    least = f"-{most}" if low is None else numbers.bracketed(low)
    if low is not None and low > 0 and numbers.single and np.float32(low) == 0:
        least = "FLT_MIN"  # an open bound at 0 stays above it
    return least, most if high is None else numbers.bracketed(high)


def _number_facts(numbers: NumberText, tables: Tables) -> dict[str, Any]:
    """Return the functions and tables in front of the ticks."""
    single, double = numbers.own_functions
    return {
        "own_functions": _write_own_functions(single, double),
        "fabs": numbers.function("fabs"),
        "largest": "FLT_MAX" if numbers.single else "DBL_MAX",
        "needs_exact": numbers.needs("exact", fine=True),
        "helpers": [
            {
                "type": numbers.type_of(fine),
                "end": OF_TIME * fine,
                "zero": numbers.constant(0.0, fine),
                "one": numbers.constant(1.0, fine),
                "choose": numbers.needs("choose", fine),
                "sign": numbers.needs("sign", fine),
            }
            for fine in (False, True)
        ],
        "tables": [_table_facts(tables.values[i], i, fine, numbers) for i, fine in sorted(numbers.tables_read)],
    }


def _table_facts(values: np.ndarray, which: int, fine: bool, numbers: NumberText) -> dict[str, Any]:
    texts = [numbers.constant(value, fine) for value in values.tolist()]
    return {
        "type": numbers.type_of(fine),
        "name": numbers.table(which, fine),
        "count": values.size,
        "entries": "\n".join(fill_lines("    ", texts, ", ", "")),
        "is_sought": (which, fine) in numbers.tables_sought,
        "halves": [*_halve(values.size - 1)],
    }


def _halve(pieces: int) -> Iterator[int]:
    """Yield the steps by which a piece of a table is found in halves: always as many, so that there is no loop."""
    while pieces > 1:
        yield pieces // 2
        pieces -= pieces // 2


def _tick_facts(spec: TargetSpec, ticks: Sequence[TickText]) -> dict[str, Any]:
    """Return each kind of tick, with the one at which no clock acts but sources change."""
    base, found = spec.loop.base, []
    for one in ticks:
        acting, when = one.tick.acting, spec.describe_clocks(one.tick.acting)
        found.append(
            {
                "kind": one.kind,
                "acting": acting,
                "when": when,
                "title": f"{when[0].upper()}{when[1:]}",
                "is_empty": one.is_empty,
                "is_written": bool(acting) or not one.is_empty or not spec.counts_clocks,
                "reads_time": one.reads_time,
                "text": "\n".join(one.lines),
            }
        )
    return {
        "ticks": found,
        "idle": next((one.kind for one in ticks if not one.tick.acting and not one.is_empty), None),
        "ticks_to_time": (base.numerator, c_constant(float(base.denominator))),
    }


def _example_facts(layout: TargetLayout, numbers: NumberText) -> dict[str, Any]:
    """Return the inputs that an example sets, and the outputs that it prints."""
    shown = [(member, i) for member in layout.members["outputs"] for i in range(member.count)][:MOST_SHOWN]
    return {
        "measured": [
            (member.access(i, "c."), numbers.constant(value))
            for member in layout.members["inputs"]
            for i, value in enumerate(member.start.tolist())
        ],
        "shown": [
            (member.variable.name + (f"[{i}]" if member.variable.shape else ""), member.access(i, "c."))
            for member, i in shown
        ],
    }


# --- elementary functions ---------------------------------------------------------------------------------------------


def _write_own_functions(single: Sequence[str], double: Sequence[str]) -> str:
    """Return the C text of our own elementary functions in single and double precision; empty for none."""
    texts = []
    if double:
        text = prepare_functions(" ".join(f"{name}(" for name in double)).replace(
            '#include "elementary.c"\n', read_fmu_source("elementary.c")
        )
        text = re.sub(r"^#define (\w+) lw_\1\n", "", text, flags=re.MULTILINE)
        # The same numbers in decimal digits, as in the rest of the source.
        text = re.sub(r"\b0x[0-9a-f.]+p[+-]?\d+\b", lambda found: repr(float.fromhex(found[0])), text)
        texts.append(re.sub(r"\b(INFINITY|NAN)\b", r"(double)\1", text))  # they are of single precision in C
    if single:
        texts.append(
            prepare_single(single).replace('#include "elementary_single.c"\n', read_fmu_source("elementary_single.c"))
        )
    return _leave_out_unused("\n".join(texts), [*(f"lw_{f}" for f in double), *(f"lw_{f}f" for f in single)])


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
