"""Aliases: names of one variable of an FMU (FMI 2.0, 2.2.7; FMI 3.0, 2.4.7.5).

An input has one wire. Were each of its names a port, the last one to be set would win.

Negated aliases of FMI 1.0 have the value of another variable with the opposite sign. The FMU's functions know value
references alone, and give and take the value of such a reference without the sign. No wire carries negated aliases
here, and no start value sets them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from .faults import FmuFault, FmuFinding
from .variables import FmuVariable, OtherVariable, fmi3_type, read_other


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


def read_negated(root: Any, model: Any) -> dict[str, OtherVariable]:
    """Return the negated aliases of a description by name, from its root and FMPy's reading; none but in FMI 1.0."""
    if model.fmiVersion != "1.0":
        return {}
    names = {v.get("name") for v in root.iterfind("ModelVariables/*") if v.get("alias") == "negatedAlias"}
    bases: dict[tuple[str, int], str] = {}
    for v in model.modelVariables:
        if v.name not in names:
            bases.setdefault((fmi3_type(v.type), v.valueReference), repr(v.name))
    return {
        v.name: replace(
            read_other(v, {}),
            negated_of=bases.get((fmi3_type(v.type), v.valueReference), f"the value reference {v.valueReference}"),
        )
        for v in model.modelVariables
        if v.name in names
    }


def judge_negated(others: Iterable[OtherVariable]) -> list[FmuFinding]:
    """Return a finding that names the negated aliases; none without them."""
    found = [v for v in others if v.negated_of]
    if not found:
        return []
    shown = ", ".join(f"{v.name!r} (of {v.negated_of})" for v in found[:5])
    more = f" and {len(found) - 5} more" if len(found) > 5 else ""
    return [
        FmuFinding(
            FmuFault.NEGATED,
            found[0].name,
            f"negated aliases are left out, neither set nor read: {shown}{more}.",
            "Take the variables behind them, and negate these in the diagram.",
        )
    ]
