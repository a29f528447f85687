"""Findings about wires that are cut: consumers whose signal the closed loop never has, or from which nothing follows.

A cut behind a port changes the signal of all its consumers. Three kinds of inputs deserve a word then:

- *Tracking.* An input with ``tracks``, such as `PID.actual`, gets the true value of its own block's output, for
  anti-windup or bumpless transfer. In the closed loop it follows that output. A cut between the two separates them: L
  then contains the controller's own correction, which the running loop never makes.
- *Ways of the controller itself.* A model in it that the wire feeds, too (`shared_wires`).
- *Inert inputs.* At the operating point nothing follows from them, as from a saturation's excess within the limits.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...blocks.core import Finding
from ..flat import FlatDiagram
from ..results import OperatingPoint
from ..wiring import join
from .block_slopes import slopes_of
from .inserted_blocks import Port, consumers_of
from .kinks import read_arguments, read_log
from .left_out_effects import BlockFinding, CutFromTracking, InertConsumer
from .shared_wires import find_shared_cuts
from .signal_paths import PathNode, SignalPaths


def find_cut_findings(
    flat: FlatDiagram, at: OperatingPoint, cut: Sequence[Port], reported: Sequence[Finding]
) -> tuple[Finding, ...]:
    """Return the findings about inputs that a cut wire also feeds; those that are ``reported`` already are left out."""
    ways = SignalPaths(flat, cut)
    after, before = ways.after(cut), ways.before(cut)
    on_loop = {
        (n.block, n.port)
        for n in after
        if not n.is_output and any(PathNode(n.block, p, True) in before for p in flat.table.blocks[n.block].outputs)
    }
    known = {(f.block, f.source) for f in reported if isinstance(f, BlockFinding)}
    inert = _find_inert(flat, at, cut, on_loop - known)
    tracking = _find_tracking(flat, ways, cut, on_loop, before)
    return (*tracking, *find_shared_cuts(flat, cut, lambda port: _name_of(flat, port)), *inert)


def _find_tracking(
    flat: FlatDiagram, ways: SignalPaths, cut: Sequence[Port], on_loop: set[Port], before: set[PathNode]
) -> tuple[Finding, ...]:
    table, found = flat.table, list[Finding]()
    for path, port in sorted(on_loop):
        tracked = table.blocks[path].inputs[port].tracks
        if tracked is None or PathNode(path, tracked, True) not in before:
            continue
        if PathNode(path, port, False) in ways.follow((path, tracked)):
            continue  # it follows its output with the cut as well
        source = table.wires[path, port]
        others = [
            join(*c)
            for c in consumers_of(table.wires, (source.block, source.port))
            if c in on_loop and table.blocks[c[0]].inputs[c[1]].tracks is None
        ]
        at = ", ".join(_name_of(flat, c) for c in cut)
        found.append(
            CutFromTracking(at, path, port, tracked, _name_of(flat, (source.block, source.port)), tuple(others))
        )
    return tuple(found)


def _find_inert(flat: FlatDiagram, at: OperatingPoint, cut: Sequence[Port], on_loop: set[Port]) -> tuple[Finding, ...]:
    """Return the consumers of a cut wire on the loop from which nothing follows at the operating point."""
    found: list[Finding] = []
    log: np.ndarray | None = None
    for wire in dict.fromkeys(cut):
        consumers = consumers_of(flat.table.wires, wire)
        for path, port in consumers:
            if len(consumers) < 2 or (path, port) not in on_loop or path not in flat.checked.traced:
                continue
            if path in flat.in_model_exchange:
                continue
            slopes = slopes_of(flat.checked.traced[path])
            if not slopes.rows.total:
                continue
            log = read_log(flat, at) if log is None else log
            z, p = read_arguments(flat, at, path, slopes, log)
            if not np.any(slopes.slopes(at.t, z, p)[1][:, slopes.columns.slices[f"u {port}"]]):
                others = tuple(join(*c) for c in consumers if c in on_loop and c != (path, port))
                found.append(InertConsumer(_name_of(flat, wire), path, port, others))
    return tuple(found)


def _name_of(flat: FlatDiagram, port: Port) -> str:
    """Return the name of the wire behind a port, its path without one."""
    names = [n for n, w in flat.table.names.items() if (w.block, w.port) == port and w.index is None]
    return min(names, key=len, default=join(*port))
