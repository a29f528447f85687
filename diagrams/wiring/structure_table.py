"""A diagram as a table: its subsystems with their rates, its blocks, its named wires."""

from __future__ import annotations

from ...blocks.core import Grid, Sheet, count_of
from .structure import Structure


def sheet_of_structure(name: str, table: Structure) -> Sheet:
    """Return a diagram as it is shown."""
    subsystems = [(path, settings) for path, settings in table.subsystems.items() if path]
    rate = table.rate("")
    rows = []
    for path, settings in subsystems:
        own = table.rate(path)
        inside = sum(f"{at}.".startswith(f"{path}.") for at in table.subsystem_of.values())
        clock = "continuous" if own is None else f"{float(own):g} s"
        rows.append((path, clock, settings.control, inside, ", ".join(settings.inputs), ", ".join(settings.outputs)))
    columns = "subsystem", "sample time", "", "blocks", "inputs", "outputs"
    return Sheet(
        f"diagram {name!r}: {count_of(len(table.blocks), 'block')}",
        (("sample time", "" if rate is None else f"{float(rate):g} s"),),
        (
            Grid("Subsystems", columns, tuple(rows)),
            Grid("Blocks", ("block", "kind"), tuple((path, b.drawn_as) for path, b in table.blocks.items())),
            Grid("Named wires", ("wire", "from"), tuple((wire, str(source)) for wire, source in table.names.items())),
        ),
    )
