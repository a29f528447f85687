"""Report of C for a target: memory, what each tick touches, and what was measured."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from ...blocks.core import count_of
from .loop_spec import LoopSpec
from .target_measure import TargetMeasurement
from .target_members import GROUPS, NAMED
from .target_spec import TargetSpec
from .target_text import TargetText
from .tick_text import TickFacts


def report_lines(spec: TargetSpec | LoopSpec, text: TargetText, measured: TargetMeasurement | None) -> Iterator[str]:
    """Yield the lines of the report of C for a target."""
    loop = spec if isinstance(spec, LoopSpec) else spec.loop
    yield f"{text.name}: C for a target, numbers in {text.number} precision"
    yield ""
    yield f"Call {text.name}_tick() every {float(loop.base):g} s."
    if isinstance(spec, LoopSpec):
        yield from _report_loop(spec, text)
    else:
        yield from _report_ticks(text, measured)


def _report_loop(spec: LoopSpec, text: TargetText) -> Iterator[str]:
    if spec.hybrid:
        yield "Between ticks the classical Runge-Kutta method (rk4) makes one step a period, or several where an"
        yield "event is in it."
    yield f"Functions of math.h, at most: {_list(text.platform_functions)}."
    yield "No memory is allocated. How long a tick takes depends on the events and equations in it: measure it."
    yield ""
    yield f"An instance has {text.bytes_of['struct']} bytes, {spec.name.upper()}_BYTES."
    states = sum(one.variable.size for one in spec.states)
    yield f"It has {count_of(states, 'state')}, {count_of(len(spec.events), 'event')}."
    for group in NAMED:
        yield f"{group}: {_list(one.variable.name for one in text.members if one.group == group)}"


def _report_ticks(text: TargetText, measured: TargetMeasurement | None) -> Iterator[str]:
    yield f"Functions of math.h: {_list(text.platform_functions)}."
    yield "No memory is allocated. Nothing in a tick loops but the search in a table, of log2(length) steps, and what"
    yield "elementary functions do inside, such as sine for angles above a million."
    yield ""
    yield "Memory in bytes"
    for group in GROUPS:
        yield f"  {group:<12}{text.bytes_of[group]:>7}"
    yield f"  {'an instance':<12}{text.bytes_of['struct']:>7}   all of it, with the count of ticks"
    yield f"  {'tables':<12}{text.bytes_of['tables']:>7}   constant, once for all instances"
    for number, tick in enumerate(text.ticks):
        yield ""
        yield f"Tick {number}: {tick.when}"
        yield from _facts(tick)
    yield ""
    yield from _measured(measured)


def _list(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"


def _facts(tick: TickFacts) -> Iterator[str]:
    count = sum(tick.operations.values())
    kinds = ", ".join(f"{n} {kind}" for kind, n in sorted(tick.operations.items(), key=lambda one: -one[1]))
    rows = {
        "subsystems": tick.subsystems,
        "blocks": tick.blocks,
        "reads inputs": tick.inputs,
        "parameters": tick.parameters,
        "states": tick.read,
        "writes states": tick.states,
        "outputs": tick.outputs,
        "operations": (f"{count} at most, whatever the data: {kinds}" if count else "none",),
    }
    for label, names in rows.items():
        yield from _row(label, names)


def _row(label: str, names: Iterable[str]) -> Iterator[str]:
    line = f"  {label:<15}"
    for name in [*names] or ["none"]:
        if len(line) + len(name) > 100 and line.strip() != label:
            yield line.rstrip()
            line = " " * 17
        line += f"{name}, "
    yield line.rstrip(", ")


def _measured(measured: TargetMeasurement | None) -> Iterator[str]:
    if measured is None:
        yield "Not measured: nothing was compiled. code.measure(inputs) compiles it and counts instructions."
        return
    yield f"Measured with a test signal of {measured.ticks} ticks"
    for one in measured.processors:
        memory = f"{one.code} bytes of instructions, {one.constants} of constants (without libraries)"
        yield f"  {one.processor}, -O2: {memory}"
        if one.instructions:
            yield (
                f"    instructions of a tick: {one.largest} at most, {min(one.instructions)} at least; "
                f"{one.stack} bytes of stack"
            )
        bound = f"{one.bound} instructions" if one.bound is not None else f"none: {one.unbounded}"
        yield f"    bound for any data: {bound}"
    for line in measured.missing:
        yield f"  {line}"
    if measured.float_error:
        yield "  largest difference between float and double, with this signal:"
        for name, value in measured.float_error.items():
            yield f"    {name:<20}{value:.3g}"
