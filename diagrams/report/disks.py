"""Disk margins of loops with several channels."""

from __future__ import annotations

from collections.abc import Mapping

from ...blocks.core import LoopwrightError
from ..document import Section, Table
from ..frequency import DiskMargin, Number, mimo_disk_margin
from .case import Case
from .uncertainty import LoopPart
from .variant import Variant


def several(case: Case, key: str, wire: str) -> LoopPart | None:
    """Return the section about a wire with several entries: its MIMO disk margin; None where it has none."""
    own: dict[Variant, Mapping[str, Number]] = {}
    rows, notes = [], []
    for v in case.usable():
        try:
            disk = mimo_disk_margin(v.loop(wire))
        except LoopwrightError as error:
            notes.append(f"{v.title}: {error.message}")
            continue
        own[v] = disk_numbers(disk)
        rows.append((v.title, disk.alpha, disk.frequency, disk_range(disk)))
    if not rows:
        return None
    table = Table(
        f"MIMO disk margin at {wire}", ("variant", "α", "at", "gains and phase of all entries at once"), tuple(rows)
    )
    numbers = {f"{v.key}.{name}": number for v, mine in own.items() for name, number in mine.items()}
    return LoopPart(Section(key, f"Loops at {wire}", tuple(notes), (table,), (), numbers), own)


def disk_numbers(disk: DiskMargin) -> dict[str, Number]:
    """Return the numbers of a disk margin by the ends of their paths."""
    how = disk.alpha.confirmed_by
    return {
        "disk_margin": disk.alpha,
        "frequency": disk.frequency,
        "gain_low": Number(disk.gain_low, "1", disk.alpha.tolerance, how),
        "gain_high": Number(disk.gain_high, "1", disk.alpha.tolerance * disk.gain_high**2, how),
        "phase_deg": Number(disk.phase_deg, "deg", 60 * disk.alpha.tolerance, how),
    }


def disk_range(disk: DiskMargin) -> str:
    """Return the gains and the phase that a disk allows, as text."""
    return f"{disk.gain_low:.4g} … {disk.gain_high:.4g}, ± {disk.phase_deg:.4g}°"
