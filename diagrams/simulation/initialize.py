"""The start of a run: states, held outputs, and inputs and outputs of FMUs that agree at t = 0.

Sources that jump at t = 0 have their values from the left for this. Such a jump is then a jump as at any later time: a
derivative answers it, an edge of it counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ...blocks.core import SimulationError
from ..compiled import Delays
from ..coupling import Links, Plant, find_fixed_point
from ..model_exchange import BlocksInModelExchange
from .failed_blocks import START_SETTLED, unsettled, unsolved_start
from .workspace import Workspace

_PLAIN_PASSES = 10
"""Passes over inputs and outputs at the start, and one for each plant, before it is decided how to continue."""
_MOST_PASSES = 100
"""Most passes where each brings the values nearer; ten times as many with loops in the initial states."""
_LOOKED_BACK = 4
"""Passes over which the rate is taken at which values come nearer."""
_ROUNDS = 5
"""Most searches, each for other values of the outputs that are no real numbers."""


class Initialization:
    """The values of a run at t = 0, as they are sought: a pass takes w, and x that depends on itself, to new ones."""

    # In Initialization Mode an FMU's outputs follow its inputs at once (FMI 3.0, 2.3.3). Where some passes show that
    # agreement takes many more, or leads away, `find_fixed_point` finds the values that a pass returns unchanged. So
    # are initial states that depend on themselves. States that are computed from inputs are those of the instant
    # before: a source that jumps at t = 0 has its value from the left, so that a derivative sees the jump.

    def __init__(
        self,
        workspace: Workspace,
        plants: Mapping[str, Plant],
        delays: Delays | None,
        take_inputs: Callable[[], None],  # lets the plants see the inputs z
        exchanged: BlocksInModelExchange,
        passes_on: str,  # values, "agree": until inputs stay, "once", or "none": inputs of FMUs keep their start values
        set_start: Callable[[Workspace], None],  # computes initial states and held outputs, as `find_start_values`
    ):
        workspace.here.t[0] = 0.0
        if delays is not None:
            delays.outputs_at(0.0, workspace.here.w)
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

    def find(self) -> None:
        """Find the values: outputs are passed on until inputs change by no more than rounding."""
        while not self.passes_agree():
            if not self.comes_nearer():
                self.search()
                return

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
