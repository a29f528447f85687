"""What a diagram does between ticks, and at events: functions of (t, x, w, p) made from one pass over the blocks."""

from __future__ import annotations

from typing import Any

import casadi as ca

from .evaluate import Pass, above, both, choose, negated
from .flat_diagram import FlatDiagram
from .layout import Clock, rows

NONE: frozenset[Clock] = frozenset()


def flow(flat: FlatDiagram) -> Any:
    """Return ``(t, x, w, p) -> dx``: the rates of the entries `FlatDiagram.continuous` of x."""
    arguments, dx = _rates(flat)
    return ca.Function("flow", arguments, [ca.densify(dx)], ["t", "x", "w", "p"], ["dx"])


def flow_jacobian(flat: FlatDiagram) -> Any:
    """Return ``(t, x, w, p) -> ∂dx/∂x`` by the continuous entries of x."""
    arguments, dx = _rates(flat)
    by_x = ca.jacobian(dx, arguments[1])[:, flat.continuous.tolist()]
    return ca.Function("flow_jacobian", arguments, [ca.densify(by_x)], ["t", "x", "w", "p"], ["jacobian"])


def _rates(flat: FlatDiagram) -> tuple[list[Any], Any]:
    t, x, w, p = flat.symbols()
    done = Pass(flat, NONE, t, x, w, p).run()
    of_all = ca.vertcat(
        *(done.rates.get(path, ca.MX.zeros(where.stop - where.start)) for path, where in flat.states.slices.items())
    )
    return [t, x, w, p], of_all[flat.continuous.tolist()] if flat.continuous.size else ca.MX(0, 1)


def indicators(flat: FlatDiagram) -> Any:
    """Return ``(t, x, w, p) -> (g, open)``: what events look at, and 1 where the boxes around an event are open."""
    t, x, w, p = flat.symbols()
    done = Pass(flat, NONE, t, x, w, p).run()
    g, opened, blocks = [], [], dict[str, Any]()
    for event in flat.events:
        if event.box:
            g.append(done.control(event.path) - 0.5)
            gate: Any = True
            for box in flat.table.gates(event.path.rpartition(".")[0]):
                gate = both(gate, done.is_open(box))
        else:
            path = event.path
            if path not in blocks:
                made = flat.checked.traced[path].indicators.call(done.arguments(path))[0]
                blocks[path] = ca.vertsplit(made)
            g.append(blocks[path][list(flat.table.blocks[path].events).index(event.name)])
            gate = done.gate_of(path)
        opened.append(ca.MX(1.0) if gate is True else ca.MX(0.0) if gate is False else gate)
    results = [ca.densify(ca.vertcat(*column)) for column in (g, opened)]
    return ca.Function("indicators", [t, x, w, p], results, ["t", "x", "w", "p"], ["g", "open"])


def jump(flat: FlatDiagram) -> Any:
    """Return ``(t, x, w, p, fired) -> x`` after the events that fire; each sees the instant before all of them."""
    t, x, w, p = flat.symbols()
    fired = ca.MX.sym("fired", len(flat.events))
    done = Pass(flat, NONE, t, x, w, p, fired=fired).run()
    own: dict[str, list[int]] = {}
    for i, event in enumerate(flat.events):
        own.setdefault(event.path, []).append(i)
    for path, indices in own.items():
        mine = ca.vertcat(*(fired[i] for i in indices))
        if path in flat.table.controls:
            continue
        state = rows(x, flat.states.slices[path])
        after = flat.checked.traced[path].jump.call([*done.arguments(path), mine])[0]
        acts = both(done.gate_of(path), ca.sum1(mine) > 0.5)
        done.new[path] = choose(acts, ca.densify(after), state)
    for i, event in enumerate(flat.events):
        if event.box and event.name == "enable":
            mode = rows(x, flat.gates.slices[event.path])
            turned = above(fired[i : i + 1])
            done.gates[event.path] = choose(turned, 1 - mode, mode)
            if flat.table.frames[event.path].when == "reset":
                opens = both(turned, negated(above(mode)))
                for path in flat.starts.slices:
                    if event.path in flat.table.gates(flat.table.frame_of[path]):
                        old = done.new.get(path, rows(x, flat.states.slices[path]))
                        done.new[path] = choose(opens, rows(x, flat.starts.slices[path]), old)
    x_next = ca.densify(flat.next_columns(x, done))
    return ca.Function("jump", [t, x, w, p, fired], [x_next], ["t", "x", "w", "p", "fired"], ["x_next"])


def loop_equations(flat: FlatDiagram, acting: frozenset[Clock]) -> Any:
    """Return ``(t, x, w, p) -> (r, J)``: what came round a loop less what was taken, and its derivative by that.

    None where no torn port acts.
    """
    t, x, w, p = flat.symbols()
    done = Pass(flat, acting, t, x, w, p).run()
    if not done.mismatch:
        return None
    r = ca.vertcat(*(made - taken for made, taken in done.mismatch))
    active = active_loops(flat, acting)
    J = ca.jacobian(r, x)[:, active]
    return ca.Function("loops", [t, x, w, p], [ca.densify(r), ca.densify(J)], ["t", "x", "w", "p"], ["r", "J"])


def active_loops(flat: FlatDiagram, acting: frozenset[Clock]) -> list[int]:
    """Return the entries of x that hold the torn ports that act, in the order in which they come round."""
    done: list[int] = []
    for path, names in flat.order.steps:
        clock = flat.clocks.get(flat.table.frame_of[path])
        if clock is not None and clock not in acting:
            continue
        for name in names:
            where = flat.loops.slices.get(f"{path}.{name}")
            if where is not None:
                done += range(where.start, where.stop)
    return done


def flow_jacobian_with_loops(flat: FlatDiagram) -> Any:
    """Return ``(t, x, w, p) -> (∂f/∂x, ∂f/∂v, ∂r/∂x, ∂r/∂v)`` for loops with values v and residual r(x, v) = 0.

    By the implicit function theorem the derivative of the rates f is ∂f/∂x − ∂f/∂v (∂r/∂v)⁻¹ ∂r/∂x.
    """
    t, x, w, p = flat.symbols()
    done = Pass(flat, NONE, t, x, w, p).run()
    of_all = ca.vertcat(
        *(done.rates.get(path, ca.MX.zeros(where.stop - where.start)) for path, where in flat.states.slices.items())
    )
    dx = of_all[flat.continuous.tolist()]
    r = ca.vertcat(*(made - taken for made, taken in done.mismatch))
    columns = flat.continuous.tolist(), active_loops(flat, NONE)
    results = [ca.densify(ca.jacobian(e, x)[:, c]) for e in (dx, r) for c in columns]
    return ca.Function("flow_jacobian", [t, x, w, p], results)
