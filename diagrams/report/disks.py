"""Disk margins of loops with several channels."""

from __future__ import annotations

from ...blocks.core import LoopwrightError
from ..document import Section, Table
from ..frequency import DiskMargin, Number, mimo_disk_margin
from .case import Case


def several(case: Case, key: str, wire: str) -> Section | None:
    """Return the section about a wire with several entries: its MIMO disk margin; None where it has none."""
    numbers: dict[str, Number] = {}
    rows, notes = [], []
    for v in case.usable():
        try:
            disk = mimo_disk_margin(v.loop(wire))
        except LoopwrightError as error:
            notes.append(f"{v.title}: {error.message}")
            continue
        numbers |= disk_numbers(v.key, disk)
        rows.append((v.title, disk.alpha, disk.frequency, disk_range(disk)))
    if not rows:
        return None
    table = Table(
        f"MIMO disk margin at {wire}", ("variant", "α", "at", "gains and phase of all entries at once"), tuple(rows)
    )
    return Section(key, f"Loops at {wire}", tuple(notes), (table,), (), numbers)


def disk_numbers(start: str, disk: DiskMargin) -> dict[str, Number]:
    """Return the numbers of a disk margin; their paths begin with ``start``."""
    how = disk.alpha.confirmed_by
    return {
        f"{start}.disk_margin": disk.alpha,
        f"{start}.frequency": disk.frequency,
        f"{start}.gain_low": Number(disk.gain_low, "1", disk.alpha.tolerance, how),
        f"{start}.gain_high": Number(disk.gain_high, "1", disk.alpha.tolerance * disk.gain_high**2, how),
        f"{start}.phase_deg": Number(disk.phase_deg, "deg", 60 * disk.alpha.tolerance, how),
    }


def disk_range(disk: DiskMargin) -> str:
    """Return the gains and the phase that a disk allows, as text."""
    return f"{disk.gain_low:.4g} … {disk.gain_high:.4g}, ± {disk.phase_deg:.4g}°"
