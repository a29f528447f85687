"""C for a target as text, and what its two kinds share: ticks alone, and the loop of runs inside."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from .c_text import sentence
from .loop_spec import LoopSpec
from .target_members import Member, Number, Status
from .tick_text import TickFacts

MOST_SHOWN = 8
"""Outputs that an example prints."""


@dataclass(frozen=True, eq=False)
class TargetText:
    """C for a target, as text.

    ``name``: its name: that of the files, and the begin of all names in them.
    ``bytes_of``: bytes of each group of the struct, of the struct, and of constant tables.
    ``ticks``: what each kind of tick touches; none with the loop of runs inside.
    """

    name: str
    number: Number
    members: tuple[Member, ...]
    files: Mapping[str, str]
    ticks: tuple[TickFacts, ...]
    bytes_of: Mapping[str, int]
    platform_functions: tuple[str, ...]
    statuses: tuple[str, ...]


def frame_facts(spec: LoopSpec, *, about: str, period: str, statuses: Iterable[Status]) -> dict[str, Any]:
    """Return the facts that the templates of both kinds have.

    ``about``: the first line, where the diagram has no description.
    ``period``: seconds between two ticks, as C text.
    """
    base = float(spec.base)
    return {
        "name": spec.name,
        "upper": spec.name.upper(),
        "about": sentence(spec.description) or about,
        "seconds": f"{base:g}",
        "period": period,
        "statuses": [*statuses],
        "example_ticks": max(1, min(1000, round(1 / base))),
    }
