"""Start values of a diagram's further runs: the inputs of blocks that start from them, as traced functions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from operator import is_
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import Block
from ..flat import NONE, FlatDiagram, Instant, bind_function, evaluate, is_true, speed_up
from .block_start_values import find_initial_state, find_start_values, values_from_left
from .workspace import Workspace

Port = tuple[str, str]


class TracedStartValues:
    """Computes what `find_start_values` does, from functions that are traced once."""

    def __init__(self, workspace: Workspace):
        flat = workspace.flat
        self._workspace = workspace
        known = _known_of(flat)
        blocks = [flat.table.blocks[path] for path in flat.checked.traced]
        if known.sorted is None or not all(map(is_, blocks, known.sorted[0])):
            known.sorted = blocks, *_sort(flat, blocks)
        _, self._starting, self._sources = known.sorted
        self._bound: dict[tuple[Port, ...], _StartFunctions] = {}
        self._left: tuple[list[Block], dict[Port, np.ndarray]] | None = None
        self._found = known.states

    @staticmethod
    def fits(flat: FlatDiagram) -> bool:
        """Whether a diagram's start can be traced: no block of it is in model exchange, or in a loop."""
        opaque = any(flat.table.blocks[path].opaque for path in flat.checked.traced)
        return not (opaque or flat.apart or flat.loops.slices)

    def set(self, workspace: Workspace) -> None:
        """Compute the start values at t = 0 from the values at hand."""
        assert workspace is self._workspace
        flat, x = workspace.flat, workspace.here.x
        if not (self._starting or flat.held.slices or flat.gates.slices or flat.starts.slices):
            return
        left = self._from_left()
        functions = self._functions(left)
        for port, values in left.items():
            functions.left[functions.places[port]] = values
        for path in functions.order:
            bound, names = functions.inputs[path]
            bound.call()
            columns: dict[str, Any] = dict.fromkeys(flat.checked.traced[path].inputs)
            columns |= dict(zip(names, bound.outputs, strict=True))
            x[flat.states.slices[path]] = self._initial(flat, path, columns)
        for path, where in flat.starts.slices.items():
            x[where] = x[flat.states.slices[path]]
        if functions.held is not None:
            functions.held.call()
            for name, values in zip(flat.held.slices, functions.held.outputs, strict=True):
                x[flat.held.slices[name]] = values
        if functions.gates is not None:
            functions.gates.call()
            for name, values in zip(flat.gates.slices, functions.gates.outputs, strict=True):
                x[flat.gates.slices[name]] = float(is_true(values))

    def _initial(self, flat: FlatDiagram, path: str, columns: dict[str, Any]) -> np.ndarray:
        """Return a block's initial state; that of the last run, where neither the block nor its inputs have changed."""
        block = flat.table.blocks[path]
        key = b"".join([b"-" if column is None else column.tobytes() for column in columns.values()])
        known = self._found.get(path)
        if known is None or known[0] is not block or known[1] != key:
            known = self._found[path] = (block, key, find_initial_state(flat, path, columns))
        return known[2]

    def _from_left(self) -> dict[Port, np.ndarray]:
        """Return the values just before t = 0 of the sources that jump there."""
        blocks = self._workspace.flat.table.blocks
        sources = [blocks[path] for path in self._sources]
        if self._left is None or not all(map(is_, sources, self._left[0])):
            found = {port: np.asarray(tap(None)) for port, tap in values_from_left(self._workspace).items()}
            self._left = (sources, found)
        return self._left[1]

    def _functions(self, left: dict[Port, np.ndarray]) -> _StartFunctions:
        key = tuple(left)
        if key not in self._bound:
            self._bound[key] = _StartFunctions(self._workspace, trace_start(self._workspace.flat, left))
        return self._bound[key]


class _StartFunctions:
    """The functions of a start, bound to a run's vectors."""

    def __init__(self, workspace: Workspace, functions: StartFunctions):
        here, self.places = workspace.here, functions.places
        self.left = np.zeros(functions.width)
        vectors = [here.x, here.w, here.p, self.left]
        self.order = tuple(functions.inputs)
        self.inputs = {path: (bind_function(f, vectors), names) for path, (f, names) in functions.inputs.items()}
        self.held, self.gates = (
            None if f is None else bind_function(f, vectors) for f in (functions.held, functions.gates)
        )


@dataclass(frozen=True, eq=False)
class StartFunctions:
    """The functions of a start, each of ``(x, w, p, left)``, with some sources as they are just before t = 0."""

    places: Mapping[Port, slice]  # of the outputs of these sources in ``left``, whose last entry is the time, 0
    inputs: Mapping[str, tuple[Any, list[str]]]
    """Inputs of the blocks that start from them, as a casadi.Function and ports, in the order of computation."""
    held: Any  # casadi.Function of the first held outputs, or None
    gates: Any  # that of the signals that enable or trigger subsystems, or None

    @property
    def width(self) -> int:
        """Number of entries of ``left``."""
        return 1 + sum(int(where.stop - where.start) for where in self.places.values())


@dataclass(eq=False)
class _Known:
    """What the runs of a diagram share of their starts."""

    functions: dict[tuple[Port, ...], StartFunctions] = field(default_factory=dict)  # by the sources before t = 0
    states: dict[str, tuple[Block, bytes, np.ndarray]] = field(default_factory=dict)
    """The last initial state of each block, with the block and its inputs: many runs start from the same ones."""
    runs: int = 0
    sorted: tuple[list[Block], list[str], list[str]] | None = None
    """The blocks, with the paths of those that start from their inputs, and of the sources."""


def _known_of(flat: FlatDiagram) -> _Known:
    return flat.keep("start values", _Known)


def _sort(flat: FlatDiagram, blocks: list[Block]) -> tuple[list[str], list[str]]:
    """Return the paths of the blocks that start from their inputs, and of those without inputs."""
    paths = [*zip(flat.checked.traced, blocks, strict=True)]
    return [p for p, block in paths if block.starts_from_inputs], [p for p, block in paths if not block.inputs]


def choose_start_values(workspace: Workspace) -> Callable[[Workspace], None]:
    """Return what computes a run's start values: traced functions, or block by block in the first run of a diagram."""
    flat = workspace.flat
    known = _known_of(flat)
    known.runs += 1  # to trace takes as long as some starts, and a diagram may run once
    if known.runs == 1 or flat.by_block or not TracedStartValues.fits(flat):
        return find_start_values
    return TracedStartValues(workspace).set


def trace_start(flat: FlatDiagram, left: Mapping[Port, np.ndarray]) -> StartFunctions:
    """Return the functions of a diagram's start, with the sources of which ``left`` has the values before t = 0."""
    known, key = _known_of(flat).functions, tuple(left)
    if key not in known:
        known[key] = _trace_start(flat, left)
    return known[key]


def _trace_start(flat: FlatDiagram, left: Mapping[Port, np.ndarray]) -> StartFunctions:
    starting = [path for path in flat.checked.traced if flat.table.blocks[path].starts_from_inputs]
    places, n = dict[Port, slice](), 0
    for port, values in left.items():
        places[port] = slice(n, n + values.size)
        n += values.size
    sizes = {"x": flat.width, "w": flat.plant_outputs.total, "p": flat.p.size, "left": n + 1}
    symbols = [ca.MX.sym(name, size) for name, size in sizes.items()]
    x, w, p, before_start = symbols

    def run(**options: Any) -> Instant:
        # The time is a symbol: as a constant it would be simplified, and −0 become 0.
        return evaluate(flat, flat.blocks, NONE, before_start[n], x, w, p, opened=True, **options)

    def tapped(where: slice) -> Callable[[Any], Any]:
        return lambda column: before_start[where]

    taps = {port: tapped(where) for port, where in places.items()}
    found: dict[str, dict[str, Any]] = {}

    def before(path: str, inputs: dict[str, Any]) -> None:
        if path in starting and path not in found:
            found[path] = dict(inputs)

    def make(columns: list[Any]) -> Any:
        # as the first run has computed them: block by block, to the sign of a zero
        return speed_up(ca.Function("start", symbols, [ca.densify(ca.MX(c)) for c in columns]), simplify=False)

    if starting:
        run(order=flat.start_order.steps, before=before, taps=taps)
    made = {path: {name: c for name, c in inputs.items() if c is not None} for path, inputs in found.items()}
    ins = {path: (make([*columns.values()]), [*columns]) for path, columns in made.items()}
    held = gates = None
    if flat.held.slices:
        now = run()
        held = make([now.held[name] for name in flat.held.slices])
    if flat.gates.slices:
        at_left = run(taps=taps)
        gates = make([at_left.control(name) for name in flat.gates.slices])
    return StartFunctions(places, ins, held, gates)
