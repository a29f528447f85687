"""The start of a run: states, held outputs, and inputs and outputs of FMUs that agree at t = 0.

Sources that jump at t = 0 have their values from the left for this. Such a jump is then a jump as at any later time: a
derivative answers it, an edge of it counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from ...blocks.core import Block, LoopwrightError, NonFiniteError, SimulationError
from ...blocks.tracing import bundle, initial_state
from ..coupling import Links, Plant, Search
from ..exchange import ExchangedBlocks
from ..flat import NONE, FlatDiagram, Instant, evaluate, evaluate_apart, indicators_of, is_true
from .diagnosis import inputs_text, shaped_inputs
from .transport_delays import Delays
from .workspace import Workspace

_MAX_PASSES = 100  # over inputs and outputs of the FMUs at the start
_PLAIN_PASSES = 10
"""Passes before the outputs of the FMUs are sought from those before."""
START_SETTLED = 1e-13
"""Relative change of an input between two passes, at most, with which the start is found: a few hundred ulps."""
_BEFORE_START = -1e-300  # s; nearer to 0 than any time of a source that is not 0

Taps = dict[tuple[str, str], Callable[[Any], Any]]


def initialize(
    workspace: Workspace,
    plants: Mapping[str, Plant],
    delays: Delays | None,
    take_inputs: Callable[[], None],
    exchanged: ExchangedBlocks,
    passes_on: str = "agree",
    set_start: Callable[[Workspace], None] | None = None,
) -> None:
    """Find values of everything at t = 0.

    In Initialization Mode an FMU's outputs follow its inputs at once (FMI 3.0, 2.3.3). Outputs are passed on
    until inputs change by no more than rounding; after some passes the next outputs are sought from those before, which
    finds them where they would run away, too.

    Initial states that are computed from inputs are those of the instant before: a source that jumps at t = 0 has its
    value from the left there, so that a derivative sees the jump, as it sees one at any later time.

    ``take_inputs`` lets the plants see the inputs z. ``passes_on`` is the exchange of values with them: "agree" until
    their inputs stay, "once", or "none", where the inputs of FMUs keep their start values. ``set_start`` computes the
    initial states and first held outputs from the values at hand; `find_start_values` by default.
    """
    flat, set_start = workspace.flat, set_start or find_start_values
    acting = flat.acting(0)
    workspace.here.t[0] = 0.0
    if delays is not None:
        delays.outputs_at(0.0, workspace.here.w)
    passes, last = 0, np.full(flat.width, np.nan)
    jump, nothing = workspace.bind_jump() if exchanged else None, np.zeros(len(flat.events))

    def look() -> None:
        if jump is not None:
            jump(nothing)

    most = _MAX_PASSES * (10 if workspace.looped else 1)
    search: Search | None = None
    while True:
        assumed = workspace.here.w.copy()
        set_start(workspace)
        workspace.evaluate(acting)
        workspace.check(acting)
        before = workspace.z.copy()
        if passes_on != "none":
            take_inputs()
            for plant in plants.values():
                plant.exchange()
        if delays is not None:
            delays.begin(workspace.z, workspace.here.w)
        moved = exchanged.exchange(workspace.here.x, look) if exchanged else ""
        workspace.evaluate(acting)
        passes += 1
        if moved and passes < most:
            continue
        if moved:
            raise SimulationError(
                f"its states and inputs at the start depend on its own outputs, and are not found: after {passes} "
                "passes they still change. Put a UnitDelay(initial_value=…) on one of the wires between.",
                block=moved,
                t=0.0,
            )
        found = not workspace.looped or np.allclose(last, workspace.here.x, rtol=START_SETTLED, atol=START_SETTLED)
        agreed = passes_on != "agree" or bool((before == workspace.z).all())
        agreed = agreed or np.allclose(before, workspace.z, rtol=START_SETTLED, atol=0.0, equal_nan=True)
        if found and agreed:
            break
        if passes == most:
            raise _unsettled(workspace, before) if found else _unsolved_start(workspace, last)
        if plants and passes >= _PLAIN_PASSES:
            search = search or Search(Links(flat).smooth_outputs, np.ones(flat.plant_outputs.total))
            workspace.here.w[:] = search.next(assumed, workspace.here.w)
        last = workspace.here.x.copy()


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
    """Return the initial state that a block, or another one in its place, computes from its inputs' columns, flat.

    Raises
    ------
    SimulationError
        An input that is not finite; a block that fails.
    """
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


def _unsolved_start(workspace: Workspace, last: np.ndarray) -> SimulationError:
    flat, x = workspace.flat, workspace.here.x
    moved = ~np.isclose(last, x, rtol=START_SETTLED, atol=START_SETTLED)
    path = next((p for p, s in flat.states.slices.items() if moved[s].any()), "")
    loops = "\n".join(flat.start_order.loops)
    return SimulationError(
        f"its initial state depends on itself, and is not found: after {_MAX_PASSES * 10} passes it still changes.\n"
        f"{loops}\nGive it an initial_value, or one to another block of this loop.",
        block=path or flat.start_order.torn[0][0],
    )


def _unsettled(workspace: Workspace, before: np.ndarray) -> SimulationError:
    flat, z = workspace.flat, workspace.z
    slices = flat.plant_inputs.slices
    name = next(n for n, s in slices.items() if not np.allclose(before[s], z[s], rtol=START_SETTLED, atol=0.0))
    path, port = flat.ports[name]
    delay = flat.table.blocks[path].transport
    own, step = (
        ("its own output", "Give it an initial_value.")
        if delay
        else ("the FMU's own outputs", "Put a UnitDelay(initial_value=…) on one of the wires between.")
    )
    return SimulationError(
        f"its value at the start depends on {own}, and is not found: after {_MAX_PASSES} passes it "
        f"still changes, from {before[slices[name]].tolist()} to {z[slices[name]].tolist()}. {step}",
        block=path,
        port=port,
    )


def values_from_left(workspace: Workspace) -> Taps:
    """Return, as the taps of `evaluate`, the values just before t = 0 of the sources that announce an instant there."""
    flat = workspace.flat
    early = {
        path for path, block in flat.table.blocks.items() if path in flat.checked.traced and _jumps_at_start(block)
    }
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


def _jumps_at_start(block: Block) -> bool:
    """Whether a block without inputs announces an instant at t = 0."""
    if block.inputs or type(block).next_instant is Block.next_instant:
        return False
    try:
        return block.next_instant(_BEFORE_START) == 0.0
    except Exception:  # it is not defined before t = 0; the run itself tells of one that fails after it
        return False


def domains_from_left(workspace: Workspace, domains: np.ndarray) -> np.ndarray:
    """Return the domains of the indicators of all events just before t = 0: 1 above 0, −1 below, 0 on the border.

    Parameters
    ----------
    domains : ndarray of int
        Those at t = 0: the answer for those that no jump of a source changes.
    """
    taps = values_from_left(workspace)
    if not taps:
        return domains
    flat, here, apart = workspace.flat, workspace.here, evaluate_apart(workspace.evaluators)

    def at(taps: Taps) -> np.ndarray:
        instant = evaluate(flat, flat.blocks, NONE, 0.0, here.x, here.w, here.p, apart=apart, taps=taps)
        return np.array([float(np.ravel(np.array(g))[0]) for g in indicators_of(instant)[0]])

    left, right = at(taps), at({})
    return np.where((left == right) | ~np.isfinite(left), domains, np.where(left > 0.0, 1, -1))
