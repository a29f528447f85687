"""The loop with continuous states, as C knows it."""

from __future__ import annotations

import ctypes

from .bound_functions import TickStructure, fields_of
from .events_in_c import WatchStructure
from .loop_over_ticks import LoopStructure

_INT, _REAL, _AT = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class ProblemStructure(ctypes.Structure):
    """A differential equation, as C knows it."""

    _fields_ = [
        *fields_of(_INT, "n width"),
        ("where", _AT),
        ("flow", TickStructure),
        ("slope", TickStructure),
        *fields_of(_AT, "t x slopes"),
        ("entries", _INT),
        *fields_of(_AT, "row column"),
        *fields_of(_REAL, "stop edge left at late"),
        *fields_of(_AT, "loops here by_loops delays"),
        *fields_of(_INT, "rates jacobians lost noting"),
        ("beyond_t", _REAL),
        ("beyond", _AT),
    ]


class DelaysStructure(ctypes.Structure):
    """Transport delays, as C knows them."""

    _fields_ = [
        *fields_of(_INT, "n distinct"),
        *fields_of(_AT, "tau different input output size start node weight"),
        *fields_of(_INT, "inputs outputs"),
        *fields_of(_AT, "here trial"),
        ("driven", TickStructure),
        *fields_of(_AT, "z found"),
        *fields_of(_REAL, "rtol atol"),
        *fields_of(_AT, "pieces edges"),
        *fields_of(_INT, "count capacity noted room smoothed"),
        ("middle", _REAL),
    ]


class MethodStructure(ctypes.Structure):
    """A method of integration, as C knows it."""

    _fields_ = [
        *fields_of(_INT, "kind n stages order extra"),
        *fields_of(_AT, "A B C E E3 P A_extra C_extra atol"),
        *fields_of(_REAL, "rtol longest exponent"),
        ("of", _AT),
        *fields_of(_REAL, "planned t t_old h start"),
        *fields_of(_INT, "count done steps rejected segment"),
        ("mark", _REAL),
        *fields_of(ctypes.c_int32, "sliver prepared"),
        *fields_of(_AT, "x x_old f y g K D J lu lu_complex Z W F error scale pivots pivots_complex"),
        *fields_of(_REAL, "h_of_lu h_before error_before tolerance"),
        *fields_of(ctypes.c_int32, "has_lu has_slope slope_is_new predicts"),
        *fields_of(_AT, "step library"),
        ("begins", ctypes.c_int32),
    ]


class HybridStructure(ctypes.Structure):
    """The loop with continuous states, as C knows it."""

    _fields_ = [
        ("l", LoopStructure),
        ("p", ProblemStructure),
        ("w", WatchStructure),
        ("methods", _AT * 2),
        *fields_of(_INT, "active automatic accepts between budget inside begun stepped"),
        *fields_of(_REAL, "t to counts_as"),
        *fields_of(_INT, "found hits misses easy outputs"),
        *fields_of(_AT, "taken taken_first taken_states before"),
        ("switched", _INT),
        ("solved", _AT),
        ("looked_at", _REAL),
        ("o", _AT),
        ("jump", _REAL),
        ("drain", _AT),
        *fields_of(_INT, "coupled lost_at"),
        ("looked", _REAL),
    ]


class SpanStructure(ctypes.Structure):
    """Ticks and instants of a call, as C knows them."""

    _fields_ = [
        ("count", _INT),
        *fields_of(_AT, "times widths kinds lands"),
        ("beyond", _REAL),
        ("edges", _INT),
        *fields_of(_AT, "edge late"),
        *fields_of(_INT, "room stays"),
    ]
