"""A diagram as a WebAssembly module: its loop, its own FMUs, and the few functions that a page calls."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ...blocks.core import DefinitionError
from ...fmus import Fmu
from ...fmus.export import LoopSpec, compile_webassembly, merge_model, write_unit
from ..exporting import let_move, loop_spec, open_whole
from ..flat import FlatDiagram, Target, WiredDiagram
from ..wiring import Wire, stepped_blocks

Tuned = tuple[str, int, int]
"""A parameter of an FMU: the FMU's path, the value reference, and the element of it."""
Place = tuple[str, int]
"""An entry of a vector of the loop's memory: "log", "w" or "p", and its number."""


@dataclass(frozen=True, eq=False)
class WebModule:
    """A diagram to run in a page.

    Attributes
    ----------
    spec : LoopSpec
        Its loop, without its FMUs.
    source : str
        The C text of all of it.
    places : mapping of (str, str) to list of Place
        Of each output of a block, by path and port: where its entries are.
    plants : tuple of str
        Paths of its FMUs.
    """

    spec: LoopSpec
    source: str
    places: Mapping[tuple[str, str], list[Place]]
    plants: tuple[str, ...]

    def compile(self) -> bytes:
        """Return the module.

        Raises
        ------
        CompilerError
            If there is no compiler that builds WebAssembly, or it fails.
        """
        with TemporaryDirectory() as folder:
            out = Path(folder) / "module.wasm"
            compile_webassembly(self.source, out)
            return out.read_bytes()


def find_plants(wired: WiredDiagram) -> dict[str, Fmu]:
    """Return the FMUs of a diagram that are stepped, by path."""
    blocks = stepped_blocks(wired.structure).items()
    return {path: block for path, block in blocks if isinstance(block, Fmu)}  # `loop_spec` says what another one is


def make_module(
    wired: WiredDiagram,
    flat: FlatDiagram,
    columns: Sequence[tuple[Wire, int]],
    moved: Sequence[Target],
    tuned: Sequence[Tuned] = (),
    *,
    solver: str = "auto",
) -> WebModule:
    """Return a diagram as a module.

    Parameters
    ----------
    flat : FlatDiagram
        The diagram with the ticks at which it is sampled.
    columns : sequence of (Wire, int)
        What samples have: outputs of blocks, each with an entry, flat.
    moved : sequence of Target
        Parameters of blocks that the page changes.
    tuned : sequence of Tuned
        Those of FMUs.
    solver : str
        Method of the continuous states.

    Raises
    ------
    DefinitionError
        For what can't be in a page, by its path, with a next step.
    """
    plants = find_plants(wired)
    texts = {path: _merge(path, plant, wired, f"m{i}") for i, (path, plant) in enumerate(plants.items())}
    opened = let_move(open_whole(wired, tuple(plants), "diagram"), moved)
    about = f"Diagram {wired.name}."
    step = float(flat.base)
    spec = loop_spec(opened, name="diagram", description=about, solver=solver, between=False, step_size=step)
    places = dict(_places(spec, plants))
    page = files(__package__).joinpath("page", "module.c").read_text(encoding="utf-8")
    glue = _write_glue(spec, places, plants, flat, columns, tuned)
    source = "\n".join([*texts.values(), write_unit(spec, own_functions=True), *glue, page])
    return WebModule(spec, source, places, tuple(plants))


def _merge(path: str, plant: Fmu, wired: WiredDiagram, prefix: str) -> str:
    """Return the C text of an FMU; refuse what is not of ours, or not stepped plainly."""
    if plant.stepping != type(plant.stepping)():
        raise DefinitionError(
            f"found {plant.stepping!r}; expected an FMU with plain steps, without options of its own. Leave stepping "
            "out for the page.",
            block=path,
        )
    variables = plant.description.variables
    ins = [plant.input_variables[port] for port in _wired_inputs(plant, path, wired)]
    outs = [plant.output_variables[port] for port in plant.outputs]
    start = [
        (reference, np.atleast_1d(value).ravel().tolist())
        for name, given in plant.start.items()
        for reference, value in _split(variables[name], given)
    ]
    text = None
    if all(v.type == "Float64" for v in (*ins, *outs)):
        text = merge_model(plant.description.file, prefix, inputs=_sized(ins), outputs=_sized(outs), start=start)
    if text is None:
        raise DefinitionError(
            f"found {plant.description.file.name}, an FMU that this version of Loopwright has not built: only binaries "
            "for other platforms are in it, and a page runs none of them. Replace it by a plant in equations "
            "(docs/howto/export.md), build it again with this version, or make the page of a diagram without it.",
            block=path,
        )
    return text


def _split(variable: Any, value: Any) -> Iterator[tuple[int, Any]]:
    """Yield the value references of a variable with their values."""
    if len(variable.references) == 1:
        yield variable.references[0], value
    else:
        yield from zip(variable.references, np.ravel(value), strict=True)


def _sized(variables: Sequence[Any]) -> list[tuple[int, int]]:
    """Return value references with their numbers of elements."""
    return [(r, v.size // len(v.references)) for v in variables for r in v.references]


def _places(spec: LoopSpec, plants: Mapping[str, Fmu]) -> Iterator[tuple[tuple[str, str], list[Place]]]:
    for block, port, first, count in spec.labels:
        yield (block, port), [("log", first + i) for i in range(count)]
    inputs = iter(spec.inputs)
    for path, plant in plants.items():
        for port in plant.outputs:
            one = next(inputs)
            yield (path, port), [(one.vector, place) for place in one.places]


def _write_glue(
    spec: LoopSpec,
    places: Mapping[tuple[str, str], list[Place]],
    plants: Mapping[str, Fmu],
    flat: FlatDiagram,
    columns: Sequence[tuple[Wire, int]],
    tuned: Sequence[Tuned],
) -> Iterator[str]:
    """Yield the C text of what `page/module.c` needs before it."""
    yield f"#define LW_N_COLUMNS {len(columns)}"
    yield "static lw_memory lw_page_memory;"
    yield "static inline void lw_read_row(double *row) {"
    for i, (wire, entry) in enumerate(columns):
        vector, place = places[wire.block, wire.port][entry]
        yield f"    row[{i}] = lw_page_memory.{vector}[{place}];"
    yield "}"
    reads, gives, entries = iter(spec.outputs), iter(spec.inputs), list[str]()
    for j, (path, plant) in enumerate(plants.items()):
        taken = [place for port in _wired_inputs(plant, path, flat) for place in next(reads).places]
        given = [place for port in plant.outputs for place in next(gives).places]
        ticks = ", ".join(f"{{{clock.every}, {clock.offset}}}" for clock in flat.plant_ticks[path])
        yield f"static const int lw_from{j}[] = {{{', '.join(map(str, taken)) or 0}}};"
        yield f"static double lw_held{j}[{max(1, len(taken))}];"
        yield f"static const int64_t lw_due{j}[][2] = {{{ticks}}};"
        own = f"m{j}lw_plant_"
        entries.append(
            f"{{{own}enter, {own}exchange, {own}start, {own}step, {own}tune, {len(taken)}, {len(given)}, lw_from{j}, "
            f"{given[0] if given else 0}, lw_held{j}, {len(flat.plant_ticks[path])}, lw_due{j}}}, "
        )
    yield f"#define LW_N_PLANTS {len(plants)}"
    yield f"#define LW_PLANTS {''.join(entries)}"
    numbers = {path: j for j, path in enumerate(plants)}
    rows = [f"{{{numbers[path]}, {reference}, {element}, 0.0, false}}, " for path, reference, element in tuned]
    yield f"#define LW_N_TUNED {len(tuned)}"
    yield f"#define LW_TUNED {''.join(rows)}"
    most = max((sum(v.size for v in plant.output_variables.values()) for plant in plants.values()), default=1)
    yield f"#define LW_MOST_OUTPUTS {most}"


def _wired_inputs(plant: Fmu, path: str, diagram: FlatDiagram | WiredDiagram) -> list[str]:
    """Return the inputs of an FMU that something is wired to, in the order of the exported diagram's outputs."""
    wires = diagram.table.wires if isinstance(diagram, FlatDiagram) else diagram.structure.wires
    return [port for port in plant.inputs if (path, port) in wires]
