"""Limits of the environments that a contact has to bear."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from ...blocks.core import OptionError, near
from .verdicts import Limit, Sense, make_limit

CONTACT_SENSES: Mapping[str, Sense] = MappingProxyType(
    {"stiffness": Sense.LEAST, "damping": Sense.LEAST, "mass": Sense.LEAST, "tool_mass": Sense.LEAST}
)
"""Properties of an environment of which a contact's limit can be required."""
WITH = "with"
"""Entry that has the properties of the environment that are held."""


class ContactLimits:
    """Limits of coupled stability that are required of a contact, in one environment.

    Parameters
    ----------
    given : mapping
        ``stiffness`` (N/m), ``damping`` (N s/m), ``mass`` and ``tool_mass`` (kg): the loop is stable at least up to so
        much, or its limit lies in a range of two numbers. ``with`` has further properties of the environment,
        such as ``{"damping": 10.0}``.
    port : str, optional
        Place of the limits, for errors.

    Raises
    ------
    OptionError
        An unknown name, a limit that is none, or no limit at all.

    Examples
    --------
    >>> asked = ContactLimits({"stiffness": 5e4, "with": {"damping": 10}})
    >>> str(asked.limits["stiffness"]), dict(asked.environment)
    ('≥ 50000', {'damping': 10.0})
    """

    def __init__(self, given: Any, port: str = "contact"):
        if not isinstance(given, Mapping):
            raise OptionError(f'found {given!r}; expected limits, such as {{"stiffness": 5e4}}. Give one.', port=port)
        for name in given:
            if name not in CONTACT_SENSES and name != WITH:
                hint = near(str(name), [*CONTACT_SENSES, WITH])
                raise OptionError(f"a contact has no limit of {name!r}. {hint}", port=f"{port}.{name}")
        limits = {
            name: make_limit(name, value, CONTACT_SENSES[name], f"{port}.{name}")
            for name, value in given.items()
            if name != WITH
        }
        if not limits:
            raise OptionError(f"found no limit; expected some of {', '.join(CONTACT_SENSES)}. Give one.", port=port)
        self.limits: Mapping[str, Limit] = MappingProxyType(limits)
        self.environment: Mapping[str, float] = MappingProxyType(_read_environment(given.get(WITH, {}), limits, port))


def _read_environment(given: Any, limits: Mapping[str, Limit], port: str) -> dict[str, float]:
    where = f"{port}.{WITH}"
    if not isinstance(given, Mapping):
        raise OptionError(f'found {given!r}; expected properties, such as {{"damping": 10}}. Give one.', port=where)
    for name, value in given.items():
        if name not in CONTACT_SENSES:
            raise OptionError(f"an environment has no {name!r}. {near(str(name), CONTACT_SENSES)}", port=where)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
            raise OptionError(
                f"found {value!r}; expected a finite number that is not negative. Give one.", port=f"{where}.{name}"
            )
        if name in limits:
            raise OptionError("found it limited and held; expected one of them. Leave one out.", port=f"{where}.{name}")
    return {str(name): float(value) for name, value in given.items()}


def read_contact_limits(given: Any, port: str = "contact") -> tuple[ContactLimits, ...]:
    """Return limits that are given as one mapping, or as a list of them for several environments."""
    every = given if isinstance(given, list | tuple) else [given]
    return tuple(one if isinstance(one, ContactLimits) else ContactLimits(one, port) for one in every)


def read_contacts(given: Any) -> dict[str, tuple[ContactLimits, ...]]:
    """Return limits by the names of contacts; those of all contacts have the name ""."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        return {"": read_contact_limits(given)}
    named = {name: one for name, one in given.items() if name not in (*CONTACT_SENSES, WITH) and _is_named(one)}
    general = {name: one for name, one in given.items() if name not in named}
    found = {"": read_contact_limits(general)} if general else {}
    return found | {str(name): read_contact_limits(one, f"contact.{name}") for name, one in named.items()}


def _is_named(value: Any) -> bool:
    return isinstance(value, Mapping | ContactLimits) or (
        isinstance(value, list | tuple) and bool(value) and all(isinstance(v, Mapping | ContactLimits) for v in value)
    )
