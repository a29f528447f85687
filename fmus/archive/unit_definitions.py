"""Units of an FMU: their names, held against the definitions in its description."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ...blocks.core import BASE_UNITS, DefinedUnit, Unit, UnitError, parse_unit

_RAD = list(BASE_UNITS).index("rad")


class FmuUnits:
    """Units by their names in an FMU (FMI 2.0, 2.2.2; FMI 3.0, 2.4.4).

    A name counts as the definition says: also one that this library reads in another way, such as "m" for minutes, or
    not at all, such as "degF". One that it can't read is written in base units if its factor is 1. A name without a
    definition counts as this library reads it; else the variable has no unit here.
    """

    def __init__(self, definitions: Mapping[str, Any]):
        self.definitions, self.complaints = definitions, list[str]()
        self._read: dict[str, str | None] = {}

    def find(self, name: str | None, *, relative: bool = False) -> str | None:
        """Return the unit of a name; of a relative quantity, such as a temperature difference, it has no offset."""
        if name is None:
            return None
        if name not in self._read:
            self._read[name] = self._find(name)
        found = self._read[name]
        if not relative or found is None or parse_unit(found).exponents != parse_unit("K").exponents:
            return found
        return DefinedUnit(replace(parse_unit(found), relative=True))

    def _find(self, name: str) -> str | None:
        try:
            ours = parse_unit(name)
        except UnitError:
            ours = None
        definition = self.definitions.get(name)
        base = None if definition is None else definition.baseUnit
        if base is None:
            return None if ours is None else name
        exponents = [int(getattr(base, symbol)) for symbol in BASE_UNITS]
        factor, offset = float(base.factor), float(base.offset)
        kg, m, s, A, K, mol, cd, rad = exponents
        theirs = Unit(name, (kg, m, s, A, K, mol, cd, rad), factor, offset, loose_angle=rad == 0)
        if ours is not None:
            mine = list(ours.exponents)
            mine[_RAD] = exponents[_RAD] = 0  # tools disagree on the radian
            close = math.isclose(ours.factor, factor, rel_tol=1e-5) and abs(ours.offset - offset) < 1e-3
            if mine == exponents and close:
                return name
            self.complaints.append(
                f"its unit {name!r} is defined in its own way, and is not taken for that of {ours.base_text}"
            )
        if not (math.isfinite(factor) and math.isfinite(offset) and factor > 0.0):
            return None
        if factor != 1.0 or offset != 0.0:
            return DefinedUnit(theirs)
        return theirs.base_text
