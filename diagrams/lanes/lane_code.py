"""The C code of a vector of runs: a diagram's ticks and its FMUs' equations, compiled for this processor."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any

from ...blocks.core import CompilerError, FmuError
from ...fmus import Fmu
from ...fmus.export import describe_processor, processor_flags
from ..compiled import LARGEST, NewtonOptions, load_compiled
from ..flat import NONE, TRUE, FlatDiagram, TickPattern, share_terms
from ..solvers import FIXED
from .flow_code import FlowSource, write_flow
from .lane_loops import LoopSource, write_loops
from .lane_plants import LanePlant, read_plant
from .lane_ticks import TickSources, read_source
from .start_code import StartSource, write_start
from .vector_code import NoLanesError, ScalarFunctions

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
    ticks: TickSources,
    kinds: Sequence[frozenset[TickPattern]],
    plants: Sequence[LanePlant],
    sizes: LaneSizes,
    count: int,
    scalars: ScalarFunctions,
    start: StartSource | None = None,
    flow: FlowSource | None = None,
    loops: Mapping[int, LoopSource] | None = None,
) -> tuple[str, Room]:
    """Write the C code that goes over ticks with a vector of runs; return it with the memory that it needs."""
    head = [f"#define LANES {count}\n", f"#define TRUTH {TRUE!r}\n"]
    head += [f"#define N_{name.upper()} {size}\n" for name, size in vars(sizes).items()]
    parts = [ticks.text]
    if loops:
        parts.append(read_source("lane_newton.c"))
    prepare, steps, resume, keep = [], [], [], []
    cases, room = [], 0

    def take(name: str, size: int) -> str:
        """Return the declaration of vectors that a function keeps."""
        nonlocal room
        if not ticks.is_grouped:
            return f"vec {name}[AT_LEAST_1({size})];"
        room += size
        return f"vec *{name} = (vec *)l->room + {room - size};"

    # Every kind of tick becomes a case of the switch; what depends on parameters alone is prepared once.
    names = "x", "w", "z", "p", "x_next", "log"
    own = [take(name, getattr(sizes, name.partition("_")[0])) for name in names]
    for i, clocks in enumerate(kinds):
        code = ticks.write(f"tick{i}", clocks)
        parts.append(code.text)
        prepare.append(f"{take(f'kept_tick{i}', code.kept)} tick{i}_prepare(p, kept_tick{i});")
        solve = ""
        if loops and i in loops:
            text, kept = write_loops(f"loops{i}", loops[i], _TICK, scalars)
            parts.append(text)
            prepare.append(f"vec kept_loops{i}[AT_LEAST_1({kept})]; loops{i}_equations_prepare(p, kept_loops{i});")
            solve = f"unsolved = loops{i}(t, x, w, p, kept_loops{i}, alive); "
        cases.append(f"case {i}: {solve}tick{i}(t, x, w, p, kept_tick{i}, x_next, z, log, ok); break;")
    # The FMUs' vectors are one after the other; a lane whose run has ended takes the numbers of another one.
    at = 0
    for i, plant in enumerate(plants):
        parts.append(plant.write(f"plant{i}"))
        first, at = at, at + plant.width
        prepare.append(f"plant{i} of{i}; plant{i}_begin(&of{i}, (const vec *)l->plant + {first});")
        steps.append(f"plant{i}_step(&of{i}, t0, h, substeps(h, l->steps[{i}]), z, w);")
        resume.append(f"plant{i}_resume(&of{i}, which, from);")
        keep.append(f"plant{i}_end(&of{i}, (vec *)l->plant + {first});")
    states = ""
    if flow is not None:
        text, kept = write_flow(flow, scalars)
        parts.append(text)
        prepare.append(f"vec kept_flow[AT_LEAST_1({kept})]; flow_prepare(p, kept_flow);")
        states = "step_states(t0, t1, x, w, p, kept_flow);"
    # lanes.c goes over the ticks; macros put the parts of this diagram into it.
    evaluate = f"switch (kind) {{ {' '.join(cases)} }}"
    parts += [
        f"#define TAKE_ROOM {' '.join(own)}\n",
        f"#define PREPARE {' '.join(prepare)}\n",
        f"#define STEP_STATES(t0, t1) {states}\n",
        f"#define STEP_PLANTS(t0, h) {' '.join(steps)}\n",
        f"#define EVALUATE(kind) {evaluate}\n",
        f"#define PLANTS_RESUME(which, from) {' '.join(resume)}\n",
        f"#define KEEP_PLANTS {' '.join(keep)}\n",
        read_source("lanes.c"),
    ]
    at_start = 0
    if start is not None:
        text, at_start = write_start(start, plants, ticks, scalars)
        parts.append(text)
    return "".join([scalars.write(), *head, read_source("vectors.h"), *parts]), Room(room, at_start)


@dataclass(frozen=True)
class Room:
    """Vectors of memory that the code needs: to go over ticks, and for the first one."""

    run: int
    start: int


@dataclass(frozen=True, eq=False)
class LaneCode:
    """The C code of a vector of runs, loaded."""

    run: Any  # goes over ticks
    kinds: Mapping[frozenset[TickPattern], int]  # sets of clocks that act together, with their numbers
    plants: Mapping[str, LanePlant]
    sizes: LaneSizes
    count: int  # runs in a vector
    library: ctypes.CDLL  # loaded as long as this lives
    starts: LaneStarts | None = None  # None if the start can't be computed over vectors
    room: Room = Room(0, 0)


@dataclass(frozen=True, eq=False)
class LaneStarts:
    """C functions of the start of a vector of runs; each takes addresses of vectors."""

    tick: Any  # (x, w, p, x_next, z, log, ok, kept): the first tick, and its memory
    outputs: Any  # (plants, z, w): the FMUs keep their inputs in z, which may be None
    values: list[Any]  # (x, w, p, left, values), as `StartSource` has them
    sizes: list[int]  # number of values of each


_COMPILING = Lock()


def compile_lanes(
    flat: FlatDiagram,
    acting: Sequence[frozenset[TickPattern]],
    count: int,
    start: StartSource | None = None,
    method: str = "",
    loops: Mapping[frozenset[TickPattern], NewtonOptions] | None = None,
) -> LaneCode:
    """Compile the code that goes over ticks with a vector of ``count`` runs, unless the cache has it.

    ``method`` is one of fixed step that integrates continuous states; empty where there are none.
    """
    with _COMPILING:
        known: dict[Any, LaneCode] = flat.made["lanes"]
        key = count, tuple(acting), method, None if start is None else start.key
        if key not in known:
            known[key] = _compile(flat.origin, acting, count, start, method, loops or {})
        return known[key]


def _compile(
    flat: FlatDiagram,
    acting: Sequence[frozenset[TickPattern]],
    count: int,
    start: StartSource | None,
    method: str,
    newton: Mapping[frozenset[TickPattern], NewtonOptions],
) -> LaneCode:
    # Lanes advance together, so nothing may happen at different times in two of them.
    if between := _between_ticks(flat, method):
        raise NoLanesError(between)
    if flat.apart:
        raise NoLanesError(f"{min(flat.apart)} is in model exchange")
    scalars = ScalarFunctions()
    # Runs that start together evaluate a tick at the start, whose clocks may be in no later tick.
    ticks = TickSources(flat, [*acting, *(() if start is None else (start.clocks,))], scalars)
    loops = dict[int, LoopSource]()
    for i, clocks in enumerate(acting):
        equations = flat.loop_equations(clocks) if clocks in newton else None
        if equations is not None:
            loops[i] = LoopSource(_check_size(equations.fast), newton[clocks])
    plants = {path: _plant(flat, path) for path in flat.plant_ticks}
    sizes = LaneSizes(
        flat.width,
        flat.plant_outputs.total,
        flat.plant_inputs.total,
        flat.parameters.total,
        flat.log.total + flat.width + bool(flat.loops.slices),
    )
    flow = None
    if flat.continuous.size:
        rates = _check_size(flat.flow.last.fast)
        flow = FlowSource(rates, flat.continuous.tolist(), method)
    source, room = write_lanes(ticks, acting, [*plants.values()], sizes, count, scalars, start, flow, loops)
    try:
        library = load_compiled(source, (*processor_flags(), *FLAGS), describe_processor())
    except (CompilerError, FmuError) as error:
        raise NoLanesError(str(error).rstrip(".")) from error
    run = library["loopwright_lanes"]
    run.restype = None
    starts = None if start is None else _bind_starts(library, start)
    kinds = {clocks: i for i, clocks in enumerate(acting)}
    return LaneCode(run, kinds, plants, sizes, count, library, starts, room)


def _check_size(function: Any) -> Any:
    """Return a function of the whole diagram, in which each operation on scalars is done once; refuse a large one."""
    if not function.is_a("SXFunction"):
        return function
    if (operations := function.n_instructions()) > LARGEST:
        raise NoLanesError(
            f"its rates, or the equations of its algebraic loops, have {operations} operations, and at most {LARGEST} "
            "are compiled as a whole"
        )
    return share_terms(function)


def _bind_starts(library: ctypes.CDLL, source: StartSource) -> LaneStarts:
    def bind(name: str, count: int) -> Any:
        function = library[f"loopwright_{name}"]
        function.restype, function.argtypes = None, [ctypes.c_void_p] * count
        return function

    sizes = [sum(function.numel_out(i) for i in range(function.n_out())) for function in source.values]
    values = [bind(f"start{i}", 5) for i in range(len(sizes))]
    return LaneStarts(bind("first_tick", 8), bind("first_outputs", 3), values, sizes)


def _between_ticks(flat: FlatDiagram, method: str) -> str:
    """Return what happens between ticks that lanes don't do, as a clause; empty where nothing does."""
    if flat.continuous.size and method not in FIXED:
        path = next(p for p, where in flat.states.slices.items() if where.start <= flat.continuous[0] < where.stop)
        return (
            f"it has continuous states, those of {path}, and each run would choose its steps; give a solver of fixed "
            "step, such as solver='rk4' with step="
        )
    if flat.continuous.size and flat.active_loops(NONE):
        return f"it has algebraic loops between ticks, such as through {min(flat.loops.slices)}"
    if flat.in_model_exchange:
        return f"{flat.in_model_exchange[0]} is in model exchange"
    if flat.events:
        event = flat.events[0]
        kind = "a subsystem that is enabled or triggered" if event.subsystem else "a block that has events"
        return f"{event.path} is {kind} in continuous time; give it, or a subsystem around it, a sample_time"
    for path in flat.checked.traced if flat.continuous.size else ():
        if flat.table.blocks[path].memory and not flat.table.is_sampled(flat.table.subsystem_of[path]):
            return f"{path} keeps a memory between ticks"
    if flat.has_delays:
        owners = {flat.ports[name][0] for name in flat.plant_inputs.slices}
        delay = min(path for path in owners if flat.table.blocks[path].transport)
        return f"{delay} is a transport delay in continuous time"
    return ""


def _plant(flat: FlatDiagram, path: str) -> LanePlant:
    block = flat.table.blocks[path]
    if not isinstance(block, Fmu):
        raise NoLanesError(f"{path} is no FMU")

    def mine(slices: Mapping[str, slice]) -> dict[str, slice]:
        return {flat.ports[name][1]: where for name, where in slices.items() if flat.ports[name][0] == path}

    return read_plant(path, block, mine(flat.plant_inputs.slices), mine(flat.plant_outputs.slices))
