"""Initial values of blocks that remember their input: given, or the input just before t = 0."""

from __future__ import annotations

from typing import Any

from ..core import Array


class StartsAtInput:
    """A block that remembers its input ``u``: without an ``initial_value``, as it is just before t = 0."""

    initial_value: Array | None

    @property
    def starts_from_inputs(self) -> bool:
        """Whether `initial` computes the state."""
        return self.initial_value is None

    def initial(self, u: Any) -> Array:
        """Return the state at the start."""
        return u.u
