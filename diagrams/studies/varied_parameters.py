"""Parameters of a study: those that a loop can be differentiated by, their values and units."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...blocks.core import Block, OptionError, ParameterSpec, Value, shorten
from ...blocks.tracing import traced_parameters
from ..flat import WiredDiagram
from ..sweeps import Box, Samples
from ..wiring import index_of, split_entry, split_path


def list_parameters(diagram: WiredDiagram) -> tuple[list[str], dict[str, str]]:
    """Return the paths of all parameters that a loop can be differentiated by, and those left out with the reason.

    They are the numbers in traced equations that are not 0, and the parameters that an FMU's block sets.
    """
    found, left_out = list[str](), dict[str, str]()
    for path, block in sorted(diagram.blocks.items()):
        if block.stepped or block.in_model_exchange:
            about: Any = block
            known = len(found)
            for name in getattr(block, "start", {}):
                variable = about.description.variables.get(name)
                if variable is not None and variable.causality == "parameter" and _is_number(block, name):
                    found.append(f"{path}.start.{name}")
            if block.stepped or len(found) > known:
                continue
        if block.opaque or block.in_model_exchange:
            left_out[path] = "its equations are evaluated from outside; name its parameters to difference them"
            continue
        for name, value in traced_parameters(block):
            if not _holds_numbers(value):
                continue
            if not np.all(value):
                left_out[f"{path}.{name}"] = "it is 0, and so structure of the traced equations; name it to include it"
            else:
                found.append(f"{path}.{name}")
    return found, left_out


def _is_number(block: Any, name: str) -> bool:
    value = np.asarray(block.start[name])
    return value.dtype.kind == "f" and bool(value.size)


def _holds_numbers(value: Any) -> bool:
    return isinstance(value, float | np.ndarray) and np.asarray(value).dtype.kind == "f" and np.size(value) > 0


def check_parameters(diagram: WiredDiagram, names: Iterable[str], study: str, *, blocks: bool = False) -> None:
    """Refuse parameters that are structure of the linear model, and no numbers in it; ``blocks`` allows whole blocks.

    These are settings of subsystems (sample time, delay, offset, method), whole numbers, such as orders and counts,
    parameters that are true or false, and those that are no numbers.
    """
    for name in names:
        if name in diagram.structure.blocks and blocks:
            continue
        head, _, last = name.rpartition(".")
        if found := _find_structure(diagram, name):
            raise OptionError(
                f"found {found} among the parameters of {study}; expected numbers that change the linear model's "
                "entries alone, by any small amount. Look at each of its values: "
                f"diagram.replace({{{name!r}: …}}).",
                block=head,
                port=last,
            )


def _find_structure(diagram: WiredDiagram, name: str) -> str:
    """Return in words why a parameter is structure; "" where it is a number in the equations."""
    head, _, last = name.rpartition(".")
    if name in diagram.structure.blocks:
        return "a whole block"
    if head in diagram.structure.subsystems:
        article = "an" if last[0] in "aeio" else "a"
        return f"{article} {last.replace('_', ' ')} of a subsystem"
    path, keys = split_path(diagram.structure, name, diagram.name)
    block: Any = diagram.structure.blocks[path]
    if start := _start_value(block, keys):
        variable = block.description.find(start)
        kind = "b" if variable.type == "Boolean" else "i" if variable.is_integer else "f"
    else:
        kind = np.asarray(read_parameter(diagram, name)).dtype.kind
    said = {"f": "", "b": "a parameter that is true or false", "i": "a whole number", "u": "a whole number"}
    return said.get(kind, "a parameter that is no number")


def _start_value(block: Block, keys: list[str]) -> str:
    """Return the name of the FMU's variable whose start value a path names; "" for another parameter."""
    is_fmu = block.stepped or block.in_model_exchange
    return ".".join(keys[1:]) if is_fmu and keys[0] == "start" else ""


def unit_of(diagram: WiredDiagram, parameter: str) -> str:
    """Return the declared unit of a parameter; "" where there is none."""
    path, keys = split_path(diagram.structure, parameter.partition("[")[0], diagram.name)
    block: Block = diagram.structure.blocks[path]
    if start := _start_value(block, keys):
        about: Any = block
        variable = about.description.variables.get(start)
        return str(getattr(variable, "unit", None) or "")
    spec = find_declaration(block, keys)
    return "" if spec is None or spec.unit is None else spec.unit


def find_declaration(block: Block, keys: list[str]) -> ParameterSpec | None:
    """Return the declaration of a parameter at a path of attribute names; None where there is none."""
    owner: Any = block
    for key in keys[:-1]:
        owner = owner.__dict__.get(key)
        if not isinstance(owner, Value):
            return None
    specs: Mapping[str, ParameterSpec] = type(owner).parameter_specs
    return specs.get(keys[-1])


def changed_entry(diagram: WiredDiagram, parameter: str, value: float) -> dict[str, Any]:
    """Return the change for `Diagram.replace` that sets a parameter, or one entry of an array: ``"pid.poles[2]"``."""
    name, bracket, entry = parameter.partition("[")
    if not bracket:
        return {name: value}
    whole = np.array(read_parameter(diagram, name), dtype=float)
    try:
        place = tuple(int(i) - 1 for i in entry.rstrip("]").split(","))
        if min(place) < 0 or len(place) != whole.ndim:
            raise IndexError
        whole[place] = value
    except (ValueError, IndexError):
        raise OptionError(
            f"found {parameter!r}; expected an entry of an array of shape {whole.shape}, counted from 1, such as "
            f"'{name}[1]'.",
            block=diagram.name,
        ) from None
    return {name: whole}


def read_parameter(diagram: WiredDiagram, name: str) -> Any:
    """Return the value of a parameter, or of an FMU's start value, by its full path; or of an entry of an array."""
    path, keys = split_path(diagram.structure, name, diagram.name)
    owner: Any = diagram.structure.blocks[path]
    if start := _start_value(owner, keys):
        known = owner.start.get(start)
        return owner.description.find(start).start if known is None else known
    last, entry = split_entry(keys[-1], ())
    for key in (*keys[:-1], last):
        owner = owner.__dict__[key] if isinstance(owner, Value) else owner[key]
    return np.asarray(owner)[index_of(entry, np.shape(owner), last)].item() if entry else owner


@dataclass(frozen=True)
class Ranges:
    """Ranges of parameters by their paths; a point of them has a fraction from 0 to 1 for each number."""

    boxes: Mapping[str, Box]

    @property
    def names(self) -> list[tuple[str, int]]:
        """The paths of all numbers, with their places in arrays."""
        return [(name, i) for name, box in self.boxes.items() for i in range(box.size)]

    def parameters_at(self, fractions: np.ndarray) -> dict[str, Any]:
        """Return the parameters at a point."""
        found, first = {}, 0
        for name, box in self.boxes.items():
            part = np.clip(fractions[first : first + box.size], 0.0, 1.0)
            found[name] = box.at(part if np.ndim(box.low) else float(part[0]))
            first += box.size
        return found

    def fractions_of(self, parameters: Mapping[str, Any]) -> np.ndarray:
        """Return the point at which parameters are."""
        parts = []
        for name, box in self.boxes.items():
            low, high, value = _read(box, parameters[name])
            if box.scale == "log":
                low, high, value = np.log(low), np.log(high), np.log(value)
            width = np.where(high > low, high - low, 1.0)
            parts.append(np.clip((value - low) / width, 0.0, 1.0))
        return np.concatenate(parts)

    def widths_at(self, parameters: Mapping[str, Any]) -> np.ndarray:
        """Return the derivative of each number by its fraction where parameters are."""
        parts = []
        for name, box in self.boxes.items():
            low, high, value = _read(box, parameters[name])
            parts.append(value * np.log(high / low) if box.scale == "log" else high - low)
        return np.concatenate(parts)


def _read(box: Box, value: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the ends of a range and a value in it as rows of numbers."""
    low, high, own = (np.ravel(np.asarray(v, dtype=float)) for v in (box.low, box.high, value))
    return low, high, own


def read_boxes(drawn: Samples) -> dict[str, Box]:
    """Return the ranges of a search: those of a Latin hypercube, or from the least to the largest value of a grid."""
    if drawn.boxes:
        return dict(drawn.boxes)
    if drawn.axes is None:
        return {}
    return {
        name: Box(min(values), max(values))
        for name, values in drawn.axes.items()
        if all(isinstance(v, float | int) and not isinstance(v, bool) for v in values)
    }


def check_ranges(diagram: WiredDiagram, boxes: Mapping[str, Box]) -> None:
    """Refuse ranges with an end outside of the bounds that the parameter itself declares, before a case is computed.

    What a block refuses in view of its other parameters is left to the cases: others may go with it.
    """
    for name, box in boxes.items():
        if name in diagram.structure.blocks:
            continue
        path, keys = split_path(diagram.structure, name.partition("[")[0], diagram.name)
        spec = find_declaration(diagram.structure.blocks[path], keys)
        if spec is None:
            continue
        for words, bound, holds in (
            ("above", spec.above, np.greater),
            ("at least", spec.minimum, np.greater_equal),
            ("at most", spec.maximum, np.less_equal),
        ):
            ends = (np.asarray(end, dtype=float) for end in (box.low, box.high))
            if bound is not None and not all(np.all(holds(end, bound)) for end in ends):
                unit = f" {spec.unit}" if spec.unit and spec.unit != "1" else ""
                raise OptionError(
                    f"found a range from {shorten(box.low)} to {shorten(box.high)}; expected values {words} "
                    f"{bound:g}{unit}, as the parameter takes them. Give a range within.",
                    block=path,
                    port=name.removeprefix(f"{path}."),
                )
