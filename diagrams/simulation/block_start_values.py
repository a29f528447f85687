"""Start values, block by block: initial states from inputs, first held outputs, and values from the left of t = 0.

A diagram's further runs get the inputs of blocks that start from them by traced functions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from operator import is_
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import Block, LoopwrightError, NonFiniteError, SimulationError
from ...blocks.tracing import bundle, initial_state
from ..flat import NONE, FlatDiagram, Instant, bind_function, evaluate, evaluate_apart, indicators_of, is_true, speed_up
from .failed_blocks import inputs_text, shaped_inputs
from .workspace import Workspace

_BEFORE_START = -1e-300  # s; nearer to 0 than any time of a source that is not 0

Taps = dict[tuple[str, str], Callable[[Any], Any]]
Port = tuple[str, str]


def find_start_values(workspace: Workspace) -> None:
    """Compute the initial states, first held outputs and controls from the values at hand, block by block."""
    _set_initial_states(workspace)
    _hold_first_outputs(workspace)


def _set_initial_states(workspace: Workspace) -> None:
    """Compute the initial states of the blocks that ask for their inputs first."""
    flat, x = workspace.flat, workspace.here.x
    blocks = flat.table.blocks
    if any(blocks[path].starts_from_inputs for path in flat.checked.traced):
        ready: set[str] = set()

        def before(path: str, inputs: dict[str, Any]) -> None:
            if blocks[path].starts_from_inputs and path not in ready:
                ready.add(path)
                x[flat.states.slices[path]] = find_initial_state(flat, path, inputs)

        _evaluate(workspace, order=flat.start_order.steps, before=before, taps=values_from_left(workspace))
    for path, where in flat.starts.slices.items():
        x[where] = x[flat.states.slices[path]]


def find_initial_state(flat: FlatDiagram, path: str, inputs: dict[str, Any], block: Block | None = None) -> np.ndarray:
    """Return the initial state that a block, or another one in its place, computes from its inputs' columns, flat."""
    trace = flat.checked.traced[path]
    for port, column in inputs.items():
        _check_finite(flat, path, port, column)
    block = flat.table.blocks[path] if block is None else block
    return _initial(path, block, bundle("u", shaped_inputs(trace, inputs)), trace.states)


def _check_finite(flat: FlatDiagram, path: str, port: str, column: Any) -> None:
    """Refuse to start a block from an input that is not finite: whoever made that is to blame."""
    wire = flat.table.wires.get((path, port))
    if column is None or wire is None:
        return
    values = np.ravel(np.array(column, dtype=float))
    if not np.all(np.isfinite(values)):
        raise NonFiniteError(
            f"found {values.tolist()} at the start; expected finite numbers, since {path}.{port} begins with it. Look "
            "for a division by zero, or a root or a logarithm of a negative number.",
            block=wire.block,
            port=wire.port,
            t=0.0,
        )


def _hold_first_outputs(workspace: Workspace) -> None:
    """Let every subsystem hold its outputs of the start, and keep the signal that enables or triggers it."""
    flat, x = workspace.flat, workspace.here.x
    if not flat.held.slices and not flat.gates.slices:
        return
    if (solve := workspace.loop_solver(frozenset(flat.distinct), workspace.here)) is not None:
        solve()  # those of subsystems that don't act at t = 0, too
    done = _evaluate(workspace)
    before = _evaluate(workspace, taps=values_from_left(workspace)) if flat.gates.slices else done
    for name, column in done.held.items():
        where = flat.held.slices[name]
        x[where] = np.ravel(np.array(column))
    for subsystem, where in flat.gates.slices.items():
        x[where] = float(is_true(before.control(subsystem)))


def _evaluate(workspace: Workspace, **options: Any) -> Instant:
    """Evaluate all blocks at t = 0 with the run's numbers, every subsystem as if it acted."""
    flat, here, apart = workspace.flat, workspace.here, evaluate_apart(workspace.evaluators)
    return evaluate(flat, flat.blocks, NONE, 0.0, here.x, here.w, here.p, opened=True, apart=apart, **options)


def _initial(path: str, block: Any, u: Any, states: Mapping[str, tuple[int, ...]]) -> np.ndarray:
    """Return a block's initial state from its inputs, flat; whatever fails says whose it is."""
    try:
        return initial_state(block, states, u)
    except SimulationError as error:
        raise error.at(block=path, t=0.0) from error.__cause__
    except Exception as error:
        expected = ", ".join(f"{name} of shape {shape}" for name, shape in states.items())
        what = str(error) if isinstance(error, LoopwrightError) else f"{type(error).__name__}: {error}"
        raise SimulationError(
            f"its initial(u) failed: {what} {inputs_text(u._asdict())} Expected {expected}.", block=path, t=0.0
        ) from error


def values_from_left(workspace: Workspace) -> Taps:
    """Return, as the taps of `evaluate`, the values just before t = 0 of the sources that announce an instant there."""
    flat = workspace.flat
    early = _sources_that_jump(flat)
    if not early:
        return {}
    here, apart = workspace.here, evaluate_apart(workspace.evaluators)
    order = [step for step in flat.start_order.steps if step[0] in early]
    found = evaluate(
        flat, flat.blocks, NONE, _BEFORE_START, here.x, here.w, here.p, opened=True, apart=apart, order=order
    )
    taps: Taps = {}
    for port, column in found.values.items():
        left = np.ravel(np.array(column, dtype=float))
        if port[0] in early and np.all(np.isfinite(left)):  # else it is not defined before t = 0, and begins there
            taps[port] = partial(_replace, left)
    return taps


def _replace(value: np.ndarray, _: Any) -> np.ndarray:
    return value


def _sources_that_jump(flat: FlatDiagram) -> set[str]:
    """Return the paths of the sources that announce an instant at t = 0; a block is asked in its first run only."""
    known: dict[str, tuple[Block, bool]] = flat.keep("sources that jump at the start", dict)
    for path in flat.checked.traced:
        block = flat.table.blocks[path]
        if path not in known or known[path][0] is not block:
            known[path] = block, _jumps_at_start(block)
    return {path for path, (_, jumps) in known.items() if jumps}


def _jumps_at_start(block: Block) -> bool:
    """Whether a block without inputs announces an instant at t = 0."""
    if block.inputs or type(block).next_instant is Block.next_instant:
        return False
    try:
        return block.next_instant(_BEFORE_START) == 0.0
    except Exception:  # it is not defined before t = 0; the run itself reports one that fails after it
        return False


def domains_from_left(workspace: Workspace, domains: np.ndarray) -> np.ndarray:
    """Return the domains of all indicators just before t = 0 (1, −1, 0 on the border), from those at t = 0."""
    # Subsystems are evaluated as if they acted: what a sampled one puts out before its first tick jumps with its
    # sources.
    taps = values_from_left(workspace)
    if not taps:
        return domains
    flat, here, apart = workspace.flat, workspace.here, evaluate_apart(workspace.evaluators)

    def at(taps: Taps) -> np.ndarray:
        instant = evaluate(flat, flat.blocks, NONE, 0.0, here.x, here.w, here.p, opened=True, apart=apart, taps=taps)
        return np.array([float(np.ravel(np.array(g))[0]) for g in indicators_of(instant)[0]])

    left, right = at(taps), at({})
    return np.where((left == right) | ~np.isfinite(left), domains, np.where(left > 0.0, 1, -1))


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
