"""C code over vectors of ticks: small ones as one function of scalar operations, others as groups of blocks."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files

from ..compiled import LARGEST, ExpandedFunctions
from ..flat import FlatDiagram, TickPattern
from .grouped_code import GroupedCode
from .scalar_calls import ScalarFunctions
from .vector_code import VectorCode, write_vectors

_TICK = ("t", "x", "w", "p")


class TickSources:
    """The ticks of a diagram, to be written as C over vectors: ``NAME(t, x, w, p, kept, x_next, z, log, ok)``.

    ``text`` comes before them; ``is_grouped``: they are groups of equal blocks, whose values need memory.
    """

    def __init__(self, flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], scalars: ScalarFunctions):
        kinds = [*dict.fromkeys(acting)]
        expanded = None if flat.by_block else ExpandedFunctions(flat, kinds)
        self.is_grouped, self.text = True, ""
        if expanded is not None and expanded.exact and expanded.operations <= LARGEST:
            self.is_grouped, self._expanded = False, dict(zip(kinds, expanded.functions, strict=True))
        else:
            self._programs = {clocks: flat.program_at(clocks) for clocks in kinds}
            self._code = GroupedCode([*self._programs.values()], scalars, read_source("grouped_lanes.c"))
            self.text = self._code.text

    def write(self, name: str, clocks: frozenset[TickPattern]) -> VectorCode:
        """Write the tick at which some clocks act, under a name."""
        if self.is_grouped:
            return self._code.write(name, self._programs[clocks])
        return write_vectors(name, self._expanded[clocks], _TICK, {3})


def read_source(name: str) -> str:
    """Return a C source of this package."""
    return files(__package__).joinpath(name).read_text(encoding="utf-8")
