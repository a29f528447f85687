"""Between two ticks: the solver, events, discontinuities of sources, transport delays."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import OptionError, SimulationError, is_before, left_of
from ..events import Domains, ManyInstants, Sliding
from ..exchange import ExchangedBlocks, OutsideEvents
from ..flat import announcers
from ..results import Occurrence
from ..solvers import AcceptedStep, Problem, make_solver
from .diagnosis import forget_trials, opaque_failure, state_values
from .initialize import domains_from_left
from .solver_setup import (
    Memory,
    NextInstants,
    absolute_tolerances,
    find_late,
    has_guards,
    longest_step,
    remembers,
    time_scale_of,
)
from .transport_delays import delays_of, keep_step
from .trials import Trials
from .workspace import Workspace

if TYPE_CHECKING:
    from ..compiled import Failure

_ULPS = 16
"""An event within so many ulps of a tick or of a sample belongs to it."""
_AT_ONCE = 1e-6
"""Part of the time between two samples within which an indicator has come back at once."""
_NO_EVENTS = np.zeros(0, dtype=bool)
NOTHING: frozenset[Any] = frozenset()
TIGHT, ONE_STEP = 1e-9, ("auto", "RK23", "RK45", "DOP853", "Radau")
"""Below this relative tolerance these methods, to which a stop costs little, land on every sample."""


class Continuous(Trials, Memory):
    """The continuous part of a run.

    Parameters
    ----------
    workspace : Workspace
        The run's numbers and functions.
    name : str
        The diagram's name.
    solver, rtol, atol, max_step
        See `Diagram.simulate`.
    on_event : callable
        Told every event that fires.
    is_stopped : callable
        Tells whether a stop condition is true in what was evaluated last.
    exchanged : ExchangedBlocks, optional
        Blocks that are evaluated from outside.
    """

    def __init__(
        self,
        workspace: Workspace,
        name: str,
        solver: str,
        rtol: float,
        atol: float,
        max_step: float | None,
        on_event: Callable[[Occurrence], None],
        is_stopped: Callable[[], bool],
        exchanged: ExchangedBlocks | None = None,
    ):
        flat = workspace.flat
        self.workspace, self.flat, self.name = workspace, flat, name
        self.on_event, self.is_stopped = on_event, is_stopped
        self.where = flat.continuous
        self._edge, self._left, self._sources_edge = math.inf, math.inf, math.inf
        self._beyond, self._nothing = None, np.zeros(self.where.size)
        self.resolution = rtol, atol
        self._loops = flat.active_loops(NOTHING)
        self._opaque = any(flat.table.blocks[path].opaque for path in flat.checked.traced)
        self.delays = delays_of(flat)
        self._jacobian = None
        problem = Problem(self.where.size, self._rate, self._slope, flat.continuous_labels)
        self.time_scale = time_scale_of(flat)
        shortest = math.inf if self.delays is None else self.delays.shortest
        longest = longest_step(flat, max_step, self.time_scale, shortest)
        self.solver = make_solver(
            solver,
            problem,
            rtol=rtol,
            atol=absolute_tolerances(flat, atol),
            step=float(flat.base),
            max_step=longest,
        )
        self.fixed = self.solver.fixed
        self.sliding = Sliding(float(flat.base) if self.fixed else None)
        self.lands = rtol < TIGHT and self.solver.name in ONE_STEP
        """Whether the solver lands on every sample: the dense output is of lower order than the step."""
        if self.fixed and self.delays is not None and float(flat.base) > self.delays.shortest * (1 + 1e-12):
            raise OptionError(
                f"the step of {float(flat.base):g} s is longer than a transport delay of {self.delays.shortest:g} s. "
                "Take a smaller step, or a solver of variable step.",
                block=name,
                port="step",
            )
        self.domains: Domains | None = None
        if flat.events:
            self._indicators, self._opened = workspace.indicators()
            plain = len(flat.indicators.stages) == 1 and not (self.delays or self._loops or self._opaque)
            many = ManyInstants(flat, workspace.trial, self._time) if plain else self._g_many
            self.domains = Domains(flat, self._g, many, self._rate, self._opened, self.time_scale)
        if flat.events or flat.outside:
            self._jump = workspace.bind_jump()
        self.outside: OutsideEvents | None = None
        """Events of blocks that are evaluated from outside; None without such blocks."""
        self.exchanged = exchanged if exchanged else None
        """Blocks that are evaluated from outside; None without any."""
        if exchanged:
            self._nominals = np.zeros(0)
            self.outside = OutsideEvents(exchanged, workspace.here.x, self._jump, self.tell_outside, self.follow)
        if self.delays is not None:
            self._driven = np.zeros(flat.plant_inputs.total)
            self._drive = workspace.plain(flat.driven, [self._driven], workspace.trial)
        self.sources = announcers(flat)
        self._looked = math.nan
        """Tick at which blocks from outside have been looked at, and before which nothing changes any more."""
        plain = not (flat.events or self.delays or self._loops or self._opaque or flat.plant_inputs.total)
        self._accepts = not plain or remembers(flat) or has_guards(flat)
        """Whether a step that ends at a tick is to be evaluated there, from the left, before the tick itself."""
        self._announced = NextInstants(self.sources)
        self.late = find_late(self.sources)
        """Instants at which sources are seen at a time just after."""
        self._crossed: dict[int, float] = {}
        """When indicators of FMUs have crossed zero last, in s."""
        self._fresh = self.save()

    # --- the instant that is reached ---------------------------------------------------------------------------------

    def enter(self, t: float) -> None:
        """Stand at an instant, beyond any discontinuity there: its values from the right."""
        self._edge = self._left = math.inf
        here = self.workspace.here
        here.t[0] = t
        if self.delays is not None:
            self.delays.look_from(t + 1.0)
            self.delays.outputs_at(t, here.w)
        self._synchronize()

    def stand_left(self, t: float, left: float) -> None:
        """Stand at an instant before the discontinuity there, at a time in s from the left."""
        self._edge, self._left = t, left
        self.workspace.here.t[0] = left

    def _synchronize(self) -> None:
        here, trial = self.workspace.here, self.workspace.trial
        trial.x[:] = here.x
        trial.w[:] = here.w

    def accept(self) -> None:
        """Evaluate the instant that is reached, and renew what blocks and loops remember."""
        self.workspace.tick()
        if self._opaque:
            forget_trials(self.flat)
        self._synchronize()

    def begin(self, *, at_start: bool) -> None:
        """Take the domains of the indicators where a run begins, at t = 0 from the left; elsewhere as they are."""
        self.enter(float(self.workspace.here.t[0]))
        if self.outside is not None:
            self.follow()
        if self.domains is not None:
            self.domains.begin(float(self.workspace.here.t[0]), self.workspace.here.x[self.where])
            if at_start:
                self.domains.domain = domains_from_left(self.workspace, self.domains.domain)
        if self.delays is not None:
            self.delays.note_edge(float(self.workspace.here.t[0]))

    def settle(self, t: float, *, ahead: bool = False) -> bool:
        """Fire what has changed its domain at an instant; return whether anything did.

        Parameters
        ----------
        ahead : bool
            Whether the instant is a tick, to which events belong that are a few ulps later.
        """
        fired = self._changed(t)
        known, self._looked = ahead and self._looked == t, math.nan
        if not fired.any():
            ahead = ahead and self._fire_ahead(t)
            if (known and not ahead) or not self._look_outside(t):
                return ahead
            fired = self._changed(t)
            if not fired.any():
                self._end_events(t)
                return True
        self.fire(t, fired)
        self.sliding.switched = True
        if ahead:
            self._fire_ahead(t)
        return True

    def _changed(self, t: float) -> np.ndarray:
        """Take over the domains of all indicators, and return which events fire."""
        if self.domains is None:
            return _NO_EVENTS
        return self.domains.update(t, self.workspace.here.x[self.where])

    def _look_outside(self, t: float) -> bool:
        """Let blocks from outside act that have events of their own at t; return whether any had."""
        return self.outside is not None and self.outside.settle(t)

    def tell_outside(self, t: float, path: str, name: str, before: np.ndarray, after: np.ndarray | None = None) -> None:
        """Tell an event of a block from outside, with all states before and after it; the present ones by default."""
        states = (state_values(self.flat, path, x) for x in (before, self.workspace.here.x if after is None else after))
        self.on_event(Occurrence(t, path, name, *states))

    def follow(self) -> None:
        """Take over what an event of a block from outside may have changed: states, and their nominal values."""
        self._synchronize()
        if self.where.size and not self.fixed and self.exchanged is not None:
            nominals = self.exchanged.nominals()
            if not np.array_equal(nominals, self._nominals):
                self._nominals = nominals
                self.solver.set_absolute_tolerance(absolute_tolerances(self.flat, self.resolution[1], nominals))

    def _end_events(self, t: float) -> None:
        if self.delays is not None:
            self.delays.note_edge(t)
        self.accept()

    def _fire_ahead(self, t: float) -> bool:
        """Fire at a tick what changes its domain within a few ulps of time; jumps see it on the far side."""
        here, domains = self.workspace.here, self.domains
        if domains is None or not t > 0.0 or not domains.is_close():
            return False
        x = here.x[self.where]
        later = t + _ULPS * math.ulp(t)
        x = x + (later - t) * self._rate(t, x)
        fired = domains.update_ahead(later, x)
        if not fired.any():
            return False
        here.t[0], here.x[self.where] = later, x
        self._synchronize()
        self.fire(t, fired, later)
        here.t[0] = t
        self._synchronize()
        return True

    def fire(self, t: float, fired: np.ndarray, at: float | None = None) -> None:
        """Let events fire at the instant t; their jumps are evaluated there, or a few ulps later, ``at``."""
        assert self.domains is not None
        at = t if at is None else at
        workspace, domains = self.workspace, self.domains
        for _ in range(domains.most):
            before = workspace.here.x.copy()
            motion = domains.motion(at, before[self.where], fired)
            if self.outside is None:
                self._jump(fired)
            else:
                self.outside.fire(t, fired)
            for i in np.flatnonzero(fired):
                self.tell_event(t, int(i), before, workspace.here.x)
                self._reset_domains(self.flat.events[int(i)])
            self._synchronize()
            domains.count(t, workspace.here.x[self.where], fired)
            domains.land(motion, at, workspace.here.x[self.where], fired)
            fired = domains.update(at, workspace.here.x[self.where])
            if not fired.any() and self._look_outside(at):
                fired = domains.update(at, workspace.here.x[self.where])
            if not fired.any():
                self._end_events(t)
                return
        raise domains.too_many(t, fired)

    def _reset_domains(self, event: Any) -> None:
        """Let the domains of a subsystem's events start anew where it has just been enabled and its states do so."""
        if not event.subsystem or self.flat.table.subsystems[event.path].when != "reset":
            return
        if self.workspace.here.x[self.flat.gates.slices[event.path]][0] > 0.5:
            assert self.domains is not None
            self.domains.reset(event.path)

    def tell_event(self, t: float, i: int, before: np.ndarray, after: np.ndarray) -> None:
        """Tell that event ``i`` has fired at t in s, with all states before and after it.

        An FMU hears of every crossing of its indicators. One that comes back at once over the zero beyond which the
        last event was located, and that changes no state, is no event of the run.
        """
        event = self.flat.events[i]
        states = [{} if event.subsystem else state_values(self.flat, event.path, x) for x in (before, after)]
        if event.path in self.flat.outside and self.domains is not None:
            last, self._crossed[i] = self._crossed.get(i, -math.inf), t
            same = all(np.array_equal(value, states[1][name]) for name, value in states[0].items())
            if same and 0.0 <= t - last <= _AT_ONCE * self.domains.spacing:
                return
        self.on_event(Occurrence(t, event.path, event.name, *states))

    # --- from tick to tick -------------------------------------------------------------------------------------------

    def advance(self, t: float, end: float, grid: Iterable[float], sample: Callable[[float], bool]) -> float | None:
        """Go from ``t`` to ``end``, where the left limit is left in ``here``.

        Parameters
        ----------
        grid : iterable of float
            Times in between at which ``sample(t)`` is called with the instant in ``here``, evaluated.
        sample : callable
            Returns whether the run ends there.

        Returns
        -------
        float or None
            Time at which a stop condition has ended the run.
        """
        workspace = self.workspace
        self.sliding.begin_step()
        times = iter(grid)
        pending = next(times, math.inf)
        while t < end:
            jump = self._next_edge(t)
            edge = jump if is_before(jump, end) else end
            self._edge, self._left = edge, max(t, left_of(edge))
            if self.delays is not None:
                self.delays.look_from(0.5 * (t + edge))
            self._synchronize()
            self._explained(self.solver.restart, t, workspace.here.x[self.where], edge)
            found, wanted = None, False
            while found is None and not wanted and t < edge:
                step: AcceptedStep = self._explained(self.solver.step)
                self.tell_changes(workspace)
                if self.domains is not None and not self.sliding.active:
                    found = self.domains.locate(step)
                    solved = workspace.trial.x[self._loops]
                    if found is not None and step.t == end and end - found[0] <= _ULPS * math.ulp(end):
                        found = end, found[1]
                t = step.t if found is None else found[0]
                while pending < t or (pending == t < edge and found is None):
                    if found is not None and t - pending <= _ULPS * math.ulp(pending):
                        break  # the event belongs to the sample, which is taken after it
                    self._put(pending, step.interpolate(pending))
                    workspace.here.t[0] = pending  # within rounding before a discontinuity it sees that from the right
                    workspace.evaluate()
                    if self._record(pending, sample):
                        return pending
                    pending = next(times, math.inf)
                if self.delays is not None and t > step.t_old:
                    keep_step(self.delays, step.t_old, t, step.interpolate, self._inputs_of_delays, self.resolution)
                self._put(t, step.x if found is None else step.interpolate(t))
                if found is not None:  # the loops as the indicators saw them, to the last bit
                    workspace.here.x[self._loops] = solved
                if self._accepts or t < end or found is not None:
                    self.accept()
                wanted = self.outside is not None and self.outside.complete_step()
            happened = found is not None or wanted
            if t == end and not (happened or self.delays or self.flat.plant_outputs.total):
                self._looked = end if is_before(end, self._sources_edge) else math.nan
            if found is None and wanted:
                self.settle(t)
            if found is not None:
                at, t = t, min(t, pending)
                self.fire(t, found[1], at)
                if at > t:
                    workspace.here.t[0] = t
                    self._synchronize()
                workspace.messages += self.sliding.look(self.domains, t)
            if t == edge and self.delays is not None:
                self.delays.note_reached(t, from_source=not is_before(t, self._sources_edge))
            if t == edge < end:  # a discontinuity of a source, or one that comes out of a delay
                self.enter(t)
                happened |= self.settle(t)
                workspace.evaluate()
            if pending == t < end:
                if self._record(t, sample):
                    return t
                pending = next(times, math.inf)
            elif happened and self._stops_at(t, sample):
                return t
        return None

    def _explained(self, call: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return call(*arguments)
        except SimulationError as error:
            found = self._explain(error)
            raise found from found.__cause__

    def explain_failure(self, failure: Failure) -> BaseException:
        """Return the error behind that of a solver which C has asked for a step."""
        if not isinstance(failure.error, SimulationError):
            return failure.error
        self._edge, self._left, self._beyond = failure.edge, failure.left, failure.beyond
        return self._explain(failure.error)

    def _explain(self, error: SimulationError) -> SimulationError:
        """Return the error behind that of the solver: what an opaque block raised, or who made a trial not finite."""
        opaque = opaque_failure(self.flat)
        if opaque is not None:
            forget_trials(self.flat)
            return opaque.at(t=error.t)
        if error.block is not None or error.state is None:
            return error
        error.blame(error.state.rpartition(".")[0])
        made = None if self._beyond is None else self._failure_at(*self._beyond)
        if made is None or made.block == error.block:
            return error
        return made.add(f" The solver could not go on without it: {error.message}")

    def _record(self, t: float, sample: Callable[[float], bool]) -> bool:
        self.workspace.check()
        return sample(t)

    def _stops_at(self, t: float, sample: Callable[[float], bool]) -> bool:
        return self.is_stopped() and (sample(t) or True)

    def _next_edge(self, t: float) -> float:
        outside = math.inf if self.outside is None else self.outside.next_instant(t)
        self._sources_edge = min(self._announced.after(t), outside)
        return min(self._sources_edge, math.inf if self.delays is None else self.delays.next_edge(t))
