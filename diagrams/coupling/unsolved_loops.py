"""Loops of direct feedthrough across FMUs, reported where a coupling does not solve them."""

from __future__ import annotations

from weakref import WeakKeyDictionary

from ..flat import FlatDiagram
from ..wiring import Structure
from .coupling_options import Coupling, Scheme
from .links import Links, direct_ports

_KNOWN: WeakKeyDictionary[FlatDiagram, bool] = WeakKeyDictionary()  # a tenth of the set-up of a run


def note_loops(flat: FlatDiagram, coupling: Coupling) -> tuple[str, ...]:
    """Return a message for each loop of direct feedthrough that the coupling leaves with values of the last step."""
    if coupling.scheme == Scheme.ITERATED:
        return ()
    if flat not in _KNOWN:
        _KNOWN[flat] = _may_loop(flat)
    if not _KNOWN[flat]:
        return ()
    return tuple(
        f"{', '.join(ports)}: by their model structures these outputs follow one another at once, in a loop across "
        "FMUs (an output without stated dependencies counts as one that follows all inputs). With coupling "
        f"{str(coupling)!r} each follows the others one communication step later. Take coupling='iterated', which "
        "solves the loop."
        for ports in Links(flat).loops
    )


def _may_loop(flat: FlatDiagram) -> bool:
    """Whether wires in continuous time close a loop through inputs that FMUs pass straight on; without any trace."""
    table, straight = flat.table, direct_ports(flat, wired=True)
    outputs = {(path, output) for path, _, output in straight}
    inputs = {(path, port) for path, port, _ in straight}
    after = {output: _inputs_behind(flat, table, *output) & inputs for output in outputs}
    follows = {
        output: {(path, other) for path, port, other in straight if (path, port) in reached}
        for output, reached in after.items()
    }
    for first in outputs:
        seen, todo = set[tuple[str, str]](), [*follows[first]]
        while todo:
            at = todo.pop()
            if at == first:
                return True
            if at not in seen:
                seen.add(at)
                todo += follows[at]
    return False


def _inputs_behind(flat: FlatDiagram, table: Structure, path: str, port: str) -> set[tuple[str, str]]:
    """Return the inputs of plants that a port reaches through blocks in continuous time."""
    found, seen = set[tuple[str, str]](), set[str]()
    todo = [(block, q) for (block, q), wire in table.wires.items() if (wire.block, wire.port) == (path, port)]
    while todo:
        block, q = todo.pop()
        if block in flat.plant_ticks:
            found.add((block, q))
        elif block not in seen and table.subsystem_of[block] not in flat.clocks:
            seen.add(block)
            todo += [(b, r) for (b, r), wire in table.wires.items() if wire.block == block]
    return found
