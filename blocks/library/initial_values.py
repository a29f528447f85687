"""Initial values of blocks that remember their input: given, or the input just before t = 0."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from ..core import Array


class StartsAtInput:
    """A block that remembers its input ``u``: without an ``initial_value``, as it is just before t = 0."""

    initial_value: Array | None
    _rows: ClassVar[str] = ""
    """The attribute with the number of past inputs that it remembers; empty for one of the input's shape."""

    @property
    def starts_from_inputs(self) -> bool:
        """Whether `initial` computes the state."""
        return self.initial_value is None

    def initial(self, u: Any) -> Array:
        """Return the state at the start, of several past inputs all rows."""
        return np.stack([u.u] * getattr(self, self._rows)) if self._rows else u.u
