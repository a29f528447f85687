"""Between two ticks: the solver, events, discontinuities of sources, transport delays."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from ...blocks.core.block import Block
from ...blocks.core.errors import NonFiniteError, OptionError, SimulationError
from ...blocks.core.instants import is_before, left_of
from ..flat.functions import active_loops
from ..results.stored import Occurrence
from ..solvers.base import Problem
from ..solvers.choose import make_solver
from .diagnosis import failure, forget_trials, opaque_failure, state_values
from .events import Domains
from .solver_setup import absolute_tolerances, recall, remembers, solver_memory, time_scale_of
from .transport_delays import delays_of, driven_function, step_inputs
from .workspace import Machine

NOTHING: frozenset[Any] = frozenset()
TIGHT, ONE_STEP = 1e-9, ("auto", "RK23", "RK45", "DOP853", "Radau")
"""Below this relative tolerance these methods, to which a stop costs little, land on every sample."""


class Continuous:
    """The continuous part of a run.

    Parameters
    ----------
    machine : Machine
        The run's numbers and functions.
    name : str
        The diagram's name.
    solver, rtol, atol, max_step
        See `Diagram.simulate`.
    on_event : callable
        Told every event that fires.
    """

    def __init__(
        self,
        machine: Machine,
        name: str,
        solver: str,
        rtol: float,
        atol: float,
        max_step: float | None,
        on_event: Callable[[Occurrence], None],
    ):
        flat = machine.flat
        self.machine, self.flat, self.name, self.on_event = machine, flat, name, on_event
        self.where = flat.continuous
        self._edge, self._left, self._sources_edge = math.inf, math.inf, math.inf
        self.beyond: tuple[float, np.ndarray] | None = None
        """The last trial of the solver at which a rate was not finite."""
        self._resolution = rtol, atol
        self._loops = active_loops(flat, NOTHING)
        self._opaque = any(flat.table.blocks[path].opaque for path in flat.checked.traced)
        self.delays = delays_of(flat)
        self._flow, self._jacobian = machine.flow(), None
        problem = Problem(self.where.size, self._rate, self._slope, flat.continuous_labels)
        self.time_scale = time_scale_of(flat)
        longest = max_step
        if longest is None and remembers(flat):
            longest = float(flat.base)  # what is remembered is renewed at accepted steps, and must not grow stale
        if longest is None and self.time_scale < math.inf:
            longest = 5.0 * self.time_scale  # else a step may fit whole periods of a source
        if self.delays is not None:
            longest = min(longest or math.inf, self.delays.shortest)
        self.solver = make_solver(
            solver,
            problem,
            rtol=rtol,
            atol=absolute_tolerances(flat, atol),
            step=float(flat.base),
            max_step=longest,
        )
        self.fixed = self.solver.fixed
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
            self._indicators, self._opened = machine.indicators()
            self.domains = Domains(flat, self._g, self._opened, self.time_scale)
            self._jump, self._fired = machine.jump()
        if self.delays is not None:
            self._driven = np.zeros(flat.plant_inputs.total)
            self._drive = machine.plain(driven_function(flat), [self._driven], machine.trial)
        self.sources = [
            (path, flat.table.blocks[path])
            for path in sorted(flat.checked.traced)
            if not flat.table.is_sampled(flat.table.frame_of[path])
            and type(flat.table.blocks[path]).next_instant is not Block.next_instant
        ]

    # --- functions of a trial: time from the left of the next discontinuity, past inputs of the delays ---------------

    def _time(self, t: float) -> float:
        t = self._left if t >= self._edge else t
        if self.delays is not None:
            self.delays.outputs_at(t, self.machine.trial.w)
        if self._loops:  # whatever was tried in between: Newton's method starts from the last accepted solution
            self.machine.trial.x[self._loops] = self.machine.here.x[self._loops]
        return t

    def _rate(self, t: float, x: np.ndarray) -> np.ndarray:
        try:
            rates = self._flow(self._time(t), x)
        except SimulationError:  # a loop without a solution: the solver shortens the step, if it can
            rates = np.full(self.where.size, math.nan)
        if not np.isfinite(rates).all():
            self.beyond = (t, x.copy())
        return rates

    def _slope(self, t: float, x: np.ndarray) -> np.ndarray:
        if self._jacobian is None:
            self._jacobian = self.machine.jacobian()  # type: ignore[assignment]
        return self._jacobian(self._time(t), x)  # type: ignore[misc, no-any-return]

    def _g(self, t: float, x: np.ndarray) -> np.ndarray:
        g = self._indicators(self._time(t), x)
        if not np.all(np.isfinite(g[self._opened > 0.5])):
            raise self._not_finite(t, x, g)
        return g

    def _not_finite(self, t: float, x: np.ndarray, g: np.ndarray) -> SimulationError:
        """Return the error of an indicator that is not finite: that of the block which made the first such value."""
        event = self.flat.events[int(np.flatnonzero(~np.isfinite(g) & (self._opened > 0.5))[0])]
        self._put(t, x)
        self.machine.look()
        if not self.machine.ok[0]:
            return failure(self.machine, NOTHING).at(t=t)  # type: ignore[return-value]
        return NonFiniteError(
            f"its indicator {event.name!r} is not a finite number; expected one. Look at roots and quotients in it.",
            block=event.path,
            t=t,
        )

    def made_by(self) -> SimulationError | None:
        """Return the error of the block that made the last trial's rates not finite; the instant is lost with it."""
        if self.beyond is None:
            return None
        t, x = self.beyond
        self._put(t, x)
        try:
            self.machine.look()
        except SimulationError as error:
            return error
        return None if self.machine.ok[0] else failure(self.machine, NOTHING).at(t=t)  # type: ignore[return-value]

    def _inputs_of_delays(self, t: float, x: np.ndarray) -> np.ndarray:
        trial = self.machine.trial
        trial.t[0] = self._time(t)
        trial.x[self.where] = x
        self._drive()
        return self._driven

    # --- the instant that is reached ---------------------------------------------------------------------------------

    def at(self, t: float) -> None:
        """Take an instant from the right: beyond any discontinuity there."""
        self._edge = self._left = math.inf
        here = self.machine.here
        here.t[0] = t
        if self.delays is not None:
            self.delays.middle = t + 1.0
            self.delays.outputs_at(t, here.w)
        self._synchronize()

    def _put(self, t: float, x: np.ndarray) -> None:
        here = self.machine.here
        here.t[0] = self._left if t >= self._edge else t
        here.x[self.where] = x
        if self.delays is not None:
            self.delays.outputs_at(here.t[0], here.w)

    def _synchronize(self) -> None:
        here, trial = self.machine.here, self.machine.trial
        trial.x[:] = here.x
        trial.w[:] = here.w

    def accept(self) -> None:
        """Evaluate the instant that is reached, and renew what blocks and loops remember."""
        machine = self.machine
        machine.look()
        if not machine.ok[0]:
            raise failure(machine, NOTHING).at(t=float(machine.here.t[0]))
        if self._opaque:
            forget_trials(machine)
        machine.here.x[:] = machine.x_next
        self._synchronize()

    def begin(self) -> None:
        """Take the domains of the indicators at the start."""
        self.at(float(self.machine.here.t[0]))
        if self.domains is not None:
            self.domains.begin(float(self.machine.here.t[0]), self.machine.here.x[self.where])
        if self.delays is not None:
            self.delays.edge(float(self.machine.here.t[0]))

    def settle(self, t: float) -> bool:
        """Fire what has changed its domain at an instant; return whether anything did."""
        if self.domains is None:
            return False
        fired = self.domains.changed(t, self.machine.here.x[self.where])
        if not fired.any():
            return False
        self._fire(t, fired)
        return True

    def _fire(self, t: float, fired: np.ndarray) -> None:
        assert self.domains is not None
        machine, domains = self.machine, self.domains
        for _ in range(domains.most):
            self._fired[:] = fired
            before = machine.here.x.copy()
            self._jump()
            machine.here.x[:] = machine.x_next
            for i in np.flatnonzero(fired):
                self._tell(t, self.flat.events[int(i)], before)
                self._reset_domains(self.flat.events[int(i)])
            domains.count(t, fired, self.name)
            self._synchronize()
            fired = domains.changed(t, machine.here.x[self.where])
            if not fired.any():
                if self.delays is not None:
                    self.delays.edge(t)
                self.accept()
                return
        raise domains.too_many(t, fired)

    def _reset_domains(self, event: Any) -> None:
        """Where a box has just been enabled and its states start anew, so do the domains of its events."""
        if not event.box or self.flat.table.frames[event.path].when != "reset":
            return
        if self.machine.here.x[self.flat.gates.slices[event.path]][0] > 0.5:
            assert self.domains is not None
            self.domains.reset(event.path)

    def _tell(self, t: float, event: Any, before: np.ndarray) -> None:
        states = [{} if event.box else state_values(self.flat, event.path, x) for x in (before, self.machine.here.x)]
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
        machine, where = self.machine, self.where
        times = iter(grid)
        pending = next(times, math.inf)
        while t < end:
            jump = self._next_edge(t)
            edge = jump if is_before(jump, end) else end
            self._edge, self._left = edge, max(t, left_of(edge))
            if self.delays is not None:
                self.delays.middle = 0.5 * (t + edge)
            self._synchronize()
            self.solver.restart(t, machine.here.x[where], edge)
            found = None
            while found is None and t < edge:
                step = self.solver.step()
                if self.domains is not None:
                    found = self.domains.locate(step.t_old, step.t, step.interpolate)
                    solved = machine.trial.x[self._loops]
                t = step.t if found is None else found[0]
                while pending < t or (pending == t < edge and found is None):
                    self._put(pending, step.interpolate(pending))
                    machine.look()
                    if self._recorded(pending, sample):
                        return pending
                    pending = next(times, math.inf)
                if self.delays is not None and t > step.t_old:
                    step_inputs(self.delays, step.t_old, t, step.interpolate, self._inputs_of_delays, self._resolution)
                self._put(t, step.x if found is None else step.interpolate(t))
                if found is not None:  # the loops as the indicators saw them, to the last bit
                    machine.here.x[self._loops] = solved
                self.accept()
            happened = found is not None
            if found is not None:
                self._fire(t, found[1])
            if t == edge and self.delays is not None:
                self.delays.reached(t, from_source=not is_before(t, self._sources_edge))
            if t == edge < end:  # a discontinuity of a source, or one that comes out of a delay
                self.at(t)
                happened |= self.settle(t)
                machine.look()
            if pending == t < end:
                if self._recorded(t, sample):
                    return t
                pending = next(times, math.inf)
            elif happened and self._stops_at(t, sample):
                return t
        return None

    def _recorded(self, t: float, sample: Callable[[float], bool]) -> bool:
        if not self.machine.ok[0]:
            raise failure(self.machine, NOTHING).at(t=t)
        return sample(t)

    def _stops_at(self, t: float, sample: Callable[[float], bool]) -> bool:
        return self.is_stopped() and (sample(t) or True)

    is_stopped: Callable[[], bool] = staticmethod(lambda: False)
    """Whether a stop condition is true in what was evaluated last; set by the run."""

    def _next_edge(self, t: float) -> float:
        self._sources_edge = min((_next_instant(path, source, t) for path, source in self.sources), default=math.inf)
        return min(self._sources_edge, math.inf if self.delays is None else self.delays.next_edge(t))

    # --- saved states ------------------------------------------------------------------------------------------------

    def save(self) -> dict[str, Any]:
        """Return what is needed to go on from here."""
        return {
            "domains": None if self.domains is None else self.domains.save(),
            "delays": None if self.delays is None else self.delays.save(),
            "solver": solver_memory(self.solver),
        }

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Go back to what `save` returned."""
        if self.domains is not None and saved["domains"] is not None:
            self.domains.restore(saved["domains"])
        if self.delays is not None and saved["delays"] is not None:
            self.delays.restore(saved["delays"])
        recall(self.solver, saved["solver"])


def _next_instant(path: str, block: Block, t: float) -> float:
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


def check_solver(error: SimulationError, machine: Machine, continuous: Continuous | None = None) -> SimulationError:
    """Return the error behind that of a solver: what an opaque block raised, or the block that made a trial not finite.

    Else say which block has the state at which the solver failed.
    """
    opaque = opaque_failure(machine)
    if opaque is not None:
        return opaque.at(t=error.t)  # type: ignore[return-value]
    if error.block is not None:
        return error
    if error.state is not None:
        error.block = error.state.rpartition(".")[0]
    made = continuous.made_by() if continuous is not None and error.block is not None else None
    if made is None or made.block == error.block:
        return error
    made.message = f"{made.message} The solver could not go on without it: {error.message}"
    return made
