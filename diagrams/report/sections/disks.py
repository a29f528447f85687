"""Disk margins of loops with several channels."""

from __future__ import annotations

from collections.abc import Mapping

from ....blocks.core import LoopwrightError
from ...frequency import DiskMargin, Number, mimo_disk_margin, with_findings
from ..case import Case
from ..pages import Section, Table
from ..variant import Cut, Variant
from .uncertainty import LoopPart, cut_key


def several(case: Case, key: str, wire: str) -> LoopPart | None:
    """Return the section about a wire with several entries: its MIMO disk margin; None where it has none."""
    own: dict[tuple[Variant, Cut], Mapping[str, Number]] = {}
    rows, notes = [], []
    for v in case.usable():
        try:
            cut, title, L = v.fullest_loop(wire)
            disk = mimo_disk_margin(L)
        except LoopwrightError as error:
            notes.append(f"{v.title}: {error.message}")
            continue
        own[v, cut] = disk_numbers(disk)
        rows.append((title, disk.alpha, disk.frequency, disk_range(disk)))
    if not rows:
        return None
    table = Table(
        f"MIMO disk margin at {wire}", ("variant", "α", "at", "gains and phase of all entries at once"), tuple(rows)
    )
    numbers = {f"{cut_key(*at)}.{name}": number for at, mine in own.items() for name, number in mine.items()}
    return LoopPart(Section(key, f"Loops at {wire}", tuple(notes), (table,), (), numbers), own)


def disk_numbers(disk: DiskMargin) -> dict[str, Number]:
    """Return the numbers of a disk margin by the ends of their paths."""
    how = disk.alpha.confirmed_by
    found = {
        "disk_margin": disk.alpha,
        "frequency": disk.frequency,
        "gain_low": Number(disk.gain_low, "1", disk.alpha.tolerance, how),
        "gain_high": Number(disk.gain_high, "1", disk.alpha.tolerance * disk.gain_high**2, how),
        "phase_deg": Number(disk.phase_deg, "deg", 60 * disk.alpha.tolerance, how),
    }
    return with_findings(found, disk.findings)


def disk_range(disk: DiskMargin) -> str:
    """Return the gains and the phase that a disk allows, as text."""
    return f"{disk.gain_low:.4g} … {disk.gain_high:.4g}, ± {disk.phase_deg:.4g}°"
