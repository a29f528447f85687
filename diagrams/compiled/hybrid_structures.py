"""The loop with continuous states, as C knows it."""

from __future__ import annotations

import ctypes
from typing import Any

from .bound_functions import TickStructure
from .compiled_loop import LoopStructure
from .watch import WatchStructure


def _fields(kind: Any, names: str) -> list[tuple[str, Any]]:
    return [(name, kind) for name in names.split()]


_INT, _REAL, _AT = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class ProblemStructure(ctypes.Structure):
    """A differential equation, as C knows it."""

    _fields_ = [
        *_fields(_INT, "n width"),
        ("where", _AT),
        ("flow", TickStructure),
        ("slope", TickStructure),
        *_fields(_AT, "t x slopes"),
        ("entries", _INT),
        *_fields(_AT, "row column"),
        *_fields(_REAL, "stop edge left at late"),
        *_fields(_AT, "loops here by_loops delays"),
        *_fields(_INT, "rates jacobians lost noting"),
        ("beyond_t", _REAL),
        ("beyond", _AT),
    ]


class DelaysStructure(ctypes.Structure):
    """Transport delays, as C knows them."""

    _fields_ = [
        *_fields(_INT, "n distinct"),
        *_fields(_AT, "tau different input output size start node weight"),
        *_fields(_INT, "inputs outputs"),
        *_fields(_AT, "here trial"),
        ("driven", TickStructure),
        *_fields(_AT, "z found"),
        *_fields(_REAL, "rtol atol"),
        *_fields(_AT, "pieces edges"),
        *_fields(_INT, "count capacity noted room smoothed"),
        ("middle", _REAL),
    ]


class MethodStructure(ctypes.Structure):
    """A method of integration, as C knows it."""

    _fields_ = [
        *_fields(_INT, "kind n stages order extra"),
        *_fields(_AT, "A B C E E3 P A_extra C_extra atol"),
        *_fields(_REAL, "rtol longest exponent"),
        ("of", _AT),
        *_fields(_REAL, "planned t t_old h start"),
        *_fields(_INT, "count done steps rejected segment"),
        ("mark", _REAL),
        *_fields(ctypes.c_int32, "sliver prepared"),
        *_fields(_AT, "x x_old f y g K D J lu lu_complex Z W F error scale pivots pivots_complex"),
        *_fields(_REAL, "h_of_lu h_before error_before tolerance"),
        *_fields(ctypes.c_int32, "has_lu has_slope slope_is_new predicts"),
        *_fields(_AT, "step library"),
        ("begins", ctypes.c_int32),
    ]


class HybridStructure(ctypes.Structure):
    """The loop with continuous states, as C knows it."""

    _fields_ = [
        ("l", LoopStructure),
        ("p", ProblemStructure),
        ("w", WatchStructure),
        ("methods", _AT * 2),
        *_fields(_INT, "active automatic accepts between budget inside begun stepped"),
        *_fields(_REAL, "t to counts_as"),
        *_fields(_INT, "found hits misses easy outputs"),
        *_fields(_AT, "taken taken_first taken_states before"),
        ("switched", _INT),
        ("solved", _AT),
        ("looked_at", _REAL),
        ("o", _AT),
        ("jump", _REAL),
        ("drain", _AT),
        *_fields(_INT, "coupled lost_at"),
        ("looked", _REAL),
    ]


class SpanStructure(ctypes.Structure):
    """Ticks and instants of a call, as C knows them."""

    _fields_ = [
        ("count", _INT),
        *_fields(_AT, "times widths kinds lands"),
        ("beyond", _REAL),
        ("edges", _INT),
        *_fields(_AT, "edge late"),
        *_fields(_INT, "room stays"),
    ]
