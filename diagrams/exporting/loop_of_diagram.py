"""A diagram as it is exported: its loop, bound as for a run, as memory and code; its variables and where they are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import DefinitionError, SimulationError
from ...blocks.tracing import GUARDS, constants_of, traced_parameters
from ...fmus.export import Guards, LoopSpec, Placed, Variable, parameter_variable
from ..compiled import CompiledLoop, NamedCode, function_text, load_runtime, read_memory, write_ticks
from ..flat import FlatDiagram, TickPattern, evaluate, kinds_of, sample_time_of, share_terms, speed_up
from ..model_exchange import BlocksInModelExchange
from ..simulation import Workspace, find_start_values, initialize, newton_options
from ..wiring import Wire, join
from .obstacles import refuse
from .open_diagram import OpenDiagram

_MOST_CLOCKS, _MOST_SETS = 64, 250


def loop_spec(opened: OpenDiagram, *, name: str, description: str = "", **options: Any) -> LoopSpec:
    """Return a diagram as it is exported.

    Parameters
    ----------
    opened : OpenDiagram
        The diagram, with its inputs and outputs.
    name, description, **options
        Fields of `LoopSpec`.

    Raises
    ------
    DefinitionError
        For what can't be exported, by its path.
    SimulationError
        If its start isn't found.
    """
    refuse(opened)
    flat = opened.wired.flatten()
    workspace = _start(opened, flat)
    acting = kinds_of(flat, every=False)
    _check_clocks(flat, len(acting), name)
    code = NamedCode(load_runtime())
    sources = write_ticks(flat, acting, straight=True)
    ticks = sources.make([code] * len(sources.writers))
    here = workspace.here
    loop = CompiledLoop(
        ticks,
        [here.t, here.x, here.w, here.p],
        [workspace.x_next, workspace.z, workspace.log, workspace.ok],
        [],
        columns=None,
        width=0,
        every=1,
        stops=[],
        loops={clocks: newton_options(flat, clocks, here.x) for clocks in ticks.loops},
    )
    vectors = {"t": here.t, "x": here.x, "w": here.w, "p": here.p}
    vectors |= {"x_next": workspace.x_next, "z": workspace.z, "log": workspace.log, "ok": workspace.ok}
    guards = [_guards(flat, clocks, i, opened) for i, clocks in enumerate(acting)]
    memory = read_memory({"loop": loop.structure}, vectors, loop.kept, code)
    variables = _Variables(opened, flat)
    return LoopSpec(
        name=name,
        description=description,
        inputs=variables.inputs(),
        outputs=variables.outputs(),
        signals=variables.signals(),
        parameters=variables.parameters(),
        states=variables.states(),
        base=flat.base,
        clocks=tuple((clock.every, clock.offset) for clock in flat.distinct),
        sets=tuple(sum(1 << i for i, clock in enumerate(flat.distinct) if clock in one) for one in acting),
        hybrid=False,
        memory=memory,
        code=function_text([*code.functions, *(function for _, function in guards if function is not None)]),
        labels=variables.labels(),
        guards=tuple(found for found, _ in guards),
        depends=variables.depends(acting),
        **options,
    )


def _guards(flat: FlatDiagram, clocks: frozenset[TickPattern], kind: int, opened: OpenDiagram) -> tuple[Guards, Any]:
    """Return what must stay positive at a kind of tick, and the function of their values; None without any."""
    names: list[tuple[str, str]] = []

    def visit(instant: Any, path: str, inputs: Any, made: Any) -> None:
        if GUARDS in made:
            names.extend((opened.shown(path), name) for name in flat.checked.traced[path].guards)

    symbols = flat.symbols()
    instant = evaluate(flat, flat.blocks, clocks, **symbols, visit=visit)
    if not names:
        return Guards(), None
    made = ca.Function(f"lw_guards_of{kind}", [*symbols.values()], [ca.densify(ca.vertcat(*instant.guards))])
    function = share_terms(speed_up(made), made.name())
    sizes = function.sz_arg(), function.sz_res(), function.sz_iw(), function.sz_w()
    return Guards(tuple(names), function.name(), sizes), function


def _start(opened: OpenDiagram, flat: FlatDiagram) -> Workspace:
    """Return the numbers of a diagram at t = 0, with the start values of its inputs."""
    workspace = Workspace(flat)
    workspace.here.w[:] = opened.starts
    try:
        initialize(workspace, {}, None, lambda: None, BlocksInModelExchange(flat), "none", find_start_values)
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


class _Variables:
    """The variables of an exported diagram."""

    def __init__(self, opened: OpenDiagram, flat: FlatDiagram):
        self._opened, self._flat = opened, flat
        self._outputs = {self._place(wire): name for name, wire in opened.outputs.items()}

    def _place(self, wire: Wire) -> tuple[int, ...]:
        """Return the entries of the log that a wire takes."""
        full = join(wire.block, wire.port)
        where, shape = self._flat.log.slices[full], self._flat.log.shapes[full]
        entries = np.arange(where.start, where.stop).reshape(shape)
        return tuple(np.ravel(entries if wire.index is None else entries[wire.index]).tolist())

    def _shape(self, wire: Wire) -> tuple[int, ...]:
        shape = self._flat.log.shapes[join(wire.block, wire.port)]
        return shape if wire.index is None else np.empty(shape)[wire.index].shape

    def inputs(self) -> tuple[Placed, ...]:
        """Return the inputs."""
        opened, flat = self._opened, self._flat
        if not opened.outside:
            return ()
        block: Any = opened.wired.blocks[opened.outside]
        found = []
        for name, port in block.outputs.items():
            where = flat.plant_outputs.slices[join(opened.outside, name)]
            start = block.start_of(name).reshape(port.shape)
            about = _unit(port.unit), port.description
            variable = Variable(name, "input", "continuous", port.shape, *about, start=start)
            found.append(Placed(variable, "w", tuple(range(where.start, where.stop)), self._is_sampled))
        return tuple(found)

    @property
    def _is_sampled(self) -> bool:
        flat = self._flat
        return all(flat.table.is_sampled(flat.table.subsystem_of[path]) for path in flat.checked.traced)

    def _signal(self, name: str, wire: Wire, causality: Any) -> Placed:
        opened = self._opened
        unit = opened.wired.checked.units.get((wire.block, wire.port))
        if isinstance(unit, tuple):
            unit = unit[wire.index] if isinstance(wire.index, int) else None
        port = self._flat.table.blocks[wire.block].outputs[wire.port]
        sampled = self._flat.table.is_sampled(self._flat.table.subsystem_of[wire.block])
        variable = Variable(name, causality, "continuous", self._shape(wire), _unit(unit), port.description)
        return Placed(variable, "log", self._place(wire), sampled)

    def outputs(self) -> tuple[Placed, ...]:
        """Return the outputs."""
        return tuple(self._signal(name, wire, "output") for name, wire in self._opened.outputs.items())

    def signals(self) -> tuple[Placed, ...]:
        """Return the named wires that are no outputs."""
        opened = self._opened
        found = []
        for full, wire in sorted(opened.wired.scheduled.names.items()):
            name = opened.shown(full)
            if name not in opened.outputs and wire.block != opened.outside:
                found.append(self._signal(name, wire, "local"))
        return tuple(found)

    def parameters(self) -> tuple[Placed, ...]:
        """Return the parameters that are symbols in the functions, and from which no other numbers are computed."""
        flat = self._flat
        found = []
        for path, trace in flat.checked.traced.items():
            block = flat.table.blocks[path]
            if trace.system_matrix is not None or constants_of(block, sample_time_of(flat.table, path), trace.method):
                continue
            first = flat.parameters.slices[path].start
            for key, value in traced_parameters(block):
                size = int(np.size(value))
                if np.all(np.ravel(value) != 0):  # zeros are structure
                    variable = parameter_variable(block, key, value, join(self._opened.shown(path), key))
                    found.append(Placed(variable, "p", tuple(range(first, first + size))))
                first += size
        return tuple(found)

    def states(self) -> tuple[Placed, ...]:
        """Return the states of blocks."""
        flat = self._flat
        found = []
        for path, own in flat.states.of_block.items():
            block = flat.table.blocks[path]
            for name, where in own.slices.items():
                port = block.states[name]
                shape = own.shapes[name]
                start = np.asarray(flat.x0[where]).reshape(shape)
                label = join(self._opened.shown(path), name)
                variable = Variable(
                    label, "local", "discrete", shape, _unit(port.unit), port.description, start=start, state=True
                )
                found.append(Placed(variable, "x", tuple(range(where.start, where.stop)), sampled=True))
        return tuple(found)

    def depends(self, acting: Sequence[frozenset[TickPattern]]) -> dict[str, tuple[int, ...]]:
        """Return the entries of w on which outputs and signals depend at an instant, at any kind of tick."""
        flat = self._flat
        found: dict[int, set[int]] = {}
        for clocks in acting:
            tick = flat.at_tick(clocks)
            sparsity = tick.last.fast.jac_sparsity(tick.results.index("log"), tick.arguments.index("w"))
            for row, column in zip(*sparsity.get_triplet(), strict=True):
                found.setdefault(row, set()).add(column)
        every = (*self.outputs(), *self.signals())
        return {
            one.variable.name: tuple(sorted({w for place in one.places for w in found.get(place, ())})) for one in every
        }

    def labels(self) -> tuple[tuple[str, str, int, int], ...]:
        """Return the outputs of blocks in the order of evaluation, with their places in the log."""
        flat = self._flat
        found = []
        for path, names in flat.order.steps:
            for name in names:
                where = flat.log.slices.get(join(path, name))
                if where is not None:
                    found.append((self._opened.shown(path), name, where.start, where.stop - where.start))
        return tuple(found)


def _unit(unit: object) -> str | None:
    return unit if isinstance(unit, str) else None
