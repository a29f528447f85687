"""A sampled diagram as C for a target: its ticks, traced with the names of blocks; what can't be on a target."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import DefinitionError, OptionError, accepts, kinds
from ...fmus.export import (
    BlockOutput,
    Kept,
    LoopSpec,
    Number,
    TargetCode,
    TargetNumbers,
    TargetSpec,
    TargetTick,
    Variable,
    check_ascii,
    split_lookups,
    unit_name,
    write_c,
)
from ..flat import FlatDiagram, TickPattern, bits_of, kinds_of, share_terms, speed_up, trace_guarded_tick
from ..wiring import join
from .loop_of_diagram import loop_spec
from .make_exported import open_model
from .obstacles import find_continuous, refuse, refuse_between_ticks, refuse_fmus
from .open_diagram import OpenDiagram
from .traced_functions import trace_computed_numbers

_LARGEST = 20_000
"""Operations of a tick that are written as text; a compiler takes long for more."""


@accepts(
    folder=kinds.path,
    name=kinds.text.or_none(),
    subsystem=kinds.text.or_none(),
    outside=kinds.names,
    outputs=kinds.names.or_none(),
    number=kinds.choice("double", "float"),
    own_functions=kinds.flag,
)
def to_c(
    model: object,
    folder: str | os.PathLike[str],
    *,
    name: str | None = None,
    subsystem: str | None = None,
    outside: Iterable[str] = (),
    outputs: Iterable[str] | None = None,
    number: Number = "double",
    own_functions: bool = False,
) -> TargetCode:
    """Write a diagram or a subsystem as C for a target: one header and one source, an example, a report.

    Standard C99 without allocation: an instance is one struct that the caller owns. In double precision its numbers are
    those of a run, bit by bit. Where something happens between ticks, or an algebraic loop is solved, the loop of runs
    is inside, in double precision alone; the numbers are those of a run with ``solver="rk4"``. No compiler is needed.

    Parameters
    ----------
    model : Diagram or subsystem
        A diagram, or a function with ``@subsystem``, whose arguments become inputs.
    folder : path
        Folder of the files ``NAME.h``, ``NAME.c``, ``NAME_example.c`` and ``NAME_report.txt``.
    name : str, optional
        Begin of the names of files, functions and types: a C identifier. Without it, that of the subsystem or diagram.
    subsystem : str, optional
        Path of a subsystem of the diagram that is written alone: what it reads are inputs.
    outside : iterable of str
        Paths of blocks of the diagram that are not written, such as the plant: what they put out are inputs, what they
        read are outputs.
    outputs : iterable of str, optional
        Named wires, or outputs of blocks by their paths, that are the outputs.
    number : {"double", "float"}
        Type of all numbers.
    own_functions : bool
        Take sine, cosine, tangent hyperbolic, exponential, exp(x) - 1, logarithm and power from Loopwright, with the
        same bits on every platform, and not from ``math.h``.

    Returns
    -------
    TargetCode
        The files; its ``measure`` compiles them for Cortex-M and counts instructions, of sampled diagrams.

    Raises
    ------
    DefinitionError
        For what can't be on a target, by its path; then nothing is written.
    OptionError
        For options that don't fit together.
    UnknownNameError
        If there is no such subsystem, block or signal.
    SimulationError
        If the diagram's start isn't found.
    DiskError
        If the files can't be written.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> from loopwright import subsystem, to_c
    >>> from loopwright.blocks import PID
    >>> @subsystem(sample_time=0.01)
    ... def controller(reference, level):
    ...     return PID(kp=2.0, ki=3.0)(reference, level).named("effort")
    >>> code = to_c(controller, mkdtemp())
    >>> [file.name for file in code.files]
    ['controller.h', 'controller.c', 'controller_example.c', 'controller_report.txt']
    >>> code.bytes_of["struct"]
    64
    """
    if name is not None and name != unit_name(name):
        raise OptionError(
            f"found {name!r}; expected a C identifier, such as {unit_name(name)!r}. C's own headers have names, too.",
            block="to_c",
            port="name",
        )
    found = open_model(model, name=name, subsystem=subsystem, outside=outside, outputs=outputs)
    if found is None:
        raise OptionError(f"found {model!r}; expected a diagram, or a function with @subsystem.", block="to_c")
    label, opened, about = found
    if number == "double" and opened.wired.has_clock and _needs_loop(opened):
        base = float(opened.wired.flatten().base)
        loop = loop_spec(opened, name=unit_name(label), description=about, solver="rk4", step_size=base)
        _check_names(loop)
        return write_c(loop, Path(folder).expanduser(), own_functions=own_functions)
    spec = target_spec(opened, name=unit_name(label), description=about)
    return write_c(spec, Path(folder).expanduser(), number=number, own_functions=own_functions)


def target_spec(opened: OpenDiagram, *, name: str, description: str) -> TargetSpec:
    """Return a diagram as C for a target is made of it.

    Raises `DefinitionError`: for what can't be on a target, by its path.
    Raises `SimulationError` if its start isn't found.
    """
    refuse(opened)
    refuse_fmus(opened)
    if not opened.wired.has_clock:
        continuous = find_continuous(opened)
        raise DefinitionError(
            "found no sample time, at which a target calls tick. Give one: @subsystem(sample_time=1e-3) of the "
            "controller, or diagram.sampled(1e-3) of all.",
            block=continuous[0] if continuous else opened.wired.name,
        )
    flat = opened.wired.flatten()
    refuse_between_ticks(opened, flat)
    loop = loop_spec(opened, name=name, description=description)
    _check_names(loop)
    acting = kinds_of(flat, every=loop.hybrid)  # what is in continuous time is computed at each tick
    numbers, fixed = _trace_numbers(opened, flat)
    start = {f.name: np.asarray(f.start) for f in loop.memory.fields if f.name in ("x", "w", "p", "log")}
    return TargetSpec(
        loop=loop,
        ticks=tuple(_trace_tick(opened, flat, clocks, name) for clocks in acting),
        kept=tuple(_kept(opened, flat, start["x"])),
        start=start,
        acting=tuple(_acting(opened, flat, clock) for clock in flat.distinct),
        numbers=numbers,
        fixed=fixed,
    )


def _trace_numbers(
    opened: OpenDiagram, flat: FlatDiagram
) -> tuple[tuple[TargetNumbers, ...], tuple[tuple[int, int], ...]]:
    """Return the numbers that are computed from parameters, and the parameters of which none can be on a target."""
    found, fixed = [], []
    for path, (one, function) in trace_computed_numbers(flat).items():
        expanded = None if function is None else _expand(function)
        if expanded is None or not expanded.is_a("SXFunction") or expanded.n_instructions() > _LARGEST:
            fixed.append((one.first, one.first + one.parameters))
        else:
            numbers = share_terms(expanded)
            found.append(TargetNumbers(opened.shown(path), one.first, one.parameters, one.count, numbers))
    return tuple(found), tuple(fixed)


def _check_names(loop: LoopSpec) -> None:
    for placed in (loop.inputs, loop.outputs, loop.signals, loop.parameters, loop.states):
        check_ascii(one.variable.name for one in placed)


def _needs_loop(opened: OpenDiagram) -> bool:
    """Return whether anything happens between ticks, or is solved by iterations: then the loop of runs is inside."""
    refuse(opened)
    refuse_fmus(opened)
    flat = opened.wired.flatten()
    return bool(find_continuous(opened) or flat.events or flat.loops.slices)


def _trace_tick(opened: OpenDiagram, flat: FlatDiagram, clocks: frozenset[TickPattern], name: str) -> TargetTick:
    made = trace_guarded_tick(flat, flat.blocks, clocks)
    try:
        function, lookups = split_lookups(made.function, _expand)
    except DefinitionError as error:
        raise error.at(block=name) from None
    if (count := function.n_instructions()) > _LARGEST:
        raise DefinitionError(
            f"a tick of it has {count} operations; at most {_LARGEST} are written for a target. Split it into parts.",
            block=name,
        )
    table = flat.table
    outputs = []
    for path, names in flat.order.steps:
        if path == opened.outside or path not in made.evaluated:
            continue
        for port in names:
            where = flat.log.slices.get(join(path, port))
            if where is not None:
                kind = type(table.blocks[path]).__name__
                outputs.append(BlockOutput(opened.shown(path), port, kind, where.start, where.stop - where.start))
    guards = tuple((opened.shown(path), guard) for path, guard in made.guards)
    return TargetTick(bits_of(flat, clocks), share_terms(function), lookups, tuple(outputs), guards)


def _expand(function: Any) -> Any:
    """Return a function as scalar operations where it has no others: simplified as a run's is."""
    found = speed_up(function)
    if found.is_a("SXFunction"):
        return found
    try:
        return function.expand()  # with large products of matrices, which runs leave as they are
    except RuntimeError:
        return function


def _kept(opened: OpenDiagram, flat: FlatDiagram, x: np.ndarray) -> list[Kept]:
    found = []
    for path, own in flat.states.of_block.items():
        block = flat.table.blocks[path]
        for state, where in own.slices.items():
            port, shape = block.states[state], own.shapes[state]
            unit = port.unit if isinstance(port.unit, str) else None
            label = join(opened.shown(path), state)
            about: Any = {"unit": unit, "description": port.description}
            found.append((where.start, label, shape, about))
    for layout, kind in ((flat.held, "held"), (flat.gates, "gate"), (flat.starts, "start")):
        for full, where in layout.slices.items():
            about = {"description": _DESCRIPTIONS[kind]}
            found.append((where.start, f"{kind}.{opened.shown(full)}", layout.shapes[full], about))
    kept = []
    for first, label, shape, about in sorted(found, key=lambda one: one[0]):
        count = int(np.prod(shape)) if shape else 1
        values = x[first : first + count].reshape(shape)
        variable = Variable("state", "local", "discrete", shape, start=values, state=True, **about)
        object.__setattr__(variable, "name", label)
        kept.append(Kept(variable, first))
    return kept


_DESCRIPTIONS = {
    "held": "output that is held until the subsystem acts again",
    "gate": "value of the control that the subsystem remembers",
    "start": "start value of a state that is reset",
}


def _acting(opened: OpenDiagram, flat: FlatDiagram, clock: TickPattern) -> tuple[str, ...]:
    return tuple(opened.shown(path) for path, own in flat.clocks.items() if own == clock)
