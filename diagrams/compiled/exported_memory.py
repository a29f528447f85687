"""The memory of a loop that is exported: the structs that are bound for C, read back as C text.

A run fills in the structs of the loop in C with addresses of vectors. The same structs, filled in in the same way, say
all that an export needs: each pointer leads into a vector, to another struct, or to a function.
"""

from __future__ import annotations

import ctypes
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from ...fmus.export import Field, LoopMemory, c_number
from ..flat import share_terms
from .bound_functions import BoundFunction, CodeOfFunctions, CompiledFunction, TickStructure
from .events_in_c import WatchStructure
from .hybrid_structures import DelaysStructure, HybridStructure, MethodStructure, ProblemStructure
from .loop_over_ticks import LoopStructure
from .newton import NewtonStructure

_STRUCTS: dict[type[ctypes.Structure], str] = {
    TickStructure: "tick",
    LoopStructure: "loop",
    NewtonStructure: "newton",
    ProblemStructure: "problem",
    DelaysStructure: "delays",
    MethodStructure: "method",
    WatchStructure: "watch",
    HybridStructure: "hybrid",
}
_FIRST = 1 << 40  # in place of the address of the first function; no vector of a process is there


class NamedCode(CodeOfFunctions):
    """Functions that C finds by their names, in one unit with the loop: nothing is compiled or loaded."""

    def __init__(self, library: ctypes.CDLL):
        super().__init__(library)
        self.__dict__["functions"] = []

    functions: list[Any]

    def find(self, function: Any) -> CompiledFunction:
        """Return a function under a name that nothing in the loop has; a number takes the place of its address."""
        self.functions.append(share_terms(function, f"lw_of_{function.name()}"))
        return CompiledFunction(self.functions[-1], _FIRST + 16 * len(self.functions))

    def name_of(self, address: int) -> str | None:
        """Return the name of a function by the number in place of its address."""
        place = (address - _FIRST) // 16 - 1
        return str(self.functions[place].name()) if 0 <= place < len(self.functions) else None


def read_memory(
    roots: Mapping[str, ctypes.Structure], vectors: Mapping[str, np.ndarray], kept: Iterable[Any], code: NamedCode
) -> LoopMemory:
    """Return the memory of a loop: of structs and of vectors, by the names of their members.

    ``kept`` lives as long as the structs: all that their pointers lead to, but for functions, which are those of
    ``code``.
    """
    return _Reader(vectors, kept, code).read(roots)


class _Reader:
    def __init__(self, vectors: Mapping[str, np.ndarray], kept: Iterable[Any], code: NamedCode):
        self._code = code
        self._fields: dict[str, Field] = {}
        self._numbers: list[tuple[str, str]] = []
        self._pointers: list[tuple[str, str]] = []
        self._names: dict[int, str] = {}  # by address
        self._named: dict[str, Any] = {}
        self._inside: list[tuple[int, int, str]] = []  # structs: begin, end, member
        owners = {id(owner): owner for owner in _memories(kept)}
        for name, vector in vectors.items():
            owner = _owner(vector)
            owners[id(owner)] = owner
            self._names[_span(owner)[0]] = name
            self._named[name] = owner
        self._owners = sorted(owners.values(), key=_span)
        self._begins = [_span(owner)[0] for owner in self._owners]

    def read(self, roots: Mapping[str, ctypes.Structure]) -> LoopMemory:
        for name, structure in roots.items():
            begin = ctypes.addressof(structure)
            self._inside.append((begin, begin + ctypes.sizeof(structure), name))
            self._fields[name] = Field(name, _STRUCTS[type(structure)], each=ctypes.sizeof(structure))
        # In the order of their names, not of addresses: one diagram has one text.
        for name, owner in self._named.items():
            if self._names[_span(owner)[0]] == name and isinstance(owner, np.ndarray):
                self._fields[name] = Field.of(name, owner)
        for name, structure in roots.items():
            self._read_struct(name, structure)
        return LoopMemory(tuple(self._fields.values()), tuple(self._numbers), tuple(self._pointers))

    def _read_struct(self, member: str, structure: ctypes.Structure) -> None:
        for name, kind, *_ in structure._fields_:
            value = getattr(structure, name)
            path = f"{member}.{name}"
            if isinstance(value, ctypes.Structure):
                self._read_struct(path, value)
            elif isinstance(value, ctypes.Array):
                for i, entry in enumerate(value):
                    self._pointers.append((f"{path}[{i}]", self._target(entry)))
            elif kind is ctypes.c_void_p:
                self._pointers.append((path, self._target(value)))
            elif value:
                self._numbers.append((path, c_number(value)))

    def _target(self, address: int | None) -> str:
        """Return what an address leads to, as C text."""
        if not address:
            return "NULL"
        if (name := self._code.name_of(address)) is not None:
            return name
        for begin, end, root in self._inside:
            if begin <= address < end:
                return f"(void *)((char *)&m->{root} + {self._offset(root, address - begin)})"
        place = bisect_right(self._begins, address) - 1
        begin, end = _span(self._owners[place]) if place >= 0 else (0, 0)
        if not begin <= address < end:
            return "NULL"  # a function of Python's, which only a run has
        owner = self._owners[place]
        member = self._names.get(begin) or self._add(owner)
        if isinstance(owner, np.ndarray):
            offset = (address - begin) // owner.itemsize
            return f"(void *)(m->{member}{f' + {offset}' if offset else ''})"
        return f"(void *)m->{member}"

    @staticmethod
    def _offset(member: str, offset: int) -> str:
        if member == "hybrid" and offset == HybridStructure.p.offset:
            return "offsetof(hybrid, p)"
        assert offset == 0
        return "0"

    def _add(self, owner: Any) -> str:
        """Add a vector, an array of pointers, or structs; return the name of its member."""
        begin, _ = _span(owner)
        number = len(self._fields)
        if isinstance(owner, np.ndarray):
            name = f"a{number}"
            self._fields[name] = Field.of(name, owner)
        elif isinstance(owner, ctypes.Structure):
            name = f"s{number}"
            self._fields[name] = Field(name, _STRUCTS[type(owner)], 1, each=ctypes.sizeof(owner))
            self._names[begin] = name
            self._read_struct(f"{name}[0]", owner)
        elif issubclass(owner._type_, ctypes.Structure):
            name = f"s{number}"
            self._fields[name] = Field(name, _STRUCTS[owner._type_], len(owner), each=ctypes.sizeof(owner._type_))
            self._names[begin] = name
            for i, structure in enumerate(owner):
                self._read_struct(f"{name}[{i}]", structure)
        else:
            name = f"v{number}"
            self._fields[name] = Field(name, "double *", len(owner))
            self._names[begin] = name
            for i, address in enumerate(owner):
                self._pointers.append((f"{name}[{i}]", self._target(address)))
        self._names[begin] = name
        return name


def _owner(vector: np.ndarray) -> np.ndarray:
    while isinstance(vector.base, np.ndarray):
        vector = vector.base
    return vector


def _span(owner: Any) -> tuple[int, int]:
    """Return the addresses at which a vector or a struct begins and ends."""
    if isinstance(owner, np.ndarray):
        begin = owner.__array_interface__["data"][0]
        return begin, begin + owner.nbytes
    begin = ctypes.addressof(owner)
    return begin, begin + ctypes.sizeof(owner)


def _memories(kept: Iterable[Any]) -> Iterator[Any]:
    """Yield all vectors, structs and arrays of pointers in lists of what must live as long as structs."""
    for item in kept:
        if isinstance(item, np.ndarray):
            if item.size:
                yield _owner(item)
        elif isinstance(item, ctypes.Structure):
            yield item
        elif isinstance(item, ctypes.Array):
            if len(item):
                yield item
        elif isinstance(item, BoundFunction):
            yield from _memories([*item.arguments, *item.results, item.inner, item.memory, *item.kept])
        elif isinstance(item, (list, tuple)):
            yield from _memories(item)


def function_text(functions: Iterable[Any]) -> str:
    """Return the C code of functions that pointers of the memory lead to."""
    from .generated_text import write_functions

    return write_functions("loop", functions)
