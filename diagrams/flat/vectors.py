"""The vectors of the whole diagram: those of an instant that was evaluated with symbols, and memory for numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import Layout
from .evaluation import Instant, rows
from .flat_layout import FlatLayout
from .program import Cells


class Vectors:
    """An instant, in memory that functions are bound to."""

    def __init__(self, layout: FlatLayout, p: np.ndarray):
        self.t = np.zeros(1)  # time in s, shape (1,)
        self.x = layout.x0.copy()  # states, held outputs, gates, reset states and loop values
        self.w = np.zeros(layout.plant_outputs.total)  # outputs of plants and of transport delays
        self.p = p  # parameters; one vector may serve several instants of a run


def next_x(instant: Instant) -> Any:
    """Return x after an instant: with the new states, held outputs and gates."""
    layout, parts = instant.layout, list[Any]()
    made: list[tuple[Layout, Mapping[str, Any]]] = [
        (layout.states, instant.new),
        (layout.held, instant.held),
        (layout.gates, instant.gates),
        (layout.starts, {}),
        (layout.loops, {}),
    ]
    for part, new in made:
        parts += [new.get(name, rows(instant.x, where)) for name, where in part.slices.items()]
    return join_columns(parts) if parts else _no_rows(instant)


def _no_rows(instant: Instant) -> Any:
    return instant.t.program.join([]) if isinstance(instant.t, Cells) else ca.MX(0, 1)


def rates(instant: Instant) -> Any:
    """Return the rates of the entries of x that are integrated."""
    layout = instant.layout
    if not layout.continuous.size:
        return _no_rows(instant)
    states = layout.states.slices.items()
    none = np.zeros if isinstance(instant.t, Cells) else ca.MX.zeros
    columns = [instant.rates[path] if path in instant.rates else none(s.stop - s.start) for path, s in states]
    of_all = join_columns(columns)
    return of_all[layout.continuous.tolist()]


def plant_inputs(instant: Instant) -> Any:
    """Return z: the inputs of what is stepped between ticks."""
    layout = instant.layout
    sources = [instant.source(*layout.ports[name]) for name in layout.plant_inputs.slices]
    if isinstance(instant.t, Cells):
        return instant.t.program.join(sources)
    return join_columns([ca.MX(ca.densify(ca.DM(s))) if isinstance(s, np.ndarray) else s for s in sources])


def log(instant: Instant) -> Any:
    """Return w, all outputs of blocks, `kept_states`, and, where loops are solved, the residual of the loops."""
    return ca.vertcat(
        instant.w,
        *outputs_of(instant),
        kept_states(instant),
        *([residual(instant)] if instant.layout.loops.slices else []),
    )


def kept_states(instant: Instant) -> Any:
    """Return x as it is recorded: before the instant.

    An output that a subsystem in continuous time holds is an exception. While the subsystem is open it changes all the
    time, and x follows only where a solver accepts a step: recorded is what would be held from now on.
    """
    layout, parts, end = instant.layout, list[Any](), 0
    for name, where in layout.held.slices.items():
        subsystem = layout.table.subsystem_of[layout.ports[name][0]]
        if name in instant.held and layout.clocks.get(subsystem) is None:
            parts += [rows(instant.x, slice(end, where.start)), instant.held[name]]
            end = where.stop
    return join_columns([*parts, rows(instant.x, slice(end, layout.width))]) if parts else instant.x


def outputs_of(instant: Instant) -> list[Any]:
    """Return the columns of all outputs of blocks, as the log lays them out."""
    layout = instant.layout
    blocks = [*layout.log.slices][len(layout.plant_outputs.slices) :]
    return [instant.values[layout.ports[name]] for name in blocks]


def loop_mismatch(instant: Instant) -> Any:
    """Return what came round the algebraic loops less what was taken there."""
    return join_columns([made - taken for made, taken in instant.mismatch])


def residual(instant: Instant) -> Any:
    """Return the largest mismatch of the algebraic loops, relative to 1 + the size of what was taken."""
    if not instant.mismatch:
        return ca.MX(0.0)
    made, taken = (ca.vertcat(*columns) for columns in zip(*instant.mismatch, strict=True))
    return ca.norm_inf(made - taken) / (1 + ca.norm_inf(taken))


def join_columns(columns: Sequence[Any]) -> Any:
    """Return columns one below the other; a column without entries where there are none."""
    if any(isinstance(column, Cells) for column in columns):
        return next(column.program for column in columns if isinstance(column, Cells)).join(columns)
    return ca.vertcat(*columns) if columns else ca.MX(0, 1)


def entries_of(column: Any) -> list[Any]:
    """Return the entries of a column, each as a column."""
    if isinstance(column, Cells):
        return [column[i : i + 1] for i in range(column.numel())]
    return [*ca.vertsplit(column)]


def densify(column: Any) -> Any:
    """Return a column that holds every entry, zeros too."""
    return column if isinstance(column, Cells) else ca.densify(column)
