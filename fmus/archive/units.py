"""Units of an FMU: their names, held against the definitions in its description."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from ...blocks.core import BASE_UNITS, UnitError, parse_unit

_RAD = list(BASE_UNITS).index("rad")


class FmuUnits:
    """Units by their names in an FMU (FMI 2.0, 2.2.2; FMI 3.0, 2.4.4).

    A name counts as the definition says. A name that this library reads in another way, such as "m" for minutes, or not
    at all, is written in base units, if its factor is 1; else the variable has no unit here.

    Attributes
    ----------
    complaints : list of str
        Texts on units whose name means something else here.
    """

    def __init__(self, definitions: Mapping[str, Any]):
        self.definitions, self.complaints = definitions, list[str]()
        self._read: dict[str, str | None] = {}

    def __getitem__(self, name: str | None) -> str | None:
        if name is None:
            return None
        if name not in self._read:
            self._read[name] = self._find(name)
        return self._read[name]

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
        if ours is not None:
            mine = list(ours.exponents)
            mine[_RAD] = exponents[_RAD] = 0  # tools disagree on the radian
            close = math.isclose(ours.factor, factor, rel_tol=1e-5) and abs(ours.offset - offset) < 1e-3
            if mine == exponents and close:
                return name
            self.complaints.append(
                f"its unit {name!r} is defined in its own way, and is not taken for that of {ours.base_text}"
            )
        if factor != 1.0 or offset != 0.0:
            return None
        exponents = [int(getattr(base, symbol)) for symbol in BASE_UNITS]
        return ".".join(f"{s}{e}" if e != 1 else s for s, e in zip(BASE_UNITS, exponents, strict=True) if e) or "1"
