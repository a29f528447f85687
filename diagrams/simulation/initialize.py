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
from ..compiled import Delays
from ..coupling import Links, Plant, find_fixed_point
from ..flat import NONE, FlatDiagram, Instant, evaluate, evaluate_apart, indicators_of, is_true
from ..model_exchange import BlocksInModelExchange
from .failed_blocks import START_SETTLED, inputs_text, shaped_inputs, unsettled, unsolved_start
from .workspace import Workspace

_PLAIN_PASSES = 10
"""Passes over inputs and outputs at the start, and one for each plant, before it is decided how to continue."""
_MOST_PASSES = 100
"""Most passes where each brings the values nearer; ten times as many with loops in the initial states."""
_LOOKED_BACK = 4
"""Passes over which the rate is taken at which values come nearer."""
_ROUNDS = 5
"""Most searches, each for other values of the outputs that are no real numbers."""
_BEFORE_START = -1e-300  # s; nearer to 0 than any time of a source that is not 0

Taps = dict[tuple[str, str], Callable[[Any], Any]]


def initialize(
    workspace: Workspace,
    plants: Mapping[str, Plant],
    delays: Delays | None,
    take_inputs: Callable[[], None],  # lets the plants see the inputs z
    exchanged: BlocksInModelExchange,
    passes_on: str,  # values, "agree": until inputs stay, "once", or "none": inputs of FMUs keep their start values
    set_start: Callable[[Workspace], None],  # computes initial states and held outputs, as `find_start_values`
) -> None:
    """Find values of everything at t = 0: outputs are passed on until inputs change by no more than rounding."""
    # In Initialization Mode an FMU's outputs follow its inputs at once (FMI 3.0, 2.3.3). Where some passes show that
    # agreement takes many more, or leads away, `find_fixed_point` finds the values that a pass returns unchanged. So
    # are initial states that depend on themselves. States that are computed from inputs are those of the instant
    # before: a source that jumps at t = 0 has its value from the left, so that a derivative sees the jump.
    workspace.here.t[0] = 0.0
    if delays is not None:
        delays.outputs_at(0.0, workspace.here.w)
    start = _Start(workspace, plants, delays, take_inputs, exchanged, passes_on, set_start)
    while not start.passes_agree():
        if not start.comes_nearer():
            start.search()
            return


class _Start:
    """The values of a run at t = 0, as they are sought: a pass takes w, and x that depends on itself, to new ones."""

    def __init__(
        self,
        workspace: Workspace,
        plants: Mapping[str, Plant],
        delays: Delays | None,
        take_inputs: Callable[[], None],
        exchanged: BlocksInModelExchange,
        passes_on: str,
        set_start: Callable[[Workspace], None],
    ):
        self.workspace, self.plants, self.delays = workspace, plants, delays
        self.take_inputs, self.exchanged, self.passes_on, self.set_start = take_inputs, exchanged, passes_on, set_start
        self.passes, self.moved = 0, ""
        self.acting = workspace.flat.acting(0)
        self._most = _MOST_PASSES * (10 if workspace.looped else 1)
        self._few = _PLAIN_PASSES + len(plants)  # a value passes a chain of plants by one with each pass
        self._jump = workspace.bind_jump() if exchanged else None
        self._nothing = np.zeros(len(workspace.flat.events))
        self._last, self._before = np.full(workspace.flat.width, np.nan), workspace.z.copy()
        self._solved, self._ran_away = True, False
        self._at: tuple[np.ndarray, np.ndarray] = (workspace.here.w.copy(), workspace.here.x.copy())
        self._changing = [np.zeros(len(values), dtype=bool) for values in self._at]
        self._first = self._at
        self._lengths: list[float] = []

    def make_pass(self) -> None:
        """Make one pass."""
        workspace, delays = self.workspace, self.delays
        self._at = (workspace.here.w.copy(), workspace.here.x.copy())
        self.set_start(workspace)
        workspace.evaluate(self.acting)
        workspace.check(self.acting)
        self._before = workspace.z.copy()
        if self.passes_on != "none":
            self.take_inputs()
            for plant in self.plants.values():
                plant.exchange()
        if delays is not None:
            delays.begin(workspace.z, workspace.here.w)
        self.moved = self.exchanged.exchange(workspace.here.x, self._look) if self.exchanged else ""
        workspace.evaluate(self.acting)

    def _look(self) -> None:
        if self._jump is not None:
            self._jump(self._nothing)

    def passes_agree(self) -> bool:
        """Make one pass, and return whether it has changed nothing but by rounding."""
        workspace = self.workspace
        try:
            self.make_pass()
        except SimulationError:
            if self.passes < 2:  # it is not the passes that have led there
                raise
            self._ran_away = True
            return False
        self.passes += 1
        if self.passes == 1:
            self._first = (workspace.here.w.copy(), workspace.here.x.copy())
        if self.moved:
            return False
        if not np.array_equal(self._at[0], workspace.here.w, equal_nan=True):
            self.set_start(workspace)  # the states that begin with values of before
            workspace.evaluate(self.acting)
        x, z, before = workspace.here.x, workspace.z, self._before
        self._solved = not workspace.looped or np.allclose(self._last, x, rtol=START_SETTLED, atol=START_SETTLED)
        agreed = self.passes_on != "agree" or bool((before == z).all())
        agreed = agreed or np.allclose(before, z, rtol=START_SETTLED, atol=0.0, equal_nan=True)
        self._last = x.copy()
        return self._solved and agreed

    def comes_nearer(self) -> bool:
        """Whether further passes will end the search: each brings the values nearer by a small enough factor."""
        if self._ran_away:
            return False
        now = (self.workspace.here.w, self.workspace.here.x)
        changed = [before != after for before, after in zip(self._at, now, strict=True)]
        if self.passes > 1:
            self._changing = [known | new for known, new in zip(self._changing, changed, strict=True)]
        with np.errstate(invalid="ignore", divide="ignore"):
            parts = [
                np.abs(after - before)[new] / np.maximum(np.abs(before), np.abs(after))[new]
                for before, after, new in zip(self._at, now, changed, strict=True)
            ]
        self._lengths.append(float(np.max(np.concatenate(parts), initial=0.0)))
        if self.passes < self._few:
            return True
        if self.passes >= self._most:
            return False
        if not any(np.any(new & known) for new, known in zip(changed, self._unknowns, strict=True)):
            return True  # whole numbers alone
        first, last = self._lengths[-_LOOKED_BACK], self._lengths[-1]
        if not 0.0 < last < first:
            self._ran_away = last > 0.0
            return last == 0.0
        more = np.log(0.1 * START_SETTLED / last) / np.log(last / first) * (_LOOKED_BACK - 1)
        return bool(self.passes + more <= self._most)

    @property
    def _unknowns(self) -> tuple[np.ndarray, np.ndarray]:
        """Entries of w and x that a pass changes, and takes."""
        w, x = self._changing
        flat = self.workspace.flat
        return w & Links(flat).smooth_outputs, x & bool(self.workspace.looped or self.exchanged)

    def search(self) -> None:
        """Find the values that a pass returns unchanged."""
        here = self.workspace.here
        if self._ran_away:
            here.w[:], here.x[:] = self._first
        for _ in range(_ROUNDS):
            stays = self._find_smooth()
            if stays:
                return
            if stays is None:
                break
        self.make_pass()
        raise self._failure()

    def _find_smooth(self) -> bool | None:
        """Find the values of the real numbers, and return whether the others stay; None without such values."""
        here = self.workspace.here
        w, x = here.w.copy(), here.x.copy()
        of_w, of_x = self._unknowns
        guess = np.concatenate([w[of_w], x[of_x]])

        def put(values: np.ndarray) -> None:
            here.w[of_w], here.x[of_x] = np.split(values, [np.count_nonzero(of_w)])

        def make(values: np.ndarray) -> np.ndarray:
            here.w[:], here.x[:] = w, x
            put(values)
            try:
                self.make_pass()
            except SimulationError:  # no value at such numbers, which a search need not come to
                return np.full(len(values), np.nan)
            self.passes += 1
            return np.concatenate([here.w[of_w], here.x[of_x]])

        found = find_fixed_point(make, guess)
        if found is None:
            here.w[:], here.x[:] = w, x
            return None
        make(found)
        stays = bool(np.all((here.w == w)[~of_w & self._changing[0]]))
        put(found)  # a steep function would magnify the rounding of its values
        self.workspace.evaluate(self.acting)
        return stays

    def _failure(self) -> SimulationError:
        if self.moved:
            return SimulationError(
                "its states and inputs at the start depend on its own outputs, and are not found: after "
                f"{self.passes} passes they still change. Put a UnitDelay(initial_value=…) on a wire between them.",
                block=self.moved,
                t=0.0,
            )
        flat = self.workspace.flat
        if not self._solved or not flat.plant_inputs.slices:
            return unsolved_start(flat, self._at[1], self.workspace.here.x, self.passes)
        return unsettled(flat, self._before, self.workspace.z, self.passes)


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
