"""What a trim is asked for, by names: states, parameters that are free, targets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...blocks.core import OptionError, ParameterError, UnknownNameError, Value, near
from ...blocks.tracing import traced_parameters
from ..flat import FlatDiagram, WiredDiagram
from ..results import OperatingPoint, PointOrigin
from ..wiring import change_parameter, split_path
from .derivatives import find_signal
from .plant_models import plant_layout


@dataclass(eq=False)
class Target:
    """What is asked of states and signals.

    States are numbered as in x, those of FMUs behind it.
    """

    fixed: set[int]
    bounds: dict[int, tuple[float, float]]
    signals: list[tuple[tuple[str, str], tuple[int, ...]]]
    labels: list[str]
    wanted: np.ndarray
    rates: dict[int, float]
    """Asked rates of states per second; NaN where any will do."""
    rest: bool = True
    """Whether states that no rate is asked of are to stay."""


@dataclass(eq=False)
class Free:
    """A parameter that a trim may change.

    Attributes
    ----------
    where : slice or None
        Its block's place among the parameters of the flattened diagram; None for an FMU's.
    """

    name: str
    path: str
    keys: list[str]
    block: Any
    start: np.ndarray
    low: np.ndarray
    high: np.ndarray
    shape: tuple[int, ...]
    where: slice | None = None
    pack: Any = field(default=None, repr=False)

    def shaped(self, value: np.ndarray) -> Any:
        """Return the parameter's value from its entries."""
        return value.reshape(self.shape).copy() if self.shape else float(value[0])

    def is_at_bound(self, value: np.ndarray) -> bool:
        """Whether an entry has come to a bound, as near as the search goes."""
        near = 1e-3 * np.where(np.isfinite(self.high - self.low), self.high - self.low, 0.0)
        return bool(np.any((value <= self.low + near) | (value >= self.high - near)))

    def changed(self, value: np.ndarray) -> Any:
        """Return the block with another value."""
        return change_parameter(self.block, self.keys, self.shaped(value))

    def packed(self, value: np.ndarray) -> np.ndarray:
        """Return the numbers of the block's parameters, as the traced functions take them."""
        found: np.ndarray = self.pack(self.changed(value))
        return found

    def slope(self, value: np.ndarray) -> np.ndarray:
        """Return the derivative of `packed`: exact where the numbers are the parameters themselves."""
        columns = []
        for i in range(value.size):
            d = 2.0**-17 * max(1.0, 2.0 ** np.round(np.log2(abs(value[i]) or 1.0)))
            up, down = value.copy(), value.copy()
            up[i], down[i] = value[i] + d, value[i] - d
            change = (self.packed(up) - self.packed(down)) / (up[i] - down[i])
            columns.append(np.where(np.isnan(change), 0.0, change))  # a sample time that there is not
        return np.array(columns).T


def known_states(flat: FlatDiagram, at: OperatingPoint) -> dict[str, np.ndarray]:
    """Return the numbers of the entries of all states, by name, in the states' shapes."""
    states = (flat.states.each, plant_layout(flat.table.blocks, at.plants, flat.width).each)
    return {name: layout.index(name) for layout in states for name in layout.slices}


def _state(name: str, known: Mapping[str, Any], what: str) -> str:
    if name in known:
        return name
    found = sorted(n for n in known if isinstance(name, str) and n.endswith("." + name))
    if len(found) == 1:
        return found[0]
    if found:
        raise UnknownNameError(
            f"{name!r} stands for several states: {', '.join(found)}. Write more of the path.", port=what
        )
    raise UnknownNameError(f"there is no state {name!r}. {near(str(name), known)}", port=what)


def _entries(value: Any, where: np.ndarray, name: str, what: str) -> np.ndarray:
    """Return a value for each entry; None is NaN."""
    try:
        numbers = np.asarray(np.nan if value is None else value, dtype=float)
        return np.ravel(np.broadcast_to(numbers, where.shape))
    except (TypeError, ValueError):
        raise OptionError(
            f"found {value!r} for {name!r}; expected a number, or numbers of shape {where.shape}.", port=what
        ) from None


def targets_of(
    flat: FlatDiagram,
    known: Mapping[str, np.ndarray],
    targets: Mapping[str, Any],
    rates: Mapping[str, Any],
    fixed: Iterable[str],
    bounds: Mapping[str, Any],
) -> Target:
    """Return what is asked, from what a user gives.

    Raises
    ------
    UnknownNameError
        A state or signal that isn't there.
    OptionError
        A value of another shape.
    """
    signals: list[Any] = []
    labels: list[str] = []
    wanted: list[np.ndarray] = []
    for name, value in targets.items():
        signal = find_signal(flat, name)
        signals.append((signal.port, signal.entries))
        labels += signal.labels
        wanted.append(_entries(value, np.zeros(len(signal.entries)), name, "targets"))
    held = {int(i) for name in fixed for i in np.ravel(known[_state(name, known, "fixed")])}
    asked: dict[int, float] = {}
    for name, value in rates.items():
        where = known[_state(name, known, "rates")]
        asked |= zip(np.ravel(where).tolist(), _entries(value, where, name, "rates").tolist(), strict=True)
    within: dict[int, tuple[float, float]] = {}
    for name, given in bounds.items():
        where = known[_state(name, known, "free")]
        low, high = _bounds(given, where.shape, name)
        within |= dict(zip(np.ravel(where).tolist(), zip(low.tolist(), high.tolist(), strict=True), strict=True))
    return Target(held, within, signals, labels, np.concatenate([*wanted, np.zeros(0)]), asked)


def _bounds(given: Any, shape: tuple[int, ...], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper bounds, flat."""
    try:
        low, high = (-np.inf, np.inf) if given is None else given
        a, b = (np.ravel(np.broadcast_to(np.asarray(v, dtype=float), shape)).copy() for v in (low, high))
    except (TypeError, ValueError):
        raise OptionError(
            f"found {given!r} for {name!r}; expected a pair (lowest, highest), or None where there are no bounds.",
            port="free",
        ) from None
    if not np.all(a <= b):
        raise OptionError(f"found {given!r} for {name!r}; expected the lowest value first.", port="free")
    return a, b


def named_states(flat: FlatDiagram, at: OperatingPoint, states: Mapping[str, Any]) -> OperatingPoint:
    """Return the operating point with other states, by name; what follows from them is not made anew."""
    known, x = known_states(flat, at), at.x.copy()
    plants = {path: {**point, "state": dict(point["state"])} for path, point in at.plants.items()}
    for name, value in states.items():
        full = _state(name, known, "states")
        where, numbers = known[full], _entries(value, known[full], name, "states")
        if np.ravel(where)[0] < flat.width:
            x[np.ravel(where)] = numbers
            continue
        path = next(p for p in plants if full.startswith(p + "."))
        plants[path]["state"][full[len(path) + 1 :]] = numbers.reshape(where.shape)
    return replace(at, x=x, plants=plants, how=PointOrigin.GIVEN)


# --- parameters ------------------------------------------------------------------------------------------------------


def free_parameters(diagram: WiredDiagram, asked: Mapping[str, Any]) -> tuple[list[Free], WiredDiagram]:
    """Return the parameters that are free, and the diagram in which all of them are symbols.

    An exact zero is structure in a trace, so a parameter that begins there is moved off it.

    Raises
    ------
    UnknownNameError
        A parameter that isn't there.
    ParameterError
        One that is no number, or that can't change what has been traced.
    """
    found, moved = [], {}
    for name, given in asked.items():
        path, keys = split_path(diagram.structure, name, diagram.name)
        block: Any = diagram.structure.blocks[path]
        value = _value(block, keys)
        low, high = _bounds(given, np.shape(value), name)
        low, high = _declared(block, keys, low, high)
        start = np.clip(np.ravel(np.asarray(value, dtype=float)), low, high)
        free = Free(f"{path}.{'.'.join(keys)}", path, keys, block, start, low, high, np.shape(value))
        if not block.stepped:
            start = np.where(start == 0.0, _away(low, high), start)
            free.start = start
            moved[free.name] = free.shaped(start)
        found.append(free)
    diagram = diagram.replace(moved) if moved else diagram
    flat = diagram.flatten(None if diagram.has_clock else 1)
    for free in found:
        if free.path in flat.checked.traced:
            _place(free, diagram, flat)
    return found, diagram


def _place(free: Free, diagram: WiredDiagram, flat: FlatDiagram) -> None:
    free.block = diagram.structure.blocks[free.path]
    if ".".join(free.keys) not in dict(traced_parameters(free.block)):
        raise ParameterError(
            "it is structure: the equations were traced with this value, so it can't be found by a trim. Try values "
            "with diagram.replace(…), one after the other.",
            block=free.path,
            port=".".join(free.keys),
        )
    free.where = flat.parameters.slices[free.path]

    def pack(block: Any) -> np.ndarray:
        packed = flat.pack(free.path, block)
        if packed.size != free.where.stop - free.where.start:  # type: ignore[union-attr]
            raise ParameterError("its structure changes with this value.", block=free.path, port=".".join(free.keys))
        return packed

    free.pack = pack


def _value(block: Any, keys: list[str]) -> Any:
    """Return a parameter's value; of an FMU its start value."""
    specs = type(block).parameter_specs
    if keys[0] not in specs:
        raise UnknownNameError(f"it has no parameter {keys[0]!r}. {near(keys[0], specs)}", block=block.label)
    value = block.__dict__[keys[0]]
    if len(keys) > 1 and isinstance(value, Value):
        return _value(value, keys[1:])
    if len(keys) > 1 and block.stepped and keys[0] == "start":
        name, variables = ".".join(keys[1:]), block.description.variables
        if name not in variables:
            raise UnknownNameError(f"the FMU has no variable {name!r}. {near(name, variables)}", block=block.label)
        start = variables[name].start
        value = value.get(name, np.zeros(variables[name].shape) if start is None else start)
        value = np.broadcast_to(np.asarray(value, dtype=float), variables[name].shape)
    if not isinstance(value, float | np.ndarray):
        raise ParameterError(f"found {value!r}; a trim finds numbers alone.", block=block.label, port=".".join(keys))
    return value


def _declared(block: Any, keys: list[str], low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds within those that the parameter has by itself."""
    spec = type(block).parameter_specs[keys[0]] if len(keys) == 1 else None
    if spec is not None:
        least = spec.minimum if spec.above is None else np.nextafter(spec.above, np.inf)
        low = low if least is None else np.maximum(low, least)
        high = high if spec.maximum is None else np.minimum(high, spec.maximum)
    return low, high


def _away(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return numbers within bounds that are not zero."""
    step = np.minimum(1.0, np.where(np.isfinite(high - low), 0.25 * (high - low), 1.0))
    return np.where(high >= -low, step, -step)
