"""C for a target in a folder: its files, the report next to them, and their measurement.

The report says what memory it takes, what each tick touches, and what was measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import OptionError, accepts, count_of, explain_calls, explain_disk_errors, kinds, write_text
from .loop_code import write_loop_target
from .loop_spec import LoopSpec
from .target_code import write_target
from .target_measure import PROCESSORS, TargetMeasurement, measure, run_here
from .target_members import GROUPS, NAMED, Number
from .target_spec import TargetSpec
from .target_text import TargetText
from .tick_text import TickFacts

_HELD = 200
"""Ticks that are counted where no test signal is given: the start values of the inputs are held."""


@explain_calls
class TargetCode:
    """C for a target: one header and one source, an example, and a report.

    ``print`` shows the report.

    Attributes
    ----------
    name : str
        Begin of all names in it.
    number : {"double", "float"}
        Type of all numbers.
    folder : Path
        Where the files are.
    files : tuple of Path
        Header, source, example and report.
    bytes_of : mapping of str to int
        Bytes of ``"parameters"``, ``"inputs"``, ``"outputs"``, ``"signals"``, ``"states"``, of an instance
        (``"struct"``) and of constant tables (``"tables"``).
    ticks : tuple of TickFacts
        By kind of tick: when it happens, and what it touches.
    measured : TargetMeasurement or None
        The last measurement.
    """

    def __init__(self, spec: TargetSpec | LoopSpec, text: TargetText, folder: Path, own_functions: bool):
        self._spec, self._text, self._own = spec, text, own_functions
        self.name, self.number, self.folder = text.name, text.number, folder
        self.bytes_of, self.ticks = text.bytes_of, text.ticks
        self.measured: TargetMeasurement | None = None
        self.files = tuple(folder / name for name in (*text.files, f"{text.name}_report.txt"))

    def __repr__(self) -> str:
        return f"C for a target {self.name!r}: {self.number}, {self.bytes_of['struct']} bytes, in {str(self.folder)!r}"

    def __str__(self) -> str:
        return self.report

    def _write(self) -> None:
        with explain_disk_errors("the C code can't be written", self.folder, "Name another folder.", block=self.name):
            self.folder.mkdir(parents=True, exist_ok=True)
            for name, text in self._text.files.items():
                write_text(self.folder / name, text)
            write_text(self.files[-1], self.report)

    @accepts(ticks=kinds.integer(1).or_none())
    def measure(
        self,
        inputs: Mapping[str, Any] | None = None,
        *,
        ticks: int | None = None,
        processors: Iterable[str] = tuple(PROCESSORS),
    ) -> TargetMeasurement:
        """Compile it for Cortex-M, count the instructions of each tick in an emulator, and write the report again.

        In single precision it is run here in both precisions, too, and the largest difference of each output is taken.

        Parameters
        ----------
        inputs : mapping of str to array_like, optional
            The test signal: values of inputs at each tick, shape (ticks, …), or one value for all; start values of the
            inputs that are not in it. The numbers hold for this signal alone, but for the bound.
        ticks : int, optional
            Number of ticks; as many as the signal has, or 200.
        processors : iterable of str
            Of ``"cortex-m4"`` (with the unit for single precision) and ``"cortex-m0"``.

        Raises
        ------
        OptionError
            For an input that it hasn't, values that don't fit, or another processor; and for C with the loop of runs
            inside, whose instructions depend on its events and equations.
        CompilerError
            If a tick of the signal fails, or a compiler warns.
        """
        if isinstance(self._spec, LoopSpec):
            raise OptionError(
                "instructions are counted of sampled diagrams alone; this one has a solver inside, whose steps and "
                "iterations depend on the data. Measure a tick on the target.",
                block=self.name,
                port="measure",
            )
        given = dict(inputs or {})
        shapes = {m.variable.name: m.variable.shape for m in self._text.members if m.group == "inputs"}
        lengths = [len(np.asarray(v)) for n, v in given.items() if np.ndim(v) > len(shapes.get(n, ()))]
        count = ticks or min(lengths, default=_HELD)
        error: dict[str, float] = {}
        missing: list[str] = []
        if self.number == "float":
            double = write_target(self._spec, own_functions=self._own)
            fine, coarse = (run_here(text, given, count) for text in (double, self._text))
            error = {name: float(np.max(np.abs(fine[name] - coarse[name]), initial=0.0)) for name in fine}
        found = []
        for processor in processors:
            one = measure(self._text, processor, given, count)
            found.append(one)
            if one.missing:
                missing.append(f"{processor}: no instructions are counted: {one.missing}")
        self.measured = TargetMeasurement(count, tuple(found), error, tuple(missing))
        self._write()
        return self.measured

    @property
    def report(self) -> str:
        """Memory, what each tick touches, and what was measured, as text."""
        return "\n".join(report_lines(self._spec, self._text, self.measured)) + "\n"


def write_c(
    spec: TargetSpec | LoopSpec, folder: Path, *, number: Number = "double", own_functions: bool = False
) -> TargetCode:
    """Write C for a target to a folder: ticks alone, or with the loop of runs inside, in double precision.

    ``own_functions``: see `write_target`.
    Raises `DiskError` if it can't be written.
    """
    if isinstance(spec, LoopSpec):
        text = write_loop_target(spec, own_functions=own_functions)
    else:
        text = write_target(spec, number=number, own_functions=own_functions)
    code = TargetCode(spec, text, folder, own_functions)
    code._write()
    return code


# --- report -----------------------------------------------------------------------------------------------------------


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
