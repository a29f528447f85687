"""Type definitions of an FMU: one for each unit, by the quantity that it measures (FMI 3.0, 2.4.4; 2.0, 2.2.3)."""

from __future__ import annotations

from collections.abc import Iterable

from ...blocks.core import parse_unit
from .variable_entries import Entry

_QUANTITIES = {
    "1": "Number",
    "s": "Time",
    "Hz": "Frequency",
    "kg": "Mass",
    "m": "Length",
    "m/s": "Velocity",
    "m/s2": "Acceleration",
    "N": "Force",
    "N/m": "TranslationalStiffness",
    "N.s/m": "TranslationalDamping",
    "rad": "Angle",
    "rad/s": "AngularVelocity",
    "rad/s2": "AngularAcceleration",
    "kg.m2": "MomentOfInertia",
    "K": "Temperature",
    "W": "Power",
    "Pa": "Pressure",
    "V": "Voltage",
    "A": "Current",
    "Ohm": "Resistance",
    "H": "Inductance",
    "F": "Capacitance",
}


def type_names(entries: Iterable[Entry]) -> dict[str, str]:
    """Return the name of the type of each unit in use, in the order of the units.

    The name is that of the unit's quantity if it is a common one, else the unit's own. A name that a variable has
    already gets an underscore, since the two must differ.
    """
    entries = tuple(entries)
    taken = {e.name for e in entries}
    found = {}
    for unit in sorted({e.variable.unit for e in entries if e.variable.unit is not None}):
        name = quantity(unit) or f"Quantity in {unit}"
        while name in taken:
            name += "_"
        taken.add(name)
        found[unit] = name
    return found


def quantity(unit: str) -> str | None:
    """Return the quantity that a unit measures, by its spelling, else by its dimension; None if unknown."""
    if unit in _QUANTITIES:
        return _QUANTITIES[unit]
    exponents = parse_unit(unit).exponents
    return next((name for known, name in _QUANTITIES.items() if parse_unit(known).exponents == exponents), None)
