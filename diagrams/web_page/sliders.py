"""The sliders of a page: parameters, and sources that are moved by hand, with their ranges."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...blocks.core import Block, OptionError, enumerate_some, near, shorten
from ...fmus import Fmu
from ...fmus.export import LoopSpec
from ..flat import Target, WiredDiagram
from ..wiring import find_control, index_of, join, split_entry

Ranges = Mapping[str, tuple[float, float] | None]
"""Sliders by the names of what they move: smallest and largest value; None chooses them."""
_LOGARITHMIC = 20.0  # ratio of the ends from which on a slider is logarithmic
_MOST = 12


@dataclass(frozen=True)
class _Bounds:
    """Least and greatest value of a parameter of an FMU, as a block's parameter declares them."""

    minimum: float | None
    above: float | None
    maximum: float | None

    @classmethod
    def of(cls, least: Any, most: Any) -> _Bounds:
        """Return the bounds of a variable, of all its entries; the least number above 0 says "above 0"."""
        lowest = None if least is None else float(np.max(least))
        is_open = lowest is not None and 0.0 < lowest <= np.finfo(float).tiny
        return cls(None if is_open else lowest, 0.0 if is_open else None, None if most is None else float(np.min(most)))


@dataclass(frozen=True)
class Slider:
    """A slider: one number that a page moves.

    ``name``: the name that it was asked for by, with the entry of an array.
    ``path``, ``keys``: the block, and the names that lead to the parameter in it.
    ``entry``: the place of the number in the parameter, flat.
    ``unit``: its unit; empty without one.
    ``of_plant``: whether the parameter is that of an FMU.
    ``index``: the entry that the keys don't have, such as ``[2]``; empty of a number, and where the keys have it.
    """

    name: str
    path: str
    keys: tuple[str, ...]
    entry: int
    value: float
    low: float
    high: float
    unit: str = ""
    label: str = ""
    of_plant: bool = False
    index: str = ""

    @classmethod
    def of_scene(cls, wired: WiredDiagram, name: str, target: Target, entry: int) -> Slider:
        """Return a number that a picture moves, which has no range."""
        path, keys = target
        values = np.asarray(_value_of(wired.structure.blocks[path], keys)[0])
        index = f"[{_number(entry, values.shape)}]" if values.ndim else ""
        return cls(name, path, tuple(keys), entry, float(values.flat[entry]), 0.0, 0.0, index=index)

    @property
    def target(self) -> Target:
        """The parameter, as `find_control` names it."""
        return self.path, [*self.keys]

    @property
    def parameter(self) -> str:
        """The number's dotted path, with the entry of an array, as `Diagram.replace` takes it."""
        return ".".join([self.path, *self.keys[:-1], self.keys[-1] + self.index])

    def value_in(self, block: Block) -> float:
        """Return the number in a variant of the block."""
        return float(np.ravel(_value_of(block, list(self.keys))[0])[self.entry])

    @property
    def is_logarithmic(self) -> bool:
        """Whether equal ways are equal ratios."""
        return self.low > 0.0 and self.high / self.low >= _LOGARITHMIC


def find_sliders(wired: WiredDiagram, given: Any, option: str) -> list[Slider]:
    """Return the sliders that a user asks for: one for each number.

    ``given``: names, with or without ranges.
    Raises `OptionError, UnknownNameError`: what are no names or ranges; a name that nothing movable has.
    """
    if isinstance(given, str):
        given = [given]
    if not isinstance(given, Mapping):
        if not isinstance(given, Iterable) or not all(isinstance(name, str) for name in given):
            raise OptionError(
                f"found {shorten(given)}; expected names, or ranges by name, such as {{'pid.kp': (0, 5)}}.",
                block=wired.name,
                port=option,
            )
        given = dict.fromkeys(given)
    return [slider for name, limits in given.items() for slider in _sliders_of(wired, name, limits, option)]


def default_sources(wired: WiredDiagram) -> list[Slider]:
    """Return sliders of the constants of a diagram, the first ones."""
    found: list[Slider] = []
    for path, block in wired.structure.blocks.items():
        specs = type(block).parameter_specs
        if block.inputs or "value" not in specs or np.size(block.parameters["value"]) > 3:
            continue
        name = next((n for n, w in wired.structure.names.items() if w.block == path), path)
        found += _sliders_of(wired, name if "." not in name else path, None, "inputs")
    return found[:_MOST]


def _sliders_of(wired: WiredDiagram, name: str, limits: Any, option: str) -> list[Slider]:
    table = wired.structure
    path, keys = find_control(table, name, wired.name)
    block = table.blocks[path]
    if isinstance(block, Fmu):
        return _sliders_of_plant(block, path, keys, name, limits, option)
    whole, entry, unit, spec = _value_of(block, keys)
    values = np.asarray(whole)
    if values.dtype.kind not in "if" or not values.size:
        raise OptionError(
            f"found {shorten(whole)} for {name!r}; expected a parameter that is a number. Name another one.",
            block=path,
            port=option,
        )
    chosen = [entry] if entry is not None else range(values.size)
    sliders = []
    for i in chosen:
        index = "" if entry is not None or not values.ndim else f"[{_number(i, values.shape)}]"
        value = float(values.ravel()[i])
        low, high = _range(value, spec, limits, path, name, option)
        sliders.append(
            Slider(name + index, path, tuple(keys), int(i), value, low, high, unit, name + index, index=index)
        )
    return sliders


def _tunable(plant: Fmu) -> list[str]:
    """Return the names of an FMU's parameters that may change between steps."""
    found = plant.description.variables.items()
    return [
        name
        for name, v in found
        if v.causality == "parameter" and v.variability == "tunable" and v.type == "Float64" and not v.is_integer
    ]


def _sliders_of_plant(plant: Fmu, path: str, keys: list[str], name: str, limits: Any, option: str) -> list[Slider]:
    """Return sliders of a parameter of an FMU that may change between steps."""
    names = _tunable(plant)
    one, chosen = split_entry(keys[-1], names)
    if keys[0] != "start" or one not in names:
        raise OptionError(
            f"{name!r} is of an FMU; expected one of its parameters that may change between steps: "
            f"{enumerate_some([f'{path}.{each}' for each in names], 8) or 'it has none'}. Make the page of "
            "diagram.replace(…) for another value of what is fixed.",
            block=path,
            port=option,
        )
    variable = plant.description.variables[one]
    values = np.asarray(plant.start.get(one, variable.start), dtype=float)
    if values.shape != variable.shape:  # one number for all entries
        values = np.broadcast_to(values, variable.shape)
    bounds = _Bounds.of(variable.minimum, variable.maximum)
    unit = "" if variable.unit in (None, "1") else str(variable.unit)
    if chosen:
        entries: Iterable[int] = [int(np.ravel_multi_index(index_of(chosen, values.shape, one), values.shape))]
    else:
        entries = range(values.size)
    sliders = []
    for i in entries:
        value = float(values.flat[i])
        low, high = _range(value, bounds, limits, path, name, option)
        index = "" if chosen or not values.ndim else f"[{_number(i, values.shape)}]"
        label = name + index
        sliders.append(Slider(label, path, tuple(keys), i, value, low, high, unit, label, True, index))
    return sliders


def _number(i: int, shape: tuple[int, ...]) -> str:
    return ",".join(str(k + 1) for k in np.unravel_index(i, shape))


def _value_of(block: Block, keys: list[str]) -> tuple[Any, int | None, str, Any]:
    """Return the value of a parameter, the entry that is meant, its unit and its declaration."""
    owner: Any = block
    for key in keys[:-1]:
        owner = owner.__dict__[key]
    specs = type(owner).parameter_specs
    name, entry = split_entry(keys[-1], specs)
    value, spec = owner.__dict__[name], specs[name]
    unit = spec.unit if isinstance(spec.unit, str) else None
    if unit is None and name == "value" and isinstance(getattr(owner, "unit", None), str):
        unit = owner.unit
    place = None
    if entry:
        shape = np.shape(value)
        place = int(np.ravel_multi_index(index_of(entry, shape, name), shape))
    return value, place, "" if unit in (None, "1") else str(unit), spec


def _range(value: float, spec: Any, limits: Any, path: str, name: str, option: str) -> tuple[float, float]:
    """Return the range of a slider: the one that is given, or one around the value, within what the block allows."""
    least = spec.minimum if spec.minimum is not None else spec.above
    most = spec.maximum
    if limits is None:
        size = abs(value)
        # A positive quantity, such as a mass, is moved by factors; a signed one around zero.
        if spec.above is not None and value > spec.above >= 0.0:
            low, high = value / 5.0, value * 5.0
        elif value == 0.0:
            low, high = -1.0, 1.0
        else:
            low, high = (
                (-2.0 * size, 2.0 * size) if name == option or option == "inputs" else sorted((0.0, 2.0 * value))
            )
        low = low if least is None else max(low, least)
        high = high if most is None else min(high, most)
        return float(low), float(high)
    try:
        low, high = (float(limit) for limit in limits)
    except (TypeError, ValueError):
        low, high = np.nan, np.nan
    if not -np.inf < low < high < np.inf:
        raise OptionError(
            f"found the range {shorten(limits)} for {name!r}; expected its smallest and its largest value, "
            "such as (0.0, 5.0).",
            block=path,
            port=option,
        )
    if not low <= value <= high:
        raise OptionError(
            f"found the range ({low:g}, {high:g}) for {name!r}, which is {value:g}; expected one that has it. Widen "
            "it, or make the page of diagram.replace(…).",
            block=path,
            port=option,
        )
    out = (least is not None and (low < least or (spec.above is not None and low <= spec.above))) or (
        most is not None and high > most
    )
    if out:
        bounds = (
            f"above {spec.above:g}" if spec.above is not None else f"from {least if least is not None else -np.inf:g}"
        )
        raise OptionError(
            f"found the range ({low:g}, {high:g}) for {name!r}; expected values {bounds}"
            f"{'' if most is None else f' to {most:g}'}. Make it smaller.",
            block=path,
            port=option,
        )
    return low, high


def place_of(slider: Slider, spec: LoopSpec) -> int:
    """Return the place of a slider's number among the parameters of a module.

    Raises `OptionError` if the equations of the diagram don't take it as a number of its own.
    """
    if slider.of_plant:
        whole = [one.variable.name for one in spec.parameters]
        keys = [
            next(n for n in (slider.keys[-1], split_entry(slider.keys[-1], ())[0]) if join(slider.path, n) in whole)
        ]
    else:
        keys = [*slider.keys[:-1], split_entry(slider.keys[-1], ())[0]]
    full = join(slider.path, ".".join(keys))
    for one in spec.parameters:
        if one.variable.name == full:
            return one.places[slider.entry]
    inside = [one.variable.name for one in spec.parameters if one.variable.name.startswith(f"{slider.path}.")]
    there = (
        f"Of this block a page can move {enumerate_some(inside, 8)}."
        if inside
        else near(full, [one.variable.name for one in spec.parameters])
    )
    raise OptionError(
        f"{slider.name!r} can't be moved while a page runs: it is structure of the equations, or other numbers are "
        f"computed from it. {there}",
        block=slider.path,
        port="sliders",
    )
