"""From calls to a table: every block with its path, every input with its source.

A diagram distinguishes blocks by identity. Subsystem borders are dissolved here: wires go from block to block.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, cast

from ...blocks.core.block import Block
from ...blocks.core.errors import DoubleDriveError, DuplicateNameError, UnwiredInputError, WiringError
from ...blocks.core.signals import Call, Signal, Wireable
from .subsystem import FrameInput, SubsystemCall


@dataclass(frozen=True)
class Frame:
    """A box: the diagram itself (path "") or a subsystem.

    Attributes
    ----------
    sample_time : Fraction or None
        Its own, in s; None where it has the rate of what surrounds it.
    method : str or None
        How continuous blocks in it are discretized; None: as in what surrounds it, see `Structure.method`.
    offset : Fraction
        Time of its first tick in s, of a box with a sample time.
    delay : int
        Computational delay of its outputs in samples.
    control : str
        "enabled" or "triggered" for a box that acts on a condition, else "".
    when : str
        "held" or "reset" for an enabled box: what its states do when it is enabled again. For a triggered box the edge:
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


@dataclass(frozen=True)
class Wire:
    """The source end of a wire: an output port, or a part of it."""

    block: str
    port: str
    index: int | slice | None = None

    def __str__(self) -> str:
        if isinstance(self.index, slice):
            return f"{self.block}.{self.port}[{self.index.start or ''}:{self.index.stop or ''}]"
        return f"{self.block}.{self.port}" + ("" if self.index is None else f"[{self.index}]")


@dataclass
class Structure:
    """The table of a diagram."""

    blocks: dict[str, Block] = field(default_factory=dict)
    frame_of: dict[str, str] = field(default_factory=dict)
    frames: dict[str, Frame] = field(default_factory=dict)
    wires: dict[tuple[str, str], Wire] = field(default_factory=dict)
    names: dict[str, Wire] = field(default_factory=dict)
    controls: dict[str, Wire] = field(default_factory=dict)
    """The source of what enables or triggers a subsystem, by the subsystem's path."""
    handed: dict[tuple[str, str], tuple[tuple[str, str], ...]] = field(default_factory=dict)
    """For an input: the boxes, with their outputs, that its signal comes out of though nothing in them makes it."""

    def clock(self, frame: str) -> Frame | None:
        """Return the frame whose sample time holds in a frame: itself, or the nearest one around it."""
        while frame and self.frames[frame].sample_time is None:
            frame = frame.rpartition(".")[0]
        found = self.frames[frame]
        return None if found.sample_time is None else found

    def method(self, frame: str) -> str:
        """Return how continuous blocks in a frame are discretized: by its own method, or the nearest one around it."""
        while frame and self.frames[frame].method is None:
            frame = frame.rpartition(".")[0]
        return self.frames[frame].method or "exact"

    def rate(self, frame: str) -> Fraction | None:
        """Return the sample time that holds in a frame, None where it is continuous."""
        found = self.clock(frame)
        return None if found is None else found.sample_time

    def subsystems_around(self, frame: str) -> list[Frame]:
        """Return the frames around a block in ``frame``, from the outermost one that is not the diagram to it."""
        parts = frame.split(".") if frame else []
        return [self.frames[".".join(parts[: i + 1])] for i in range(len(parts))]

    def gates(self, frame: str) -> tuple[str, ...]:
        """Return the enabled and triggered boxes around a block in ``frame``, from outside in."""
        return tuple(f.path for f in self.subsystems_around(frame) if f.control)

    def triggered_around(self, frame: str) -> str | None:
        """Return the innermost triggered box around a block in ``frame``."""
        return next((f.path for f in reversed(self.subsystems_around(frame)) if f.control == "triggered"), None)

    def is_event(self, box: str) -> bool:
        """Whether a box is enabled or triggered in continuous time, by an event, and not at ticks."""
        return box in self.controls and self.rate(box) is None and not self.is_sampled(box.rpartition(".")[0])

    def is_traced(self, path: str) -> bool:
        """Whether a run evaluates a block's equations: it is not stepped, and no transport delay in continuous time."""
        block = self.blocks[path]
        return not block.stepped and (not block.transport or self.is_sampled(self.frame_of[path]))

    def is_sampled(self, frame: str) -> bool:
        """Whether blocks in a frame act at instants only: ticks, or those of a trigger."""
        return self.rate(frame) is not None or self.triggered_around(frame) is not None


def stepped_blocks(table: Structure, inside: str = "") -> dict[str, Block]:
    """Return the blocks that a run steps from outside, such as FMUs, by path in alphabetical order.

    Parameters
    ----------
    table : Structure
        The diagram's table.
    inside : str
        Path of a block or a subsystem: only what it is, or holds; all without it.
    """
    paths = [p for p, b in table.blocks.items() if b.stepped and (not inside or f"{p}.".startswith(f"{inside}."))]
    return {path: table.blocks[path] for path in sorted(paths)}


@dataclass(frozen=True, eq=False)
class _Inside:
    """The inside of a box, as the place where what it returns is used."""

    box: SubsystemCall


_ROOT: Any = object()  # the diagram itself, as the place where its roots are used


def join(frame: str, name: str) -> str:
    """Return the dotted path of ``name`` in a frame."""
    return f"{frame}.{name}" if frame else name


class Collector:
    """Walks from the roots against the wires, then gives every block its path."""

    def __init__(self, roots: Iterable[Any]):
        self.calls: dict[int, Call] = {}  # block identity → its call
        self.blocks: dict[int, Block] = {}  # every block met, in order
        self.boxes: dict[int, SubsystemCall] = {}
        self.named: list[tuple[str, Signal, Any]] = []  # wire name, signal, consumer (a call, a box, or None)
        self.consumers: dict[int, list[Any]] = {}
        self.seen: set[int] = set()
        self.stack: list[Any] = []
        for root in roots:
            if not isinstance(root, Wireable):
                raise WiringError(f"found {root!r}; expected calls of blocks or subsystems, such as plant(force=u).")
            self._follow(root._signal() if isinstance(root, Signal) else root, _ROOT)
            while self.stack:
                self._follow(*self.stack.pop())

    def _follow(self, item: Any, consumer: Any) -> None:
        if isinstance(item, Signal):
            if item.wire:
                self.named.append((item.wire, item, consumer))
            source = item.source
            if isinstance(source, FrameInput):
                self._follow(source.frame, None)
            elif isinstance(source, SubsystemCall):
                self._follow(source, None)
            elif isinstance(item.call, Call):
                self._follow(item.call, consumer)
            else:
                self._add_block(source, consumer)
        elif isinstance(item, Call):
            self._add_block(cast(Block, item.block), consumer)  # signals know blocks by their face only
            known = self.calls.setdefault(id(item.block), item.origin)
            if known is not item.origin:
                raise DoubleDriveError(
                    "this block is called twice in one diagram, so its inputs would be driven twice. Make a second "
                    "block: "
                    f"{item.block.label}.replace().",
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
                self.boxes[id(item)] = item
                self.stack.extend((s, _Inside(item)) for s in reversed(list(item.results.values())))
                self.stack.extend((c, None) for c in reversed(item.calls))
                self.stack.extend((s, item) for s in reversed(list(item.wires.values())))
        else:
            self._add_block(item, consumer)

    def _add_block(self, block: Block, consumer: Any) -> None:
        self.blocks.setdefault(id(block), block)
        self.consumers.setdefault(id(block), []).append(consumer)

    def structure(self) -> Structure:
        """Return the table."""
        table = Structure(frames={"": Frame("", None, "exact")})
        inner = {id(c): box for box in self.boxes.values() for c in box.calls}
        path_of_box: dict[int, str] = {}
        taken: dict[str, Any] = {}

        def place(frame: str, given: str | None, label: str) -> str:
            path = join(frame, given or label)
            if given and path in taken:
                raise DuplicateNameError(
                    f"two blocks or subsystems are called {given!r} here. Rename one with name=… or .replace(name=…).",
                    block=path,
                )
            count = 2
            while path in taken or (not given and path in fixed):
                path, count = join(frame, f"{label}_{count}"), count + 1
            taken[path] = True
            return path

        fixed: set[str] = set()

        def subsystem_path(box: SubsystemCall) -> str:
            if id(box) not in path_of_box:
                outer = inner.get(id(box))
                frame = "" if outer is None else subsystem_path(outer)
                path_of_box[id(box)] = place(frame, box.label, box.label)
            return path_of_box[id(box)]

        def subsystem_of_item(item: Any) -> str | None:
            if item is None:
                return None
            if item is _ROOT:
                return ""
            if isinstance(item, _Inside):
                return subsystem_path(item.box)
            outer = inner.get(id(item))
            return "" if outer is None else subsystem_path(outer)

        for box in sorted(self.boxes.values(), key=lambda b: (subsystem_path(b).count("."), subsystem_path(b))):
            path, made = subsystem_path(box), box.subsystem
            table.frames[path] = Frame(
                path,
                made.sample_time,
                made.method,
                tuple(box.wires),
                tuple(box.outputs),
                made.offset,
                made.delay,
                made.control,
                made.when,
            )
        # frames of all blocks, then the given names, then the numbered ones
        frames: dict[int, str] = {}
        for key, block in self.blocks.items():
            call = self.calls.get(key)
            if call is not None:
                frames[key] = subsystem_of_item(call) or ""
            else:
                if any(port.default is None for port in block.inputs.values()):
                    needed = [n for n, port in block.inputs.items() if port.default is None]
                    raise UnwiredInputError(
                        f"an output of this block is used, but the block is never called, so nothing is wired to "
                        f"{', '.join(map(repr, needed))}. Call it, and give the call (or what it drives) to the "
                        f"Diagram.",
                        block=block.label,
                        port=needed[0],
                    )
                users = [subsystem_of_item(c) for c in self.consumers[key]]
                frames[key] = _common_subsystem([u for u in users if u is not None])
            if block.name:
                fixed.add(join(frames[key], block.name))
        paths: dict[int, str] = {}
        for given in (True, False):
            for key, block in self.blocks.items():
                if bool(block.name) is given:
                    paths[key] = place(frames[key], block.name, block.label)
        for key, block in self.blocks.items():
            table.blocks[paths[key]] = block
            table.frame_of[paths[key]] = frames[key]
        for key, call in self.calls.items():
            for port, signal in call.wires.items():
                crossed: list[tuple[SubsystemCall, str]] = []
                wire = table.wires[paths[key], port] = _resolve(signal, paths, crossed)
                maker = f"{table.frame_of[wire.block]}."
                outputs = [(subsystem_path(box), output) for box, output in crossed]
                handed = tuple((box, output) for box, output in outputs if not maker.startswith(f"{box}."))
                if handed:
                    table.handed[paths[key], port] = handed
        for box in self.boxes.values():
            if box.subsystem.control:
                table.controls[subsystem_path(box)] = _resolve(box.wires[box.subsystem.control_input], paths)
        for name, signal, consumer in self.named:
            wire = _resolve(signal, paths)
            frame = subsystem_of_item(consumer)
            frame = table.frame_of[wire.block] if frame is None else frame
            if table.names.setdefault(join(frame, name), wire) != wire:
                raise DuplicateNameError(
                    f"two wires are called {name!r} here: {table.names[join(frame, name)]} and {wire}. Rename one.",
                    block=frame or None,
                    port=name,
                )
        return table


def _common_subsystem(frames: list[str]) -> str:
    """Return the innermost frame that holds all the given ones."""
    if not frames:
        return ""
    parts = [f.split(".") if f else [] for f in frames]
    common: list[str] = []
    for level in zip(*parts, strict=False):
        if len(set(level)) > 1:
            break
        common.append(level[0])
    return ".".join(common)


def _resolve(signal: Signal, paths: dict[int, str], crossed: list[tuple[SubsystemCall, str]] | None = None) -> Wire:
    """Follow a signal through subsystem borders to its block; ``crossed`` takes the outputs of boxes on the way."""
    index = signal.index
    while True:
        if isinstance(signal.source, FrameInput):
            inner = signal.source.frame.wires[signal.source.port]
        elif isinstance(signal.source, SubsystemCall):
            inner = signal.source.results[signal.port]
            if crossed is not None:
                crossed.append((signal.source, signal.port))
        else:
            return Wire(paths[id(signal.source)], signal.port, index)
        if index is not None and inner.index is not None:
            raise WiringError(
                "a part of a part of a signal is taken across a subsystem's border; index it once.", port=signal.port
            )
        index = inner.index if index is None else index
        signal = inner
