"""Aliases: names of one variable of an FMU (FMI 2.0, 2.2.7; FMI 3.0, 2.4.7.5).

An input has one wire. Were each of its names a port, the last one to be set would win.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from .variables import FmuVariable


def find_aliases(variables: Mapping[str, FmuVariable]) -> tuple[dict[str, FmuVariable], dict[str, str]]:
    """Return variables in which each input is listed once, and first names by the others of inputs and parameters.

    Further names of an input are locals, which are read.
    """
    first: dict[tuple[str, tuple[int, ...]], FmuVariable] = {}
    found, aliases = dict(variables), {}
    for name, variable in variables.items():
        if variable.causality not in ("input", "parameter"):
            continue
        other = first.setdefault((variable.type, variable.references), variable)
        if other is not variable:
            aliases[name] = other.name
            if variable.causality == "input":
                found[name] = replace(variable, causality="local")
    return found, aliases
