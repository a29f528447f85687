"""Events between ticks in C: the domains of their indicators, and what has fired."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from ..flat import FlatDiagram
from .bound_functions import FunctionInC, MemoryForC, TickStructure, fields_of
from .event_domains import Domains
from .model_exchange_in_c import NativeModelExchange

_LOGGED = 2**22  # bytes of what has fired in a call
_INSTANTS = 1100  # of a step that are looked at together, at most
_INT, _REAL, _AT = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class WatchStructure(ctypes.Structure):
    """The events as C knows them."""

    _fields_ = [
        ("m", _INT),
        ("indicators", TickStructure),
        ("jump", TickStructure),
        *fields_of(_AT, "z open fired rising falling hysteretic hysteresis own own_first"),
        *fields_of(_REAL, "spacing finest step"),
        *fields_of(_AT, "domain low high slack size rounding largest counts latest fresh"),
        *fields_of(_AT, "side stuck briefs brief_at recent recent_fired"),
        ("fired_times", _INT),
        ("log", _AT),
        *fields_of(_INT, "logged capacity"),
        *fields_of(_AT, "times seen gates domains x x_before now strict values motion later fires following"),
        *fields_of(_AT, "gate inside inside_first start"),
        *fields_of(_INT, "sliding switched"),
        ("slid", _AT),
        *fields_of(_INT, "pile culprit piled"),
    ]


class Pile(IntEnum):
    """How events pile up so that a run can't continue; see `EventLimits`."""

    IN_CONTACT, ZENO, CHATTERS, ENDLESS, ENDLESS_OUTSIDE = range(5)


class Fired(NamedTuple):
    """An event that has fired: its time in s, its place among the events, and the states before and after it."""

    t: float
    event: int
    before: np.ndarray
    after: np.ndarray


class Watch:
    """The events of a run, watched in C.

    Parameters
    ----------
    flat : FlatDiagram
        The diagram.
    functions : mapping of str to FunctionInC
        Its functions ``"indicators"`` and ``"jump"``.
    trial, here : sequence of ndarray
        The vectors (t, x, w, p) of a trial, and of the instant that is reached.
    x_next : ndarray
        Where jumps write the next states.
    domains : Domains
        What is kept of them, where C writes.
    step : float or None
        Fixed step of the method in s; None where it chooses its steps.
    exchange : NativeModelExchange, optional
        FMUs in model exchange, whose events they are, too.
    logged : int
        Bytes of what has fired, which is taken before there are more.

    Attributes
    ----------
    structure : WatchStructure
        It as C knows it; valid as long as this lives.
    """

    def __init__(
        self,
        flat: FlatDiagram,
        functions: Mapping[str, FunctionInC],
        trial: Sequence[np.ndarray],
        here: Sequence[np.ndarray],
        x_next: np.ndarray,
        *,
        domains: Domains,
        step: float | None,
        exchange: NativeModelExchange | None = None,
        logged: int = _LOGGED,
    ):
        self._memory = memory = MemoryForC()
        bind_block = None if exchange is None else exchange.bind_block
        events, n = flat.events, flat.continuous.size
        m = self._m = len(events)
        self._width = flat.width
        self.structure = WatchStructure(m=m, spacing=domains.spacing, finest=2e-16 * domains.spacing)
        self.structure.step = np.nan if step is None else step
        z, opened, fired = np.zeros(m), np.zeros(m), np.zeros(m)
        for name, vectors in {"z": z, "open": opened, "fired": fired}.items():
            self._put(name, vectors)
        self.structure.indicators = memory.bind(functions["indicators"], trial, [z, opened], bind_block)
        # Blocks in model exchange look at every instant; `loop_over_time` binds the jumps of a diagram with some.
        if exchange is None:
            self.structure.jump = memory.bind(functions["jump"], [*here, fired], [x_next])
        self.fired = fired
        """Which events fire in a jump, from 0 to 1."""
        flags = {
            "rising": [e.direction != "falling" for e in events],
            "falling": [e.direction != "rising" for e in events],
            "hysteretic": [e.hysteresis > 0.0 for e in events],
        }
        for name, values in flags.items():
            self._put(name, np.array(values, dtype=np.uint8))
        self._put("hysteresis", np.array([e.hysteresis for e in events]))
        self._put("own", np.concatenate([np.zeros(0), *domains.own]).astype(np.int64))
        self._put("own_first", np.cumsum([0, *map(len, domains.own)]).astype(np.int64))
        self._put_resets(flat)
        for name, part in domains.parts.items():
            self._put(name, part)
        self._slid = np.full(m, np.nan)
        self._put("slid", self._slid)
        # at least a row for each event: all of them may fire at one instant
        row = 2 + 2 * self._width
        self._log = np.zeros((max(200 if logged else 1, m, logged // (8 * row)), row))
        self._put("log", self._log)
        self.structure.capacity = len(self._log)
        for name in ("times", "seen", "gates", "domains"):
            self._put(name, np.zeros(_INSTANTS * (1 if name == "times" else m)))
        for name in ("x", "x_before"):
            self._put(name, np.zeros(n))
        for name in ("now", "strict", "values", "later"):
            self._put(name, np.zeros(m))
        self._put("motion", np.zeros(6 * m))
        self.fires = np.zeros(m, dtype=np.uint8)
        """Which events fire at the instant that C has come to."""
        self._put("fires", self.fires)
        self._put("following", np.zeros(m, dtype=np.uint8))

    @property
    def kept(self) -> list[Any]:
        """All that lives as long as it: whatever the pointers of its structure lead to."""
        return self._memory.kept

    def _put(self, name: str, vector: np.ndarray) -> None:
        setattr(self.structure, name, self._memory.own(vector))

    def _put_resets(self, flat: FlatDiagram) -> None:
        """Tell C the events that reset a subsystem: its gate among the states, and the events inside it."""
        gates, inside = np.full(self._m, -1, dtype=np.int64), list[list[int]]()
        for i, event in enumerate(flat.events):
            inside.append([])
            if event.subsystem and flat.table.subsystems[event.path].when == "reset":
                gates[i] = flat.gates.slices[event.path].start
                own = (j for j, e in enumerate(flat.events) if e.path.startswith(f"{event.path}.") and not e.subsystem)
                inside[i].extend(own)
        self._put("gate", gates)
        self._put("inside", np.array([j for own in inside for j in own] + [0], dtype=np.int64))
        self._put("inside_first", np.cumsum([0, *map(len, inside)]).astype(np.int64))

    def take_slid(self) -> list[tuple[float, int]]:
        """Return the events that have begun to slide since the last call, and when, in s."""
        found = [(float(self._slid[i]), int(i)) for i in np.flatnonzero(~np.isnan(self._slid))]
        self._slid[:] = np.nan
        return sorted(found)

    def take(self, structure: WatchStructure) -> list[Fired]:
        """Return what has fired since the last call, from the structure that C has changed."""
        count, width = structure.logged, self._width
        rows = self._log[:count].copy()
        structure.logged = 0
        return [Fired(float(r[0]), int(r[1]), r[2 : 2 + width], r[2 + width :]) for r in rows]
