"""Functions of an instant that a solver tries: rates, their Jacobian, indicators, inputs of transport delays."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cached_property

import numpy as np

from ...blocks.core import FmuRuntimeError, NonFiniteError, SimulationError
from ..events import evaluate_many
from ..flat import FlatDiagram
from .transport_delays import Delays
from .workspace import Workspace


class Trials:
    """Functions of a trial, with the time from the left of the next discontinuity, and past inputs of the delays."""

    workspace: Workspace
    flat: FlatDiagram
    where: np.ndarray
    """The entries of x that are integrated."""
    delays: Delays | None
    """Next discontinuity in time, infinite without one."""
    _left: float
    """Last time before it."""
    late: Mapping[float, float]
    _loops: list[int]
    _jacobian: Callable[[float, np.ndarray], np.ndarray] | None
    _indicators: Callable[[float, np.ndarray], np.ndarray]
    _opened: np.ndarray
    _driven: np.ndarray
    _drive: Callable[[], None]
    _nothing: np.ndarray
    """A zero for each rate."""
    _beyond: tuple[float, np.ndarray] | None
    """The last trial of the solver at which a rate was not finite."""

    @cached_property
    def _flow(self) -> Callable[[float, np.ndarray], np.ndarray]:
        """The rates at a trial; a run in C seldom asks for them, and those of a large diagram take seconds to trace."""
        return self.workspace.flow()

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
        except SimulationError:  # a loop without a solution: the solver shortens the step, if it can
            rates = np.full(self.where.size, math.nan)
        if self._nothing.dot(rates) != 0.0:  # one of them is not finite; this costs a third of asking each
            self._beyond = (t, x.copy())
        return rates

    def _slope(self, t: float, x: np.ndarray) -> np.ndarray:
        if self._jacobian is None:
            self._jacobian = self.workspace.jacobian()
        return self._jacobian(self._time(t), x)

    def _g(self, t: float, x: np.ndarray) -> np.ndarray:
        g = self._indicators(self._time(t), x)
        if not math.isfinite(sum(g.tolist())) and not np.all(np.isfinite(g[self._opened > 0.5])):
            raise self._not_finite(t, x, g)
        return g

    def _g_many(self, times: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return evaluate_many(lambda t, x: self._indicators(self._time(t), x), self._opened, times, states)

    def _not_finite(self, t: float, x: np.ndarray, g: np.ndarray) -> SimulationError:
        """Return the error of an indicator that is not finite: that of the block which made the first such value."""
        event = self.flat.events[int(np.flatnonzero(~np.isfinite(g) & (self._opened > 0.5))[0])]
        made = self._failure_at(t, x)
        return made or NonFiniteError(
            f"its indicator {event.name!r} is not a finite number; expected one. Look at roots and quotients in it.",
            block=event.path,
            t=t,
        )

    def _failure_at(self, t: float, x: np.ndarray) -> SimulationError | None:
        self._put(t, x)
        try:
            self.workspace.evaluate()
            self.workspace.check()
        except SimulationError as error:
            return error
        return None

    def _inputs_of_delays(self, t: float, x: np.ndarray) -> np.ndarray:
        trial = self.workspace.trial
        trial.t[0] = self._time(t)
        trial.x[self.where] = x
        self._drive()
        return self._driven

    def _put(self, t: float, x: np.ndarray) -> None:
        here = self.workspace.here
        here.t[0] = min(t, self._left)
        here.x[self.where] = x
        if self.delays is not None:
            self.delays.outputs_at(here.t[0], here.w)
