"""The structure of a diagram is collected from the calls that close it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from ...blocks.core import (
    Block,
    Call,
    DoubleDriveError,
    DuplicateNameError,
    Signal,
    UnwiredInputError,
    Wireable,
    WiringError,
    as_block,
    shorten,
)
from .buses import Bus
from .structure import Structure, Wire, join
from .subsystem_settings import SubsystemSettings
from .subsystems import SubsystemCall, SubsystemInput


@dataclass(frozen=True, eq=False)
class _Inside:
    """The inside of a subsystem, as the place where its results are used."""

    call: SubsystemCall


class _Root:
    """The diagram itself, as the place where its roots are used."""


_Consumer = Call | SubsystemCall | _Inside | _Root | None
"""User of a signal: a call, a subsystem, or a place; None for a reference that says nothing about the place."""


class Collector:
    """Walks from the roots against the wires, then gives every block its path."""

    def __init__(self, roots: Iterable[object]):
        # Two blocks are the same node only if they are one object.
        self.calls: dict[int, Call] = {}  # block identity → its call
        self.blocks: dict[int, Block] = {}  # every block met, in order
        self.subsystems: dict[int, SubsystemCall] = {}
        self.named: list[tuple[str, Signal, _Consumer]] = []  # wire name, signal, consumer
        self.consumers: dict[int, list[_Consumer]] = {}
        self.seen: set[int] = set()
        self.stack: list[tuple[Wireable, _Consumer]] = []
        for root in roots:
            if not isinstance(root, Wireable):
                made = as_block(root, "(u)")
                raise WiringError(
                    f"found {shorten(root)}; expected calls of blocks or subsystems. "
                    + (f"{made}." if made else "Give them after the name: Diagram('loop', plant(force=u)).")
                )
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
        elif isinstance(item, Bus):
            self.stack.extend((s, consumer) for s in reversed(list(item.values())))

    def _add_block(self, block: Block, consumer: _Consumer) -> None:
        self.blocks.setdefault(id(block), block)
        self.consumers.setdefault(id(block), []).append(consumer)

    def structure(self) -> Structure:
        """Return the structure."""
        places = _Places(self.subsystems.values())
        table = Structure(subsystems={"": SubsystemSettings("", None, "exact")})
        for inner in sorted(self.subsystems.values(), key=lambda s: (places.path(s).count("."), places.path(s))):
            path = places.path(inner)
            table.subsystems[path] = replace(
                inner.subsystem.settings, path=path, inputs=tuple(inner.wires), outputs=tuple(inner.outputs)
            )
        subsystems = {key: self._find_subsystem(key, places) for key in self.blocks}
        paths = places.place_blocks(self.blocks, subsystems)
        for key, block in self.blocks.items():
            table.blocks[paths[key]] = block
            table.subsystem_of[paths[key]] = subsystems[key]
        self._add_wires(table, places, paths)
        self._add_names(table, places, paths)
        return table

    def _find_subsystem(self, key: int, places: _Places) -> str:
        """Return the path of the subsystem in which a block is: where it is called, else around all its users."""
        block, call = self.blocks[key], self.calls.get(key)
        if call is not None:
            return places.of(call) or ""
        needed = [name for name, port in block.inputs.items() if port.default is None]
        if needed:
            raise UnwiredInputError(
                f"an output of this block is used, but the block is never called, so nothing is wired to "
                f"{', '.join(map(repr, needed))}. Call it, and give the call (or one that it drives) to the Diagram."
                f"{block.advise_unwired(needed)}",
                block=block.label,
                port=needed[0],
            )
        users = (places.of(consumer) for consumer in self.consumers[key])
        return _common_subsystem([user for user in users if user is not None])

    def _add_wires(self, table: Structure, places: _Places, paths: dict[int, str]) -> None:
        """Add the sources of inputs, and those of what controls subsystems and leaves them."""
        for key, call in self.calls.items():
            for port, signal in call.wires.items():
                crossed: list[tuple[SubsystemCall, str]] = []
                wire = table.wires[paths[key], port] = _resolve(signal, paths, crossed)
                maker = f"{table.subsystem_of[wire.block]}."
                outputs = [(places.path(passing), output) for passing, output in crossed]
                handed = tuple((path, output) for path, output in outputs if not maker.startswith(f"{path}."))
                if handed:
                    table.handed[paths[key], port] = handed
        for inner in self.subsystems.values():
            path = places.path(inner)
            if inner.subsystem.control:
                table.controls[path] = _resolve(inner.wires[inner.subsystem.control_input], paths)
            for output, result in inner.results.items():
                table.results[path, output] = _resolve(result, paths)
            for name, signal in inner.wires.items():
                table.arguments[path, name] = _resolve(signal, paths)

    def _add_names(self, table: Structure, places: _Places, paths: dict[int, str]) -> None:
        """Add the sources of named wires; a name belongs to the place where it is used."""
        for name, signal, consumer in self.named:
            wire = _resolve(signal, paths)
            subsystem = places.of(consumer)
            subsystem = table.subsystem_of[wire.block] if subsystem is None else subsystem
            known = table.names.setdefault(join(subsystem, name), wire)
            if known != wire:
                raise DuplicateNameError(
                    f"two wires are called {name!r} here: {known} and {wire}. Rename one.",
                    block=subsystem or None,
                    port=name,
                )


class _Places:
    """Paths of subsystems and blocks: names that are given stay; a label that is taken gets a number."""

    def __init__(self, subsystems: Iterable[SubsystemCall]):
        self._around = {id(call): outer for outer in subsystems for call in outer.calls}
        self._paths: dict[int, str] = {}
        self._taken: set[str] = set()
        self._given: set[str] = set()

    def path(self, call: SubsystemCall) -> str:
        """Return the path of a subsystem."""
        if id(call) not in self._paths:
            self._paths[id(call)] = self._take(self._outside(call), call.label, call.label)
        return self._paths[id(call)]

    def of(self, consumer: _Consumer) -> str | None:
        """Return the path of the subsystem in which a signal is used, "" for the diagram; None if that isn't known."""
        if consumer is None:
            return None
        if isinstance(consumer, _Root):
            return ""
        return self.path(consumer.call) if isinstance(consumer, _Inside) else self._outside(consumer)

    def place_blocks(self, blocks: dict[int, Block], subsystems: dict[int, str]) -> dict[int, str]:
        """Return the paths of blocks in these subsystems, all by identity; given names come first."""
        self._given = {join(subsystems[key], block.name) for key, block in blocks.items() if block.name}
        named, others = ([key for key, block in blocks.items() if bool(block.name) is has] for has in (True, False))
        return {key: self._take(subsystems[key], blocks[key].name, blocks[key].label) for key in (*named, *others)}

    def _outside(self, call: Call | SubsystemCall) -> str:
        outer = self._around.get(id(call))
        return "" if outer is None else self.path(outer)

    def _take(self, subsystem: str, given: str | None, label: str) -> str:
        path = join(subsystem, given or label)
        if given and path in self._taken:
            raise DuplicateNameError(
                f"two blocks or subsystems are called {given!r} here. Rename one with name=… or .replace(name=…).",
                block=path,
            )
        count = 2
        while path in self._taken or (not given and path in self._given):
            path, count = join(subsystem, f"{label}_{count}"), count + 1
        self._taken.add(path)
        return path


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
