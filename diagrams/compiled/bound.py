"""Compiled functions, bound to vectors."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np

from .loop import TickStructure


class BoundFunction:
    """A compiled function, bound to vectors.

    Parameters
    ----------
    function : casadi.Function
        The function that was compiled.
    at : int
        Address of its C function.
    arguments, results : sequence of ndarray
        Its vectors.

    Attributes
    ----------
    structure : ctypes.Structure
        It as C knows it; valid as long as this lives.
    """

    def __init__(self, function: Any, at: int, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]):
        given, made = (ctypes.c_void_p * function.sz_arg())(), (ctypes.c_void_p * function.sz_res())()
        for into, vectors in ((given, arguments), (made, results)):
            for i, vector in enumerate(vectors):
                into[i] = address(vector)
        iw, w = np.zeros(function.sz_iw() + 1, dtype=np.int64), np.zeros(function.sz_w() + 1)
        self._kept = given, made, iw, w, arguments, results
        self.structure = TickStructure(at, ctypes.addressof(given), ctypes.addressof(made), address(iw), address(w))


def address(vector: np.ndarray) -> int | None:
    """Return the address of a vector; None without entries."""
    return vector.ctypes.data if vector.size else None
