"""Pages of the reference that are made of the package's facts: units, and the help of the command line."""

from __future__ import annotations

import io
import os
import re
from contextlib import redirect_stdout, suppress
from pathlib import Path
from unittest.mock import patch

_UNITS = """# Units

A unit is a text: `"N.m"`, `"rad/s"`, `"kg.m2"`. The grammar is that of Modelica and FMI: factors joined by a dot, one
`/` at most, a denominator of several factors in parentheses (`J/(kg.K)`), integer exponents with or without `^`
(`m/s2`, `m^2`, `s-1`). Also read are `*` or `·` for the dot, raised digits (`m³/s`), and `Nm`, `Wh`, `Ah`, `VA`.

- A wire between two ports with units that differ is an error, with the factor.
- A port without a unit takes any.
- Operators on signals compute the unit of the result where all operands have one: m / s is m/s.
- `UnitConversion` converts on purpose; `Fmu(…, convert_units=True)` at the ports of an FMU.

| unit | is | |
|---|---|---|
"""


def _units() -> str:
    """Return the page of units."""
    from loopwright.blocks.core import units

    rows = []
    for name, unit in sorted({**units._PREFIXED, **units._PLAIN}.items(), key=lambda item: item[0].lower()):
        offset = f" + {unit.offset:.6g}" if unit.offset else ""
        prefixes = "with prefixes p to G" if name in units._PREFIXED else ""
        rows.append(f"| `{name}` | {unit.factor:.10g} · {unit.base_text}{offset} | {prefixes} |")
    return _UNITS + "\n".join(rows) + "\n"


def _help_of(*command: str) -> str:
    """Return what a command prints for ``--help``, 88 columns wide."""
    from loopwright.diagrams.cli import main

    printed = io.StringIO()
    with redirect_stdout(printed), suppress(SystemExit), patch.dict(os.environ, COLUMNS="88"):
        main([*command, "--help"])
    return "\n".join(line.rstrip() for line in printed.getvalue().splitlines())


def _command_line() -> str:
    """Return the page of the command line: the help of each command."""
    text = "# Command line\n\n`python -m loopwright` is the same as `loopwright`.\n\n"
    whole = _help_of()
    commands = re.findall(r"(?m)^    ([a-z]+)  ", whole)
    for title, shown in {"loopwright": whole, **{f"loopwright {name}": _help_of(name) for name in commands}}.items():
        text += f"## {title}\n\n```text\n{shown}\n```\n\n"
    return text


def write(folder: Path) -> None:
    """Write the pages into the folder of the reference."""
    (folder / "units.md").write_text(_units(), encoding="utf-8")
    (folder / "command_line.md").write_text(_command_line(), encoding="utf-8")
