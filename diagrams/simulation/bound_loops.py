"""The loops in C, bound to the numbers of a run: over ticks, and over time between them.

What is exported is bound in the same way, without plants and without samples: `diagrams/exporting`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ...fmus.calls import FmuInstance
from ..compiled import CompiledHybrid, CompiledLoop, DiagramCode, NativeModelExchange, PythonStep
from ..flat import NONE
from .algebraic_loops import newton_options
from .continuous import Continuous
from .workspace import Workspace


def bind_ticks(
    workspace: Workspace, code: DiagramCode, plants: Sequence[FmuInstance | PythonStep] = (), **options: Any
) -> CompiledLoop:
    """Return the loop over ticks; plants and options are those of `CompiledLoop`."""
    flat, here = workspace.flat, workspace.here
    return CompiledLoop(
        code,
        [here.t, here.x, here.w, here.p],
        [workspace.x_next, workspace.z, workspace.log, workspace.ok],
        plants,
        loops={clocks: newton_options(flat, clocks, here.x) for clocks in code.loops},
        **options,
    )


def bind_hybrid(
    continuous: Continuous,
    code: DiagramCode,
    ticks: CompiledLoop,
    *,
    exchange: NativeModelExchange | None = None,
    plants: bool = False,  # whether there are any, which read outputs
    **options: Any,
) -> CompiledHybrid:
    """Return the loop over time around that over ticks; options are those of `CompiledHybrid`."""
    workspace, flat, here = continuous.workspace, continuous.flat, continuous.workspace.here
    return CompiledHybrid(
        code,
        flat,
        ticks,
        [here.t, here.x, here.w, here.p],
        workspace.x_next,
        continuous.methods,
        step=float(flat.base) if continuous.fixed else None,
        domains=continuous.domains,
        accepts=continuous.accepts(judged=code.judged, plants=plants, exchanged=exchange is not None),
        loops=newton_options(flat, NONE, here.x) if flat.active_loops(NONE) else None,
        exchange=exchange,
        delays=continuous.delays,
        tolerances=continuous.resolution,
        **options,
    )
