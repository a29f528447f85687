"""Names of a run's signals: full names, and the entries that they stand for."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from ...blocks.core import Layout, UnknownNameError, near
from ..wiring import Wire


def resolve(name: str, wires: Mapping[str, Wire], ports: Collection[str]) -> str:
    """Return the full name that ``name`` stands for: a wire's or port's path, or a unique end of one; wires go first.

    Raises
    ------
    UnknownNameError
        If there is none, or several.
    """
    if name in wires or name in ports:
        return name
    for group in (wires, ports):
        found = sorted(n for n in group if n.endswith("." + name))
        if found and (len(found) == 1 or (group is wires and len({wires[n] for n in found}) == 1)):
            return found[0]
        if found:
            error = UnknownNameError(
                f"{name!r} stands for several signals: {', '.join(found)}. Write more of the path."
            )
            error.candidates = tuple(found)
            raise error
    short = {n.rpartition(".")[2] for n in (*wires, *ports)}
    raise UnknownNameError(f"no signal {name!r} was recorded. {near(name, short | set(wires) | set(ports))}")


def entries(full: str, layout: Layout, wires: Mapping[str, Wire]) -> np.ndarray:
    """Return the numbers of a signal's entries in the vector of a sample, in the signal's shape."""
    wire = wires.get(full)
    port = full if wire is None else f"{wire.block}.{wire.port}"
    whole = layout.index(port)
    return whole if wire is None or wire.index is None else np.asarray(whole[wire.index])
