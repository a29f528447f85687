"""NumPy's functions that are applied to signals, each with the unit of its result.

A function that jumps, such as ``np.floor``, is not among them: a solver would not land on its jumps. A unit follows
only where those of all operands are known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .errors import UnitError
from .frozen import FrozenMapping, freeze
from .units import (
    combine_units,
    common_unit,
    describe_mismatch,
    difference_unit,
    root_unit,
    same_unit,
    uncertain_unit,
)
from .values import identity

Units = Mapping[str, str | tuple[str, ...] | None]
"""Units of a block's inputs, by name; None where it is not known."""
Rule = Callable[[Mapping[str, str], str], "str | None"]
"""From the units of all operands, by name, and the function's name to the unit of the result."""


@dataclass(frozen=True)
class Place:
    """Place of a signal among the arguments of a NumPy function."""

    index: int


class NumpyCall:
    """A NumPy function of signals (each a `Place`) and of numbers: ``np.sum(…, axis=0)``; it can be pickled."""

    def __init__(self, function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]):
        self.function, self.args, self.kwargs = function, freeze(args), FrozenMapping(kwargs)
        self.__name__ = function.__name__

    def simplified(self) -> Callable[..., Any]:
        """Return NumPy's function itself where it has one argument, the signal."""
        return self.function if self.args == (Place(0),) and not self.kwargs else self

    def __call__(self, *values: Any) -> Any:
        """Return the function's result with the values at their places."""

        def fill(part: Any) -> Any:
            if isinstance(part, Place):
                return values[part.index]
            return tuple(map(fill, part)) if isinstance(part, tuple) else part

        return self.function(*map(fill, self.args), **{key: fill(part) for key, part in self.kwargs.items()})

    def _identity(self) -> Any:
        return self.function, identity(self.args), identity(self.kwargs)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, NumpyCall) and self._identity() == other._identity()

    def __hash__(self) -> int:
        return hash(self._identity())

    def __repr__(self) -> str:
        keywords = (f"{key}={value!r}" for key, value in self.kwargs.items())
        shown = ("…" if isinstance(part, Place) else repr(part) for part in self.args)
        return f"np.{self.__name__}({', '.join((*shown, *keywords))})"


# --- units of results ------------------------------------------------------------------------------------------------


def _expect(units: Mapping[str, str], accepted: tuple[str, ...], name: str, why: str) -> None:
    for port, unit in units.items():
        if not any(same_unit(unit, one) for one in accepted):
            step = describe_mismatch(unit, accepted[0])
            raise UnitError(f"expected {' or '.join(accepted)}, as np.{name} takes {why}: {step}", port=port)


def _alike(units: Mapping[str, str], name: str) -> str | None:
    """All operands are in one unit, and so is the result."""
    (first, unit), *rest = units.items()
    for port, other in rest:
        if not same_unit(other, unit):
            step = describe_mismatch(other, unit)
            raise UnitError(f"expected {unit} as {first} is, as np.{name} takes like units: {step}", port=port)
    return common_unit(*units.values())


def _difference(units: Mapping[str, str], name: str) -> str | None:
    """Return the unit of a difference of operands, which are in one unit."""
    unit = _alike(units, name)
    return None if unit is None else difference_unit(unit)


def _of_several(units: Mapping[str, str], name: str) -> str | None:
    """Return the unit of a sum of operands, which are in one unit; how many they are is not known."""
    unit = _alike(units, name)
    return None if unit is None else uncertain_unit(unit)


def _of_angle(units: Mapping[str, str], name: str) -> str | None:
    _expect(units, ("rad", "1"), name, "an angle or a pure number")
    return "1"


def _of_number(units: Mapping[str, str], name: str) -> str | None:
    _expect(units, ("1", "rad"), name, "a pure number")
    return "1"


def _angle_of_number(units: Mapping[str, str], name: str) -> str | None:
    _expect(units, ("1",), name, "a pure number")
    return "rad"


def _angle_of_two(units: Mapping[str, str], name: str) -> str | None:
    _alike(units, name)
    return "rad"


def multiply_units(units: Mapping[str, str], name: str) -> str | None:
    """Return the unit of a product."""
    return combine_units(*((unit, 1) for unit in units.values()))


def _quotient(units: Mapping[str, str], name: str) -> str | None:
    over, under = units.values()
    return combine_units((over, 1), (under, -1))


def _power(n: int) -> Rule:
    return lambda units, name: combine_units(*((unit, n) for unit in units.values()))


def _root(degree: int) -> Rule:
    return lambda units, name: root_unit(next(iter(units.values())), degree)


def _raised(units: Mapping[str, str], name: str) -> str | None:
    base, exponent = units.items()
    _expect(dict([exponent]), ("1",), name, "a pure number as exponent")
    return "1" if same_unit(base[1], "1") else None


def _converted(before: str, after: str) -> Rule:
    def rule(units: Mapping[str, str], name: str) -> str | None:
        _expect(units, (before,), name, f"an angle in {before}")
        return after

    return rule


def _unknown(units: Mapping[str, str], name: str) -> str | None:
    return None


_ENTRYWISE: dict[Any, Rule] = {
    np.divide: _quotient,
    np.reciprocal: _power(-1),
    np.square: _power(2),
    np.sqrt: _root(2),
    np.cbrt: _root(3),
    np.power: _raised,
    np.radians: _converted("deg", "rad"),
    np.deg2rad: _converted("deg", "rad"),
    np.degrees: _converted("rad", "deg"),
    np.rad2deg: _converted("rad", "deg"),
    np.arctan2: _angle_of_two,
    np.hypot: _of_several,
    np.absolute: _alike,
    np.fabs: _alike,
}
_ENTRYWISE |= dict.fromkeys((np.sin, np.cos, np.tan), _of_angle)
_ENTRYWISE |= dict.fromkeys((np.arcsin, np.arccos, np.arctan), _angle_of_number)
_ENTRYWISE |= dict.fromkeys((np.exp, np.exp2, np.expm1, np.log, np.log2, np.log10, np.log1p), _of_number)
_ENTRYWISE |= dict.fromkeys((np.sinh, np.cosh, np.tanh, np.arcsinh, np.arccosh, np.arctanh, np.sinc), _of_number)
_AS_A_WHOLE: dict[Any, Rule] = {
    np.matmul: multiply_units,
    np.inner: multiply_units,
    np.outer: multiply_units,
    np.cross: multiply_units,
    np.dot: multiply_units,
    np.vdot: multiply_units,
    np.var: _power(2),
    np.linalg.inv: _power(-1),
    np.linalg.solve: lambda units, name: _quotient(dict(reversed(list(units.items()))), name),
    np.linalg.det: _unknown,
    np.prod: _unknown,
    np.polyval: _unknown,
}
_AS_A_WHOLE |= dict.fromkeys((np.mean, np.average, np.max, np.min, np.amax, np.amin, np.median), _alike)
_AS_A_WHOLE |= dict.fromkeys((np.sum, np.cumsum, np.trace, np.linalg.norm), _of_several)
_AS_A_WHOLE |= dict.fromkeys((np.std, np.ptp, np.diff), _difference)
_AS_A_WHOLE |= dict.fromkeys((np.flip, np.roll, np.sort), _alike)
_AS_A_WHOLE |= dict.fromkeys((np.reshape, np.ravel, np.transpose, np.squeeze, np.repeat, np.tile, np.diag), _alike)
_AS_A_WHOLE |= dict.fromkeys((np.stack, np.concatenate, np.vstack, np.column_stack), _alike)
RULES: Mapping[Any, Rule] = {**_ENTRYWISE, **_AS_A_WHOLE}
"""NumPy's functions of signals, with the unit of their results."""


def result_unit(function: Any, units: Units) -> str | tuple[str, ...] | None:
    """Return the unit of the result of a NumPy function of inputs in these units; None where it is not known."""
    call = function.function if isinstance(function, NumpyCall) else function
    rule = RULES.get(call) if isinstance(call, np.ufunc) or callable(call) else None
    if rule is None or not units or any(unit is None for unit in units.values()):
        return None
    known = {name: unit for name, unit in units.items() if unit is not None}
    return follow_entries(rule, known, call.__name__, entrywise=call in _ENTRYWISE)


def follow_entries(
    rule: Rule, units: Mapping[str, str | tuple[str, ...]], name: str, *, entrywise: bool = True
) -> str | tuple[str, ...] | None:
    """Return the unit of a result by a rule, entry by entry where units are given for each."""
    count = next((len(unit) for unit in units.values() if isinstance(unit, tuple)), None)
    if count is None:
        return rule({port: unit for port, unit in units.items() if isinstance(unit, str)}, name)
    if any(isinstance(unit, tuple) and len(unit) != count for unit in units.values()):
        return None
    entries = [{p: u if isinstance(u, str) else u[i] for p, u in units.items()} for i in range(count)]
    if entrywise:
        found = [rule(entry, name) for entry in entries]
        return None if None in found else tuple(unit for unit in found if unit is not None)
    same = all(same_unit(entry[port], entries[0][port]) for entry in entries for port in entry)
    return rule(entries[0], name) if same else None
