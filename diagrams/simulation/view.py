"""A running simulation as others see it: everything may be read, nothing may be changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

from ...blocks.core import brief, explain_calls
from ..coupling import Plant
from ..model_exchange import ModelExchangeBlock
from ..results import Occurrence, Stopped
from .workspace import Workspace


@dataclass
class Position:
    """Where a run is in time; the run alone changes it."""

    base: Fraction
    """Seconds between two ticks."""
    tick: int = 0
    stopped: Stopped | None = None
    """The stop condition, or the FMU, that has ended the run, which may be between two ticks."""
    end: float | None = None
    """Time in s between two ticks at which the run has ended, because its duration has."""
    is_broken_off: bool = False
    """Whether it has failed, or was interrupted, after this tick: the numbers may then be those of a later instant."""
    fired: list[Occurrence] = field(default_factory=list)
    """The events of the latest instant at which any fired."""

    def time_of(self, tick: int) -> float:
        """Return the time of a tick in s, rounded once."""
        return tick * self.base.numerator / self.base.denominator

    @property
    def t(self) -> float:
        """Time that the run has reached in s."""
        if self.stopped is not None:
            return self.stopped.t
        return self.time_of(self.tick) if self.end is None else self.end

    def note_event(self, event: Occurrence) -> None:
        """Keep an event that has fired, with those of the same instant."""
        if self.fired and self.fired[-1].t != event.t:
            self.fired.clear()
        self.fired.append(event)

    def restore(self, tick: int, stopped: Stopped | None) -> None:
        """Go to a saved position; nothing has fired there."""
        self.tick, self.stopped, self.end, self.is_broken_off = tick, stopped, None, False
        self.fired.clear()


@explain_calls
@dataclass(frozen=True, eq=False)
class SimulationView:
    """The instant that a simulation has reached, to be read: ``simulation.view``.

    It follows the simulation: its arrays are read-only, and change as the run continues. Copy what is to be kept.

    Attributes
    ----------
    x : ndarray, shape (n,)
        States, held outputs, gates, reset states and loop values at this instant, laid out as `FlatDiagram` says; in
        the units of the blocks' states.
    x_next : ndarray, shape (n,)
        The states after the instant, laid out as ``x``: the run continues with them.
    w : ndarray, shape (m,)
        Outputs of plants and of transport delays, as ``FlatDiagram.plant_outputs`` lays them out, in the ports' units.
    z : ndarray, shape (k,)
        Inputs of plants and of transport delays, as ``FlatDiagram.plant_inputs`` lays them out, in the ports' units.
    log : ndarray, shape (l,)
        Every output, as ``FlatDiagram.log`` lays them out, in the ports' units.
    plants : mapping of str to Plant
        The plants that are loaded, by path.
    exchanged : mapping of str to ModelExchangeBlock
        The blocks in model exchange, by path, in a run that has begun.
    """

    x: np.ndarray
    x_next: np.ndarray
    w: np.ndarray
    z: np.ndarray
    log: np.ndarray
    plants: Mapping[str, Plant]
    exchanged: Mapping[str, ModelExchangeBlock]
    _position: Position = field(repr=False)

    def __repr__(self) -> str:
        return brief("a run in the making", f"t = {self._position.t:.9g} s", then=".t, .x, .w")

    @classmethod
    def of(
        cls,
        workspace: Workspace,
        plants: Mapping[str, Plant],
        exchanged: Mapping[str, ModelExchangeBlock],
        position: Position,
    ) -> SimulationView:
        """Return the view of a run's numbers, plants and position."""
        n, width = workspace.flat.log.total, workspace.flat.width
        return cls(
            x=_read_only(workspace.log[n : n + width]),
            x_next=_read_only(workspace.here.x),
            w=_read_only(workspace.here.w),
            z=_read_only(workspace.z),
            log=_read_only(workspace.log[:n]),
            plants=plants,
            exchanged=exchanged,
            _position=position,
        )

    @property
    def t(self) -> float:
        """Time in s."""
        return self._position.t

    @property
    def tick(self) -> int:
        """Number of the last tick that the run has reached; one that is stopped between two ticks is beyond it."""
        return self._position.tick

    @property
    def stopped(self) -> Stopped | None:
        """The stop condition or FMU that has ended the run."""
        return self._position.stopped

    @property
    def events(self) -> tuple[Occurrence, ...]:
        """The events that have fired at this instant."""
        return tuple(event for event in self._position.fired if event.t == self.t)


def describe_simulation(name: str, view: SimulationView, *, is_open: bool | None) -> str:
    """Return the state of a simulation, its time, and next steps."""
    kind = f"simulation of {name!r}"
    if is_open is None:
        return brief(kind, "not begun", then="with … as simulation: simulation.advance(duration)")
    stopped = "" if view.stopped is None else f"stopped by {view.stopped.block}"
    then = ".advance(duration), .view, .save(), .run()" if is_open else ".run()"
    return brief(kind, f"at t = {view.t:.9g} s" + ("" if is_open else ", ended"), stopped, then=then)


def _read_only(vector: np.ndarray) -> np.ndarray:
    """Return a vector's own memory, which can't be written through the result."""
    view = vector.view()
    view.flags.writeable = False
    return view
