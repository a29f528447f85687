"""Diagrams with inputs and outputs: what is exported of a diagram, with everything around it as one block."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...blocks.core import Block, Output, ParameterError, UnknownNameError, near, parameter
from ..flat import FlatDiagram, Target, WiredDiagram, with_movable
from ..simulation import RunOptions, Simulation
from ..wiring import Collector, Structure, Subsystem, Wire, find_path, join, split_entry

_OUTSIDE = "outside"
_STEP = 1e-3  # s, of a diagram without any; its start has none


@dataclass(frozen=True, eq=False)
class OpenDiagram:
    """A diagram with inputs and outputs.

    ``wired``: its blocks and wires; the inputs are outputs of a block that nothing steps.
    ``outside``: path of that block; empty without inputs.
    ``outputs``: the outputs: by name, where their values come from, in the diagram as it was wired.
    ``inside``: path of the subsystem that it is a part of; names are shown from there on.
    ``states``: states of blocks at the start, flat, by path, as the diagram around it finds them.
    ``moved``: parameters, by path, of which zeros are numbers in the functions; see `let_move`.
    """

    wired: WiredDiagram
    outside: str
    outputs: Mapping[str, Wire]
    inside: str = ""
    states: Mapping[str, np.ndarray] = field(default_factory=dict)
    moved: frozenset[str] = frozenset()

    def shown(self, path: str) -> str:
        """Return a path as it is shown."""
        return path.removeprefix(f"{self.inside}.") if self.inside else path

    @property
    def starts(self) -> dict[str, np.ndarray]:
        """Start values of the inputs, flat, by their full names in the diagram."""
        if not self.outside:
            return {}
        block = self.wired.blocks[self.outside]
        assert isinstance(block, Outside)
        return {join(self.outside, name): block.start_of(name) for name in block.outputs}


def open_subsystem(subsystem: Subsystem, facade_class: type[Any], name: str) -> OpenDiagram:
    """Return a subsystem with its arguments as inputs; shapes and units are those that its blocks declare.

    Raises `WiringError, TraceError`: as for a diagram of it.
    """
    names = [p.name for p in subsystem.parameters]
    if subsystem.control_input and subsystem.control_input not in names:
        names.append(subsystem.control_input)
    given = {p.name: p.default for p in subsystem.parameters if _is_number(p.default)}
    guessed = Outside([(n, np.shape(given.get(n, 0.0)), None, "", 0.0) for n in names], name=_OUTSIDE)
    table = _wire(subsystem, guessed, names)
    ports = [_declared(table, n, given.get(n, 0.0)) for n in names]
    table = _wire(subsystem, Outside(ports, name=_OUTSIDE), names)
    path = next(p for p in table.subsystems if p and "." not in p)
    wired = WiredDiagram(name, table, "error", facade_class)
    outputs = {output: wired.scheduled.results[p, output] for p, output in table.results if p == path}
    return OpenDiagram(wired, _OUTSIDE if names else "", _apart(outputs, names, path), path)


def _wire(subsystem: Subsystem, outside: Outside, names: list[str]) -> Structure:
    return Collector([subsystem(**{n: getattr(outside, n) for n in names})]).structure()


def _is_number(value: object) -> bool:
    """Whether the default of an argument is a number, or an array of them."""
    return isinstance(value, int | float | list | tuple | np.ndarray) and np.asarray(value).dtype.kind in "if"


def _declared(table: Structure, name: str, start: Any) -> tuple[str, tuple[int, ...], str | None, str, Any]:
    """Return an input with the shape and the unit that the blocks declare that read it."""
    shape = np.shape(start)
    unit, description = None, ""
    for (path, port), wire in table.wires.items():
        if (wire.block, wire.port) != (_OUTSIDE, name):
            continue
        declared = table.blocks[path].inputs[port]
        if wire.index is None and declared.shape:
            shape = declared.shape
        if wire.index is None and isinstance(declared.unit, str):
            unit = declared.unit
        description = description or declared.description
    return name, shape, unit, description, start


def open_part(wired: WiredDiagram, path: str, name: str) -> OpenDiagram:
    """Return a subsystem of a diagram with whatever it reads from around it as inputs.

    Raises `UnknownNameError` if there is no such subsystem.
    """
    table = wired.structure
    found = find_path(path, {p: p for p in table.subsystems if p}, "subsystem", wired.name)
    inside = {p for p in table.blocks if p.startswith(f"{found}.")}
    start = find_start(wired)
    ports: dict[tuple[str, str, Any], tuple[Any, ...]] = {}
    taken: set[str] = set()

    def enter(wire: Wire) -> Wire:
        if wire.block in inside:
            return wire
        # A port is called as the argument of the subsystem's function, where there is one: the user chose that name.
        argument = next(
            (n for (p, n), w in table.arguments.items() if p == found and w in (wire, replace(wire, index=None))), None
        )
        whole = argument is not None and table.arguments[found, argument].index is None
        index = None if argument is None or whole else wire.index
        key = (wire.block, wire.port, index)
        if key not in ports:
            base = label = argument or f"{wire.block}_{wire.port}".replace(".", "_")
            count = 2
            while label in taken:
                label, count = f"{base}_{count}", count + 1
            taken.add(label)
            shape = wired.checked.shapes[wire.block, wire.port]
            shape = shape if index is None else np.empty(shape)[index].shape
            unit = wired.checked.units.get((wire.block, wire.port))
            unit = unit if index is None or not isinstance(unit, tuple) else unit[index]
            description = table.blocks[wire.block].outputs[wire.port].description
            value = start.signal(wire.block, wire.port)
            ports[key] = (label, shape, unit, description, value if index is None else value[index])
        return Wire(_OUTSIDE, ports[key][0], wire.index if index is None else None)

    # Subsystems around stay, as they say the rate and when the part is enabled; their other blocks go.
    part = table.copy()
    around = [f.path for f in table.subsystems_around(found)]
    part.subsystems = {p: s for p, s in table.subsystems.items() if not p or p in around or p.startswith(f"{found}.")}
    part.blocks = {p: table.blocks[p] for p in table.blocks if p in inside}
    part.subsystem_of = {p: table.subsystem_of[p] for p in part.blocks}
    part.wires = {(p, q): enter(w) for (p, q), w in table.wires.items() if p in inside}
    part.controls = {p: enter(w) for p, w in table.controls.items() if p in part.subsystems}
    part.names = {n: w for n, w in table.names.items() if w.block in inside}
    part.handed = {
        key: tuple(one for one in passed if one[0] in part.subsystems)
        for key, passed in table.handed.items()
        if key[0] in inside
    }
    part.results = {
        key: enter(w) for key, w in table.results.items() if key[0] == found or key[0].startswith(f"{found}.")
    }
    part.arguments = {}
    if ports:
        part.blocks[_OUTSIDE] = Outside(tuple(ports.values()), name=_OUTSIDE)
        part.subsystem_of[_OUTSIDE] = ""
    called = _outer_names(table, found)
    part.names = {n: w for n, w in part.names.items() if n not in called.values()}
    opened = WiredDiagram(name, part, wired.loops, wired.facade_class)
    results = {output: opened.scheduled.results[p, output] for p, output in part.results if p == found}
    outputs = {called[n].rpartition(".")[2] if n in called else n: wire for n, wire in results.items()}
    return OpenDiagram(opened, _OUTSIDE if ports else "", _apart(outputs, taken, found), found, start.states)


def _outer_names(table: Structure, path: str) -> dict[str, str]:
    """Return wires' full names outside of a subsystem for its outputs that have no name of their own inside."""
    outputs = [output for p, output in table.results if p == path]
    found: dict[str, str] = {}
    taken = set(outputs)
    for output in outputs:
        if join(path, output) in table.names:
            continue
        for name, wire in table.names.items():
            last = name.rpartition(".")[2]
            if wire == table.results[path, output] and not name.startswith(f"{path}.") and last not in taken:
                found[output] = name
                taken.add(last)
                break
    return found


def open_whole(wired: WiredDiagram, outside: Sequence[str], name: str) -> OpenDiagram:
    """Return a diagram without some of its blocks, such as the plant or a source, whose place is outside.

    What they put out are its inputs, and what they read its outputs; if they read nothing, the named wires are, and
    without any the outputs of blocks that nothing reads.

    Raises `UnknownNameError` if there is no such block.
    """
    table = wired.structure.copy()
    ports: list[tuple[Any, ...]] = []
    moved: dict[tuple[str, str], str] = {}
    read: dict[str, Wire] = {}
    paths = [find_path(given, table.blocks, "block", wired.name) for given in outside]
    start = find_start(wired) if paths else _DiagramStart.none()

    def label(path: str, port: str, taken: Collection[str], *, alone: bool) -> str:
        """Return the name of a port: its own, or where that is taken with its block's in front."""
        own, full = port.replace(".", "_"), f"{path}_{port}".replace(".", "_")
        return path.replace(".", "_") if alone else own if own not in taken and len(paths) == 1 else full

    # What a removed block gave becomes an input, and what it read becomes an output.
    for path in paths:
        block = table.blocks.pop(path)
        del table.subsystem_of[path]
        for port, declared in block.outputs.items():
            unit = wired.checked.units.get((path, port))
            key = label(path, port, [p[0] for p in ports], alone=len(block.outputs) == 1 and not block.inputs)
            ports.append((key, wired.checked.shapes[path, port], unit, declared.description, start.signal(path, port)))
            moved[path, port] = key
        for port in block.inputs:
            if (wire := table.wires.pop((path, port), None)) is not None:
                read[label(path, port, read, alone=False)] = wire
            table.handed.pop((path, port), None)

    def move(wire: Wire) -> Wire:
        key = moved.get((wire.block, wire.port))
        return wire if key is None else Wire(_OUTSIDE, key, wire.index)

    table.wires = {key: move(wire) for key, wire in table.wires.items()}
    table.controls = {key: move(wire) for key, wire in table.controls.items()}
    table.results = {key: move(wire) for key, wire in table.results.items()}
    table.names = {key: move(wire) for key, wire in table.names.items()}
    table.results |= {("", key): move(wire) for key, wire in read.items()}
    table.arguments = {}
    if ports:
        table.blocks[_OUTSIDE] = Outside(tuple(ports), name=_OUTSIDE)
        table.subsystem_of[_OUTSIDE] = ""
    opened = WiredDiagram(name, table, wired.loops, wired.facade_class)
    scheduled = opened.scheduled
    # Without wires to removed blocks the named wires are the outputs; without those, whatever nothing reads.
    outputs = {key: scheduled.results["", key] for key in read} or dict(scheduled.names)
    outputs = {n: w for n, w in outputs.items() if w.block != _OUTSIDE} or _unread(opened)
    outputs = _apart(outputs, [p[0] for p in ports], "")
    return OpenDiagram(opened, _OUTSIDE if ports else "", outputs, states=start.states)


def start_at(opened: OpenDiagram, start: Mapping[str, Any]) -> OpenDiagram:
    """Return a diagram whose inputs have other start values, by their names.

    Raises `UnknownNameError, ParameterError`: for a name that no input has, and what are no finite numbers of its
    shape.
    """
    if not start:
        return opened
    outside = opened.wired.structure.blocks[opened.outside] if opened.outside else None
    assert outside is None or isinstance(outside, Outside)
    shapes = {} if outside is None else {name: shape for name, shape, *_ in outside.ports}
    for name, value in start.items():
        if name not in shapes:
            near_names = near(name, shapes) if shapes else "It has no inputs."
            raise UnknownNameError(
                f"there is no input {name!r} in it. {near_names}", block=opened.wired.name, port="start"
            )
        try:
            is_sound = bool(np.all(np.isfinite(np.broadcast_to(np.asarray(value, dtype=float), shapes[name]))))
        except (TypeError, ValueError):
            is_sound = False
        if not is_sound:
            raise ParameterError(
                f"found {value!r} for the start of {name!r}; expected finite numbers of shape {shapes[name]}.",
                block=opened.wired.name,
                port="start",
            )
    assert outside is not None
    structure = opened.wired.structure.copy()
    ports = [(name, *rest, start.get(name, value)) for name, *rest, value in outside.ports]
    structure.blocks[opened.outside] = Outside(ports, name=_OUTSIDE)
    wired = opened.wired
    made = WiredDiagram(wired.name, structure, wired.loops, wired.facade_class)
    return replace(opened, wired=made, states={})  # states that begin with inputs are found again


def let_move(opened: OpenDiagram, targets: Sequence[Target]) -> OpenDiagram:
    """Return a diagram in which some parameters can be moved that are zero, and structure else.

    ``targets``: path of a block, and the names that lead to a parameter in it.
    """
    names = {join(path, ".".join([*keys[:-1], split_entry(keys[-1], ())[0]])) for path, keys in targets}
    return replace(opened, wired=with_movable(opened.wired, targets), moved=opened.moved | names)


def _apart(outputs: Mapping[str, Wire], inputs: Collection[str], inside: str) -> dict[str, Wire]:
    """Return outputs of which none has an input's name: such a one is called after its block, too."""
    found: dict[str, Wire] = {}
    taken = {*inputs, *outputs}
    for name, wire in outputs.items():
        label = name
        if name in inputs:
            block = wire.block.removeprefix(f"{inside}.") if inside else wire.block
            base = label = f"{block}_{name}".replace(".", "_")
            count = 2
            while label in taken:
                label, count = f"{base}_{count}", count + 1
            taken.add(label)
        found[label] = wire
    return found


def _unread(opened: WiredDiagram) -> dict[str, Wire]:
    """Return the outputs of blocks that no wire leads from, by their paths."""
    table = opened.scheduled
    read = {(wire.block, wire.port) for wire in (*table.wires.values(), *table.controls.values())}
    ports = [(p, q) for p, q in opened.checked.shapes if p != _OUTSIDE and (p, q) not in read]
    return {join(p, q): Wire(p, q) for p, q in ports}


def choose_outputs(opened: OpenDiagram, outputs: tuple[str, ...] | None) -> OpenDiagram:
    """Return a diagram with some outputs: named wires, or outputs of blocks by their paths, or the ends of these."""
    if outputs is None:
        return opened
    chosen: dict[str, Wire] = {}
    wired = opened.wired
    known = {
        **{opened.shown(join(p, q)): Wire(p, q) for p, q in wired.checked.shapes if p != opened.outside},
        **{opened.shown(n): w for n, w in wired.scheduled.names.items()},
        **opened.outputs,
    }
    for name in outputs:
        chosen[name] = known[find_path(name, known, "signal", wired.name)]
    return replace(opened, outputs=chosen)


class Outside(Block):
    """Whatever is around a diagram that is exported: nothing steps it, its outputs are set from outside."""

    stepped = True
    ports: Any = parameter(kw_only=False, description="inputs of the diagram: name, shape, unit, start value, ...")

    @property
    def outputs(self) -> dict[str, Output]:  # type: ignore[override]
        """The inputs of the diagram."""
        return {
            name: Output(shape=shape, unit=unit, description=description, name=name)
            for name, shape, unit, description, _ in self.ports
        }

    def start_of(self, name: str) -> np.ndarray:
        """Return the start value of an input, flat."""
        shape, start = next((shape, start) for key, shape, _, _, start in self.ports if key == name)
        return np.ravel(np.broadcast_to(np.asarray(start, dtype=float), shape))


@dataclass(frozen=True, eq=False)
class _DiagramStart:
    """Signals and states of a diagram at t = 0."""

    flat: FlatDiagram | None
    log: np.ndarray
    states: Mapping[str, np.ndarray]

    @classmethod
    def none(cls) -> _DiagramStart:
        """Return the start of which nothing is asked."""
        return cls(None, np.zeros(0), {})

    def signal(self, path: str, port: str) -> np.ndarray:
        """Return an output of a block."""
        assert self.flat is not None
        full = join(path, port)
        return np.array(self.log[self.flat.log.slices[full]].reshape(self.flat.log.shapes[full]))


def find_start(wired: WiredDiagram) -> _DiagramStart:
    """Begin a run of a diagram, and return its start.

    Raises `LoopwrightError`: as a run does.
    """
    with Simulation(wired, RunOptions(step=None if wired.has_base else _STEP)) as simulation:
        flat, view = simulation.flat, simulation.view
        log, x = view.log.copy(), view.x.copy()
    # blocks that delays and units have become are other ones in a part, and start from their inputs
    own = {path: x[where] for path, where in flat.states.slices.items() if path in wired.structure.blocks}
    return _DiagramStart(flat, log, own)
