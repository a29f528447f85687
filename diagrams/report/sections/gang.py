"""The gang of four of a loop: S and T, and the responses between its wire and the next one on the loop."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ....blocks.core import LoopwrightError
from ...linearization import linearize
from ...wiring import CheckedDiagram
from .. import figures
from ..case import Case
from ..pages import Plot
from ..variant import Variant, in_s
from ..wires import blocks_on_loops

POINTS = 400
WHOLE = 1e-6
"""Relative deviation of PS·CS from S·T below which the loop goes through both wires."""


def gang_of_four(case: Case, key: str, wire: str) -> tuple[Plot, ...]:
    """Return the figure of the responses PS and CS, which S and T leave open; none where no other wire cuts the loop.

    P leads from the wire to the nearest named one downstream that the whole loop goes through, C back from there.
    """
    for other in wires_downstream(case.diagram, wire):
        curves = {}
        for v in case.usable():
            if v.is_design or v.is_actual:
                try:
                    found = _responses(v, wire, other)
                except LoopwrightError:
                    continue
                if found is None:
                    break  # the wires are those of all variants
                curves[v.key] = (v.title, *found)
        if curves:
            return (figures.gang(f"inner_{key}_gang", curves, wire, other, case.axes, case.looks),)
    return ()


def wires_downstream(diagram: CheckedDiagram, wire: str) -> Iterator[str]:
    """Yield the named scalar wires downstream of a wire on its loops, the nearest first."""
    names, table = diagram.names, diagram.structure
    if wire not in names:
        return
    inside = blocks_on_loops(diagram)
    sources = {(w.block, w.port, str(w.index)): name for name, w in names.items() if name != wire}
    start = names[wire]
    known: Mapping[tuple[str, str], Any] = diagram.checked.shapes
    waiting, seen = deque([(start.block, start.port)]), {start.block}
    while waiting:
        at, port = waiting.popleft()
        for (block, _), w in table.wires.items():
            if w.block != at or block in seen or block not in inside or (at == start.block and w.port != port):
                continue
            seen.add(block)
            yield from sorted(
                name for (b, p, i), name in sources.items() if b == block and i == "None" and known[b, p] == ()
            )
            waiting.append((block, ""))


def _responses(v: Variant, wire: str, other: str) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return frequencies in rad/s, and the responses from a disturbance at the wire to the other, and back.

    None where the loop does not go through the other wire alone: PS·CS is not S·T then.
    """
    model = linearize(v.diagram, v.point, inputs=[wire, other], outputs=[wire, other], stairs=v.stairs)
    s = np.abs(in_s(model.poles, model.dt))
    s = s[s > 1e-6 * max(1e-300, float(np.max(s, initial=0.0)))]
    top = 0.999 * np.pi / model.dt if model.dt else 30 * float(np.max(s, initial=1.0))
    low = min(float(np.min(s, initial=1.0)) / 10, top / 100)
    w = np.geomspace(max(low, top / 1e6), top, POINTS)
    points = np.exp(1j * w * model.dt) if model.dt else 1j * w
    eye = np.eye(len(model.A))
    G = np.array([model.C @ np.linalg.solve(p * eye - model.A, model.B.astype(complex)) + model.D for p in points])
    L = figures.response(v.loop(wire), w)
    both, expected = np.abs(G[:, 1, 0] * G[:, 0, 1]), np.abs(L / (1 + L) ** 2)
    if np.max(np.abs(both - expected)) > WHOLE * np.max(expected):
        return None
    return w, np.abs(G[:, 1, 0]), np.abs(G[:, 0, 1])
