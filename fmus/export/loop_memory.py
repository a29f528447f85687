"""The memory of an exported loop: every struct and vector that its C code reads or writes, as one C struct."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .c_text import c_array, c_number

_C_TYPES = {"float64": "double", "int64": "int64_t", "int32": "int32_t", "uint8": "uint8_t"}


@dataclass(frozen=True, eq=False)
class Field:
    """A member of the memory: a struct, several of them, pointers, or a vector of numbers.

    ``length``: number of entries; 0 for a single one.
    ``each``: bytes of an entry, where pointers have eight.
    """

    name: str
    kind: str
    length: int = 0
    start: np.ndarray | None = None
    each: int = 8

    @classmethod
    def of(cls, name: str, vector: np.ndarray) -> Field:
        """Return the member that holds a vector of numbers."""
        return cls(name, _C_TYPES[vector.dtype.name], max(1, vector.size), vector.ravel().copy(), vector.itemsize)

    @property
    def declaration(self) -> str:
        """The member's declaration."""
        return f"{self.kind} {self.name}{f'[{self.length}]' if self.length else ''};"


@dataclass(frozen=True, eq=False)
class LoopMemory:
    """The memory of a loop: an instance is one block of it, and nothing else is allocated.

    ``numbers``: numbers in structs that are not 0 at the start: the member, and the number, as C text.
    ``pointers``: pointers: the member, and what it points to; ``m`` is the memory.
    """

    fields: tuple[Field, ...]
    numbers: tuple[tuple[str, str], ...]
    pointers: tuple[tuple[str, str], ...]

    @property
    def bytes(self) -> int:
        """Bytes of it where pointers have eight; nowhere more."""
        return 4 * 8 + sum(-(-field.each * max(1, field.length) // 8) * 8 for field in self.fields)

    def write(self) -> str:
        """Return the C text: the struct ``lw_memory``, and the functions ``lw_fill``, ``lw_bind`` and ``lw_unbind``.

        ``lw_fill`` sets start values. ``lw_bind`` sets the pointers. It has to be called again for a
        memory that was copied to another place.
        ``lw_unbind`` sets them all to NULL, so that equal memories have equal bytes.
        """
        return "\n".join([*self._declare(), *self._tables(), *self._fill(), *self._bind()]) + "\n"

    def _declare(self) -> Iterator[str]:
        yield "typedef struct {"
        yield "    int64_t tick; /* the next one */"
        yield "    int64_t lost; /* kind of the tick that can't be evaluated */"
        yield "    int64_t reason; /* why the loop with continuous states can't continue, see instants.c */"
        yield "    double now;   /* time that has been reached, s */"
        yield from (f"    {field.declaration}" for field in self.fields)
        yield "} lw_memory;\n"

    def _started(self) -> Iterator[tuple[Field, np.ndarray]]:
        for field in self.fields:
            if field.start is not None and field.start.any():
                yield field, field.start

    def _tables(self) -> Iterator[str]:
        for field, start in self._started():
            yield c_array(field.kind, f"lw_start_{field.name}", map(c_number, start.tolist())).rstrip()

    def _fill(self) -> Iterator[str]:
        yield "static void lw_fill(lw_memory *m) {"
        yield "    memset(m, 0, sizeof *m);"
        for field, _ in self._started():
            yield f"    memcpy(m->{field.name}, lw_start_{field.name}, sizeof lw_start_{field.name});"
        yield from (f"    m->{member} = {value};" for member, value in self.numbers)
        yield "}\n"

    def _bind(self) -> Iterator[str]:
        yield "static void lw_bind(lw_memory *m) {"
        yield from (f"    m->{member} = {target};" for member, target in self.pointers)
        yield "}\n"
        yield "static void lw_unbind(lw_memory *m) {"
        yield "    (void)m;"
        yield from (f"    m->{member} = NULL;" for member, _ in self.pointers)
        yield "}\n"
