"""Communication points of plants: the ticks to which an FMU, or another stepped block, steps.

A plant steps at the ticks of the sampled subsystem that it is in, and of those that it is wired to, directly or
through blocks in continuous time; plants that are wired to one another in this way share their ticks. So a subsystem
that has nothing to do with a plant never changes its communication points.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from ...blocks.core import Block
from ..wiring import Structure, exact_time, stepped_blocks
from .clocks import EVERY, TickPattern, in_order


@dataclass(frozen=True, eq=False)
class StepTable:
    """Steps of the plants that end at some ticks, for a loop over these; each array has a row for each tick.

    Attributes
    ----------
    begins, widths : ndarray, shape (n, plants)
        Where the step of each plant begins, and its length, in s; length 0 where none ends at the tick.
    holds : ndarray, shape (n, plants), of uint8
        Whether the plant takes the tick's inputs, and holds them to its next communication point.
    """

    begins: np.ndarray
    widths: np.ndarray
    holds: np.ndarray

    def part(self, start: int, stop: int) -> StepTable:
        """Return some of its ticks, by their places."""
        return StepTable(self.begins[start:stop], self.widths[start:stop], self.holds[start:stop])


def takes_any_step(plant: Block) -> bool:
    """Whether the communication steps of a plant may have any length."""
    return bool(getattr(plant, "variable_step", False)) and getattr(plant, "fixed_internal_step", None) is None


def own_step(plant: Block) -> Fraction | None:
    """Return the communication step in s that a plant asks for; None where its wires decide."""
    found = getattr(getattr(plant, "stepping", None), "communication_step", None)
    return None if found is None else exact_time(found, block=plant.label)


def suggested_step(plant: Block) -> float | None:
    """Return the communication step in s of a plant's default experiment; None where it has none above 0."""
    found = getattr(getattr(plant, "description", None), "step_size", None)
    return found if found is not None and 0.0 < found < math.inf else None


def find_plant_ticks(
    table: Structure, clocks: Mapping[str, TickPattern], base: Fraction, *, every: bool
) -> dict[str, tuple[TickPattern, ...]]:
    """Return the ticks at which each plant steps, by path; ``clocks`` are those of sampled subsystems.

    With ``every``, a step was asked for: then plants without their own communication step step at every tick.
    """
    plants = stepped_blocks(table)
    own = {path: step for path, plant in plants.items() if (step := own_step(plant)) is not None}
    asked = {path: TickPattern(int(step / base)) for path, step in own.items()}
    anything = {*clocks.values(), *asked.values()}
    found: dict[str, tuple[TickPattern, ...]] = {}
    for group, wired in _group(table, clocks, plants):
        shared = {EVERY} if every else wired or anything or {EVERY}
        for path in group:
            if path in asked:
                found[path] = (asked[path],)
            elif EVERY in shared:
                found[path] = (EVERY,)
            else:
                found[path] = in_order(shared) if takes_any_step(plants[path]) else (_even(shared),)
    return dict(sorted(found.items()))


def _even(clocks: Iterable[TickPattern]) -> TickPattern:
    """Return the slowest even ticks, from 0 on, that hold those of all the clocks."""
    return TickPattern(math.gcd(*(n for clock in clocks for n in (clock.every, clock.offset))))


def _group(
    table: Structure, clocks: Mapping[str, TickPattern], plants: Mapping[str, Block]
) -> list[tuple[set[str], set[TickPattern]]]:
    """Return the plants that are wired to one another, with the clocks of the subsystems that these are wired to."""
    edges = {(wire.block, path) for (path, _), wire in table.wires.items()}
    for subsystem, wire in table.controls.items():
        inside = [p for p, s in table.subsystem_of.items() if f"{s}.".startswith(f"{subsystem}.")]
        edges |= {(wire.block, path) for path in inside}
    following: dict[str, set[str]] = {}
    preceding: dict[str, set[str]] = {}
    for source, reader in edges:
        following.setdefault(source, set()).add(reader)
        preceding.setdefault(reader, set()).add(source)
    groups: list[tuple[set[str], set[TickPattern]]] = []
    for plant in plants:
        own = clocks.get(table.subsystem_of[plant])
        group, wired = {plant}, set[TickPattern]() if own is None else {own}
        for neighbours in (following, preceding):
            todo, seen = [*neighbours.get(plant, ())], set[str]()
            while todo:
                path = todo.pop()
                if path in seen:
                    continue
                seen.add(path)
                clock = clocks.get(table.subsystem_of[path])
                if path in plants:
                    group.add(path)
                elif clock is not None:
                    wired.add(clock)
                else:
                    todo += neighbours.get(path, ())
        for other in [g for g in groups if g[0] & group]:
            groups.remove(other)
            group, wired = group | other[0], wired | other[1]
        groups.append((group, wired))
    return groups
