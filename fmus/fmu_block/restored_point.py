"""A point of an instance to which differences go back again and again, checked to be reached."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..calls import FmuInstance, FmuState

_ROUNDING = 1e-12
"""Largest difference of a value that was restored, relative to its size: far below the distances of differences."""


class RestoredPoint:
    """A state that is saved and restored, as long as that has the values of the point again.

    Values are compared until each has moved and come back once. They are read after a restore at the point itself, too,
    so that an FMU which computes outputs again then is compared with itself. Where a state can't be restored, or the
    FMU says that it has restored one and has not (`lied`), ``start`` brings a fresh instance to the point.
    """

    def __init__(self, instance: FmuInstance, names: Sequence[str], start: Callable[[], None]):
        self._instance, self._names, self._start = instance, [*names], start
        self.is_restored, self.lied = instance.description.can_save, False
        self._state: FmuState | None = None
        about = [instance.description.find(name) for name in names]
        self._nominals = np.concatenate([np.zeros(0), *(np.abs(np.ravel(v.nominals)) for v in about)])
        self._open = np.ones(self._nominals.size, dtype=bool)
        self._begun = np.zeros(0)

    def save(self) -> None:
        """Take the instance's present state as the point."""
        instance = self._instance
        self.free()
        if self.is_restored:
            self._state = instance.save()
            instance.restore(self._state)
            self._begun = instance.values(self._names)

    def go_back(self) -> None:
        """Bring the instance to the point."""
        if self._state is not None and self._restore(self._state):
            return
        self.free()
        self._start()
        self.save()

    def give_up(self) -> None:
        """Restore no state from here on: the FMU continues otherwise behind a restored state than from its start."""
        self.free()
        self.is_restored, self.lied = False, True

    def resume(self) -> None:
        """Restore states again, after `give_up` for a look at the difference that there was none."""
        self.is_restored, self.lied = True, False

    def free(self) -> None:
        """Free the saved state; do so before the instance is made again, to which it does not belong."""
        if self._state is not None:
            self._state.free()
            self._state = None

    def _restore(self, state: FmuState) -> bool:
        """Restore the state; return whether the values are those of the point."""
        instance, compares = self._instance, bool(self._open.any())
        moved = instance.values(self._names) if compares else self._begun
        instance.restore(state)
        if not compares:
            return True
        allowed, found = _ROUNDING * (self._nominals + np.abs(self._begun)), instance.values(self._names)
        if np.any(self._open & np.isfinite(self._begun) & ~(np.abs(found - self._begun) <= allowed)):
            self.is_restored, self.lied = False, True
            return False
        self._open &= ~(np.abs(moved - self._begun) > allowed)
        return True
