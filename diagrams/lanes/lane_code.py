"""The C code of a vector of runs: a diagram's ticks and its FMUs' equations, compiled for this processor."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from threading import Lock
from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca

from ...blocks.core import CompilerError, FmuError
from ...fmus import Fmu
from ...fmus.export import describe_processor, processor_flags
from ..compiled import LARGEST, load_compiled
from ..flat import TRUE, FlatDiagram, TickPattern
from .flow_code import METHODS, FlowSource, write_flow
from .lane_plants import LanePlant, read_plant
from .no_lanes import NoLanesError
from .start_code import StartSource, write_start
from .vector_code import write_vectors

# A product and a sum of one expression are fused, whatever the optimizer does; more of it gains nothing.
FLAGS = ("-O2", "-ffp-contract=on")
_TICK = ("t", "x", "w", "p")


@dataclass(frozen=True)
class LaneSizes:
    """Numbers of entries of the vectors of a run."""

    x: int
    w: int
    z: int
    p: int
    log: int


def write_lanes(
    ticks: Sequence[Any],
    plants: Sequence[LanePlant],
    sizes: LaneSizes,
    count: int,
    start: StartSource | None = None,
    flow: FlowSource | None = None,
) -> str:
    """Write the C code that goes over ticks with a vector of runs.

    Parameters
    ----------
    ticks : sequence of casadi.Function
        ``(t, x, w, p) -> (x_next, z, log, ok)``, of scalar operations, one for each set of clocks that act together.
    plants : sequence of LanePlant
        The FMUs in their order.
    sizes : LaneSizes
        Entries of the vectors.
    count : int
        Runs in a vector.
    start : StartSource, optional
        Functions from which runs start.
    flow : FlowSource, optional
        Rates of the continuous states.
    """
    parts = [f"#define LANES {count}\n", f"#define TRUTH {TRUE!r}\n"]
    parts += [f"#define N_{name.upper()} {size}\n" for name, size in vars(sizes).items()]
    parts.append(read_source("vectors.h"))
    prepare, steps, go_on, keep = [], [], [], []
    cases = []
    for i, tick in enumerate(ticks):
        code = write_vectors(f"tick{i}", tick, _TICK, {3})
        parts.append(code.text)
        prepare.append(f"vec kept_tick{i}[AT_LEAST_1({code.kept})]; tick{i}_prepare(p, kept_tick{i});")
        cases.append(f"case {i}: tick{i}(t, x, w, p, kept_tick{i}, x_next, z, log, ok); break;")
    at = 0
    for i, plant in enumerate(plants):
        parts.append(plant.write(f"plant{i}"))
        first, at = at, at + plant.width
        prepare.append(f"plant{i} of{i}; plant{i}_begin(&of{i}, (const vec *)l->plant + {first});")
        steps.append(f"plant{i}_step(&of{i}, t0, h, substeps(h, l->steps[{i}]), z, w);")
        go_on.append(f"plant{i}_go_on(&of{i}, which, from);")
        keep.append(f"plant{i}_end(&of{i}, (vec *)l->plant + {first});")
    states = ""
    if flow is not None:
        text, kept = write_flow(flow)
        parts.append(text)
        prepare.append(f"vec kept_flow[AT_LEAST_1({kept})]; flow_prepare(p, kept_flow);")
        states = "step_states(t0, t1, to, x, w, p, kept_flow);"
    evaluate = f"switch (kind) {{ {' '.join(cases)} }}"
    parts += [
        f"#define PREPARE {' '.join(prepare)}\n",
        f"#define STEP_STATES(t0, t1, to) {states}\n",
        f"#define STEP_PLANTS(t0, h) {' '.join(steps)}\n",
        f"#define EVALUATE(kind) {evaluate}\n",
        f"#define PLANTS_GO_ON(which, from) {' '.join(go_on)}\n",
        f"#define KEEP_PLANTS {' '.join(keep)}\n",
        read_source("lanes.c"),
    ]
    if start is not None:
        parts.append(write_start(start, plants))
    return "".join(parts)


def read_source(name: str) -> str:
    """Return a C source of this package."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


@dataclass(frozen=True, eq=False)
class LaneCode:
    """The C code of a vector of runs, loaded.

    Attributes
    ----------
    run : callable
        Goes over ticks.
    kinds : mapping
        The sets of clocks that act together, with their numbers.
    plants : mapping of str to LanePlant
        The FMUs by path.
    sizes : LaneSizes
        Entries of the vectors.
    count : int
        Runs in a vector.
    library : CDLL
        The library, which is loaded as long as this lives.
    starts : LaneStarts or None
        Functions of the start of runs; None if it can't be computed over vectors.
    has_states : bool
        Whether there are continuous states between ticks.
    """

    run: Any
    kinds: Mapping[frozenset[TickPattern], int]
    plants: Mapping[str, LanePlant]
    sizes: LaneSizes
    count: int
    library: ctypes.CDLL
    starts: LaneStarts | None = None
    has_states: bool = False


@dataclass(frozen=True, eq=False)
class LaneStarts:
    """C functions of the start of a vector of runs; each takes addresses of vectors.

    Attributes
    ----------
    tick : callable
        ``(x, w, p, x_next, z, log, ok)``: the tick with which they begin.
    outputs : callable
        ``(plants, z, w)``: outputs of the FMUs at their inputs in z, which they keep; z may be None.
    values : list of callable
        ``(x, w, p, left, values)``, as `StartSource` has them.
    sizes : list of int
        Number of values of each.
    """

    tick: Any
    outputs: Any
    values: list[Any]
    sizes: list[int]


_COMPILED: WeakKeyDictionary[FlatDiagram, dict[Any, LaneCode]] = WeakKeyDictionary()
_COMPILING = Lock()


def compile_lanes(
    flat: FlatDiagram,
    acting: Sequence[frozenset[TickPattern]],
    count: int,
    start: StartSource | None = None,
    method: str = "",
) -> LaneCode:
    """Compile the code that goes over ticks with a vector of runs, unless the cache has it.

    Parameters
    ----------
    flat : FlatDiagram
        The diagram.
    acting : sequence of frozenset of TickPattern
        The sets of clocks that act together at some tick.
    count : int
        Runs in a vector.
    start : StartSource, optional
        Functions from which runs start.
    method : str
        The method of fixed step that integrates continuous states; empty where there is none.

    Raises
    ------
    NoLanesError
        If its runs can't go side by side, or there is no compiler.
    """
    with _COMPILING:
        known = _COMPILED.setdefault(flat.origin, {})
        key = count, tuple(acting), method, None if start is None else start.key
        if key not in known:
            known[key] = _compile(flat.origin, acting, count, start, method)
        return known[key]


def _compile(
    flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], count: int, start: StartSource | None, method: str
) -> LaneCode:
    if between := _between_ticks(flat, method):
        raise NoLanesError(between)
    if flat.loops.slices:
        raise NoLanesError(f"it has algebraic loops, such as through {next(iter(flat.loops.slices))}")
    if flat.apart:
        raise NoLanesError(f"{min(flat.apart)} is evaluated from outside")
    if flat.by_block:
        raise NoLanesError("its ticks have too many operations to be compiled as a whole")
    ticks = [flat.at_tick(clocks).last.fast for clocks in acting]
    if not all(tick.is_a("SXFunction") for tick in ticks):
        raise NoLanesError(_no_scalars(flat))
    if (operations := sum(tick.n_instructions() for tick in ticks)) > LARGEST:
        raise NoLanesError(f"its ticks have {operations} operations, and at most {LARGEST} are compiled as a whole")
    ticks = [_share(tick) for tick in ticks]
    plants = {path: _plant(flat, path) for path in flat.plant_ticks}
    first = ticks[0]
    sizes = LaneSizes(
        *(first.numel_in(1), first.numel_in(2), first.numel_out(1), first.numel_in(3), first.numel_out(2))
    )
    flow = None
    if flat.continuous.size:
        rates = flat.flow.last.fast
        if not rates.is_a("SXFunction"):
            raise NoLanesError(_no_scalars(flat))
        flow = FlowSource(_share(rates), flat.continuous.tolist(), method)
    begin = None if start is None else StartSource(_share(start.tick), start.values, start.key)
    source = write_lanes(ticks, [*plants.values()], sizes, count, begin, flow)
    try:
        library = load_compiled(source, (*processor_flags(), *FLAGS), describe_processor())
    except (CompilerError, FmuError) as error:
        raise NoLanesError(str(error).rstrip(".")) from error
    run = library["loopwright_lanes"]
    run.restype = None
    starts = None if begin is None else _bind_starts(library, begin)
    return LaneCode(
        run, {clocks: i for i, clocks in enumerate(acting)}, plants, sizes, count, library, starts, flow is not None
    )


def _bind_starts(library: ctypes.CDLL, source: StartSource) -> LaneStarts:
    def bind(name: str, count: int) -> Any:
        function = library[f"loopwright_{name}"]
        function.restype, function.argtypes = None, [ctypes.c_void_p] * count
        return function

    sizes = [sum(function.numel_out(i) for i in range(function.n_out())) for function in source.values]
    values = [bind(f"start{i}", 5) for i in range(len(sizes))]
    return LaneStarts(bind("first_tick", 7), bind("first_outputs", 3), values, sizes)


def _between_ticks(flat: FlatDiagram, method: str) -> str:
    """Return what happens between ticks that lanes don't do, as a clause; empty where nothing does."""
    if flat.continuous.size and method not in METHODS:
        path = next(p for p, where in flat.states.slices.items() if where.start <= flat.continuous[0] < where.stop)
        return (
            f"it has continuous states, those of {path}, and each run would choose its steps; give a solver of fixed "
            "step, such as solver='rk4' with step="
        )
    if flat.outside:
        return f"{flat.outside[0]} is evaluated from outside"
    if flat.events:
        event = flat.events[0]
        kind = "a subsystem that is enabled or triggered" if event.subsystem else "a block that has events"
        return f"{event.path} is {kind} in continuous time; give it, or a subsystem around it, a sample_time"
    for path in flat.checked.traced if flat.continuous.size else ():
        if flat.table.blocks[path].memory and not flat.table.is_sampled(flat.table.subsystem_of[path]):
            return f"{path} keeps a memory between ticks"
    delays = {flat.ports[name][0] for name in flat.plant_inputs.slices}
    delays = {path for path in delays if flat.table.blocks[path].transport}
    return f"{min(delays)} is a transport delay in continuous time" if delays else ""


def _no_scalars(flat: FlatDiagram) -> str:
    """Return which blocks are no scalar operations, as a clause."""
    traced = flat.checked.traced
    found = [path for path in traced if not traced[path].function.is_a("SXFunction")]
    few = f"{', '.join(found[:3])}{' and others' if len(found) > 3 else ''}" if found else "it"
    return (
        f"{few} {'have' if len(found) > 1 else 'has'} a table or a large matrix product, which is no scalar operation"
    )


def _share(tick: Any) -> Any:
    symbols = tick.sx_in()
    return ca.Function(tick.name(), symbols, ca.cse(tick.call(symbols)))


def _plant(flat: FlatDiagram, path: str) -> LanePlant:
    block = flat.table.blocks[path]
    if not isinstance(block, Fmu):
        raise NoLanesError(f"{path} is no FMU")

    def mine(slices: Mapping[str, slice]) -> dict[str, slice]:
        return {flat.ports[name][1]: where for name, where in slices.items() if flat.ports[name][0] == path}

    return read_plant(path, block, mine(flat.plant_inputs.slices), mine(flat.plant_outputs.slices))
