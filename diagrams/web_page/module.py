"""A diagram as a WebAssembly module: its loop, its own FMUs, and the few functions that a page calls."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ...fmus.export import LoopSpec, compile_webassembly, write_unit
from ..exporting import let_move, loop_spec, open_whole, own_fmus
from ..flat import FlatDiagram, Target, WiredDiagram
from ..wiring import Wire

_WAY_OUT = "Or make the page of a diagram without it."
Place = tuple[str, int]
"""An entry of a vector of the loop's memory: "log", "w" or "p", and its number."""


@dataclass(frozen=True, eq=False)
class WebModule:
    """A diagram to run in a page.

    ``places``: of each output of a block, by path and port: where its entries are.
    """

    spec: LoopSpec
    source: str
    places: Mapping[tuple[str, str], list[Place]]

    def compile(self) -> bytes:
        """Return the module.

        Raises `CompilerError` if there is no compiler that builds WebAssembly, or it fails.
        """
        with TemporaryDirectory() as folder:
            out = Path(folder) / "module.wasm"
            compile_webassembly(self.source, out)
            return out.read_bytes()


def make_module(
    wired: WiredDiagram,
    flat: FlatDiagram,
    columns: Sequence[tuple[Wire, int]],
    moved: Sequence[Target],
    *,
    solver: str = "auto",
) -> WebModule:
    """Return a diagram as a module.

    ``flat``: the diagram with the ticks at which it is sampled.
    ``columns``: what samples have: outputs of blocks, each with an entry, flat.
    Raises `DefinitionError`: for what can't be in a page, by its path, with a next step.
    """
    opened = let_move(open_whole(wired, (), "diagram"), moved)
    own_fmus(opened, _WAY_OUT)
    about = f"Diagram {wired.name}."
    step = float(flat.base)
    between = not wired.has_clock  # else nothing would be evaluated
    spec = loop_spec(opened, name="diagram", description=about, solver=solver, between=between, step_size=step)
    places = dict(_places(spec, wired))
    page = files(__package__).joinpath("page", "module.c").read_text(encoding="utf-8")
    glue = _write_glue(places, columns)
    return WebModule(spec, "\n".join([write_unit(spec, own_functions=True), *glue, page]), places)


def _places(spec: LoopSpec, wired: WiredDiagram) -> Iterator[tuple[tuple[str, str], list[Place]]]:
    for block, port, first, count in spec.labels:
        yield (block, port), [("log", first + i) for i in range(count)]
    for plant in spec.plants:
        place = plant.placed.first_output
        for port in wired.blocks[plant.placed.path].outputs:
            count = int(np.prod(wired.checked.shapes[plant.placed.path, port]))
            yield (plant.placed.path, port), [("w", place + i) for i in range(count)]
            place += count


def _write_glue(places: Mapping[tuple[str, str], list[Place]], columns: Sequence[tuple[Wire, int]]) -> Iterator[str]:
    """Yield the C text of what `page/module.c` needs before it."""
    yield f"#define LW_N_COLUMNS {len(columns)}"
    yield "static lw_memory lw_page_memory;"
    yield "static inline void lw_read_row(double *row) {"
    for i, (wire, entry) in enumerate(columns):
        vector, place = places[wire.block, wire.port][entry]
        yield f"    row[{i}] = lw_page_memory.{vector}[{place}];"
    yield "}"
