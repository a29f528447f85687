"""Values between flat vectors of float64 and an FMU's functions for each type, by calls that are bound once."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from ...blocks.core import Layout
from ..archive import FmuVariable, inexact
from .bound_calls import BoundCalls, Call
from .fmi_calls import WARNING, FmiCalls

_ROUNDED = 1e-12
_MOST_LISTS = 50
"""Lists of variables whose calls are kept; others are read type by type."""

EXACT, SINGLE = 1e-12, 1e-6
"""Relative distances up to which a value is kept, of double precision and of variables in single precision."""


def is_kept(found: np.ndarray, put: np.ndarray, *, single: bool = False, tolerance: float = EXACT) -> bool:
    """Return whether an FMU has the values that were set; a NaN is lost.

    An FMU may compute in single precision behind variables in double precision: their nearest numbers are the values.
    """
    if np.array_equal(found, put):
        return True
    if single:
        tolerance = SINGLE
    with np.errstate(over="ignore"):
        rounded = put.astype(np.float32).astype(float)
    return bool(np.all((np.abs(found - put) <= tolerance * np.abs(put)) | (found == rounded)))


class Transfer:
    """Calls that get or set the values of ports, all of one type in one call; ``chosen`` of the ports, or all.

    The vector holds the values of all ports, one after the other. Float64 values are read and written in it if all
    ports are of that type.
    """

    def __init__(
        self,
        fmi: FmiCalls,
        verb: str,
        ports: Mapping[str, FmuVariable],
        vector: np.ndarray,
        chosen: Collection[str] | None = None,
    ):
        self.groups: list[TypeGroup] = []
        self.vector = vector
        places = Layout.of({port: v.shape for port, v in ports.items()}).slices
        mine = {port: v for port, v in ports.items() if chosen is None or port in chosen}
        for type_ in dict.fromkeys(v.type for v in mine.values()):
            alike = {port: v for port, v in mine.items() if v.type == type_}
            self.groups.append(TypeGroup(fmi, verb, type_, alike, {p: places[p] for p in alike}, vector))
        self.is_plain = all(group.direct for group in self.groups)
        self._ports, self._places = mine, {port: places[port] for port in mine}
        self.has_limits = any(v.minimum is not None or v.maximum is not None for v in mine.values())
        """Whether a port has a smallest or largest value."""

    @cached_property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest value of each entry of the vector; infinite without one."""
        low, high = np.full(self.vector.size, -np.inf), np.full(self.vector.size, np.inf)
        for port, v in self._ports.items() if self.has_limits else ():
            low[self._places[port]], high[self._places[port]] = (np.ravel(side) for side in v.limits)
        # A signal at its bound that was converted from another unit may be off by a rounding.
        return low - _ROUNDED * np.abs(low), high + _ROUNDED * np.abs(high)

    @cached_property
    def _bounded(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places of the entries with a limit, and their least and greatest values."""
        low, high = self.limits
        places = np.flatnonzero(np.isfinite(low) | np.isfinite(high))
        return places, low[places], high[places]

    @property
    def plain_call(self) -> tuple[Callable[..., int], tuple[Any, ...]] | None:
        """The one call of a plain transfer; None without ports."""
        return (self.groups[0].function, self.groups[0].arguments) if self.groups else None

    @property
    def is_whole(self) -> bool:
        """Whether the values of the calls are those of the vector, all of one type and contiguous."""
        return all(group.is_whole for group in self.groups) and self.vector.flags.c_contiguous

    @property
    def views(self) -> list[tuple[memoryview, memoryview]]:
        """Memory of the vector, and of the values of each call that are not the vector's own."""
        return [(self.vector.data, group.buffer.data) for group in self.groups if group.size and not group.direct]

    @property
    def calls(self) -> list[Call]:
        """The calls, one for each type."""
        return [(group.function, group.arguments) for group in self.groups]

    def check_limits(self) -> None:
        """Raise the error of a value out of the range that the FMU's description states (`OutOfRangeError`)."""
        places, low, high = self._bounded
        found = self.vector[places]
        wrong = (found < low) | (found > high)
        if wrong.any():
            place = int(places[wrong][0])
            port = next(port for port, where in self._places.items() if where.start <= place < where.stop)
            value = float(self.vector[place])
            raise OutOfRangeError(port, f"found {value:.9g}; expected {self._ports[port].range_text}")

    def fill(self) -> None:
        """Copy the vector's values to where the calls read them; an `UnfitError` for one that is none of its type."""
        for group in self.groups:
            group.check_and_fill(self.vector)

    def spread(self) -> None:
        """Copy the values that were read into the vector; an `UnfitError` for an integer that it can't hold."""
        for group in self.groups:
            group.spread(self.vector)

    def set(self) -> int:
        """Set the values of the vector; return the first status that is no success, else 1 after a warning, else 0.

        After an `UnfitError` nothing of its type has been set.
        """
        self.fill()
        worst = 0
        for group in self.groups:
            if status := group.function(*group.arguments):
                if status > WARNING:
                    return status
                worst = status
        return worst


class UnfitError(Exception):
    """A value that doesn't fit: its port, and the reason, as "found …; expected …"."""

    def __init__(self, port: str, reason: str):
        super().__init__(port, reason)
        self.port, self.reason = port, reason


class OutOfRangeError(UnfitError):
    """A value out of the range that the FMU's description states."""


class TypedCall:
    """The call that gets or sets variables of one type, and the buffer of their values, made here if none is given."""

    def __init__(self, fmi: FmiCalls, verb: str, variables: Sequence[FmuVariable], buffer: np.ndarray | None = None):
        type_, references = variables[0].type, [r for v in variables for r in v.references]
        self.size = sum(v.size for v in variables)
        self.buffer = fmi.allocate(self.size, fmi.types[type_].ctype) if buffer is None else buffer
        self._kept = (ctypes.c_uint * max(1, len(references)))(*references)  # as long as its address is an argument
        self.function = fmi.value_function(verb, type_)
        self.arguments = fmi.value_arguments(self._kept, len(references), self.buffer.ctypes.data, self.size)


class TypeGroup(TypedCall):
    """Ports of one type: the call with their values, and their places in the vector."""

    def __init__(
        self,
        fmi: FmiCalls,
        verb: str,
        type_: str,
        ports: dict[str, FmuVariable],
        places: dict[str, slice],
        vector: np.ndarray,
    ):
        self.ports, self.places = ports, places
        variables = [*ports.values()]
        self.is_whole = type_ == "Float64" and sum(v.size for v in variables) == vector.size
        self.direct = self.is_whole and fmi.in_process
        self.is_integer = any(v.is_integer for v in variables)
        self.index = np.concatenate([np.arange(s.start, s.stop) for s in places.values()])
        super().__init__(fmi, verb, variables, vector if self.direct else None)

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Least and greatest values (n,) of the type; None of an enumeration whose numbers have gaps."""
        low, high = list[np.ndarray](), list[np.ndarray]()
        for variable in self.ports.values():
            if (found := variable.range_of_type) is None:
                return None
            low.append(np.full(variable.size, found[0]))
            high.append(np.full(variable.size, found[1]))
        return np.concatenate(low), np.concatenate(high)

    def check_and_fill(self, vector: np.ndarray) -> None:
        """Copy the values of the vector into the buffer."""
        if self.is_whole:
            if not self.direct:
                self.buffer[:] = vector
            return
        for port, where in self.places.items():
            if reason := self.ports[port].complaint(vector[where]):
                raise UnfitError(port, reason)
        self.buffer[: self.size] = vector[self.index]

    def spread(self, vector: np.ndarray) -> None:
        """Copy the values of the buffer into the vector."""
        if self.is_whole:
            if not self.direct:
                vector[:] = self.buffer
            return
        if self.is_integer and self.buffer.itemsize == 8 and inexact(self.buffer):
            port, value = next(
                (port, value)
                for port, values in zip(self.ports, self._split(), strict=True)
                for value in values
                if inexact(value)
            )
            raise UnfitError(
                port, f"found {value}; expected at most 2**53 in size, up to which a signal holds every integer"
            )
        vector[self.index] = self.buffer[: self.size]

    def _split(self) -> Sequence[np.ndarray]:
        ends = np.cumsum([v.size for v in self.ports.values()])[:-1]
        return np.split(self.buffer[: self.size], ends)


class WatchedInputs:
    """Some of the inputs, with the values that were taken last."""

    def __init__(self, fmi: FmiCalls, ports: Mapping[str, FmuVariable], vector: np.ndarray, chosen: Sequence[str]):
        places = Layout.of({port: v.shape for port, v in ports.items()}).slices
        self.index = np.concatenate([np.zeros(0, dtype=int), *(np.r_[places[port]] for port in chosen)])
        self.source = vector
        self.values = np.array(vector[self.index])
        self.transfer = Transfer(fmi, "Set", ports, vector, chosen)

    @property
    def differs(self) -> bool:
        """Whether the values of the diagram are others than those that were taken last."""
        return not np.array_equal(self.source[self.index], self.values)

    def take(self) -> bool:
        """Note the values of the diagram; return whether they have changed."""
        changed = self.differs
        self.values[:] = self.source[self.index]  # a zero may have got another sign
        return changed


class BoundReading:
    """Calls that read lists of variables, bound when a list is read for the second time."""

    def __init__(self, fmi: FmiCalls):
        self.fmi = fmi
        self._seen: set[tuple[str, ...]] = set()
        self._lists: dict[tuple[str, ...], tuple[BoundCalls, list[TypedCall]]] = {}

    def read(self, groups: Sequence[Sequence[FmuVariable]]) -> list[np.ndarray]:
        """Return the values of each group of variables of one type; nothing in process, or where a call fails."""
        key = tuple(v.name for group in groups for v in group)
        if self.fmi.in_process or not key:
            return []
        if key not in self._lists:
            if key not in self._seen or len(self._lists) >= _MOST_LISTS:
                self._seen.add(key)
                return []
            made = [TypedCall(self.fmi, "Get", group) for group in groups]
            self._lists[key] = self.fmi.bind([(one.function, one.arguments) for one in made]), made
        bound, calls = self._lists[key]
        return [np.array(one.buffer) for one in calls] if 0 <= bound.run() <= WARNING else []
