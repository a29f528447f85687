"""The blocks in continuous time, as the plants of a communication step see them."""

from __future__ import annotations

from typing import Any, Protocol


class Rest(Protocol):
    """The blocks in continuous time between two ticks; they take part in a communication step.

    A protocol: the loop over time, above this sub-package, gives them to a coupling scheme.
    """

    def advance(self, t: float, end: float) -> float | None:
        """Go from t to the end, with the plants' outputs as they are in w; return where a stop condition ended it."""

    def save(self) -> Any:
        """Return the present state, for `restore`."""

    def restore(self, saved: Any) -> None:
        """Go back to a state."""

    def accept(self) -> None:
        """Keep the events that have happened since the last call."""
