"""A diagram as it is exported: its loop, bound as for a run, as memory and code; its variables and where they are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...blocks.core import DefinitionError, OptionError, SimulationError
from ...fmus.export import (
    ROOM_FOR_EDGES,
    CFunction,
    ComputedNumbers,
    Field,
    LoopMemory,
    LoopSpec,
    Placed,
)
from ..compiled import (
    CompiledHybrid,
    NamedCode,
    function_text,
    functions_between,
    load_runtime,
    read_memory,
    write_code,
)
from ..coupling import bind
from ..flat import NONE, Announcer, FlatDiagram, TickPattern, bits_of, flatten, has_all_kinds, kinds_of
from ..model_exchange import BlocksInModelExchange
from ..simulation import (
    Continuous,
    Initialization,
    RunOptions,
    Workspace,
    bind_hybrid,
    bind_ticks,
    find_late,
    find_start_values,
    next_instant,
)
from ..solvers import METHODS, MethodKind
from ..wiring import exact_time
from .exported_variables import ExportedVariables, is_sampled
from .obstacles import refuse
from .open_diagram import OpenDiagram
from .plants_to_merge import loaded, merge, own_fmus
from .traced_functions import (
    trace_computed_numbers,
    trace_guards,
    trace_left,
    trace_rates,
    trace_slopes,
    trace_start_values,
)

_MOST_CLOCKS, _MOST_SETS = 64, 250
_STIFF = 50.0
"""Time constants of the fastest mode in a communication step above which a diagram is stiff: an explicit method takes
15 steps there for its stability alone."""
_MOST_EDGES, _LISTED = 4000, 600
"""Discontinuities that a source may have before it ends; and those of one without end, by which its period is known."""
_PHASES = 8  # discontinuities in a period, at most
_SAME = 1e-9  # of a period

Edges = tuple[tuple[float, float], ...]


def loop_spec(
    opened: OpenDiagram,
    *,
    name: str,
    description: str = "",
    solver: str = "auto",
    rtol: float = RunOptions.rtol,
    atol: float = RunOptions.atol,
    between: bool = True,
    differentiated: bool = False,
    **options: Any,
) -> LoopSpec:
    """Return a diagram as it is exported.

    ``rtol``, ``atol``: relative and absolute tolerance of a method of variable step.
    ``between``: whether outputs follow inputs between ticks, too, where nothing moves there.
    ``differentiated``: whether its derivatives are wanted.
    Raises `DefinitionError`: for what can't be exported, by its path.
    Raises `SimulationError` if its start isn't found.
    """
    refuse(opened)
    own_fmus(opened)  # or refused, before anything is made
    flat = _flatten(opened, name, options.get("step_size", 1e-3), between=between)
    workspace = _start(opened, flat)
    here = workspace.here
    acting = kinds_of(flat, every=False) if flat.distinct else []
    hybrid = flat.hybrid or (between and not is_sampled(flat))
    acting = [NONE, *(clocks for clocks in acting if clocks)] if hybrid else acting
    _check_clocks(flat, len(acting), name)
    code = NamedCode(load_runtime())
    vectors = {"t": here.t, "x": here.x, "w": here.w, "p": here.p, "seen_p": here.p.copy()}
    vectors |= {"x_next": workspace.x_next, "z": workspace.z, "log": workspace.log, "ok": workspace.ok}
    facts: dict[str, Any] = {}
    functions: list[Any] = []
    if hybrid:
        vectors |= {"edge": np.zeros(ROOM_FOR_EDGES), "late": np.zeros(ROOM_FOR_EDGES)}
        step = options.get("step_size", LoopSpec.step_size)
        continuous = _continuous(workspace, name, solver, rtol, atol, step)
        bound = _bind_hybrid(continuous, acting, code)
        memory = read_memory({"hybrid": bound.structure}, vectors, bound.kept, code)
        facts["edges"], facts["periodic"] = _find_edges(continuous.sources)
        facts["events"] = tuple((opened.shown(e.path), e.name, e.subsystem) for e in flat.events)
        left = trace_left(workspace)
        facts["left"] = None if left is None else CFunction.of(left)
        functions += [] if left is None else [left]
    else:
        loop = bind_ticks(workspace, write_code(flat, acting, whole=True).find(code))
        memory = read_memory({"loop": loop.structure}, vectors, loop.kept, code)
    plants, more = merge(opened, flat, flat.parameters.total)
    memory = _with_parameters(memory, here.p, more)
    guards = [trace_guards(flat, clocks, i, opened) for i, clocks in enumerate(acting)]
    start, untraced = trace_start_values(flat, workspace)
    numbers = trace_computed_numbers(flat)
    variables = ExportedVariables(opened, flat, here.x.copy(), untraced, numbers)
    if differentiated and not plants:  # of plants inside only the steps are known
        facts |= _slopes(flat, acting, variables, numbers, start, functions)
    functions += [start, *(f for _, f in numbers.values()), *(f for _, f in guards)]
    return LoopSpec(
        name=name,
        description=description,
        inputs=variables.inputs(),
        outputs=variables.outputs(),
        signals=variables.signals(),
        parameters=(*variables.parameters(), *more),
        states=variables.states(),
        base=flat.base,
        clocks=tuple((clock.every, clock.offset) for clock in flat.distinct),
        clocked=variables.clocked(),
        sets=tuple(bits_of(flat, one) for one in acting),
        hybrid=hybrid,
        memory=memory,
        code=function_text([*code.functions, *dict.fromkeys(f for f in functions if f is not None)]),
        labels=variables.labels(),
        guards=tuple(found for found, _ in guards),
        start=None if start is None else CFunction.of(start),
        start_kind=_start_kind(flat, acting, name),
        numbers=tuple(one for one, f in numbers.values() if f is not None),
        plants=plants,
        depends=variables.depends(acting),
        found_at_build=variables.found_at_build(),
        **facts,
        **options,
    )


def _with_parameters(memory: LoopMemory, p: np.ndarray, more: Sequence[Placed]) -> LoopMemory:
    """Return a memory with the parameters of FMUs behind the diagram's own."""
    starts = [np.ravel(np.asarray(one.variable.start)) for one in more]
    longer = Field.of("p", np.concatenate([p, *starts]))
    return (
        replace(memory, fields=tuple(longer if one.name == "p" else one for one in memory.fields)) if more else memory
    )


def _slopes(
    flat: FlatDiagram,
    acting: Sequence[frozenset[TickPattern]],
    variables: ExportedVariables,
    numbers: Mapping[str, tuple[ComputedNumbers, Any]],
    start: Any,
    functions: list[Any],
) -> dict[str, Any]:
    """Return the derivatives as fields of a `LoopSpec`, and add their functions to the others."""
    shown = (*variables.outputs(), *variables.signals())
    if any(one.vector not in ("log", "x") for one in shown):
        return {}
    entries = sorted({place for one in shown for place in one.places})
    integrated = bool(flat.continuous.size)
    slopes, made, knowns = trace_slopes(flat, acting, entries, numbers, start, rates=integrated)
    if slopes is None:
        return {}
    if integrated:
        rates = trace_rates(flat)
        slopes, made = replace(slopes, function=CFunction.of(rates)), [*made, rates]
    functions += made
    variables.are_rates_shown = integrated
    return {"slopes": slopes, "knowns": knowns}


def _flatten(opened: OpenDiagram, name: str, step: float, *, between: bool) -> FlatDiagram:
    """Return the diagram with its ticks; without any, a step takes their place. Outputs may be had between ticks."""
    wired = opened.wired
    if not wired.has_base:
        base = exact_time(step, block=name)
        return flatten(wired.scheduled, wired.checked, wired.orders, base, name=name, asked=False, between=True)
    flat = wired.flatten()
    if is_sampled(flat) or not (between or flat.hybrid):
        return flat
    return flatten(wired.scheduled, wired.checked, wired.orders, name=name, between=True)


def _continuous(workspace: Workspace, name: str, solver: str, rtol: float, atol: float, step: float) -> Continuous:
    """Return the continuous part, with a method that C has.

    Raises `OptionError`: for a method of another library.
    """
    known = METHODS.get(solver)
    if known is not None and known.kind is MethodKind.LIBRARY:
        raise OptionError(
            f"found solver={solver!r}, whose steps another library takes, which isn't exported. Give 'RK45', or "
            "'Radau' for a stiff diagram.",
            block=name,
            port="solver",
        )
    continuous = Continuous(workspace, name, solver, rtol, atol, None, lambda event: None)
    continuous.begin(at_start=True)
    if solver != "auto":
        return continuous
    return _continuous(workspace, name, _choose_solver(continuous, step), rtol, atol, step)


def _choose_solver(continuous: Continuous, step: float) -> str:
    """Return the explicit method of "auto", or the implicit one where stability would ask for many steps.

    A run changes between the two as it goes; an exported diagram keeps the one that suits its start.
    """
    method = continuous.method
    if len(method.names) == 1:
        return method.active
    explicit, implicit = method.names
    fastest = -method.leftmost_eigenvalue(0.0, continuous.workspace.here.x[continuous.where])
    return implicit if _STIFF < fastest * step < np.inf else explicit


def _bind_hybrid(continuous: Continuous, acting: Sequence[frozenset[TickPattern]], code: NamedCode) -> CompiledHybrid:
    """Return the loop with continuous states, bound to the numbers of a start, without plants."""
    between = functions_between(continuous.flat, stiff=continuous.is_stiff)
    made = write_code(continuous.flat, acting, between, whole=True).find(code)
    return bind_hybrid(continuous, made, bind_ticks(continuous.workspace, made), drain=lambda: None, logged=0)


def _start(opened: OpenDiagram, flat: FlatDiagram) -> Workspace:
    """Return the numbers of a diagram at t = 0, with the start values of its inputs."""
    workspace = Workspace(flat)
    for name, values in opened.starts.items():
        workspace.here.w[flat.plant_outputs.slices[name]] = values
    with loaded(opened, flat) as plants:
        bind(flat, plants, workspace.z, workspace.here.w)
        exchanged, passes_on = BlocksInModelExchange(flat), "agree" if plants else "none"
        try:
            Initialization(workspace, plants, None, lambda: None, exchanged, passes_on, find_start_values).find()
        except SimulationError as error:
            raise error.at(t=0.0) from error.__cause__
    for path, values in opened.states.items():
        if path in flat.states.slices:
            workspace.here.x[flat.states.slices[path]] = values
    return workspace


def _check_clocks(flat: FlatDiagram, sets: int, name: str) -> None:
    if len(flat.distinct) > _MOST_CLOCKS or sets > _MOST_SETS:
        raise DefinitionError(
            f"found {len(flat.distinct)} sample times, of which {sets} sets act together; at most {_MOST_CLOCKS} and "
            f"{_MOST_SETS} are exported. Choose sample times that are multiples of each other.",
            block=name,
        )
    if not has_all_kinds(flat):
        raise DefinitionError(
            "its sample times act together again only after more than a million ticks of "
            f"{float(flat.base):g} s, and an exported diagram has code for each set that acts together. Choose sample "
            "times that are multiples of each other.",
            block=name,
        )


def _start_kind(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], name: str) -> int:
    """Return the kind of the tick at which all clocks act; -1 without algebraic loops."""
    if not flat.loops.slices:
        return -1
    every = frozenset(flat.distinct)
    if every not in acting:
        raise DefinitionError(
            "it has an algebraic loop, and subsystems that never act at the same tick; an exported diagram can't find "
            "its start then. Leave out the offset of a sample time, or break the loop by a UnitDelay.",
            block=name,
        )
    return acting.index(every)


def _find_edges(sources: Sequence[tuple[str, Announcer]]) -> tuple[Edges, Edges]:
    """Return discontinuities of sources, each with the time at which it is seen there; and first ones with periods.

    Raises `DefinitionError`: for a source with very many of them that don't repeat.
    """
    late = find_late(sources)
    single, periodic = set[float](), list[tuple[float, float]]()
    for path, source in sources:
        found: list[float] = []
        t = -1e-300  # an instant at 0 is one
        while len(found) < _MOST_EDGES and (t := next_instant(path, source, t)) < math.inf:
            found.append(t)
            if len(found) == _LISTED and (repeats := _find_period(found)) is not None:
                periodic += repeats
                break
        else:
            if len(found) == _MOST_EDGES:
                raise DefinitionError(
                    f"it has more than {_MOST_EDGES} discontinuities, which don't repeat; so many are not exported. "
                    "Put it into a sampled subsystem, or leave it outside: outside=….",
                    block=path,
                )
            single.update(found)
    return tuple((t, late.get(t, t)) for t in sorted(single)), tuple(periodic)


def _find_period(times: list[float]) -> list[tuple[float, float]] | None:
    """Return the first discontinuities with their period; None if they don't repeat from the first one on."""
    for phases in range(1, _PHASES + 1):
        whole = (len(times) - 1) // phases
        period = (times[whole * phases] - times[0]) / whole
        expected = (times[i % phases] + (i // phases) * period for i in range(len(times)))
        if all(abs(a - b) <= _SAME * period for a, b in zip(times, expected, strict=True)):
            return [(times[i], period) for i in range(phases)]
    return None
