"""Saving the complete state of a run, and restoring it."""

from __future__ import annotations

from ..results import RunState, layout_of
from .engine import Engine


def can_save(engine: Engine) -> bool:
    """Whether every plant can turn its state into bytes."""
    return all(plant.can_serialize and not plant.failed for plant in engine.loaded.values())


def save_state(engine: Engine) -> RunState:
    """Return the complete state of a run at the tick that it has reached.

    Raises
    ------
    FmuError
        An FMU that can't save its state, or can't turn it into bytes.
    """
    workspace, position = engine.workspace, engine.position
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


def restore_state(engine: Engine, state: RunState) -> None:
    """Put a run into a state that fits it."""
    for path, plant in engine.plants.items():
        plant.restore(plant.deserialize(state.fmus[path]))
    for path, block in engine.exchanged.blocks.items():
        block.restore_bytes(state.fmus[path])
    engine.workspace.restore(t=state.t, x=state.x, w=state.w, z=state.z, log=state.log)
    if engine.continuous is not None and state.continuous is not None:
        engine.continuous.restore(state.continuous)
    engine.position.restore(state.tick, state.stopped)
    engine.steps.restore(state.plant_steps, state.tick)
    if engine.coupled is not None:
        engine.coupled.proposed = state.proposed_step
