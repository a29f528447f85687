"""The structure of a diagram: every block with its path, every input with its source.

`Collector` makes it from the calls that close a diagram. It tells blocks apart by identity. Wires lead from block to
block, across the borders of subsystems.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from fractions import Fraction

from ...blocks.core import (
    Block,
    Call,
    DoubleDriveError,
    DuplicateNameError,
    Signal,
    UnwiredInputError,
    Wireable,
    WiringError,
    explain_calls,
)
from .subsystems import SubsystemCall, SubsystemInput


@explain_calls
@dataclass(frozen=True)
class SubsystemSettings:
    """Settings of a subsystem, or of the diagram itself (path "").

    Attributes
    ----------
    sample_time : Fraction or None
        Its own sample time in s; None where that of its surroundings holds.
    method : str or None
        Discretization of continuous blocks in it; None: as in its surroundings, see `Structure.method`.
    offset : Fraction
        Time of its first tick in s, where it has a sample time.
    delay : int
        Computational delay of its outputs in samples.
    control : str
        "enabled" or "triggered" for a subsystem that acts on a condition, else "".
    when : str
        For an enabled subsystem "held" or "reset": its states when it is enabled again. For a triggered one the edge:
        "rising", "falling" or "both".
    """

    path: str
    sample_time: Fraction | None
    method: str | None
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    offset: Fraction = Fraction(0)
    delay: int = 0
    control: str = ""
    when: str = ""


@explain_calls
@dataclass(frozen=True)
class Wire:
    """The source end of a wire: an output port, or a part of it."""

    block: str
    port: str
    index: int | slice | None = None

    def __str__(self) -> str:
        return f"{self.block}.{self.port}{self.part}"

    @property
    def part(self) -> str:
        """The part of the port as text, "" for the whole: entries are counted from 1, up to and including the last."""
        if isinstance(self.index, slice):
            start, stop = self.index.start or 0, self.index.stop
            return f"[{start + (start >= 0)}:{'' if stop is None else stop if stop >= 0 else stop - 1}]"
        return "" if self.index is None else f"[{self.index + (self.index >= 0)}]"


@dataclass
class Structure:
    """Blocks, subsystems and wires of a diagram, by path.

    Attributes
    ----------
    blocks : dict
        Every block by its path.
    subsystem_of : dict
        Path of the subsystem that a block stands in, by the block's path.
    subsystems : dict
        Settings of every subsystem by its path, the diagram's own under "".
    wires : dict
        The source of every wired input, by (block path, input).
    names : dict
        The source of every named wire.
    controls : dict
        The source of the signal that enables or triggers a subsystem, by the subsystem's path.
    handed : dict
        For an input, by (block path, input): the subsystems, each with its output, that only pass its signal through.
    results : dict
        The source of every output of a subsystem, by (the subsystem's path, output).
    """

    blocks: dict[str, Block] = field(default_factory=dict)
    subsystem_of: dict[str, str] = field(default_factory=dict)
    subsystems: dict[str, SubsystemSettings] = field(default_factory=dict)
    wires: dict[tuple[str, str], Wire] = field(default_factory=dict)
    names: dict[str, Wire] = field(default_factory=dict)
    controls: dict[str, Wire] = field(default_factory=dict)
    handed: dict[tuple[str, str], tuple[tuple[str, str], ...]] = field(default_factory=dict)
    results: dict[tuple[str, str], Wire] = field(default_factory=dict)

    def copy(self) -> Structure:
        """Return a structure with dictionaries of its own."""
        return Structure(*(dict(getattr(self, f.name)) for f in fields(self)))

    def with_blocks(self, blocks: Mapping[str, Block]) -> Structure:
        """Return a structure with other blocks in some places; it shares all dictionaries but that of the blocks."""
        found = copy.copy(self)
        found.__dict__["blocks"] = {**self.blocks, **blocks}
        return found

    def clock(self, subsystem: str) -> SubsystemSettings | None:
        """Return the subsystem whose sample time holds in one: itself, or the nearest around it; None without any."""
        while subsystem and self.subsystems[subsystem].sample_time is None:
            subsystem = subsystem.rpartition(".")[0]
        found = self.subsystems[subsystem]
        return None if found.sample_time is None else found

    def method(self, subsystem: str) -> str:
        """Return the discretization of continuous blocks in a subsystem: its own, or that of the nearest around it."""
        while subsystem and self.subsystems[subsystem].method is None:
            subsystem = subsystem.rpartition(".")[0]
        return self.subsystems[subsystem].method or "exact"

    def rate(self, subsystem: str) -> Fraction | None:
        """Return the sample time that holds in a subsystem, None where it is continuous."""
        found = self.clock(subsystem)
        return None if found is None else found.sample_time

    def subsystems_around(self, subsystem: str) -> list[SubsystemSettings]:
        """Return a subsystem and all those around it, from outside in; the diagram itself is none."""
        parts = subsystem.split(".") if subsystem else []
        return [self.subsystems[".".join(parts[: i + 1])] for i in range(len(parts))]

    def gates(self, subsystem: str) -> tuple[str, ...]:
        """Return the paths of the enabled and triggered subsystems around a block in ``subsystem``, from outside in."""
        return tuple(f.path for f in self.subsystems_around(subsystem) if f.control)

    def triggered_around(self, subsystem: str) -> str | None:
        """Return the path of the innermost triggered subsystem around a block in ``subsystem``; None without any."""
        return next((f.path for f in reversed(self.subsystems_around(subsystem)) if f.control == "triggered"), None)

    def is_event(self, path: str) -> bool:
        """Whether a subsystem is enabled or triggered in continuous time, by an event, and not at ticks."""
        return path in self.controls and self.rate(path) is None and not self.is_sampled(path.rpartition(".")[0])

    def is_traced(self, path: str) -> bool:
        """Whether a run evaluates a block's equations: a stepped block and a continuous transport delay have none."""
        block = self.blocks[path]
        return not block.stepped and (not block.transport or self.is_sampled(self.subsystem_of[path]))

    def is_sampled(self, subsystem: str) -> bool:
        """Whether blocks in a subsystem act at instants only: at ticks, or when it is triggered."""
        return self.rate(subsystem) is not None or self.triggered_around(subsystem) is not None


def stepped_blocks(table: Structure, inside: str = "") -> dict[str, Block]:
    """Return the blocks that a run steps from outside, such as FMUs, by path in alphabetical order.

    Parameters
    ----------
    table : Structure
        The diagram's structure.
    inside : str
        Path of a block or a subsystem, to which the search is limited; the whole diagram without it.
    """
    paths = [p for p, b in table.blocks.items() if b.stepped and (not inside or f"{p}.".startswith(f"{inside}."))]
    return {path: table.blocks[path] for path in sorted(paths)}


@dataclass(frozen=True, eq=False)
class _Inside:
    """The inside of a subsystem, as the place where its results are used."""

    call: SubsystemCall


class _Root:
    """The diagram itself, as the place where its roots are used."""


_Consumer = Call | SubsystemCall | _Inside | _Root | None
"""User of a signal: a call, a subsystem, or a place; None for a reference that says nothing about the place."""


def join(subsystem: str, name: str) -> str:
    """Return the dotted path of ``name`` in a subsystem."""
    return f"{subsystem}.{name}" if subsystem else name


class Collector:
    """Walks from the roots against the wires, then gives every block its path."""

    def __init__(self, roots: Iterable[object]):
        self.calls: dict[int, Call] = {}  # block identity → its call
        self.blocks: dict[int, Block] = {}  # every block met, in order
        self.subsystems: dict[int, SubsystemCall] = {}
        self.named: list[tuple[str, Signal, _Consumer]] = []  # wire name, signal, consumer
        self.consumers: dict[int, list[_Consumer]] = {}
        self.seen: set[int] = set()
        self.stack: list[tuple[Wireable, _Consumer]] = []
        for root in roots:
            if not isinstance(root, Wireable):
                raise WiringError(f"found {root!r}; expected calls of blocks or subsystems, such as plant(force=u).")
            self._follow(root, _Root())
            while self.stack:
                self._follow(*self.stack.pop())

    def _follow(self, item: Wireable, consumer: _Consumer) -> None:
        if isinstance(item, Signal):
            if item.wire:
                self.named.append((item.wire, item, consumer))
            source = item.source
            if isinstance(source, SubsystemInput):
                self._follow(source.call, None)
            elif isinstance(source, SubsystemCall):
                self._follow(source, None)
            elif isinstance(item.call, Call):
                self._follow(item.call, consumer)
            elif isinstance(source, Block):
                self._add_block(source, consumer)
        elif isinstance(item, Call) and isinstance(item.block, Block):  # always: signals know blocks by a protocol
            self._add_block(item.block, consumer)
            known = self.calls.setdefault(id(item.block), item.origin)
            if known is not item.origin:
                raise DoubleDriveError(
                    "this block is called twice in one diagram, so its inputs would be driven twice. Make a second "
                    f"block: {item.block.label}.replace().",
                    block=item.block.label,
                )
            for port, name in zip(item.primary, item.names, strict=False):
                if name:
                    self.named.append((name, Signal(item.block, port, None, name, item), item.origin))
            if id(item.origin) not in self.seen:
                self.seen.add(id(item.origin))
                self.stack.extend((s, item.origin) for s in reversed(list(item.wires.values())))
        elif isinstance(item, SubsystemCall):
            if id(item) not in self.seen:
                self.seen.add(id(item))
                self.subsystems[id(item)] = item
                self.stack.extend((s, _Inside(item)) for s in reversed(list(item.results.values())))
                self.stack.extend((c, None) for c in reversed(item.calls))
                self.stack.extend((s, item) for s in reversed(list(item.wires.values())))
        elif isinstance(item, Block):
            self._add_block(item, consumer)

    def _add_block(self, block: Block, consumer: _Consumer) -> None:
        self.blocks.setdefault(id(block), block)
        self.consumers.setdefault(id(block), []).append(consumer)

    def structure(self) -> Structure:
        """Return the structure."""
        table = Structure(subsystems={"": SubsystemSettings("", None, "exact")})
        around = {id(c): outer for outer in self.subsystems.values() for c in outer.calls}
        subsystem_paths: dict[int, str] = {}
        taken: set[str] = set()

        def place(subsystem: str, given: str | None, label: str) -> str:
            path = join(subsystem, given or label)
            if given and path in taken:
                raise DuplicateNameError(
                    f"two blocks or subsystems are called {given!r} here. Rename one with name=… or .replace(name=…).",
                    block=path,
                )
            count = 2
            while path in taken or (not given and path in fixed):
                path, count = join(subsystem, f"{label}_{count}"), count + 1
            taken.add(path)
            return path

        fixed: set[str] = set()

        def subsystem_path(call: SubsystemCall) -> str:
            if id(call) not in subsystem_paths:
                outer = around.get(id(call))
                subsystem = "" if outer is None else subsystem_path(outer)
                subsystem_paths[id(call)] = place(subsystem, call.label, call.label)
            return subsystem_paths[id(call)]

        def place_of(consumer: _Consumer) -> str | None:
            if consumer is None:
                return None
            if isinstance(consumer, _Root):
                return ""
            if isinstance(consumer, _Inside):
                return subsystem_path(consumer.call)
            outer = around.get(id(consumer))
            return "" if outer is None else subsystem_path(outer)

        for inner in sorted(self.subsystems.values(), key=lambda s: (subsystem_path(s).count("."), subsystem_path(s))):
            path, made = subsystem_path(inner), inner.subsystem
            table.subsystems[path] = SubsystemSettings(
                path,
                made.sample_time,
                made.method,
                tuple(inner.wires),
                tuple(inner.outputs),
                made.offset,
                made.delay,
                made.control,
                made.when,
            )
        # the place of every block, then the given names, then the numbered ones
        subsystems: dict[int, str] = {}
        for key, block in self.blocks.items():
            call = self.calls.get(key)
            if call is not None:
                subsystems[key] = place_of(call) or ""
            else:
                if any(port.default is None for port in block.inputs.values()):
                    needed = [n for n, port in block.inputs.items() if port.default is None]
                    raise UnwiredInputError(
                        f"an output of this block is used, but the block is never called, so nothing is wired to "
                        f"{', '.join(map(repr, needed))}. Call it, and give the call (or one that it drives) to the "
                        f"Diagram.",
                        block=block.label,
                        port=needed[0],
                    )
                users = [place_of(c) for c in self.consumers[key]]
                subsystems[key] = _common_subsystem([u for u in users if u is not None])
            if block.name:
                fixed.add(join(subsystems[key], block.name))
        paths: dict[int, str] = {}
        for given in (True, False):
            for key, block in self.blocks.items():
                if bool(block.name) is given:
                    paths[key] = place(subsystems[key], block.name, block.label)
        for key, block in self.blocks.items():
            table.blocks[paths[key]] = block
            table.subsystem_of[paths[key]] = subsystems[key]
        for key, call in self.calls.items():
            for port, signal in call.wires.items():
                crossed: list[tuple[SubsystemCall, str]] = []
                wire = table.wires[paths[key], port] = _resolve(signal, paths, crossed)
                maker = f"{table.subsystem_of[wire.block]}."
                outputs = [(subsystem_path(passing), output) for passing, output in crossed]
                handed = tuple((path_, output) for path_, output in outputs if not maker.startswith(f"{path_}."))
                if handed:
                    table.handed[paths[key], port] = handed
        for inner in self.subsystems.values():
            if inner.subsystem.control:
                table.controls[subsystem_path(inner)] = _resolve(inner.wires[inner.subsystem.control_input], paths)
            for output, result in inner.results.items():
                table.results[subsystem_path(inner), output] = _resolve(result, paths)
        for name, signal, consumer in self.named:
            wire = _resolve(signal, paths)
            subsystem = place_of(consumer)
            subsystem = table.subsystem_of[wire.block] if subsystem is None else subsystem
            if table.names.setdefault(join(subsystem, name), wire) != wire:
                raise DuplicateNameError(
                    f"two wires are called {name!r} here: {table.names[join(subsystem, name)]} and {wire}. Rename one.",
                    block=subsystem or None,
                    port=name,
                )
        return table


def _common_subsystem(subsystems: list[str]) -> str:
    """Return the innermost subsystem that holds all the given ones."""
    if not subsystems:
        return ""
    parts = [f.split(".") if f else [] for f in subsystems]
    common: list[str] = []
    for level in zip(*parts, strict=False):
        if len(set(level)) > 1:
            break
        common.append(level[0])
    return ".".join(common)


def _resolve(signal: Signal, paths: dict[int, str], crossed: list[tuple[SubsystemCall, str]] | None = None) -> Wire:
    """Follow a signal across borders to its block; ``crossed`` collects the outputs of subsystems on the way."""
    index = signal.index
    while True:
        if isinstance(signal.source, SubsystemInput):
            inner = signal.source.call.wires[signal.source.port]
        elif isinstance(signal.source, SubsystemCall):
            inner = signal.source.results[signal.port]
            if crossed is not None:
                crossed.append((signal.source, signal.port))
        else:
            return Wire(paths[id(signal.source)], signal.port, index)
        if index is not None and inner.index is not None:
            message = "a part of a part of a signal is taken across a subsystem's border; index it once."
            raise WiringError(message, port=signal.port)
        index = inner.index if index is None else index
        signal = inner
