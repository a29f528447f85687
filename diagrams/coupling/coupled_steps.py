"""Communication steps of plants that are coupled: schemes, iteration with rollback, adaptive steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from ...blocks.core import OptionError, SimulationError, left_of
from ..flat import FlatDiagram, takes_any_step
from .coupling_options import Coupling, Scheme
from .links import Links
from .plant_steps import PlantSteps, step_all
from .plants import Plant
from .rollback import Beginning, Rollback, accept_steps, find_taken_back, save_plant, texts_of, try_steps

SAFETY, SHRINK, GROW = 0.9, 0.2, 4.0
"""Of the next adaptive step: factor, and its smallest and largest change."""


@dataclass
class Effort:
    """Work that a coupling has done in a run."""

    steps: int = 0
    """Communication steps that were accepted."""
    rejected: int = 0
    """Communication steps whose estimated error was too large."""
    passes: int = 0
    """Passes over communication steps, of iterated coupling."""
    shortest: float = field(default=float("inf"))
    """Shortest communication step in s."""


class ContinuousRest(Protocol):
    """The blocks in continuous time, which take part in a communication step of the plants.

    A protocol: the loop over time, above this sub-package, gives them to a coupling scheme.
    """

    def advance(self, t: float, end: float) -> float | None:
        """Go from t to the end, with the plants' outputs as they are in w; return where a stop condition ended it."""

    def save(self) -> Any:
        """Return the present state, for `restore`."""

    def restore(self, saved: Any) -> None:
        """Go back to a state."""

    def accept(self) -> None:
        """Keep the events that have happened since the last call."""


class CoupledSteps:
    """Communication steps of all plants of a run, by a scheme other than the default."""

    def __init__(
        self,
        flat: FlatDiagram,
        name: str,
        plants: Mapping[str, Plant],  # may be filled later
        coupling: Coupling,
        steps: PlantSteps,
        z: np.ndarray,
        w: np.ndarray,
        exchange: Callable[[float], np.ndarray],  # gives the inputs that follow from w at a time in s, between ticks
        rest: ContinuousRest,
    ) -> None:
        self._flat, self._name, self._plants, self.coupling = flat, name, plants, coupling
        self._z, self._w, self._exchange, self._rest = z, w, exchange, rest
        self.links = Links(flat)
        self.effort = Effort()
        self._refuse(steps)
        self._order = self.links.order(coupling.order)
        self._takes = self.links.renewed_inputs(self._order)
        self._all_outputs = np.concatenate(
            [np.zeros(0, dtype=int), *(np.arange(s.start, s.stop) for s in self.links.outputs.values())]
        )
        links = self.links
        passed = links.direct & links.moving[None, :]
        straight = {path: passed[links.outputs[path]].any(axis=1) for path in links.paths}
        self._straight = {path: rows for path, rows in straight.items() if rows.any()}
        counts = coupling.scheme == Scheme.ITERATED or links.felt | ~passed.any(axis=1)
        self._counted = np.broadcast_to(counts, self._w.shape)[self._all_outputs]
        self._rollback = Rollback(links, w)
        self._untried = {path for path in flat.plant_ticks if takes_any_step(flat.table.blocks[path])}
        self.proposed: float | None = None
        """Length in s of the next communication step, with adaptive steps."""

    def _refuse(self, steps: PlantSteps) -> None:
        """Refuse a scheme for which a plant lacks something."""
        coupling, blocks = self.coupling, self._flat.table.blocks
        if not steps.regular:
            few = next(path for path in self._flat.plant_ticks if not steps.is_regular(path))
            raise OptionError(
                f"found coupling {coupling.scheme!r}, while {few} has its own communication points, fewer than the "
                "run has ticks; expected FMUs that all step at every tick. Give simulate(…, step=…), which asks for "
                "that, leave out its communication_step, or take coupling='jacobi'.",
                block=self._name,
                port="coupling",
            )
        for path in self._flat.plant_ticks:
            if (coupling.scheme == Scheme.ITERATED or coupling.error is not None) and not _can_save(blocks[path]):
                raise OptionError(
                    f"found coupling {coupling.scheme!r}{'' if coupling.error is None else ' with an error'}, which "
                    "goes back to the beginning of a step; expected an FMU that can save its state "
                    "(canGetAndSetFMUState of its description is false). Take coupling='gauss_seidel' or 'jacobi' with "
                    "a smaller step, or export the FMU with that capability.",
                    block=path,
                    port="coupling",
                )
            if coupling.scheme != Scheme.JACOBI and passes_slopes(blocks[path]):
                raise OptionError(
                    f"found input_derivatives with coupling {coupling.scheme!r}, whose inputs are no longer those of "
                    "the step's beginning, so that a slope from there leads astray; expected coupling 'jacobi', which "
                    "is of second order with these slopes where inputs are smooth. Take that, or leave them out.",
                    block=path,
                    port="coupling",
                )
            if coupling.error is not None and not takes_any_step(blocks[path]):
                raise OptionError(
                    "found a coupling with adaptive communication steps; expected an FMU that takes steps of any "
                    "length (canHandleVariableCommunicationStepSize of its description is false). Leave out error=, "
                    "and give simulate(…, step=…).",
                    block=path,
                    port="coupling",
                )

    @property
    def order(self) -> tuple[str, ...]:
        """Order in which the plants step one after the other; empty where they step together."""
        return self._order if self.coupling.scheme == Scheme.GAUSS_SEIDEL else ()

    # --- from tick to tick --------------------------------------------------------------------------------------------

    def go(self, t: float, end: float, h: float) -> float | None:
        """Go from one tick to the next; return the time in s at which a stop condition ended the run before that."""
        if self.coupling.error is not None or self.coupling.scheme == Scheme.ITERATED:
            try_steps(self._plants.values())
            if self._untried:
                self._try_two_halves(t, h)
        if self.coupling.error is not None:
            return self._go_adaptively(t, end)
        ended = self._step(t, end, h)
        self._accept()
        self._count(h)
        return ended

    def _accept(self) -> None:
        self._rest.accept()
        accept_steps(self._plants.values())

    def _count(self, h: float) -> None:
        self.effort.steps += 1
        self.effort.shortest = min(self.effort.shortest, h)

    def _step(self, t: float, end: float, h: float) -> float | None:
        """Take a communication step by the scheme."""
        if self.coupling.scheme == Scheme.ITERATED:
            return self._iterate(t, end, h)
        ended = self._rest.advance(t, end)
        if ended is not None:
            return ended
        if self.coupling.scheme == Scheme.JACOBI:
            step_all(self._plants.values(), t, h)
            return None
        for path in self._order:
            renewed = self._takes[path]
            if renewed.size:
                self._z[renewed] = self._exchange(left_of(end))[renewed]
            self._plants[path].step(t, h)
        return None

    # --- iterated -----------------------------------------------------------------------------------------------------

    def _iterate(self, t: float, end: float, h: float) -> float | None:
        """Repeat a step until the outputs at its end, which were assumed, are those that come of it."""
        links, outs, felt = self.links, self._all_outputs, self.links.felt[self._all_outputs]
        smooth = links.smooth_outputs[outs]
        start = self._save()
        before, inputs = self._w[outs].copy(), self._z.copy()
        guess = before.copy()
        search = Search(felt & smooth, links.nominals[outs])
        for count in range(self.coupling.passes):
            if count:
                self._restore(start)
            self._w[outs] = np.where(smooth, 0.5 * (before + guess), before)
            ended = self._rest.advance(t, end)
            if ended is not None:
                return ended
            self._w[outs] = guess
            self.effort.passes += 1
            self._pass_over(t, end, h, inputs, start)
            found = self._w[outs].copy()
            size = links.nominals[outs] + np.abs(found)
            off = np.where(felt, np.abs(found - guess) / size, 0.0)
            if not off.max(initial=0.0) > self.coupling.tolerance:
                return None
            guess = search.next(guess, found)
        worst = int(np.argmax(off))
        path, port = links.name_of_output(int(outs[worst]))
        raise SimulationError(
            f"the iterated coupling does not converge: after {self.coupling.passes} passes over the step of {h:g} s "
            f"the output still changes by {off[worst]:.3g} of its size; expected at most {self.coupling.tolerance:g} "
            "(tolerance). Take a smaller step, or Coupling(scheme='iterated', tolerance=…, passes=…).",
            block=path,
            port=port,
            t=t,
        )

    def _pass_over(self, t: float, end: float, h: float, inputs: np.ndarray, start: Beginning) -> None:
        """Step all plants with the inputs that follow from w at the end of the step."""
        # The states come of the mean of the inputs at the beginning and at the end: held over the step, it has their
        # integral. Outputs that follow an input at once come of a step with the input at the end.
        links = self.links
        last = np.where(links.moving & links.smooth_inputs, self._exchange(left_of(end)), inputs)
        made = {}
        if self._straight:
            self._z[:] = last
            step_all([self._plants[path] for path in self._straight], t, h)
            for path, rows in self._straight.items():
                made[path] = self._w[links.outputs[path]][rows].copy()
                self._restore_plant(path, start)
        self._z[:] = np.where(links.moving & links.smooth_inputs, 0.5 * (inputs + last), inputs)
        step_all(self._plants.values(), t, h)
        for path, rows in self._straight.items():
            self._w[links.outputs[path]][rows] = made[path]
        self._z[:] = inputs

    # --- adaptive -----------------------------------------------------------------------------------------------------

    def _go_adaptively(self, t: float, end: float) -> float | None:
        """Go to the next tick in communication steps whose error, estimated by step doubling, is small enough."""
        assert self.coupling.error is not None
        links, outs, order = self.links, self._all_outputs, self.coupling.convergence_order
        now = t
        h = end - t if self.proposed is None else min(self.proposed, end - t)
        while now < end:
            if now > t:
                self._z[links.moving] = self._exchange(left_of(now))[links.moving]
            rest = end - now
            h = rest if h > 0.99 * rest else 0.5 * rest if h > 0.5 * rest else h
            last = end if h == rest else now + h
            start = self._save()
            ended = self._step(now, last, last - now)
            if ended is None:
                coarse = self._w[outs].copy()
                self._restore(start)
                ended = self._take_two(now, last)
            if ended is not None:
                self._accept()
                return ended
            fine = self._w[outs]
            size = self.coupling.error * (links.nominals[outs] + np.abs(fine))
            off = np.where(self._counted, np.abs(fine - coarse) / size, 0.0)
            estimate = float(off.max(initial=0.0)) / (2.0**order - 1.0)
            factor = SAFETY * max(estimate, 1e-12) ** (-1.0 / (order + 1))
            taken = last - now
            if estimate <= 1.0:
                self._accept()
                self._end_before(now, last, end)
                self._count(taken / 2)
                self._count(taken / 2)
                self.proposed = max(taken * min(GROW, factor), self.coupling.shortest)
                h, now = self.proposed, last
                continue
            self.effort.rejected += 1
            self._restore(start)
            h = taken * max(SHRINK, factor)
            if h < self.coupling.shortest:
                raise self._too_short(off, estimate, now, h)
        return None

    def _take_two(self, t: float, end: float) -> float | None:
        middle = t + 0.5 * (end - t)
        ended = self._step(t, middle, middle - t)
        if ended is not None:
            return ended
        self._end_before(t, middle, end)
        moving = self.links.moving
        self._z[moving] = self._exchange(left_of(middle))[moving]
        return self._step(middle, end, end - middle)

    def _end_before(self, t: float, now: float, end: float) -> None:
        """End the run where a plant has asked for that at a time before the tick's."""
        for plant in self._plants.values():
            if now < end and getattr(plant, "ends_run", False):
                made: Any = plant
                raise made.termination(t, now - t, now)

    def _too_short(self, off: np.ndarray, estimate: float, t: float, h: float) -> SimulationError:
        path, port = self.links.name_of_output(int(self._all_outputs[int(np.argmax(off))]))
        return SimulationError(
            f"the estimated error of a communication step is {estimate:.3g} times the one allowed "
            f"({self.coupling.error:g}), and the step would be {h:.3g} s; expected at least "
            f"{self.coupling.shortest:g} s (shortest). An output that jumps, or direct feedthrough in a loop of FMUs, "
            "can be the cause. Allow a larger error, a shorter step, or take scheme='iterated'.",
            block=path,
            port=port,
            t=t,
        )

    # --- going back ---------------------------------------------------------------------------------------------------

    def _try_two_halves(self, t: float, h: float) -> None:
        """Refuse plants that take back a step when the next one begins; those that don't move are tried again later."""
        start, made, plants = self._save(), [], [self._plants[path] for path in sorted(self._untried)]
        for begin, length in ((t, 0.5 * h), (t + 0.5 * h, 0.5 * h), (t, h)):
            if length == h:
                self._restore(start)
            step_all(plants, begin, length)
            made.append(self._w.copy())
        self._restore(start)
        self._untried -= find_taken_back(self.links, sorted(self._untried), made, t)

    def _save(self) -> Beginning:
        plants = {path: save_plant(plant) for path, plant in self._plants.items()}
        texts = {path: {port: list(v) for port, v in texts_of(plant).items()} for path, plant in self._plants.items()}
        refused = {path: getattr(plant, "refused", None) for path, plant in self._plants.items()}
        saved = Beginning(self._rest.save(), plants, texts, refused, self._w.copy(), self._z.copy())
        if self._rollback.is_open:
            for path in self._plants:
                self._restore_plant(path, saved)
            saved.read = self._w.copy()
            self._w[:] = saved.w
        return saved

    def _restore(self, saved: Beginning) -> None:
        for path in self._plants:
            self._restore_plant(path, saved)
        self._rest.restore(saved.rest)
        self._w[:], self._z[:] = saved.w, saved.z

    def _restore_plant(self, path: str, saved: Beginning) -> None:
        """Let a plant go back; its texts, whose record would begin again, stay as they were there."""
        plant = self._plants[path]
        before = self._w[self.links.outputs[path]].copy()
        plant.restore(saved.plants[path])
        if saved.read is not None:
            self._rollback.check(path, before, saved.read, getattr(saved.plants[path], "t", None))
        if saved.refused.get(path) is not None:
            refusing: Any = plant
            refusing.refused = saved.refused[path]
        for port, changes in texts_of(plant).items():
            changes[:] = saved.texts[path][port]

    @property
    def messages(self) -> tuple[str, ...]:
        """Work of the coupling so far, in words."""
        effort, coupling = self.effort, self.coupling
        if not effort.steps:
            return ()
        text = f"coupling {coupling.scheme}: {effort.steps} communication steps"
        if coupling.error is not None:
            text += f", {effort.rejected} more repeated with a shorter one, the shortest of {effort.shortest:.3g} s"
        if effort.passes:
            text += f", {effort.passes} passes"
        return (f"{text}.",)


def passes_slopes(block: Any) -> bool:
    """Whether a run gives a plant the slopes of its inputs."""
    return bool(getattr(getattr(block, "stepping", None), "input_derivatives", False))


def _can_save(block: Any) -> bool:
    return bool(getattr(block, "can_save", True))


class Search:
    """Search for values that a pass over a step returns unchanged, from the passes so far.

    The next guess is the best linear combination of the passes so far, by least squares (interface quasi-Newton with
    an inverse Jacobian from least squares, Degroote, Bathe, Vierendeels 2009): n + 1 passes solve n linear equations,
    also where plain repetition diverges.
    """

    def __init__(self, where: np.ndarray, scale: np.ndarray):
        self._where, self._scale = where, scale[where]
        self._found: list[np.ndarray] = []
        self._off: list[np.ndarray] = []

    def next(self, guess: np.ndarray, found: np.ndarray) -> np.ndarray:
        """Return the next guess, after a pass has made ``found`` of a guess."""
        result, where = found.copy(), self._where
        self._found.append(found[where])
        self._off.append((found[where] - guess[where]) / self._scale)
        if len(self._off) > 1:
            changes = np.array([off - self._off[-1] for off in self._off[:-1]]).T
            made = np.array([values - self._found[-1] for values in self._found[:-1]]).T
            weights = np.linalg.lstsq(changes, -self._off[-1], rcond=1e-10)[0]
            result[where] += made @ weights
        return result
