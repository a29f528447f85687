"""The continuous part of a run: its method, its events and delays, as the loop in C is set up with them.

The loop lands on discontinuities of sources ahead. Coupled plants may go back over a step: then it goes back, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ...blocks.core import Block, FmuRuntimeError, OptionError, ParameterError, SimulationError, identity
from ..compiled import Domains, MethodOptions, delays_of
from ..coupling import accept_steps, try_steps
from ..flat import Announcer, FlatDiagram, Times, announcers, renumber
from ..model_exchange import BlocksInModelExchange, OwnEvents
from ..results import Occurrence
from ..solvers import METHODS, Method, MethodKind, Problem
from .block_start_values import domains_from_left
from .failed_blocks import state_values
from .workspace import Workspace

_AT_ONCE = 1e-6
"""Part of the time between two samples within which an indicator has come back at once."""
NOTHING: frozenset[Any] = frozenset()
TIGHT = 1e-9
"""Below this relative tolerance methods of one step, to which a stop costs little, land on every sample."""
_MOST_EDGES = 100_000  # discontinuities of sources ahead, in a call


class Continuous:
    """The continuous part of a run."""

    def __init__(
        self,
        workspace: Workspace,
        name: str,
        solver: str,
        rtol: float,
        atol: float,
        max_step: float | None,
        on_event: Callable[[Occurrence], None],
        exchanged: BlocksInModelExchange | None = None,
    ):
        flat = workspace.flat
        self.workspace, self.flat, self.name, self.on_event = workspace, flat, name, on_event
        self.where = flat.continuous
        """The entries of x that are integrated."""
        self._left = math.inf
        self._nothing = np.zeros(self.where.size)
        self.beyond: tuple[float, np.ndarray] | None = None
        """Time in s and states of the last trial of the method at which a rate was not finite."""
        self.resolution = rtol, atol
        """Relative and absolute tolerance."""
        self._loops = flat.active_loops(NOTHING)
        self.delays = delays_of(flat)
        time_scale = _time_scale_of(flat)
        shortest = math.inf if self.delays is None else self.delays.shortest
        self.method = Method(
            solver,
            Problem(self.where.size, self._rate, self._slope, flat.continuous_labels),
            rtol=rtol,
            atol=absolute_tolerances(flat, atol),
            step=float(flat.base),
            max_step=_longest_step(flat, max_step, time_scale, shortest),
        )
        self.fixed = self.method.fixed
        multistep = any(METHODS[name].kind is MethodKind.LIBRARY for name in self.method.names)
        self.lands = rtol < TIGHT and not (self.method.fixed or multistep)
        """Whether the method lands on every sample: the dense output is of lower order than the step."""
        if self.fixed and self.delays is not None and float(flat.base) > self.delays.shortest * (1 + 1e-12):
            raise OptionError(
                f"the step of {float(flat.base):g} s is longer than a transport delay of {self.delays.shortest:g} s. "
                "Take a smaller step, or a solver of variable step.",
                block=name,
                port="step",
            )
        self.domains = Domains(flat, time_scale) if flat.events else None
        self.exchanged = exchanged if exchanged else None
        """Blocks in model exchange; None without any."""
        self.own_events = OwnEvents(exchanged) if exchanged else None
        self._nominals = np.zeros(0)
        self.sources = announcers(flat)
        self.late = find_late(self.sources)
        """Instants at which sources are seen at a time just after."""
        self._crossed: dict[int, float] = {}
        """When indicators of FMUs have crossed zero last, in s."""
        self._fresh = self.save()
        self._changed: dict[str, Block] = {}  # blocks with other parameters than at the start, by path

    # --- its method, as the loop in C is set up with it ---------------------------------------------------------------

    @property
    def methods(self) -> list[MethodOptions]:
        """The methods in C that integrate a run: that of the solver's name, and one for where it is stiff."""
        method, n = self.method, self.where.size
        if not n:
            return [MethodOptions("euler", 1.0, np.zeros(0), method.max_step)]
        if method.fixed:
            return [MethodOptions(method.name, 1.0, np.zeros(n), method.max_step)]
        atol = np.broadcast_to(np.asarray(method.atol, dtype=float), (n,)).copy()
        return [MethodOptions(name, method.rtol, atol, method.max_step) for name in method.names]

    def describe_methods(self) -> str:
        """Return in words which methods integrate the run, and where."""
        facts = METHODS.get(self.method.name)
        if facts is not None and facts.library is not None:
            return f"{facts.library.value} takes steps of {facts.title}, and the rest of the run is C"
        names = ", and where it is stiff ".join(f"{METHODS[m.name].title} ({m.name})" for m in self.methods)
        return f"{names} runs in C as solver={self.method.name!r}"

    @property
    def is_stiff(self) -> bool:
        """Whether the solver needs the derivative of the rates."""
        return any(METHODS[method.name].uses_slope for method in self.methods)

    def accepts(self, *, judged: bool, plants: bool = False, exchanged: bool = False) -> int:
        """Return after which steps blocks are evaluated (`CompiledHybrid`); ``judged``: outputs may be non-finite."""
        judged = judged and not self.fixed
        always = plants or self.workspace.looped or remembers(self.flat) or _has_guards(self.flat)
        return 1 if always or (judged and not exchanged) else 2 if judged else 0

    def begin(self, *, at_start: bool) -> None:
        """Take the domains of the indicators where a run begins, at t = 0 from the left; elsewhere as they are."""
        here = self.workspace.here
        t = float(here.t[0])
        self.stand_in(math.inf, math.inf)
        if self.delays is not None:
            self.delays.look_from(t + 1.0)
            self.delays.outputs_at(t, here.w)
        self._synchronize()
        if self.exchanged is not None:
            self.follow()
        if self.domains is not None:
            self.domains.begin(self.indicators(t, here.x[self.where])[0])
            if at_start:
                domain = self.domains.parts["domain"]
                domain[:] = domains_from_left(self.workspace, domain)
        if self.delays is not None:
            self.delays.note_edge(t)

    def _synchronize(self) -> None:
        here, trial = self.workspace.here, self.workspace.trial
        trial.x[:] = here.x
        trial.w[:] = here.w

    # --- events ------------------------------------------------------------------------------------------------------

    def report_own_event(self, t: float, path: str, name: str, before: np.ndarray, after: np.ndarray) -> None:
        """Report an event of a block in model exchange, with all states before and after it."""
        self.on_event(Occurrence(t, path, name, *(state_values(self.flat, path, x) for x in (before, after))))

    def follow(self) -> None:
        """Take over nominal values of states, which an event of a block in model exchange may have changed."""
        if self.where.size and not self.fixed and self.exchanged is not None:
            nominals = self.exchanged.nominals()
            if not np.array_equal(nominals, self._nominals):
                self._nominals = nominals
                self.method.set_absolute_tolerance(absolute_tolerances(self.flat, self.resolution[1], nominals))

    def report_event(self, t: float, i: int, before: np.ndarray, after: np.ndarray) -> None:
        """Report that event ``i`` has fired at t in s, with all states before and after it."""
        # An FMU hears of every crossing of its indicators. One that comes back at once over the zero beyond which the
        # last event was located, and that changes no state, is no event of the run.
        event = self.flat.events[i]
        states = [{} if event.subsystem else state_values(self.flat, event.path, x) for x in (before, after)]
        if event.path in self.flat.in_model_exchange and self.domains is not None:
            last, self._crossed[i] = self._crossed.get(i, -math.inf), t
            same = all(np.array_equal(value, states[1][name]) for name, value in states[0].items())
            if same and 0.0 <= t - last <= _AT_ONCE * self.domains.spacing:
                return
        self.on_event(Occurrence(t, event.path, event.name, *states))

    # --- functions of a trial, for errors and decisions --------------------------------------------------------------

    def stand_in(self, edge: float, left: float) -> None:
        """Let trials be seen within a stretch: up to a discontinuity, the edge, from its left; both in s."""
        self.method.stop, self._left = edge, left

    def put(self, t: float, x: np.ndarray) -> None:
        """Put the instant that is reached to a time in s, and to continuous states."""
        here = self.workspace.here
        here.t[0] = min(t, self._left)
        here.x[self.where] = x
        if self.delays is not None:
            self.delays.outputs_at(here.t[0], here.w)

    @cached_property
    def _flow(self) -> Callable[[float, np.ndarray], np.ndarray]:
        return self.workspace.flow()

    @cached_property
    def _jacobian(self) -> Callable[[float, np.ndarray], np.ndarray]:
        return self.workspace.jacobian()

    @cached_property
    def _indicators(self) -> tuple[Callable[[float, np.ndarray], np.ndarray], np.ndarray]:
        return self.workspace.indicators()

    def _time(self, t: float) -> float:
        t = min(t, self._left)  # a step may end a rounding error before the edge
        t = self.late.get(t, t)
        if self.delays is not None:
            self.delays.outputs_at(t, self.workspace.trial.w)
        if self._loops:  # whatever was tried in between: Newton's method starts from the last accepted solution
            self.workspace.trial.x[self._loops] = self.workspace.here.x[self._loops]
        return t

    def _rate(self, t: float, x: np.ndarray) -> np.ndarray:
        try:
            rates = self._flow(self._time(t), x)
        except FmuRuntimeError:
            raise
        except SimulationError:  # a loop without a solution
            rates = np.full(self.where.size, math.nan)
        if self._nothing.dot(rates) != 0.0:  # one of them is not finite
            self.beyond = (t, x.copy())
        return rates

    def _slope(self, t: float, x: np.ndarray) -> np.ndarray:
        return self._jacobian(self._time(t), x)

    def indicators(self, t: float, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the indicators at a trial, and 1 for each in an open subsystem."""
        evaluate, opened = self._indicators
        return evaluate(self._time(t), x).copy(), opened

    def change_of_indicators(self, t: float) -> tuple[float, np.ndarray]:
        """Return a time in s, and by how much the indicators change in it from the instant that is reached."""
        assert self.domains is not None
        self.stand_in(math.inf, math.inf)
        self._synchronize()
        h, x = self.domains.spacing, self.workspace.here.x[self.where]
        later = x + h * self._rate(t, x)
        return h, np.abs(self.indicators(t, later)[0] - self.indicators(t, x)[0])

    # --- parameters that change ------------------------------------------------------------------------------------

    def plan_with(self, path: str, block: Block) -> None:
        """Plan steps with the instants that a variant of a block announces; see `Workspace.set_parameters`."""
        # The longest step of the method follows from the time scale.
        if block.time_scale() != self.flat.table.blocks[path].time_scale():
            raise ParameterError(
                "the solver's longest step follows from how fast it changes, such as the frequency of a sine, so this "
                "can't change in a run. Start a run of diagram.replace(…).",
                block=path,
            )
        self._changed[path] = block
        self.sources = announcers(renumber(self.flat, self._changed))
        self.late = find_late(self.sources)

    # --- what is kept from step to step ------------------------------------------------------------------------------

    def save(self) -> dict[str, Any]:
        """Return what is needed to continue from here."""
        return {
            "domains": None if self.domains is None else self.domains.save(),
            "delays": None if self.delays is None else self.delays.save(),
            "method": self.method.save(),
        }

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Go back to what `save` returned."""
        if self.domains is not None and saved["domains"] is not None:
            self.domains.restore(saved["domains"])
        if self.delays is not None and saved["delays"] is not None:
            self.delays.restore(saved["delays"])
        self.method.restore(saved["method"])

    def fits(self, old: Mapping[str, Block], new: Mapping[str, Block]) -> bool:
        """Whether it fits variants of some blocks, by path: no tolerance and no limit of a step changes with them."""
        return self.delays is None and all(_scales_of(block) == _scales_of(old[path]) for path, block in new.items())

    def begin_again(self, flat: FlatDiagram) -> None:
        """Forget the run before: another one begins, with other numbers of the diagram."""
        self.flat, self.sources = flat, announcers(flat)
        self._changed.clear()
        self.late, self.beyond = find_late(self.sources), None
        self.stand_in(math.inf, math.inf)
        self.restore(self._fresh)
        self.method.begin_again()
        if self.domains is not None:
            self.domains.begin_again()


def find_edges(
    continuous: Continuous, t: float, end: float, *, limited: bool = True
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the discontinuities of sources from t to the first of each after the end; None if they are too many."""
    found = set[float]()
    for path, source in continuous.sources:
        edge = t
        while edge <= end and (edge := next_instant(path, source, edge)) < math.inf:
            found.add(edge)
            if limited and len(found) > _MOST_EDGES:
                return None
    if t in continuous.late:
        found.add(t)
    edges = np.array(sorted(found))
    return edges, np.array([continuous.late.get(float(edge), float(edge)) for edge in edges])


class EdgesAhead:
    """Discontinuities of sources, found once for a stretch of ticks, in however many calls C goes through it."""

    def __init__(self, continuous: Continuous):
        self._continuous = continuous
        self._begin, self._end = math.inf, -math.inf
        self._found = np.zeros(0), np.zeros(0)

    def until(self, t: float, end: float, *, limited: bool) -> tuple[np.ndarray, np.ndarray] | None:
        """Return those from t on, up to an end and the first one of each source after it; see `find_edges`."""
        if t < self._begin or end > self._end:
            found = find_edges(self._continuous, t, end, limited=limited)
            if found is None:
                return None
            self._begin, self._end, self._found = t, end, found
        edges, late = self._found
        first = int(np.searchsorted(edges, t, side="left" if t in self._continuous.late else "right"))
        return edges[first:], late[first:]


@dataclass
class _Saved:
    t: float
    x: np.ndarray
    continuous: Any
    exchanged: Mapping[str, bytes]
    messages: tuple[str, ...]
    events: int


class ContinuousPart:
    """The blocks in continuous time between two ticks: advanced, saved and restored; see `ContinuousRest`."""

    def __init__(self, workspace: Workspace, continuous: Continuous | None, exchanged: BlocksInModelExchange):
        self._workspace, self._continuous, self._exchanged = workspace, continuous, exchanged
        self._events: list[Occurrence] = []  # reported when they are accepted: a pass may be gone back over
        self.go_between: Callable[[float, float], float | None] | None = None
        """Takes them from one instant to another, as `HybridTicks.go_between`; None where nothing happens between."""
        if continuous is not None:
            self._report = continuous.on_event
            continuous.on_event = self._events.append

    def advance(self, t: float, end: float) -> float | None:
        """Go from t to the end, both in s; return the time at which a stop condition has ended the run."""
        if self._continuous is None:
            return None
        assert self.go_between is not None
        self._workspace.here.t[0] = t
        if self._continuous.delays is not None:
            self._continuous.delays.note_edge(t)  # the outputs of the plants have jumped
        return self.go_between(t, end)

    def save(self) -> _Saved:
        """Return the present state."""
        here, workspace = self._workspace.here, self._workspace
        continuous = None if self._continuous is None else self._continuous.save()
        try_steps(self._exchanged.blocks.values())
        exchanged = {path: block.serialize() for path, block in self._exchanged.blocks.items()}
        return _Saved(float(here.t[0]), here.x.copy(), continuous, exchanged, workspace.messages, len(self._events))

    def restore(self, saved: _Saved) -> None:
        """Go back to a state."""
        here, workspace = self._workspace.here, self._workspace
        here.t[0], here.x[:] = saved.t, saved.x
        workspace.messages = saved.messages
        del self._events[saved.events :]
        for path, block in self._exchanged.blocks.items():
            block.restore_bytes(saved.exchanged[path])
            block.refused = None
        if self._continuous is not None:
            self._continuous.restore(saved.continuous)

    def accept(self) -> None:
        """Report the events that have happened, and raise the error of an input that was out of its range."""
        accept_steps(self._exchanged.blocks.values())
        if self._events:
            for event in self._events:
                self._report(event)
            self._events.clear()


def _time_scale_of(flat: FlatDiagram) -> float:
    """Return the shortest time within which a source in a continuous subsystem changes."""
    table = flat.table
    paths = (p for p in flat.checked.traced if not table.is_sampled(table.subsystem_of[p]))
    return min((float(table.blocks[p].time_scale()) for p in paths), default=math.inf)


def remembers(flat: FlatDiagram) -> bool:
    """Whether a block in a continuous subsystem has a memory, such as a projection's last foot point."""
    table = flat.table
    return any(table.blocks[p].memory and not table.is_sampled(table.subsystem_of[p]) for p in flat.checked.traced)


def _has_guards(flat: FlatDiagram) -> bool:
    """Whether a block in a continuous subsystem has guards, which are looked at after every step."""
    table, traced = flat.table, flat.checked.traced
    return any(traced[p].guards and not table.is_sampled(table.subsystem_of[p]) for p in traced)


def absolute_tolerances(flat: FlatDiagram, atol: float, nominals: np.ndarray | None = None) -> Any:
    """Return the absolute tolerance of each continuous state: ``atol`` times its nominal value."""
    # ``nominals`` are those of the entries of x whose blocks declare none.
    scale = np.ones(flat.width) if nominals is None else nominals.copy()
    for path, own in flat.states.of_block.items():
        for name, where in own.slices.items():
            nominal = flat.table.blocks[path].states[name].nominal
            if nominal is not None:
                scale[where] = nominal
    scale = scale[flat.continuous]
    return atol if np.all(scale == 1.0) or np.ndim(atol) else atol * scale


def _longest_step(flat: FlatDiagram, max_step: float | None, time_scale: float, shortest_delay: float) -> float | None:
    """Return the longest step of a solver in s: that asked for, or what memories, sources and delays allow."""
    longest = max_step
    if longest is None and remembers(flat):
        longest = float(flat.base)  # memory is renewed at accepted steps, and must not grow stale
    if longest is None and time_scale < math.inf:
        longest = 5.0 * time_scale  # else a step may fit whole periods of a source
    if shortest_delay < math.inf:
        longest = min(longest or math.inf, shortest_delay)
    return longest


def find_late(sources: Sequence[tuple[str, Announcer]]) -> dict[float, float]:
    """Return the instants in s at which sources are seen at a time just after, and that time."""
    return {t: after for _, one in sources if isinstance(one, Times) for t, after in one.late.items()}


def next_instant(path: str, block: Announcer, t: float) -> float:
    """Return the next instant of a block; one that does not come after t would keep the run where it is."""
    try:
        found = block.next_instant(t)
        later = found > t
    except Exception as error:
        raise SimulationError(
            f"its next_instant({t!r}) failed: {type(error).__name__}: {error}. Expected a time after that, or math.inf "
            "if there is none.",
            block=path,
            t=t,
        ) from error
    if not later:
        raise SimulationError(
            f"its next_instant({t!r}) is {found!r}; expected a time after that, or math.inf if there is none.",
            block=path,
            t=t,
        )
    return found


def _scales_of(block: Block) -> object:
    """Return what a block contributes to tolerances and to the limit of a step."""
    return block.time_scale(), [identity(port.nominal) for port in block.states.values()]
