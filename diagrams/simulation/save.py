"""Saving the complete state of a run, and restoring it."""

from __future__ import annotations

import numpy as np

from ...blocks.core import FmuError, FmuRuntimeError, OptionError
from ...fmus.calls import FmuInstance
from ..results import RunState, layout_of
from ..wiring import join
from .engine import Engine

SAME = 1e-6
"""Distance of two outputs, absolute and relative, that an FMU which computes them again may make."""


def can_save(engine: Engine) -> bool:
    """Whether the run is at a tick, none of its FMUs has ended it, and every one can turn its state into bytes."""
    able, position = all(plant.can_serialize and not plant.failed for plant in engine.loaded.values()), engine.position
    return able and position.end is None and not position.is_broken_off and not engine.ended_by


def save_state(engine: Engine) -> RunState:
    """Return the complete state of a run at the tick that it has reached."""
    workspace, position = engine.workspace, engine.position
    if engine.ended_by:
        raise FmuError(
            f"the FMU has asked to end the simulation (terminateSimulation) at t = {position.t:.9g} s, so that "
            "no run can continue from there; expected a state before that time. Save the run at an earlier tick.",
            block=engine.ended_by,
        )
    if position.end is not None:
        raise OptionError(
            f"the run has ended at t = {position.t:g} s, between two ticks, and is not saved there. Save it at a tick.",
            block=engine.name,
        )
    if position.is_broken_off:
        raise broken_off_error(position.t, engine.name, "be saved there")
    return RunState(
        t=position.t,
        tick=position.tick,
        base=position.base,
        diagram=engine.name,
        x=workspace.here.x.copy(),
        w=workspace.here.w.copy(),
        z=workspace.z.copy(),
        log=workspace.log.copy(),
        layout=layout_of(engine.flat),
        continuous=None if engine.continuous is None else engine.continuous.save(),
        plant_steps=engine.steps.save(),
        proposed_step=None if engine.coupled is None else engine.coupled.proposed,
        fmus={path: plant.serialize() for path, plant in engine.loaded.items()},
        stopped=position.stopped,
    )


def broken_off_error(t: float, name: str, what: str) -> OptionError:
    """Return the error of a run that has failed or was interrupted after a tick, so that it can't do something."""
    return OptionError(
        f"the run has failed, or was interrupted, on its way from t = {t:g} s, and can't {what}: its numbers may be "
        "those of a later instant. Keep simulation.save() before such a part, and go back to it: "
        "simulation.restore(state).",
        block=name,
    )


def restore_state(engine: Engine, state: RunState) -> None:
    """Put a run into a state that fits it."""
    w = engine.workspace.here.w
    for path, plant in engine.plants.items():
        before = w.copy()
        plant.restore(plant.deserialize(state.fmus[path]))
        if isinstance(plant, FmuInstance):  # it reads its outputs again
            left = (w == before) & (np.abs(w - state.w) > SAME * (1.0 + np.abs(state.w)))
            _check_outputs(engine, path, left, state)
    for path, block in engine.exchanged.blocks.items():
        block.restore_bytes(state.fmus[path])
    engine.workspace.restore(t=state.t, x=state.x, w=state.w, z=state.z, log=state.log)
    if engine.continuous is not None and state.continuous is not None:
        engine.continuous.restore(state.continuous)
    engine.position.restore(state.tick, state.stopped)
    engine.steps.restore(state.plant_steps, state.tick)
    if engine.coupled is not None:
        engine.coupled.proposed = state.proposed_step


def _check_outputs(engine: Engine, path: str, left: np.ndarray, state: RunState) -> None:
    """Refuse a state of an FMU from which an output is ``left`` as it was before."""
    outputs = engine.flat.plant_outputs.slices
    for name in engine.flat.table.blocks[path].outputs:
        where = outputs.get(join(path, name), slice(0, 0))
        if left[where].any():
            raise FmuRuntimeError(
                "the FMU does not restore its state, although its function for that reports success: found its output "
                f"{engine.workspace.here.w[where].tolist()}, as before; expected {state.w[where].tolist()}. Run again "
                "from the start, and report it to its makers.",
                block=path,
                port=name,
                t=state.t,
            )
