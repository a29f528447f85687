"""A block that is in model exchange in a run, such as an FMU, and its evaluator.

A `ModelExchangeBlock` is loaded for a run, as a plant is. A `ModelExchangeEvaluator` lets the stages of the diagram's
functions call it; it is there before the block is loaded, as the functions are bound first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Any, Protocol

import numpy as np

from ...blocks.core import SimulationError, Wanted
from ...blocks.tracing import GUARDS, NEXT
from ..flat import JUMP, Evaluator, FlatDiagram, no_evaluator, sort_names

_STEP = float(np.cbrt(np.finfo(float).eps))  # of a difference, relative to the nominal value
Values = Callable[[float, np.ndarray, np.ndarray], np.ndarray]


class ModelExchangeBlock(Protocol):
    """A block whose equations a run evaluates; see `loopwright.fmus.calls.ModelExchangeInstance`.

    States and inputs are flat, in the order of the block's. A protocol: the instances come from the package `fmus`,
    which this sub-package doesn't know, or from users.
    """

    is_trial: bool
    """Whether a step may be taken back, so that an input out of its range is kept in `refused`, and no error yet."""
    refused: SimulationError | None
    """Error of an input that was out of its range in a trial step."""

    is_built_here: bool
    """Whether Loopwright has built it, so that its derivatives need no check."""

    @property
    def messages(self) -> Sequence[str]:
        """Messages of the run so far."""

    @property
    def failed(self) -> bool:
        """Whether its last call failed, so that it can't continue."""

    @property
    def next_time(self) -> float:
        """Time in s of its next event that is known beforehand; infinite without one."""

    @property
    def discarded(self) -> str:
        """The last evaluation that it could not compute; empty if there is none."""

    @property
    def ends_run(self) -> bool:
        """Whether it asks for the end of the run, at the instant that is reached."""

    @property
    def nominals(self) -> np.ndarray:
        """Nominal values of its states."""

    def add_note(self, text: str) -> None:
        """Add a message of the run on this block."""

    def evaluation(self, wanted: Wanted) -> Values:
        """Return the call ``(t, x, u) -> values`` of outputs, rates of the states and indicators, one after the other.

        It leaves everything that the block keeps as it is.
        """

    def slopes(self, ports: Sequence[str], *, rates: bool, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray | None:
        """Return the derivative of such values by (x, u); None: by differences."""

    def exchange(self, u: np.ndarray) -> np.ndarray:
        """Set the inputs at the start, and return the states that follow from them."""

    def begin_exchange(self) -> np.ndarray:
        """End the start, and return the states with which the run begins."""

    def has_jumped(self, u: np.ndarray) -> bool:
        """Whether an input has jumped since the last instant that was reached."""

    def handle_event(self, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Let events act, and return the states after them."""

    def accept(self, t: float, x: np.ndarray, u: np.ndarray) -> bool:
        """Take note of an instant that the solver has reached; return whether an event is wanted there."""

    def operating_point(self) -> dict[str, Any]:
        """Return its time ``t`` in s, ``state`` and ``inputs`` by name."""

    @property
    def can_serialize(self) -> bool:
        """Whether `serialize` works."""

    def serialize(self) -> bytes:
        """Return its complete state."""

    def restore_bytes(self, data: bytes) -> None:
        """Go to the state of such bytes."""


OWN_EVENTS = INPUT_EVENT, TIME_EVENT, STEP_EVENT = "input_event", "time_event", "step_event"
"""Names of events that no indicator fires: an input has jumped, a time has come, a step has ended."""


class Look(Enum):
    """Purpose of an evaluation of `JUMP`, by which a block sees an instant with all its inputs."""

    START = "start"
    """The start is still sought: the states are the block's own."""
    STEP = "step"
    """The solver has accepted a step that ends there."""
    EVENTS = "events"
    """Events may act there."""


class ModelExchangeEvaluator(Evaluator):
    """Evaluator of one block in a run: for the stages, and for the events."""

    def __init__(self, flat: FlatDiagram, path: str):
        self.path = path
        self.look = Look.START
        """Purpose of the next evaluations of `JUMP`."""
        self._outputs = frozenset(flat.checked.traced[path].outputs)
        self._count = len(flat.table.blocks[path].events)
        self._loaded: ModelExchangeBlock | None = None
        self._calls: dict[tuple[str, ...], Values] = {}
        self.u = np.zeros(0)
        """The inputs at the last look at an instant."""
        self.event: str | None = None
        """Name of the event that has acted at the last `JUMP`, "" for those of indicators; None if there was none."""
        self.wants_event = False
        """Whether the block wants an event at the instant that was accepted."""

    @property
    def block(self) -> ModelExchangeBlock:
        """The block, once it is loaded."""
        if self._loaded is None:
            raise no_evaluator(self.path)
        return self._loaded

    def load(self, block: ModelExchangeBlock) -> None:
        """Take the block of a run."""
        self._loaded = block

    def look_at(self, call: Callable[[], None], *, completes_step: bool) -> str | None:
        """Look at an instant that is reached, by a bound call; return the name of the event that acts, see `event`."""
        self.look, self.event = Look.STEP if completes_step else Look.EVENTS, None
        call()
        return self.event

    # --- an Evaluator ------------------------------------------------------------------------------------------------

    def evaluate(self, names: tuple[str, ...], t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the equations that are wanted; see `loopwright.diagrams.flat.stages.Evaluator`."""
        call = self._calls.get(names)
        if call is None:
            call = self._calls[names] = self._bind(names)
        return call(t, x, u)

    def _bind(self, names: tuple[str, ...]) -> Values:
        if names == (JUMP,):
            return self._jump
        return self.block.evaluation(self._wanted(names))

    def _wanted(self, names: tuple[str, ...]) -> Wanted:
        wanted = sort_names(names)
        assert self._outputs.issuperset(wanted.outputs)
        return wanted

    def _jump(self, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Look at an instant that is reached: let events act, or take note of a step that the solver has accepted."""
        n = u.size - self._count  # behind the inputs is 1 for each event that fires
        u, fired = u[:n], u[n:]
        self.u = u.copy()
        block = self.block
        if self.look is Look.START:
            return x
        if self.look is Look.STEP:
            self.wants_event = block.accept(t, x, u) or self.wants_event
            return x
        if fired.any():
            self.event = ""
        elif t >= block.next_time:
            self.event = TIME_EVENT
        elif self.wants_event:
            self.event = STEP_EVENT
        elif block.has_jumped(u):
            self.event = INPUT_EVENT
        else:
            return x
        self.wants_event = False
        return block.handle_event(t, x, u)

    def differentiate(self, names: tuple[str, ...], t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray | None:
        """Return the derivative of `evaluate` by (t, x, u), NaN by t; None: by differences."""
        if not {NEXT, GUARDS, *self._outputs}.issuperset(names):
            return None
        # Differences are by states and inputs alone: time can't go back behind an event.
        wanted = sort_names(names)
        J = self.find_slopes(names, wanted, t, x, u)
        return np.hstack([np.full((len(J), 1), math.nan), J])

    def find_slopes(self, names: tuple[str, ...], wanted: Wanted, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the derivative of `evaluate` by (x, u): the block's own, or differences.

        They are for Newton's method within a run. Linear models take those of `PointEvaluator`, whose error is known.
        """
        J = self.block.slopes(wanted.outputs, rates=wanted.rates, t=t, x=x, u=u)
        return self.differences(names, t, x, u) if J is None else J

    def differences(
        self, names: tuple[str, ...], t: float, x: np.ndarray, u: np.ndarray, scale: float = 1.0
    ) -> np.ndarray:
        """Return the derivative of `evaluate` by (x, u), by central differences over parts of the nominal values."""
        columns = []
        scales = [*self.block.nominals, *(0.0 for _ in u)]
        for i, (at, nominal) in enumerate(zip([*x, *u], scales, strict=True)):
            step = scale * _STEP * max(abs(at), nominal or 1.0)
            made = []
            for side in (step, -step):
                moved = np.concatenate([x, u])
                moved[i] += side
                made.append((moved[i], self.evaluate(names, t, moved[: x.size], moved[x.size :]).copy()))
            columns.append((made[0][1] - made[1][1]) / (made[0][0] - made[1][0]))
        return np.array(columns).T if columns else np.zeros((self.evaluate(names, t, x, u).size, 0))
