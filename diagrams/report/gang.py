"""The gang of four of a loop: S and T, and the responses between its wire and the next one on the loop."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...blocks.core import LoopwrightError
from ..linearization import linearize
from ..report_writing import Plot, Texts
from ..wiring import CheckedDiagram
from . import plots as figures
from .case import Case
from .variant import Variant, in_s
from .wires import blocks_on_loops

TEXTS = Texts(__package__, "figures")
POINTS = 400


def gang_of_four(case: Case, key: str, wire: str) -> tuple[Plot, ...]:
    """Return the figure of the responses PS and CS, which S and T leave open; none where there is no second wire.

    P is what lies between the wire and the next named one downstream, y; C is what leads back.
    """
    other = next_wire(case.diagram, wire)
    if other is None:
        return ()
    curves: dict[str, tuple[str, np.ndarray, np.ndarray, np.ndarray]] = {}
    for v in case.usable():
        if v.is_design or v.is_actual:
            try:
                curves[v.key] = (v.title, *_responses(v, wire, other))
            except LoopwrightError:
                continue
    if not curves:
        return ()
    figure = figures.gang(curves, wire, other, case.axes)
    return (Plot(f"inner_{key}_gang", TEXTS.line("gang", wire=wire, other=other), figure),)


def next_wire(diagram: CheckedDiagram, wire: str) -> str | None:
    """Return the nearest named wire downstream of a wire on its loops, a scalar as it is; None where there is none."""
    names, table = diagram.names, diagram.structure
    if wire not in names:
        return None
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
            here = sorted(
                name for (b, p, i), name in sources.items() if b == block and i == "None" and known[b, p] == ()
            )
            if here:
                return here[0]
            waiting.append((block, ""))
    return None


def _responses(v: Variant, wire: str, other: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return frequencies in rad/s, and the responses from a disturbance at the wire to the other, and back."""
    model = linearize(v.diagram, v.point, inputs=[wire, other], outputs=[wire, other], stairs=v.stairs)
    s = np.abs(in_s(model.poles, model.dt))
    s = s[s > 1e-6 * max(1e-300, float(np.max(s, initial=0.0)))]
    top = 0.999 * np.pi / model.dt if model.dt else 30 * float(np.max(s, initial=1.0))
    low = min(float(np.min(s, initial=1.0)) / 10, top / 100)
    w = np.geomspace(max(low, top / 1e6), top, POINTS)
    points = np.exp(1j * w * model.dt) if model.dt else 1j * w
    eye = np.eye(len(model.A))
    G = np.array([model.C @ np.linalg.solve(p * eye - model.A, model.B.astype(complex)) + model.D for p in points])
    return w, np.abs(G[:, 1, 0]), np.abs(G[:, 0, 1])
