"""Sliding modes with a fixed step: events that follow each other without end wait for the end of the step."""

from __future__ import annotations

from ..flat import FlatEvent
from .domains import Domains

_PART = 1e-9  # of a step, within which a few events in a row are a sliding mode


class Sliding:
    """Whether the events of a fixed step wait for its end, as in a sliding mode: an ideal relay, say.

    They do from where a few follow each other at once, until none fires at the end of a step.

    Parameters
    ----------
    step : float or None
        The fixed step in s; None where the solver chooses its steps.
    """

    def __init__(self, step: float | None):
        self._step, self._told = step, set[str]()
        self.active = False
        self.switched = False
        """Whether an event has fired at the end of the step."""

    def begin_step(self) -> None:
        """Begin a step: events are located again if none has fired at the end of the last one."""
        self.active, self.switched = self.active and self.switched, False

    def look(self, domains: Domains | None, t: float) -> tuple[str, ...]:
        """Look at the events that have just fired; return what is to be told of them, once for each event."""
        event = None if domains is None or self._step is None else domains.limits.slides(_PART * self._step)
        if event is None:
            return ()
        self.active = True
        return self.tell(event, t)

    def tell(self, event: FlatEvent, t: float) -> tuple[str, ...]:
        """Return what is to be told of an event that waits for the ends of steps from t on, in s; once for each."""
        name = f"{event.path}.{event.name}"
        if name in self._told:
            return ()
        self._told.add(name)
        told = (
            f"t = {t:.6g} s: {name} switches back and forth without end (a sliding mode); from here on it is looked at "
            "once a step. A hysteresis would make it an event again."
        )
        return (told,)

    def forget(self) -> None:
        """Tell of events again that were told in a run before."""
        self._told.clear()

    def save(self) -> tuple[bool, bool]:
        """Return what is needed to go on from here."""
        return self.active, self.switched

    def restore(self, saved: tuple[bool, bool]) -> None:
        """Go back to what `save` returned."""
        self.active, self.switched = saved
