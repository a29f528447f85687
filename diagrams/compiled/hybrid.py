"""The compiled loop with continuous states: a method of integration, events and ticks, gone through in C."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from ..flat import NONE, FlatDiagram, StepTable, TickPattern
from .delays import NativeDelays, PastInputs
from .differences import Differences
from .functions import at
from .hybrid_code import Between, HybridCode
from .hybrid_structures import HybridStructure, MethodStructure, ProblemStructure, SpanStructure
from .library_method import LIBRARY_METHODS, USES_SLOPE, Failure, LibraryMethod
from .loop import CompiledLoop, NewtonOptions, NewtonStructure, OutcomeStructure
from .radau import radau_numbers
from .runtime import load_runtime
from .staged import NativeExchange
from .staged_functions import Staged, StagedSlopes
from .watch import Fired, Pile, Watch

FIXED = ("euler", "heun", "rk4")
_KINDS = {"euler": 0, "heun": 1, "rk4": 2, "RK23": 3, "RK45": 3, "DOP853": 4, "Radau": 5}
_KINDS |= dict.fromkeys(LIBRARY_METHODS, 6)
_SECONDS = 0.05  # of a call, about, after which Ctrl-C has its turn
_LIBRARY_STEP = 200_000  # ns that a library takes for a step, about
_UNKNOWN = 20  # steps of the first call beside FMUs that may take any time


class HybridReason(IntEnum):
    """Reasons for which the loop returns: those of `Reason`, and more."""

    DONE, FMU_FAILED, FMU_FLAGS, NOT_OK, STOPPED, HALTED, SUSPENDED, ASK_BETWEEN, ASK_TICK, ENDED, LOOK = range(11)
    ASK_REST, ASK_SETTLE, ASK_FIRE, OUTSIDE_FAILED, PILED_UP = range(11, 16)


@dataclass(frozen=True, eq=False)
class MethodOptions:
    """A method of integration.

    Attributes
    ----------
    name : str
        Its name: "euler", "heun", "rk4", "RK23", "RK45", "DOP853", "Radau", or one of `LIBRARY_METHODS`.
    rtol : float
        Relative tolerance.
    atol : ndarray, shape (n,)
        Absolute tolerances.
    longest : float
        Longest step in s; of a method of fixed step, its step.
    """

    name: str
    rtol: float
    atol: np.ndarray
    longest: float


class Span(NamedTuple):
    """Ticks and instants that are gone through in one call.

    Attributes
    ----------
    times : ndarray, shape (n + 1,)
        Time from which they go, and of each of them, in s.
    widths : ndarray, shape (n,)
        Length of each, in s.
    kinds : ndarray, shape (n,), of int32
        Clocks that act at each of them, as places in `CompiledHybrid.kinds`.
    lands : ndarray, shape (n,), of uint8
        0 where the instant is recorded from a step beyond it.
    beyond : float
        Time of the first one after them that is landed on, in s.
    edges, late : ndarray
        Discontinuities of sources in s, and when they are seen at the instant itself.
    steps : StepTable or None
        Steps of the plants that end at each; None where all plants step at each of them.
    """

    times: np.ndarray
    widths: np.ndarray
    kinds: np.ndarray
    lands: np.ndarray
    beyond: float
    edges: np.ndarray
    late: np.ndarray
    steps: StepTable | None = None


class HybridOutcome(NamedTuple):
    """Where and why the loop has returned; see `Outcome`.

    ``t`` is the time in s that the states have reached.
    """

    ticks: int
    rows: int
    reason: HybridReason
    plant: int
    stage: int
    status: int
    t: float


class CompiledHybrid:
    """The loop over ticks with continuous states, bound to the numbers of a run.

    Parameters
    ----------
    code : HybridCode
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
    spacing : float
        Longest time in s between two instants at which indicators of events are evaluated.
    own : sequence of ndarray
        For each event: the places of its block's states among the integrated ones.
    loops : NewtonOptions, optional
        Newton's method for the algebraic loops between ticks, where there are some.
    exchange : NativeExchange, optional
        FMUs in model exchange, where there are some.
    accepts : {0, 1, 2}
        Whether blocks are to be evaluated after every step (1): they remember something, have guards, may fail, or FMUs
        read them; or after every one that ends between ticks (2).
    delays : PastInputs, optional
        The memory of transport delays, where there are some; their inputs are kept within ``tolerances``, relative and
        absolute.
    """

    def __init__(
        self,
        code: HybridCode,
        flat: FlatDiagram,
        loop: CompiledLoop,
        arguments: Sequence[np.ndarray],
        x_next: np.ndarray,
        methods: Sequence[MethodOptions],
        *,
        step: float | None,
        spacing: float,
        own: Sequence[np.ndarray],
        accepts: int,
        loops: NewtonOptions | None = None,
        exchange: NativeExchange | None = None,
        delays: PastInputs | None = None,
        tolerances: tuple[float, float] = (0.0, 0.0),
    ):
        self.ticks, self._kept = loop, list[Any]([code, arguments, x_next])
        self.kinds: Mapping[frozenset[TickPattern], int] = loop.kinds
        n, width, (_, x, w, p) = flat.continuous.size, flat.width, arguments
        trial = [np.zeros(1), x.copy(), w if delays is None else w.copy(), p]
        where = self._own(flat.continuous.astype(np.int64))
        slope = code.between.get("slope")
        slopes = np.zeros(0 if slope is None else n * n if loops else len(slope.pattern[0]))
        self._hybrid = hybrid = HybridStructure(l=loop.structure, automatic=len(methods) > 1, accepts=accepts)
        self._exchange, hybrid.looked = exchange, np.nan
        self._solver: NewtonStructure | None = None
        self._tolerances = list[np.ndarray]()
        hybrid.budget = self._largest_budget = _budget(code.between["flow"].operations, methods, n)
        if exchange is not None:
            hybrid.budget = min(hybrid.budget, _UNKNOWN)
        hybrid.between = self.kinds[NONE]
        hybrid.p = ProblemStructure(
            n=n,
            width=width,
            where=where,
            flow=self._bind(code.between["flow"], trial, [np.zeros(n)]),
            t=self._own(trial[0]),
            x=self._own(trial[1]),
            slopes=self._own(slopes),
        )
        self._delays: NativeDelays | None = None
        if delays is not None:
            driven = np.zeros(flat.plant_inputs.total)
            bound = self._bind(code.between["driven"], trial, [driven])
            self._delays = NativeDelays(delays, bound, driven, w, trial[2], tolerances)
            hybrid.p.delays = self._delays.address
        results = [slopes]
        if loops is not None:
            m = len(loops.where)
            self._solver = loop.bind_loops(code.ticks, NONE, trial, loops)
            hybrid.p.loops, hybrid.p.here = ctypes.addressof(self._solver), at(x)
            hybrid.solved = self._own(np.zeros(m))
            if not isinstance(slope, StagedSlopes):
                through = np.zeros(2 * n * m)
                hybrid.p.by_loops = self._own(through)
                results += [through[: n * m], through[n * m :], np.zeros(m * m)]
        if slope is not None:
            typical = np.maximum(np.abs(methods[-1].atol) / methods[-1].rtol, 1e-300)
            hybrid.p.slope = self._bind(slope, trial, results, typical)
            if loops is None or isinstance(slope, StagedSlopes):
                rows, columns = slope.pattern
                hybrid.p.entries = len(rows)
                hybrid.p.row, hybrid.p.column = (self._own(np.array([*v, 0], dtype=np.int64)) for v in (rows, columns))
        of = ctypes.addressof(hybrid) + HybridStructure.p.offset
        self.methods = [self._method(options, n, of, code.steps.get(options.name)) for options in methods]
        self._names = [options.name for options in methods]
        self._libraries = {
            i: LibraryMethod(one.name, one.rtol, one.atol, one.longest, flat.continuous_labels, hybrid.p, method)
            for i, (one, method) in enumerate(zip(methods, self.methods, strict=True))
            if one.name in LIBRARY_METHODS
        }
        if self._libraries:
            loop.calls_python = True
        for i, method in enumerate(self.methods):
            hybrid.methods[i] = ctypes.addressof(method)
        hybrid.before = self._own(np.zeros(width))
        hybrid.outputs = flat.log.total
        self.watch: Watch | None = None
        """The events; None without any."""
        if flat.events:
            self.watch = Watch(
                flat, code.between, trial, arguments, x_next, spacing=spacing, step=step, own=own, exchange=exchange
            )
            hybrid.w = self.watch.structure
        if exchange is not None:
            jump = code.between["jump"]
            assert isinstance(jump, Staged)
            fired = np.zeros(0) if self.watch is None else self.watch.fired
            exchange.bind_jump(jump, [*arguments, fired], [x_next])
            hybrid.o = ctypes.addressof(exchange.structure)
        taken = [flat.taken_at(clocks) for clocks in self.kinds]
        self.taken_states = self._zeros(width)
        """All states that a tick leaves, before the events behind it."""
        hybrid.taken = self._own(np.concatenate([np.zeros(0), *taken]).astype(np.int64))
        hybrid.taken_first = self._own(np.cumsum([0, *map(len, taken)]).astype(np.int64))
        hybrid.taken_states = self._own(self.taken_states)
        self._outcome = OutcomeStructure()
        self._run, self._guard = load_runtime()["loopwright_go"], loop.guard
        self._run.restype = None
        self._fresh = [(structure, bytes(structure)) for structure in (hybrid, *self.methods)]

    def begin_anew(self) -> None:
        """Forget the run before: methods have no step in mind, and no sign of stiffness has been seen."""
        for structure, content in self._fresh:
            ctypes.memmove(ctypes.addressof(structure), content, len(content))
        for library in self._libraries.values():
            library.begin_anew()

    def _zeros(self, n: int) -> np.ndarray:
        self._kept.append(np.zeros(n))
        return self._kept[-1]  # type: ignore[no-any-return]

    def _own(self, values: np.ndarray) -> int | None:
        self._kept.append(values)
        return at(values)

    def _bind(
        self,
        function: Between,
        arguments: Sequence[np.ndarray],
        results: Sequence[np.ndarray],
        typical: np.ndarray | None = None,
    ) -> Any:
        if self._exchange is not None and isinstance(function, Staged):
            return self._exchange.bind(function, arguments, results)
        if self._exchange is not None and isinstance(function, StagedSlopes):
            assert typical is not None
            return self._exchange.bind_slopes(function, arguments, results, typical, self._solver)
        assert not isinstance(function, Staged | StagedSlopes)
        if isinstance(function, Differences):
            assert typical is not None
            bound = function.bind(arguments, results, typical)
        else:
            bound = function.bind(arguments, results)
        self._kept.append(bound)
        return bound.structure

    def _method(self, options: MethodOptions, n: int, of: int, step: int | None) -> MethodStructure:
        import scipy.integrate

        name = options.name
        made = MethodStructure(
            kind=_KINDS[name], n=n, of=of, rtol=options.rtol, longest=options.longest, planned=np.nan, step=step
        )
        self._tolerances.append(np.broadcast_to(options.atol, (n,)).astype(float))
        made.atol = self._own(self._tolerances[-1])
        if name in ("RK23", "RK45", "DOP853"):
            of_scipy = getattr(scipy.integrate, name)
            stages = made.stages = of_scipy.n_stages
            made.exponent = of_scipy.error_estimator_order
            A = np.zeros((stages, stages))
            A[:, : of_scipy.A.shape[1]] = of_scipy.A
            made.A, made.B, made.C = (self._own(np.array(a, dtype=float)) for a in (A, of_scipy.B, of_scipy.C))
            if name == "DOP853":
                made.extra, made.order = len(of_scipy.C_EXTRA), 7
                made.E, made.E3, made.P = (
                    self._own(np.array(a, dtype=float)) for a in (of_scipy.E5, of_scipy.E3, of_scipy.D)
                )
                made.A_extra, made.C_extra = (
                    self._own(np.array(a, dtype=float)) for a in (of_scipy.A_EXTRA, of_scipy.C_EXTRA)
                )
            else:
                made.order = of_scipy.P.shape[1]
                made.E, made.P = (self._own(np.array(a, dtype=float)) for a in (of_scipy.E, of_scipy.P))
        elif name == "Radau":
            made.order, made.exponent = 3, 3
            made.A = self._own(radau_numbers())
            made.tolerance = max(10 * np.finfo(float).eps / options.rtol, min(0.03, options.rtol**0.5))
            made.J, made.lu, made.lu_complex = (self._own(np.zeros(k * n * n)) for k in (1, 1, 2))
            made.Z, made.W, made.F = (self._own(np.zeros(3 * n)) for _ in range(3))
            made.error, made.scale = (self._own(np.zeros(n)) for _ in range(2))
            made.pivots, made.pivots_complex = (self._own(np.zeros(n, dtype=np.int64)) for _ in range(2))
        for field in ("x", "x_old", "f", "y", "g"):
            setattr(made, field, self._own(np.zeros(n)))
        made.K, made.D = self._own(np.zeros(17 * n)), self._own(np.zeros(7 * n))
        return made

    # --- going on ----------------------------------------------------------------------------------------------------

    def begin(self, t: float) -> None:
        """Begin an interval at a tick, or at any instant between two, that the run has reached."""
        self._hybrid.inside, self._hybrid.t = 0, t

    @property
    def fired_times(self) -> int:
        """Number of instants at which events have fired."""
        return int(self._hybrid.w.fired_times)

    @fired_times.setter
    def fired_times(self, count: int) -> None:
        self._hybrid.w.fired_times = count

    @property
    def sliding(self) -> tuple[bool, bool]:
        """Whether events of a fixed step wait for its end, and whether one has fired there; see `Sliding`."""
        return bool(self._hybrid.w.sliding), bool(self._hybrid.w.switched)

    @sliding.setter
    def sliding(self, state: tuple[bool, bool]) -> None:
        self._hybrid.w.sliding, self._hybrid.w.switched = state

    @property
    def pile(self) -> tuple[Pile, int, int]:
        """How events have piled up, the event that is to blame, and how many times in a row."""
        return Pile(self._hybrid.w.pile), int(self._hybrid.w.culprit), int(self._hybrid.w.piled)

    def take_fired(self) -> list[Fired]:
        """Return the events that have fired since the last call."""
        return [] if self.watch is None else self.watch.take(self._hybrid.w)

    def take_steps(self, steps: Mapping[str, int]) -> None:
        """Take generated steps of the methods, by name; to the last bit they do what the methods do."""
        for method, name in zip(self.methods, self._names, strict=True):
            method.step = steps.get(name)

    def plan(self, steps: Sequence[float | None]) -> None:
        """Let the methods take steps of some lengths in s next; None: they choose their first step."""
        for method, step in zip(self.methods, steps, strict=True):
            method.planned = np.nan if step is None else step

    @property
    def left(self) -> float | None:
        """Time in s from the left of the discontinuity that has been reached; None where there is none."""
        problem = self._hybrid.p
        return float(problem.left) if problem.edge == self._hybrid.t else None

    def set_tolerances(self, methods: Sequence[MethodOptions]) -> None:
        """Take other absolute tolerances of the methods."""
        for i, (vector, options) in enumerate(zip(self._tolerances, methods, strict=True)):
            vector[:] = options.atol
            if i in self._libraries:
                self._libraries[i].set_absolute_tolerance(options.atol)

    def limit_budget(self, spent: float) -> None:
        """Let calls take fewer steps if one has taken long, in s; FMUs may take any time for an evaluation."""
        if spent > 2 * _SECONDS:
            self._hybrid.budget = max(1, int(self._hybrid.budget * _SECONDS / spent))
        elif spent < 0.5 * _SECONDS:
            self._hybrid.budget = min(2 * self._hybrid.budget, self._largest_budget)

    def take_failure(self) -> Failure | None:
        """Return why a method of another library could not take the last step; None if nothing failed."""
        return next((failure for one in self._libraries.values() if (failure := one.take_failure())), None)

    @property
    def active(self) -> int:
        """Place of the method that goes on."""
        return int(self._hybrid.active)

    @active.setter
    def active(self, place: int) -> None:
        if place != self._hybrid.active:
            self._hybrid.active, self._hybrid.hits, self._hybrid.misses, self._hybrid.easy = place, 0, 0, 0

    def looked_at(self) -> float:
        """Return the step in s at which the problem has seemed stiff, or no longer; going on is possible then."""
        self._hybrid.switched = 0
        return float(self._hybrid.looked_at)

    @property
    def planned(self) -> list[float | None]:
        """Steps in s that the methods would take next."""
        return [None if np.isnan(method.planned) else float(method.planned) for method in self.methods]

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
        steps, rejected = (sum(getattr(m, name) for m in self.methods) for name in ("steps", "rejected"))
        return steps, rejected, self._hybrid.p.rates, self._hybrid.p.jacobians

    def run(self, span: Span, rows: np.ndarray) -> HybridOutcome:
        """Go through ticks and instants between them, at most as many as there are rows to be written.

        Parameters
        ----------
        rows : ndarray, shape (m, 1 + width)
            Samples: their time in s, then their values.
        """
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
        )
        self.ticks.set_steps(span.steps)
        found = self._outcome
        if self._delays is not None:
            self._delays.hand_over(self._hybrid.t)
        with self._guard():
            self._run(ctypes.byref(self._hybrid), ctypes.byref(given), ctypes.c_void_p(at(rows)), ctypes.byref(found))
        if self._delays is not None:
            self._delays.take_back()
        return HybridOutcome(
            found.ticks, found.rows, HybridReason(found.reason), found.plant, found.stage, found.status, self._hybrid.t
        )


def _budget(flow: int, methods: Sequence[MethodOptions], n: int) -> int:
    """Return the steps of a call: an operation takes about 1 ns, and so does one of the factors of a Jacobian."""
    step = 100 + 15 * flow + (4 * n**3 if any(m.name in USES_SLOPE for m in methods) else 0)
    if any(m.name in LIBRARY_METHODS for m in methods):
        step += _LIBRARY_STEP
    return max(10, int(_SECONDS * 1e9 / step))
