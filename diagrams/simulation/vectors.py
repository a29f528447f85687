"""The vectors t, x, w, p at which all functions of a diagram are evaluated."""

from __future__ import annotations

import numpy as np

from ..flat import FlatDiagram


class Vectors:
    """An instant, in memory that functions are bound to.

    Attributes
    ----------
    t : ndarray
        Time in s, shape (1,).
    x : ndarray
        States, held outputs, gates, reset states and loop values, shape (`FlatDiagram.width`,).
    w : ndarray
        Outputs of plants and of transport delays.
    p : ndarray
        Parameters; one vector may serve several instants of a run.
    """

    def __init__(self, flat: FlatDiagram, p: np.ndarray):
        self.t = np.zeros(1)
        self.x = flat.x0.copy()
        self.w = np.zeros(flat.plant_outputs.total)
        self.p = p
