"""Short text of a run, for a cell of a notebook."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from ...blocks.core import brief, count_of, enumerate_some
from .recorded_signals import RecordedSignals
from .stored import Occurrence, Stopped


class ToldRun(RecordedSignals, Protocol):
    """The members of a run that its short text tells."""

    @property
    def tier(self) -> str:
        """Form of the loop over ticks."""

    @property
    def messages(self) -> tuple[str, ...]:
        """Its messages."""

    @property
    def events(self) -> Sequence[Occurrence]:
        """The events that fired."""

    @property
    def stopped(self) -> Stopped | None:
        """The end by a stop condition."""


_MESSAGES = 3
"""Messages that are shown; the others are counted."""


def describe_run(run: ToldRun) -> str:
    """Return what a run is, its samples and signals, its messages, and next steps."""
    t = run.t
    span = f" from {t[0]:.9g} to {t[-1]:.9g} s" if len(t) else ""
    names = run.names
    wires = [name for name in run.wires if name in names]
    first = (wires or names or ["name"])[0]
    facts = (
        count_of(len(t), "sample") + span,
        count_of(len(names), "signal") + (f" (named: {enumerate_some(wires)})" if wires else ""),
        run.tier,
        f"stopped at {run.stopped.t:.9g} s by {run.stopped.block}" if run.stopped is not None else "",
        count_of(len(run.events), "event") if run.events else "",
        count_of(len(run.messages), "message") if run.messages else "",
    )
    head = brief(f"run of {run.diagram_name!r}", *facts, then=f"run[{first!r}], run.plot({first!r}), run.at(t)")
    more = len(run.messages) - _MESSAGES
    return "\n".join([head, *run.messages[:_MESSAGES], *([f"and {more} more: run.messages"] if more > 0 else [])])
