"""The loop over time in C: a method of integration, events and ticks, bound to the numbers of a run."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from ..flat import NONE, FlatDiagram, StepTable, TickPattern
from ..solvers import METHODS, MethodKind
from .bound_functions import CALL, MemoryForC, at
from .compiled_libraries import load_runtime
from .diagram_code import DiagramCode
from .differential_equation import DifferentialEquation
from .event_domains import Domains
from .events_in_c import Fired, Pile, Watch
from .hybrid_structures import HybridStructure, SpanStructure
from .integration_methods import IntegrationMethod, MethodOptions, StepFailure
from .loop_over_ticks import CompiledLoop, Outcome, OutcomeStructure
from .model_exchange_in_c import NativeModelExchange
from .newton import NewtonOptions
from .transport_delays import Delays

_SECONDS = 0.05  # of a call, about, after which Ctrl-C has its turn
_LIBRARY_STEP = 200_000  # ns that a library takes for a step, about
_UNKNOWN = 20  # steps of the first call next to FMUs that may take any time


class Lost(IntEnum):
    """What can't be done where the loop breaks off: see problem.c."""

    NOWHERE, IN_STEP, IN_PROGRESS, IN_SLOPE, AT_TRIAL, AT_INSTANT = range(6)


class Sign(IntEnum):
    """Signs that another method may continue: the problem is stiff, no longer, or this method can take no step."""

    NONE, STIFF, EASY, STUCK = range(4)


class BrokenOff(NamedTuple):
    """Where and why the loop has broken off."""

    lost: Lost
    acting: frozenset[TickPattern] | None  # at an instant: the clocks that act; None where too seldom for code
    method: str
    t_old: float  # begin and end of its last step, in s, and the continuous states there
    t: float
    x_old: np.ndarray
    x: np.ndarray
    trial_t: float  # the trial: its time in s, and the continuous states
    trial_x: np.ndarray
    beyond: tuple[float, np.ndarray] | None  # the last trial with a rate that was not finite
    step: float  # mean length of the last steps in s, of a run that does not get on
    edge: float  # the end of the stretch in s, and the last time before it
    left: float


class Span(NamedTuple):
    """Ticks and instants that are gone through in one call; times in s."""

    times: np.ndarray  # shape (n + 1,): from where they go, and of each of them
    widths: np.ndarray  # shape (n,): length of each
    kinds: np.ndarray  # shape (n,), int32: clocks that act, as places in `CompiledHybrid.kinds`
    lands: np.ndarray  # shape (n,), uint8: 0 where the instant is recorded from a step beyond it
    beyond: float  # time of the first one after them that is landed on
    edges: np.ndarray  # discontinuities of sources
    late: np.ndarray  # when these are seen at the instant itself
    steps: StepTable | None = None  # of the plants, that end at each; None: all plants step at each
    stays: bool = False  # the run is at the first tick, so that no plant steps to it


class CompiledHybrid:
    """The loop over ticks with continuous states, bound to the numbers of a run.

    Parameters
    ----------
    code : DiagramCode
        The functions.
    flat : FlatDiagram
        The diagram.
    loop : CompiledLoop
        Its ticks, bound to the run.
    arguments : sequence of ndarray
        The vectors (t, x, w, p) of the run.
    x_next : ndarray
        Where jumps write the next states.
    methods : sequence of MethodOptions
        The method, and, where it may be changed for one that is made for stiff problems, that one.
    step : float or None
        Fixed step of the method in s; None where it chooses its steps.
    domains : Domains, optional
        What is kept of events, where there are some.
    loops : NewtonOptions, optional
        Newton's method for the algebraic loops between ticks, where there are some.
    exchange : NativeModelExchange, optional
        FMUs in model exchange, where there are some.
    accepts : {0, 1, 2}
        Whether blocks are to be evaluated after every step (1): they remember something, have guards, may fail, or FMUs
        read them; or after every one that ends between ticks (2).
    delays : Delays, optional
        The memory of transport delays, where there are some; their inputs are kept within ``tolerances``, relative and
        absolute.
    drain : callable
        Called where no more events can be logged: takes those that have been.
    coupled : bool
        Whether the continuous states continue within the steps of the plants, by `run_between`.
    logged : int, optional
        Bytes of events that have fired, which are taken before there are more; see `Watch`.
    """

    def __init__(
        self,
        code: DiagramCode,
        flat: FlatDiagram,
        loop: CompiledLoop,
        arguments: Sequence[np.ndarray],
        x_next: np.ndarray,
        methods: Sequence[MethodOptions],
        *,
        step: float | None,
        domains: Domains | None,
        accepts: int,
        loops: NewtonOptions | None = None,
        exchange: NativeModelExchange | None = None,
        delays: Delays | None = None,
        tolerances: tuple[float, float] = (0.0, 0.0),
        drain: Callable[[], None],
        coupled: bool = False,
        logged: int | None = None,
    ):
        n, width = flat.continuous.size, flat.width
        self.ticks, self.kinds = loop, loop.kinds
        self._memory = memory = MemoryForC(code, arguments, x_next)
        self._exchange = exchange
        self._hybrid = hybrid = HybridStructure(l=loop.structure, automatic=len(methods) > 1, accepts=accepts)
        hybrid.between, hybrid.looked, hybrid.coupled = self.kinds[NONE], np.nan, coupled
        hybrid.outputs = flat.log.total
        hybrid.budget = self._largest_budget = _budget(code.operations_of_rates, methods, n)
        if exchange is not None:
            hybrid.budget = min(hybrid.budget, _UNKNOWN)
        typical = np.maximum(np.abs(methods[-1].atol) / methods[-1].rtol, 1e-300)
        self._equation = DifferentialEquation(
            code,
            flat,
            loop,
            arguments,
            typical=typical,
            loops=loops,
            exchange=exchange,
            delays=delays,
            tolerances=tolerances,
        )
        hybrid.p = self._equation.structure
        if loops is not None:
            hybrid.solved = memory.zeros(len(loops.where))
        # Each method integrates the one problem; those of libraries are asked for steps by a callback into Python.
        labels = flat.continuous_labels
        self.methods = [IntegrationMethod(one, hybrid.p, labels, code.steps.get(one.name)) for one in methods]
        for i, method in enumerate(self.methods):
            hybrid.methods[i] = ctypes.addressof(method.structure)
            loop.calls_python = loop.calls_python or method.library is not None
        hybrid.before = memory.zeros(width)
        hybrid.drain = loop.called.function(CALL, drain)
        # Events come last: their jumps read the vectors above, and those of FMUs in model exchange fire with them.
        self.watch: Watch | None = None
        """The events; None without any."""
        trial = self._equation.trial
        if domains is not None:
            size = {} if logged is None else {"logged": logged}
            self.watch = Watch(
                flat, code.between, trial, arguments, x_next, domains=domains, step=step, exchange=exchange, **size
            )
            hybrid.w = self.watch.structure
        if exchange is not None:
            fired = np.zeros(0) if self.watch is None else self.watch.fired
            jump = memory.bind(code.between["jump"], [*arguments, fired], [x_next], exchange.bind_block)
            exchange.structure.jump = jump
            hybrid.o = ctypes.addressof(exchange.structure)
        taken = [*(flat.taken_at(clocks) for clocks in self.kinds), np.arange(width)]
        self.taken_states = np.zeros(width)
        """All states that a tick leaves, before the events behind it."""
        self._taken = np.concatenate([np.zeros(0), *taken]).astype(np.int64)
        self._taken_first = np.cumsum([0, *map(len, taken)]).astype(np.int64)
        hybrid.taken, hybrid.taken_first = memory.own(self._taken), memory.own(self._taken_first)
        hybrid.taken_states = memory.own(self.taken_states)
        self._outcome = OutcomeStructure()
        library = load_runtime()
        self._run, self._run_between, self._note_beyond = (
            library[f"loopwright_{name}"] for name in ("go", "go_between", "note_beyond")
        )
        self._run.restype = self._run_between.restype = self._note_beyond.restype = None
        structures = (hybrid, *(method.structure for method in self.methods))
        self._fresh = [(structure, bytes(structure)) for structure in structures]

    @property
    def structure(self) -> HybridStructure:
        """The loop as C knows it."""
        return self._hybrid

    @property
    def kept(self) -> list[Any]:
        """All that lives as long as the loop: whatever its pointers lead to."""
        events = [] if self.watch is None else self.watch.kept
        methods = [part for method in self.methods for part in (method.structure, method.kept)]
        return [*self.ticks.kept, *self._memory.kept, *self._equation.kept, *events, *methods]

    def note_taken(self, states: np.ndarray) -> None:
        """Note which states the tick renews that Python has just evaluated for C; see `CompiledLoop`."""
        first = self._taken_first[-2]
        self._taken_first[-1] = first + len(states)
        self._taken[first : first + len(states)] = states

    def begin_again(self) -> None:
        """Forget the run before: methods have no step in mind, and no sign of stiffness has been seen."""
        for structure, content in self._fresh:
            ctypes.memmove(ctypes.addressof(structure), content, len(content))
        for method in self.methods:
            if method.library is not None:
                method.library.begin_again()

    # --- continuing ------------------------------------------------------------------------------------------------

    def begin(self, t: float) -> None:
        """Begin an interval at a tick, or at any instant between two, that the run has reached."""
        self._hybrid.inside, self._hybrid.t = 0, t

    def hand_over_domains(self, domains: Domains) -> None:
        """Let C continue with what is kept of events, apart from its arrays."""
        watch = self._hybrid.w
        watch.fired_times, (watch.sliding, watch.switched) = domains.fired_times, domains.sliding

    def take_back_domains(self, domains: Domains) -> None:
        """Let Python continue with what is kept of events, apart from its arrays."""
        watch = self._hybrid.w
        domains.fired_times, domains.sliding = int(watch.fired_times), (bool(watch.sliding), bool(watch.switched))

    @property
    def pile(self) -> tuple[Pile, int, int]:
        """How events have piled up, the event that is to blame, and how many times in a row."""
        return Pile(self._hybrid.w.pile), int(self._hybrid.w.culprit), int(self._hybrid.w.piled)

    def own_event(self, place: int) -> str:
        """Return the name of the last event that an FMU in model exchange has had by itself, by its place."""
        assert self._exchange is not None
        return self._exchange.name_of_event(place)

    def take_fired(self) -> list[Fired]:
        """Return the events that have fired since the last call."""
        return [] if self.watch is None else self.watch.take(self._hybrid.w)

    def take_steps(self, steps: Mapping[str, int]) -> None:
        """Take generated steps of the methods, by name; to the last bit they do what the methods do."""
        for method in self.methods:
            method.structure.step = steps.get(method.name)

    def plan(self, steps: Sequence[float | None]) -> None:
        """Let the methods take steps of some lengths in s next; None: they choose their first step."""
        for method, step in zip(self.methods, steps, strict=True):
            method.structure.planned = np.nan if step is None else step

    def set_tolerances(self, methods: Sequence[MethodOptions]) -> None:
        """Take other absolute tolerances of the methods."""
        for method, options in zip(self.methods, methods, strict=True):
            method.set_absolute_tolerance(options.atol)

    def limit_budget(self, spent: float) -> None:
        """Let calls take fewer steps if one has taken long, in s; FMUs may take any time for an evaluation."""
        if spent > 2 * _SECONDS:
            self._hybrid.budget = max(1, int(self._hybrid.budget * _SECONDS / spent))
        elif spent < 0.5 * _SECONDS:
            self._hybrid.budget = min(2 * self._hybrid.budget, self._largest_budget)

    def take_failure(self) -> StepFailure | None:
        """Return why a method of another library could not take the last step; None if nothing failed."""
        libraries = [method.library for method in self.methods if method.library is not None]
        return next((failure for one in libraries if (failure := one.take_failure())), None)

    @property
    def active(self) -> int:
        """Place of the method that continues."""
        return int(self._hybrid.active)

    @active.setter
    def active(self, place: int) -> None:
        if place != self._hybrid.active:
            self._hybrid.active, self._hybrid.hits, self._hybrid.misses, self._hybrid.easy = place, 0, 0, 0

    def take_sign(self) -> tuple[Sign, float]:
        """Return the sign that another method may continue, and the step in s at which it came; C may continue then."""
        sign, self._hybrid.switched = Sign(self._hybrid.switched), Sign.NONE
        return sign, float(self._hybrid.looked_at)

    def broken_off(self) -> BrokenOff:
        """Return where and why the loop has broken off."""
        hybrid = self._hybrid
        problem, method, n = hybrid.p, self.methods[hybrid.active].structure, hybrid.p.n
        where = self._equation.where
        lost, step = Lost(problem.lost), float(problem.beyond_t)
        with self.ticks.plants.guard():
            if lost is Lost.IN_STEP:
                self._note_beyond(ctypes.byref(hybrid))
        beyond = None if lost is not Lost.IN_STEP or np.isnan(problem.beyond_t) else problem.beyond_t
        x_old, x = (
            np.array((ctypes.c_double * n).from_address(a)) if n else np.zeros(0) for a in (method.x_old, method.x)
        )
        clocks = next((clocks for clocks, kind in self.kinds.items() if kind == hybrid.lost_at), None)
        return BrokenOff(
            lost,
            clocks,
            self.methods[hybrid.active].name,
            method.t_old,
            method.t,
            x_old,
            x,
            float(self._equation.trial[0][0]),
            self._equation.trial[1][where].copy(),
            None if beyond is None else (beyond, self._equation.beyond.copy()),
            step,
            problem.edge,
            problem.left,
        )

    @property
    def coupled(self) -> bool:
        """Whether the continuous states continue within the steps of the plants."""
        return bool(self._hybrid.coupled)

    @property
    def planned(self) -> list[float | None]:
        """Steps in s that the methods would take next."""
        planned = [method.structure.planned for method in self.methods]
        return [None if np.isnan(step) else float(step) for step in planned]

    @property
    def skip(self) -> int:
        """Samples to leave out before the next one that is kept."""
        return int(self._hybrid.l.skip)

    @skip.setter
    def skip(self, count: int) -> None:
        self._hybrid.l.skip = count

    @property
    def counts(self) -> tuple[int, int, int, int]:
        """Steps that were taken and rejected, and evaluations of the rates and of their derivative."""
        steps, rejected = (sum(getattr(m.structure, name) for m in self.methods) for name in ("steps", "rejected"))
        return steps, rejected, self._hybrid.p.rates, self._hybrid.p.jacobians

    def run(self, span: Span, rows: np.ndarray) -> Outcome:
        """Go through ticks and instants between them, at most as many as ``rows``, each t in s, then values."""
        return self._go(self._run, span, rows, self._outcome)

    def run_between(self, span: Span, rows: np.ndarray) -> Outcome:
        """Go to the end of a span, before a tick there, while `run` waits for the plants; see `run`."""
        return self._go(self._run_between, span, rows, OutcomeStructure())

    def _go(self, run: Any, span: Span, rows: np.ndarray, found: OutcomeStructure) -> Outcome:
        given = SpanStructure(
            count=len(span.widths),
            times=at(span.times),
            widths=at(span.widths),
            kinds=at(span.kinds),
            lands=at(span.lands),
            beyond=span.beyond,
            edges=len(span.edges),
            edge=at(span.edges),
            late=at(span.late),
            room=len(rows),
            stays=span.stays,
        )
        if span.steps is not None:
            self.ticks.set_steps(span.steps)
        delays = self._equation.delays
        if delays is not None:
            delays.hand_over(self._hybrid.t)
        with self.ticks.plants.guard():
            run(ctypes.byref(self._hybrid), ctypes.byref(given), ctypes.c_void_p(at(rows)), ctypes.byref(found))
        if delays is not None:
            delays.take_back()
        return found.read(self._hybrid.t)


def _budget(flow: int, methods: Sequence[MethodOptions], n: int) -> int:
    """Return the steps of a call: an operation takes about 1 ns, and so does one of the factors of a Jacobian."""
    step = 100 + 15 * flow + (4 * n**3 if any(METHODS[m.name].uses_slope for m in methods) else 0)
    if any(METHODS[m.name].kind is MethodKind.LIBRARY for m in methods):
        step += _LIBRARY_STEP
    return max(10, int(_SECONDS * 1e9 / step))
