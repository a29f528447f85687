"""Contacts that a TOML file asks for: ports, wires and directions, and limits that are required of them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from ...blocks.core import LoopwrightError, OptionError
from ..contact import Contact, PortNames, make_contact
from ..flat import WiredDiagram
from ..requirements import REQUIRED, ContactLimits, TomlFile, read_contact_limits

TABLE = "contact"
"""Name of the tables, [contact.NAME]."""
KEYS = (*PortNames._fields, "direction", "at", "stairs", REQUIRED)
"""Entries of a contact's table."""


@dataclass(frozen=True)
class ContactTask:
    """Contacts that a TOML file asks for."""

    file: TomlFile
    places: Mapping[str, Mapping[str, Any]]  # entries of each contact's table, by its name
    limits: Mapping[str, tuple[ContactLimits, ...]]  # by the names of contacts; those of all have the name ""
    _made: dict[str, Contact] = field(default_factory=dict, repr=False)

    @classmethod
    def read(cls, source: str | os.PathLike[str] | TomlFile) -> Self:
        """Return the task of a file with tables ``[contact.NAME]``.

        Parameters
        ----------
        source : path or TomlFile
            File such as this one; ``force = false`` is a force that the controller does not measure::

                [contact.hand]
                port = "cart.push"
                position = "cart.position"
                velocity = "cart.velocity"
                force = "felt"
                direction = [1.0]

                [contact.hand.requirements]
                stiffness = 5e4
                with = {damping = 10}
        """
        file = source if isinstance(source, TomlFile) else TomlFile.read(source, TABLE)
        tables = file.table(TABLE)
        named = {name: table for name, table in tables.items() if name != REQUIRED}
        if not named:
            raise file.error(
                'found no table [contact.NAME]; expected one. Write [contact.hand], with port = "plant.external_force".'
            )
        limits = {"": _read_limits(file, tables[REQUIRED], f"{TABLE}.{REQUIRED}")} if REQUIRED in tables else {}
        for name, table in named.items():
            key = f"{TABLE}.{name}"
            if not isinstance(table, Mapping):
                raise file.error(f"found {table!r}; expected a table. Write [{key}], and its entries below.", key)
            if not name.isidentifier():
                raise file.error(
                    "found this name; expected letters, digits and underscores, as it stands in dotted paths.", key
                )
            file.check_keys(key, KEYS)
            if REQUIRED in table:
                limits[name] = _read_limits(file, table[REQUIRED], f"{key}.{REQUIRED}")
        return cls(file, {name: {k: v for k, v in t.items() if k != REQUIRED} for name, t in named.items()}, limits)

    def find(self, diagram: WiredDiagram) -> Mapping[str, Contact]:
        """Return the contacts by their names; each is made once for a diagram."""
        for name, given in self.places.items():
            if name in self._made and self._made[name].wired is diagram:
                continue
            options = {key: given[key] for key in ("stairs",) if key in given}
            try:
                self._made[name] = make_contact(
                    diagram, PortNames.of(given), given.get("direction", "perp"), given.get("at"), options
                )
            except LoopwrightError as error:
                known = error.port if error.port in KEYS else ""
                key = ".".join(part for part in (TABLE, name, known) if part)
                raise self.file.error(error.message, key) from error
        return dict(self._made)


def _read_limits(file: TomlFile, given: Any, key: str) -> tuple[ContactLimits, ...]:
    try:
        return read_contact_limits(given, key)
    except OptionError as error:
        raise file.error_at(error) from None
