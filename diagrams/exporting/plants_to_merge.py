"""FMUs in a diagram that is exported: those of our own are merged from the C that they carry, others are refused."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np

from ...blocks.core import DefinitionError
from ...fmus import Fmu
from ...fmus.calls import FmuInstance
from ...fmus.export import INTEGRATORS, MergedPlant, Placed, PlacedPlant, Variable, read_own_sources
from ..flat import FlatDiagram
from ..wiring import join
from .open_diagram import OpenDiagram

_OWN = ("integrator",)  # parameters of its own integrator that decide on memory
_WAY_OUT = (
    "Leave it outside, build(diagram, outside=[{path!r}]), and couple the two FMUs where they are used; "
    "diagram.to_ssp(…) writes both, and how they are coupled, into one file."
)


def own_fmus(opened: OpenDiagram, way_out: str = _WAY_OUT) -> dict[str, Fmu]:
    """Return the FMUs of a diagram that are merged, by path; ``way_out`` is what an error says at last.

    Raises `DefinitionError`: for an FMU that can't be, by its path, with a next step.
    """
    found = {}
    for path, block in opened.wired.scheduled.blocks.items():
        if path == opened.outside or block.transport or not (block.stepped or block.in_model_exchange):
            continue
        _check(block, path, way_out)
        assert isinstance(block, Fmu)
        found[path] = block
    return dict(sorted(found.items()))


def _check(block: Any, path: str, way_out: str) -> None:
    """Refuse what can't be merged."""
    way = way_out.format(path=path)
    if not isinstance(block, Fmu):
        raise DefinitionError(f"something outside steps it, of which there is no C code. {way}", block=path)
    name = block.description.file.name
    if block.in_model_exchange:
        raise DefinitionError(
            f"found {name} in model exchange, whose equations the diagram's solver takes; expected co-simulation. "
            f"Write Fmu(…, interface='co_simulation'), or put the plant's block itself into the diagram. {way}",
            block=path,
        )
    sources = read_own_sources(block.description.file)
    if sources is None:
        raise DefinitionError(
            f"found {name}, an FMU that this version of Loopwright has not built from a block; of others there is no "
            "C code to merge. Replace it by a plant in equations (docs/howto/export.md), build it again with this "
            f"version, or if it is a diagram's, put its blocks into this diagram. {way}",
            block=path,
        )
    if block.stepping != type(block.stepping)():
        raise DefinitionError(
            f"found {block.stepping!r}; expected an FMU with plain steps, without options of its own. Leave stepping "
            f"out. {way}",
            block=path,
        )
    ports = (*block.input_variables.values(), *block.output_variables.values())
    if other := next((v for v in ports if v.type != "Float64"), None):
        raise DefinitionError(f"found {other.name} of type {other.type}; expected Float64. {way}", block=path)


def merge(opened: OpenDiagram, flat: FlatDiagram, width: int) -> tuple[tuple[MergedPlant, ...], tuple[Placed, ...]]:
    """Return the FMUs of a diagram as they are merged, and their parameters.

    ``width``: size of the diagram's own p, behind which the parameters of its FMUs are.
    """
    plants, parameters = [], list[Placed]()
    for path, block in own_fmus(opened).items():
        variables = block.description.variables
        wired = [port for port in block.inputs if (path, port) in flat.table.wires]
        ins = [block.input_variables[port] for port in wired]
        outs = [block.output_variables[port] for port in block.outputs]
        # A parameter that a wire sets is an input here; the solver's own settings are no parameters of the model.
        taken = {key for one in ins for key in one.keys}
        own = [
            v
            for v in variables.values()
            if v.causality == "parameter" and v.type == "Float64" and v.name not in _OWN and not taken & {*v.keys}
        ]
        first = width
        for one in own:
            given = block.start.get(one.name, one.start)
            variable = Variable(
                join(opened.shown(path), one.name),
                "parameter",
                "tunable" if one.variability == "tunable" else "fixed",
                one.shape,
                one.unit,
                one.description,
                start=given,
                minimum=_bound(one.minimum, np.max),
                maximum=_bound(one.maximum, np.min),
            )
            parameters.append(Placed(variable, "p", tuple(range(width, width + one.size))))
            width += one.size
        # Start values that are no parameter of the whole are written into the code once.
        set_here = {v.name for v in own}
        start = [
            (reference, values)
            for name, given in block.start.items()
            if name not in set_here
            for reference, values in _split(block.description.find(name), given)
        ]
        integrator = np.ravel(block.start.get("integrator", variables["integrator"].start))
        sources = read_own_sources(block.description.file)
        assert sources is not None
        plants.append(
            MergedPlant(
                sources=sources,
                inputs=_sized(ins),
                outputs=_sized(outs),
                parameters=_sized(own),
                tunable=[one.variability == "tunable" for one in own for _ in one.references],
                start=start,
                implicit=bool(integrator[0] == INTEGRATORS["rodas"]),
                placed=PlacedPlant(
                    path=opened.shown(path),
                    clocks=tuple((clock.every, clock.offset) for clock in flat.plant_ticks[path]),
                    first_input=flat.plant_inputs.slices[join(path, wired[0])].start if wired else 0,
                    first_output=flat.plant_outputs.slices[join(path, next(iter(block.outputs)))].start,
                    first_parameter=first,
                ),
            )
        )
    return tuple(plants), tuple(parameters)


@contextmanager
def loaded(opened: OpenDiagram, flat: FlatDiagram) -> Iterator[dict[str, FmuInstance]]:
    """Load the FMUs of a diagram, to find its start."""
    with ExitStack() as stack:
        found: dict[str, FmuInstance] = {}
        for path, block in own_fmus(opened).items():
            wired = [port for port in block.inputs if (path, port) in flat.table.wires]
            found[path] = stack.enter_context(block.instantiate(wired, None, start_time=0.0))
        yield found


def _bound(limit: Any, choose: Any) -> float | None:
    """Return a limit that holds for all elements."""
    return None if limit is None else float(choose(limit))


def _split(variable: Any, value: Any) -> Iterator[tuple[int, Sequence[float]]]:
    """Yield the value references of a variable with their values."""
    values = np.ravel(np.broadcast_to(np.asarray(value, dtype=float), variable.shape))
    each = np.split(values, len(variable.references))
    for reference, part in zip(variable.references, each, strict=True):
        yield reference, part.tolist()


def _sized(variables: Sequence[Any]) -> list[tuple[int, int]]:
    """Return value references with their numbers of elements."""
    return [(r, v.size // len(v.references)) for v in variables for r in v.references]
