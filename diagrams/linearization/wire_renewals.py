"""Ticks at which wires are renewed: those of the clock behind their sources, or else of their readers' clock."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ...blocks.core import OptionError
from ..flat import FlatDiagram, TickPattern
from .taps import Tap


def ticks_to_renewal(flat: FlatDiagram, ports: Iterable[tuple[str, str]], tick: int) -> int:
    """Return the number of ticks after ``tick`` until the wires are renewed; 0 if they are not renewed together.

    A wire is renewed at the ticks of the clock behind its source. A wire that follows continuous states or an FMU is
    renewed at the ticks of the clock of its readers.
    """
    clock = _find_one_clock(flat, list(ports))
    return 0 if clock is None or clock.acts(tick) else clock.after(tick) - tick


def ticks_between_renewals(flat: FlatDiagram, ports: Iterable[tuple[str, str]]) -> int | None:
    """Return the number of ticks from one renewal of the wires to the next; None if they are not renewed together."""
    clock = _find_one_clock(flat, list(ports))
    return None if clock is None else clock.every


def find_slower_clocks(flat: FlatDiagram, ports: Iterable[tuple[str, str]], name: str) -> frozenset[TickPattern]:
    """Return the clocks slower than the wires: than the fastest clock behind their sources, or their readers."""
    ports = list(ports)
    for reading in (False, True):
        found = [_find_clocks(flat, port, reading=reading) for port in ports]
        if all(found):
            every = min(clock.every for clocks in found for clock in clocks or ())
            return frozenset(clock for clock in flat.distinct if clock.every > every)
    raise OptionError(
        f"found no sampled subsystem that makes or reads {', '.join('.'.join(port) for port in ports)} alone; expected "
        "one, whose rate says which loops are slower. Take the loop at a wire of a sampled subsystem.",
        block=name,
        port="slow",
    )


def _find_one_clock(flat: FlatDiagram, ports: Sequence[tuple[str, str]]) -> TickPattern | None:
    """Return the one clock behind the sources of all wires, or else that of all their readers; None without one."""
    for reading in (False, True):
        found: set[TickPattern] | None = set()
        for port in ports:
            clocks = _find_clocks(flat, port, reading=reading)
            found = None if clocks is None or found is None else found | clocks
        if found is not None and len(found) == 1:
            return next(iter(found))
    return None


def _find_clocks(flat: FlatDiagram, port: tuple[str, str], *, reading: bool) -> set[TickPattern] | None:
    """Return the clocks behind a port, or with ``reading`` those of its readers.

    Blocks in continuous time without states are passed through; with states, or an FMU, the result is None.
    """
    table = flat.table
    found: set[TickPattern] = set()
    todo, seen = [port[0]] if not reading else _readers(flat, port), set[str]()
    while todo:
        path = todo.pop()
        if path in seen:
            continue
        seen.add(path)
        subsystem = table.subsystem_of[path]
        if table.is_sampled(subsystem) and subsystem in flat.clocks:
            found.add(flat.clocks[subsystem])
            continue
        where = flat.states.slices.get(path)
        if path not in flat.checked.traced or (where is not None and where.stop > where.start):
            return None
        if reading:
            todo += [block for (block, _), w in table.wires.items() if w.block == path]
        else:
            todo += [w.block for (block, _), w in table.wires.items() if block == path]
    return found


def _readers(flat: FlatDiagram, port: tuple[str, str]) -> list[str]:
    return [block for (block, _), w in flat.table.wires.items() if (w.block, w.port) == port]


def group_by_renewals(flat: FlatDiagram, signals: Sequence[Tap], ticks: Sequence[int]) -> list[list[int]]:
    """Return the groups of places in ``ticks`` between the renewals of the wires; empty if no one clock renews them."""
    clock = _find_one_clock(flat, [signal.port for signal in signals])
    if clock is None or not clock.acts(ticks[0]):
        return []
    groups: list[list[int]] = []
    for place, k in enumerate(ticks):
        if clock.acts(k):
            groups.append([place])
        else:
            groups[-1].append(place)
    return groups


def clock_of(flat: FlatDiagram, tap: Tap) -> TickPattern | None:
    """Return the clock of the subsystem that a wire comes from; None of one in continuous time."""
    subsystem = flat.table.subsystem_of.get(tap.port[0], "")
    return flat.clocks.get(subsystem) if flat.table.is_sampled(subsystem) else None
