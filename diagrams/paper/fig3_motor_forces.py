"""The 2×2 loop of Fig. 3 at the motor forces."""

from __future__ import annotations

from typing import Any

from ...blocks.core import LoopwrightError
from ..frequency import Number, mimo_disk_margin
from ..report import Implementation, Section, Table, Texts, disk_numbers, disk_range
from .fig3_case import Fig3Case

TEXTS = Texts(__package__, "motor_forces")


def motor_forces(case: Fig3Case) -> Section | None:
    """Return the section about the loop at the motor forces, at several path points, with and without offset."""
    numbers: dict[str, Number] = {}
    rows: list[tuple[Any, ...]] = []
    notes: list[str] = []
    for v in case.usable():
        if not (v.is_design or v.is_actual or v.implementation is Implementation.SAMPLED):
            continue
        for place, eta, xi in case.places():
            at = case.at(v, eta, xi)
            if at is None:
                continue
            try:
                disk = mimo_disk_margin(at.loop("motor_force"))
            except LoopwrightError as error:
                notes.append(f"{v.title} at {place}: {error.message}")
                continue
            numbers |= {f"{v.key}.{place}.{name}": number for name, number in disk_numbers(disk).items()}
            rows.append((v.title, f"{eta:.3f} m", f"{xi:.3f} m", disk.alpha, disk.frequency, disk_range(disk)))
    if not rows:
        return None
    columns = ("variant", "η", "ξ", "α", "at", "gains and phase")
    table = Table("MIMO disk margin at the motor forces", columns, tuple(rows))
    text = (*TEXTS.paragraphs("disk"), *notes)
    part = Section("motor_force", "Loops at the motor forces", text, (table,), (), numbers)
    return Section("inner", "Inner loops", sections=(part,))
