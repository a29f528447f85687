"""The request of a trim: states, free parameters and targets, by their names."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ...blocks.core import Block, OptionError, ParameterError, UnknownNameError, Value, elements, near
from ...blocks.tracing import extrapolate, traced_parameters
from ..flat import FlatDiagram, WiredDiagram
from ..results import OperatingPoint, PointOrigin
from ..wiring import change_parameter, explain_absent_state, find_place, index_of, split_entry
from .plant_models import plant_layout
from .taps import find_signal

if TYPE_CHECKING:
    from ...fmus.fmu_block import Fmu

WHOLE = 1e-10
"""Distance from a whole number up to which a slope is one."""


@dataclass(eq=False)
class Target:
    """Wanted values of states and signals.

    States have their numbers in x; the numbers of FMUs' states follow those of x.
    """

    fixed: set[int]
    bounds: dict[int, tuple[float, float]]
    signals: list[tuple[tuple[str, str], tuple[int, ...]]]
    labels: list[str]
    wanted: np.ndarray
    rates: dict[int, float]
    """Wanted rates of states per second; NaN for any rate."""
    rest: bool = True
    """Whether states without a wanted rate stay the same."""


@dataclass(eq=False)
class Free:
    """A parameter that a trim may change."""

    name: str  # path of the block, and name of the parameter in it
    path: str
    keys: list[str]  # name of the parameter, with the names in it
    block: Block
    start: np.ndarray  # first value of the entries
    low: np.ndarray  # their bounds
    high: np.ndarray
    shape: tuple[int, ...]
    where: slice | None = None  # the block's slice of the parameters of the flattened diagram; None for an FMU
    pack: Callable[[Block], np.ndarray] | None = field(default=None, repr=False)

    def find_entries(self, entry: tuple[int, ...]) -> list[tuple[int, str]]:
        """Return the places and names of all entries, or of one that is named by its numbers, counted from 1."""
        names = list(enumerate(elements(self.name, self.shape)))
        if not entry:
            return names
        return [names[int(np.ravel_multi_index(index_of(entry, self.shape, self.name), self.shape))]]

    def shape_value(self, value: np.ndarray) -> np.ndarray | float:
        """Return the parameter's value from its entries."""
        return value.reshape(self.shape).copy() if self.shape else float(value[0])

    def find_sides(self, value: np.ndarray, i: int, d: float) -> tuple[list[np.ndarray], float]:
        """Return values with entry i greater, and less, by d or up to the bound, and the distance of the two."""
        high, low = value.copy(), value.copy()
        high[i], low[i] = min(value[i] + d, self.high[i]), max(value[i] - d, self.low[i])
        return [high, low], float(high[i] - low[i])

    def is_at_bound(self, value: np.ndarray) -> bool:
        """Whether an entry is at a bound, within the accuracy of the search."""
        near = 1e-3 * np.where(np.isfinite(self.high - self.low), self.high - self.low, 0.0)
        return bool(np.any((value <= self.low + near) | (value >= self.high - near)))

    def change_block(self, value: np.ndarray) -> Block:
        """Return the block with another value."""
        return change_parameter(self.block, self.keys, self.shape_value(value))

    def pack_value(self, value: np.ndarray) -> np.ndarray:
        """Return the numbers of the block's parameters, an argument of the traced functions."""
        assert self.pack is not None
        return self.pack(self.change_block(value))

    def slope(self, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivative of `pack_value` by differences of fourth order, and each column's error.

        The error is 0 where the numbers are the parameters themselves. An entry with one value only stays.
        """
        columns, errors = [], []
        for i, middle in enumerate(value):
            size = 2.0**-10 * 2.0 ** np.round(np.log2(abs(middle) or 1.0))
            h, nodes = spread_nodes(middle, size, self.low[i], self.high[i])
            if not h:
                columns.append(np.zeros(self.pack_value(value).size))
                errors.append(0.0)
                continue
            found = []
            for place in (0.0, *nodes):
                moved = value.copy()
                moved[i] = middle + place * h
                found.append(np.nan_to_num(self.pack_value(moved)))  # NaN is no sample time
            slope, error = difference(found, h, nodes)
            columns.append(slope)
            errors.append(float(np.max(error, initial=0.0)))
        return np.array(columns).T, np.array(errors)


def spread_nodes(value: float, h: float, low: float, high: float) -> tuple[float, tuple[float, ...]]:
    """Return a step, and the places next to a value, in steps, at which `difference` needs a function.

    They lie on both sides, on one side where the value is at a bound.
    """
    below, above = value - low, high - value
    if min(below, above) >= 1e-3 * h:
        return min(h, 0.5 * below, 0.5 * above), (1.0, -1.0, 2.0, -2.0)
    side = 1.0 if above > below else -1.0
    return min(h, 0.25 * max(below, above)), (side, 2.0 * side, 4.0 * side)


def difference(values: Sequence[Any], h: float, nodes: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return a slope and an estimate of its errors, from values at 0 and at the nodes, in steps h.

    Slopes that are whole numbers up to rounding are exact, as where the values are the argument itself.
    """
    f, s = [np.asarray(v, dtype=float) for v in values], nodes[0]
    if len(nodes) == 4:
        near, far = (f[1] - f[2]) / (2.0 * h), (f[3] - f[4]) / (4.0 * h)
    else:
        near = (4.0 * f[1] - 3.0 * f[0] - f[2]) / (2.0 * s * h)
        far = (4.0 * f[2] - 3.0 * f[0] - f[3]) / (4.0 * s * h)
    slope, error = extrapolate(near, far), np.abs(near - far)
    whole = np.round(slope)
    exact = (np.abs(slope - whole) <= WHOLE) & (error <= WHOLE)
    return np.where(exact, whole, slope), np.where(exact, 0.0, error)


def index_states(flat: FlatDiagram, at: OperatingPoint) -> dict[str, np.ndarray]:
    """Return the numbers of the entries of all states, by name, in the states' shapes."""
    states = (flat.states.each, plant_layout(flat.table.blocks, at.plants, flat.width).each)
    return {name: layout.index(name) for layout in states for name in layout.slices}


def _find_state(flat: FlatDiagram, name: str, known: Mapping[str, np.ndarray], argument: str) -> str:
    """Return the full name of a state; ``argument`` is that of the user's call."""
    if name in known:
        return name
    found = sorted(n for n in known if isinstance(name, str) and n.endswith("." + name))
    if len(found) == 1:
        return found[0]
    if found:
        raise UnknownNameError(
            f"{name!r} stands for several states: {', '.join(found)}. Write more of the path.", port=argument
        )
    reason = explain_absent_state(flat.table.blocks, str(name))
    step = f"{reason[0].upper()}{reason[1:]}" if reason else near(str(name), known)
    raise UnknownNameError(f"there is no state {name!r}. {step}", port=argument)


def _spread_value(value: Any, where: np.ndarray, name: str, argument: str) -> np.ndarray:
    """Return a value for each entry; None gives NaN."""
    try:
        numbers = np.asarray(np.nan if value is None else value, dtype=float)
        return np.ravel(np.broadcast_to(numbers, where.shape))
    except (TypeError, ValueError):
        raise OptionError(
            f"found {value!r} for {name!r}; expected a number, or numbers of shape {where.shape}. Give that.",
            port=argument,
        ) from None


def read_targets(
    flat: FlatDiagram,
    known: Mapping[str, np.ndarray],
    targets: Mapping[str, Any],
    rates: Mapping[str, Any],
    fixed: Iterable[str],
    bounds: Mapping[str, Any],
) -> Target:
    """Return the wanted values from the arguments of `Diagram.trim`."""
    signals: list[tuple[tuple[str, str], tuple[int, ...]]] = []
    labels: list[str] = []
    wanted: list[np.ndarray] = []
    for name, value in targets.items():
        signal = find_signal(flat, name)
        signals.append((signal.port, signal.entries))
        labels += signal.labels
        wanted.append(_spread_value(value, np.zeros(len(signal.entries)), name, "targets"))
    held = {int(i) for name in fixed for i in np.ravel(known[_find_state(flat, name, known, "fixed")])}
    asked: dict[int, float] = {}
    for name, value in rates.items():
        where = known[_find_state(flat, name, known, "rates")]
        asked |= zip(np.ravel(where).tolist(), _spread_value(value, where, name, "rates").tolist(), strict=True)
    within: dict[int, tuple[float, float]] = {}
    for name, given in bounds.items():
        where = known[_find_state(flat, name, known, "free")]
        low, high = _read_bounds(given, where.shape, name)
        within |= dict(zip(np.ravel(where).tolist(), zip(low.tolist(), high.tolist(), strict=True), strict=True))
    return Target(held, within, signals, labels, np.concatenate([*wanted, np.zeros(0)]), asked)


def _read_bounds(given: Any, shape: tuple[int, ...], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper bounds of all entries, flat."""
    try:
        low, high = (-np.inf, np.inf) if given is None else given
        a, b = (np.ravel(np.broadcast_to(np.asarray(v, dtype=float), shape)).copy() for v in (low, high))
    except (TypeError, ValueError):
        raise OptionError(
            f"found {given!r} for {name!r}; expected a pair (lowest, highest), or None for no bounds. Give that.",
            port="free",
        ) from None
    if not np.all(a <= b):
        raise OptionError(
            f"found {given!r} for {name!r}; expected the lowest value first. Exchange the two.", port="free"
        )
    return a, b


def set_states(flat: FlatDiagram, at: OperatingPoint, states: Mapping[str, Any]) -> OperatingPoint:
    """Return the operating point with other states, given by name; its signals are not computed again."""
    known, x = index_states(flat, at), at.x.copy()
    plants = {path: {**point, "state": dict(point["state"])} for path, point in at.plants.items()}
    for name, value in states.items():
        full = _find_state(flat, name, known, "states")
        where, numbers = known[full], _spread_value(value, known[full], name, "states")
        if np.ravel(where)[0] < flat.width:
            x[np.ravel(where)] = numbers
            continue
        path = next(p for p in plants if full.startswith(p + "."))
        plants[path]["state"][full[len(path) + 1 :]] = numbers.reshape(where.shape)
    return replace(at, x=x, plants=plants, how=PointOrigin.GIVEN)


# --- parameters ------------------------------------------------------------------------------------------------------


def free_parameters(diagram: WiredDiagram, asked: Mapping[str, Any]) -> tuple[list[Free], WiredDiagram]:
    """Return the free parameters, and a diagram in whose equations all of them are symbols.

    A trace takes an exact zero for structure, so a parameter that is zero starts next to it. Start values of
    FMUs are no symbols.
    """
    found, moved = [], {}
    for name, given in asked.items():
        path, keys = find_place(diagram.structure, name, diagram.name)
        block = diagram.structure.blocks[path]
        value = read_value(block, keys, block.label)
        low, high = _read_bounds(given, np.shape(value), name)
        low, high = _limit_bounds(block, keys, low, high)
        start = np.clip(np.ravel(np.asarray(value, dtype=float)), low, high)
        free = Free(f"{path}.{'.'.join(keys)}", path, keys, block, start, low, high, np.shape(value))
        if not (block.stepped or block.in_model_exchange):
            start = np.where(start == 0.0, _move_off_zero(low, high), start)
            free.start = start
            moved[free.name] = free.shape_value(start)
        found.append(free)
    diagram = diagram.replace(moved) if moved else diagram
    flat = diagram.flatten(None if diagram.has_clock else 1)
    for free in found:
        if free.path in flat.checked.traced and not free.block.in_model_exchange:
            locate(free, diagram, flat)
    return found, diagram


def split_array(diagram: WiredDiagram, name: str) -> tuple[str, tuple[int, ...]]:
    """Return the path of a parameter, and the entry of an array that is named behind it: ``"motor.denominator[1]"``."""
    path, keys = find_place(diagram.structure, name, diagram.name)
    block = diagram.structure.blocks[path]
    known = cast("Fmu", block).description.variables if _is_start_value(block, keys) else ()
    return (name, ()) if ".".join(keys[1:]) in known else split_entry(name, ())


def locate(free: Free, diagram: WiredDiagram, flat: FlatDiagram) -> None:
    """Set the block, slice and packing of a free parameter of a traced block."""
    free.block = diagram.structure.blocks[free.path]
    if ".".join(free.keys) not in dict(traced_parameters(free.block)):
        raise ParameterError(
            "it is structure: the equations were traced with this value; expected a parameter that they contain. Try "
            "values with diagram.replace(…), one after the other.",
            block=free.path,
            port=".".join(free.keys),
        )
    where = free.where = flat.parameters.slices[free.path]

    def pack(block: Block) -> np.ndarray:
        packed = flat.pack(free.path, block)
        if packed.size != where.stop - where.start:
            raise ParameterError(
                "found a value that changes the block's structure; expected the same structure. Try values with "
                "diagram.replace(…), one after the other.",
                block=free.path,
                port=".".join(free.keys),
            )
        return packed

    free.pack = pack


def read_value(owner: Value, keys: list[str], label: str) -> float | np.ndarray:
    """Return the value of a parameter, or an FMU's start value; ``label`` is the block's name in errors."""
    specs = type(owner).parameter_specs
    if keys[0] not in specs:
        raise UnknownNameError(f"it has no parameter {keys[0]!r}. {near(keys[0], specs)}", block=label)
    value = owner.__dict__[keys[0]]
    if len(keys) > 1 and isinstance(value, Value):
        return read_value(value, keys[1:], label)
    if isinstance(owner, Block) and _is_start_value(owner, keys):
        name, variables = ".".join(keys[1:]), cast("Fmu", owner).description.variables
        if name not in variables:
            raise UnknownNameError(f"the FMU has no variable {name!r}. {near(name, variables)}", block=label)
        start = variables[name].start
        value = value.get(name, np.zeros(variables[name].shape) if start is None else start)
        value = np.broadcast_to(np.asarray(value, dtype=float), variables[name].shape)
    if not isinstance(value, float | np.ndarray):
        raise ParameterError(
            f"found {value!r}; expected numbers: a trim finds numbers alone. Free another parameter.",
            block=label,
            port=".".join(keys),
        )
    return value


def _limit_bounds(block: Block, keys: list[str], low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the given bounds, limited by those of the parameter's declaration."""
    spec = type(block).parameter_specs[keys[0]] if len(keys) == 1 else None
    if spec is not None:
        least = spec.minimum if spec.above is None else np.nextafter(spec.above, np.inf)
        low = low if least is None else np.maximum(low, least)
        high = high if spec.maximum is None else np.minimum(high, spec.maximum)
    if _is_start_value(block, keys):
        variable = cast("Fmu", block).description.variables[".".join(keys[1:])]
        low = low if variable.minimum is None else np.maximum(low, np.ravel(variable.minimum))
        high = high if variable.maximum is None else np.minimum(high, np.ravel(variable.maximum))
    return low, high


def _is_start_value(block: Block, keys: Sequence[str]) -> bool:
    """Return whether a parameter is a start value of an FMU."""
    return len(keys) > 1 and keys[0] == "start" and (block.stepped or block.in_model_exchange)


def _move_off_zero(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return numbers within bounds that are not zero."""
    step = np.minimum(1.0, np.where(np.isfinite(high - low), 0.25 * (high - low), 1.0))
    return np.where(high >= -low, step, -step)
