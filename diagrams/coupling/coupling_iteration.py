"""Search for the values on which the plants of a communication step agree."""

from __future__ import annotations

import numpy as np


class Search:
    """Search for values that a pass over a step returns unchanged, from the passes so far.

    The next guess is the best linear combination of the passes so far, by least squares (interface quasi-Newton with
    an inverse Jacobian from least squares, Degroote, Bathe, Vierendeels 2009): n + 1 passes solve n linear equations,
    also where plain repetition diverges.
    """

    def __init__(self, where: np.ndarray, scale: np.ndarray):
        self._where, self._scale = where, scale[where]
        self._found: list[np.ndarray] = []
        self._off: list[np.ndarray] = []

    def next(self, guess: np.ndarray, found: np.ndarray) -> np.ndarray:
        """Return the next guess, after a pass has made ``found`` of a guess."""
        result, where = found.copy(), self._where
        self._found.append(found[where])
        self._off.append((found[where] - guess[where]) / self._scale)
        if len(self._off) > 1:
            changes = np.array([off - self._off[-1] for off in self._off[:-1]]).T
            made = np.array([values - self._found[-1] for values in self._found[:-1]]).T
            weights = np.linalg.lstsq(changes, -self._off[-1], rcond=1e-10)[0]
            result[where] += made @ weights
        return result
