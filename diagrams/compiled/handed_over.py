"""Blocks that are evaluated from outside, handed over to a loop in C and taken back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from ..flat import FlatDiagram
from .runtime import load_runtime
from .staged import NativeBlock, NativeExchange


class HandedBlock(NativeBlock, Protocol):
    """A block that C can evaluate; see `loopwright.fmus.calls.ExchangeInstance`."""

    next_time: float
    ends_run: bool

    def find_native_obstacle(self) -> str | None:
        """Return why a loop in C can't evaluate it; None if it can."""

    @property
    def reached_inputs(self) -> np.ndarray:
        """Values of all inputs at the last instant that was reached."""

    @property
    def is_final(self) -> bool:
        """Whether no earlier state will be restored."""

    def take_back(self, u: np.ndarray, next_time: float, *, read_nominals: bool) -> None:
        """Go on from where a loop in C has come to."""

    def take_end(self, t: float, *, in_event: bool) -> None:
        """Note that the block has asked a loop in C to end the run."""

    def take_warning(self, action: str, t: float) -> None:
        """Note a warning that a loop in C has got."""

    def judge_native(self, action: str, status: int, t: float) -> None:
        """Raise the error of a call of C that has failed."""


class Wanting(Protocol):
    """Notes whether a block wants an event at the instant that was accepted."""

    wants_event: bool


def find_exchange_obstacle(blocks: Mapping[str, Any]) -> str | None:
    """Return why blocks that are evaluated from outside can't be handed over to C; None if they can."""
    for path, block in blocks.items():
        reason = block.find_native_obstacle() if hasattr(block, "find_native_obstacle") else "is evaluated by Python"
        if reason is not None:
            return f"the FMU {path!r} in model exchange {reason}"
    return None


class HandedOver:
    """Blocks that are evaluated from outside, in a run that goes on in C.

    Parameters
    ----------
    flat : FlatDiagram
        The diagram.
    blocks : mapping of str to HandedBlock
        The blocks by path, loaded.
    notes : mapping of str to Wanting
        Whether each wants an event.
    tell : callable
        ``tell(t, path, before, after)``: told events of inputs that have changed states, with all states before and
        after them.
    """

    def __init__(
        self,
        flat: FlatDiagram,
        blocks: Mapping[str, Any],
        notes: Mapping[str, Wanting],
        tell: Callable[[float, str, np.ndarray, np.ndarray], None],
    ):
        self._notes, self._tell = notes, tell
        self._blocks: dict[str, HandedBlock] = {path: blocks[path] for path in flat.outside}
        first = {path: flat.states.slices[path].start for path in flat.outside}
        self.native = NativeExchange(self._blocks, first, flat.width, load_runtime())
        """The blocks as C knows them."""
        self._with_c = False

    def hand_over(self) -> None:
        """Let C go on from an instant that Python has come to."""
        self._with_c = True
        for path, block in self._blocks.items():
            self.native.hand_over(
                path,
                block.reached_inputs,
                block.next_time,
                asks=self._notes[path].wants_event,
                ended=block.ends_run,
                final=block.is_final,
            )

    def take_back(self) -> bool:
        """Let Python go on from where C has come to; return whether nominal values have changed."""
        changed = False
        if not self._with_c:  # Python has gone on, and has been interrupted
            return changed
        self._with_c = False
        for path, block in self._blocks.items():
            state = self.native.state_of(path)
            self._notes[path].wants_event = bool(state.asks)
            if state.ended and not block.ends_run:
                block.take_end(state.end, in_event=bool(state.in_event))
            block.take_back(self.native.inputs_of(path), state.next_time, read_nominals=bool(state.other_nominals))
            changed |= bool(state.other_nominals)
            state.other_nominals = 0
        return changed

    def tell(self) -> None:
        """Tell what has happened in C: warnings, and events of inputs that have changed states."""
        self.native.remote.take_messages()
        for path, action, t in self.native.take_warnings():
            self._blocks[path].take_warning(action, t)
        for event in self.native.take_events():
            self._tell(event.t, event.path, event.before, event.after)

    def has_news(self) -> bool:
        """Whether a block asks for the end of the run, or has other nominal values."""
        states = [(self.native.state_of(path), block) for path, block in self._blocks.items()]
        return any(state.other_nominals or (state.ended and not block.ends_run) for state, block in states)

    def judge(self) -> None:
        """Raise the error of the call that has failed."""
        failed = self.native.failure()
        self._blocks[failed.path].judge_native(failed.action, failed.status, failed.t)
