"""Start values, block by block: initial states from inputs, first held outputs, and values from the left of t = 0."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from ...blocks.core import Block, LoopwrightError, NonFiniteError, SimulationError
from ...blocks.tracing import bundle, initial_state
from ..flat import NONE, FlatDiagram, Instant, evaluate, evaluate_apart, indicators_of, is_true
from .failed_blocks import inputs_text, shaped_inputs
from .workspace import Workspace

_BEFORE_START = -1e-300  # s; nearer to 0 than any time of a source that is not 0

Taps = dict[tuple[str, str], Callable[[Any], Any]]


def find_start_values(workspace: Workspace) -> None:
    """Compute the initial states, first held outputs and controls from the values at hand, block by block."""
    _set_initial_states(workspace)
    _hold_first_outputs(workspace)


def _set_initial_states(workspace: Workspace) -> None:
    """Compute the initial states of the blocks that ask for their inputs first."""
    flat, x = workspace.flat, workspace.here.x
    blocks = flat.table.blocks
    if any(blocks[path].starts_from_inputs for path in flat.checked.traced):
        ready: set[str] = set()

        def before(path: str, inputs: dict[str, Any]) -> None:
            if blocks[path].starts_from_inputs and path not in ready:
                ready.add(path)
                x[flat.states.slices[path]] = find_initial_state(flat, path, inputs)

        _evaluate(workspace, order=flat.start_order.steps, before=before, taps=values_from_left(workspace))
    for path, where in flat.starts.slices.items():
        x[where] = x[flat.states.slices[path]]


def find_initial_state(flat: FlatDiagram, path: str, inputs: dict[str, Any], block: Block | None = None) -> np.ndarray:
    """Return the initial state that a block, or another one in its place, computes from its inputs' columns, flat."""
    trace = flat.checked.traced[path]
    for port, column in inputs.items():
        _check_finite(flat, path, port, column)
    block = flat.table.blocks[path] if block is None else block
    return _initial(path, block, bundle("u", shaped_inputs(trace, inputs)), trace.states)


def _check_finite(flat: FlatDiagram, path: str, port: str, column: Any) -> None:
    """Refuse to start a block from an input that is not finite: whoever made that is to blame."""
    wire = flat.table.wires.get((path, port))
    if column is None or wire is None:
        return
    values = np.ravel(np.array(column, dtype=float))
    if not np.all(np.isfinite(values)):
        raise NonFiniteError(
            f"found {values.tolist()} at the start; expected finite numbers, since {path}.{port} begins with it. Look "
            "for a division by zero, or a root or a logarithm of a negative number.",
            block=wire.block,
            port=wire.port,
            t=0.0,
        )


def _hold_first_outputs(workspace: Workspace) -> None:
    """Let every subsystem hold its outputs of the start, and keep the signal that enables or triggers it."""
    flat, x = workspace.flat, workspace.here.x
    if not flat.held.slices and not flat.gates.slices:
        return
    if (solve := workspace.loop_solver(frozenset(flat.distinct), workspace.here)) is not None:
        solve()  # those of subsystems that don't act at t = 0, too
    done = _evaluate(workspace)
    before = _evaluate(workspace, taps=values_from_left(workspace)) if flat.gates.slices else done
    for name, column in done.held.items():
        where = flat.held.slices[name]
        x[where] = np.ravel(np.array(column))
    for subsystem, where in flat.gates.slices.items():
        x[where] = float(is_true(before.control(subsystem)))


def _evaluate(workspace: Workspace, **options: Any) -> Instant:
    """Evaluate all blocks at t = 0 with the run's numbers, every subsystem as if it acted."""
    flat, here, apart = workspace.flat, workspace.here, evaluate_apart(workspace.evaluators)
    return evaluate(flat, flat.blocks, NONE, 0.0, here.x, here.w, here.p, opened=True, apart=apart, **options)


def _initial(path: str, block: Any, u: Any, states: Mapping[str, tuple[int, ...]]) -> np.ndarray:
    """Return a block's initial state from its inputs, flat; whatever fails says whose it is."""
    try:
        return initial_state(block, states, u)
    except SimulationError as error:
        raise error.at(block=path, t=0.0) from error.__cause__
    except Exception as error:
        expected = ", ".join(f"{name} of shape {shape}" for name, shape in states.items())
        what = str(error) if isinstance(error, LoopwrightError) else f"{type(error).__name__}: {error}"
        raise SimulationError(
            f"its initial(u) failed: {what} {inputs_text(u._asdict())} Expected {expected}.", block=path, t=0.0
        ) from error


def values_from_left(workspace: Workspace) -> Taps:
    """Return, as the taps of `evaluate`, the values just before t = 0 of the sources that announce an instant there."""
    flat = workspace.flat
    early = _sources_that_jump(flat)
    if not early:
        return {}
    here, apart = workspace.here, evaluate_apart(workspace.evaluators)
    order = [step for step in flat.start_order.steps if step[0] in early]
    found = evaluate(
        flat, flat.blocks, NONE, _BEFORE_START, here.x, here.w, here.p, opened=True, apart=apart, order=order
    )
    taps: Taps = {}
    for port, column in found.values.items():
        left = np.ravel(np.array(column, dtype=float))
        if port[0] in early and np.all(np.isfinite(left)):  # else it is not defined before t = 0, and begins there
            taps[port] = partial(_replace, left)
    return taps


def _replace(value: np.ndarray, _: Any) -> np.ndarray:
    return value


def _sources_that_jump(flat: FlatDiagram) -> set[str]:
    """Return the paths of the sources that announce an instant at t = 0; a block is asked in its first run only."""
    known: dict[str, tuple[Block, bool]] = flat.keep("sources that jump at the start", dict)
    for path in flat.checked.traced:
        block = flat.table.blocks[path]
        if path not in known or known[path][0] is not block:
            known[path] = block, _jumps_at_start(block)
    return {path for path, (_, jumps) in known.items() if jumps}


def _jumps_at_start(block: Block) -> bool:
    """Whether a block without inputs announces an instant at t = 0."""
    if block.inputs or type(block).next_instant is Block.next_instant:
        return False
    try:
        return block.next_instant(_BEFORE_START) == 0.0
    except Exception:  # it is not defined before t = 0; the run itself reports one that fails after it
        return False


def domains_from_left(workspace: Workspace, domains: np.ndarray) -> np.ndarray:
    """Return the domains of all indicators just before t = 0 (1, −1, 0 on the border), from those at t = 0."""
    # Subsystems are evaluated as if they acted: what a sampled one puts out before its first tick jumps with its
    # sources.
    taps = values_from_left(workspace)
    if not taps:
        return domains
    flat, here, apart = workspace.flat, workspace.here, evaluate_apart(workspace.evaluators)

    def at(taps: Taps) -> np.ndarray:
        instant = evaluate(flat, flat.blocks, NONE, 0.0, here.x, here.w, here.p, opened=True, apart=apart, taps=taps)
        return np.array([float(np.ravel(np.array(g))[0]) for g in indicators_of(instant)[0]])

    left, right = at(taps), at({})
    return np.where((left == right) | ~np.isfinite(left), domains, np.where(left > 0.0, 1, -1))
