"""Responses of the running diagram to a step that is added to a wire, next to those of its linear model.

The consumers of the wire get its signal v plus a step d, as `frequency_response` adds sines: from the point on, and
held between the samples where the diagram is sampled. At an equilibrium the sources keep their values, so that a step
of the diagram's own doesn't meet the added one. A second run without the step is subtracted, so that a diagram which
moves by itself, such as one with a reference that turns, gives the step's part only.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from ...blocks.core import LoopwrightError, OptionError, SimulationError, accepts, brief, explain_calls, kinds
from ..flat import WiredDiagram
from ..linearization import (
    EQUILIBRIUM,
    Linearization,
    PointLike,
    find_signal,
    hold_sources,
    linearize,
    operating_point,
    refine_ticks,
    ticks_between_renewals,
)
from ..results import ExpectedStep, OperatingPoint
from ..wiring import stepped_blocks
from .beginning import can_start_at, with_ticks
from .between_samples import BETWEEN, SMOOTH, Instants, WithinSamples, can_step_finer, choose_instants, moves_between
from .injection import InjectionRun, SamplesAtWire, inject_signal
from .predicted_step import Predicted, find_final, predict, predict_within

SAMPLES = 1000
"""Samples of the response of a diagram that is not sampled."""
GROWN = 1e6
"""Growth of a signal, relative to the step and to the signal before, that no stable loop makes."""
CHUNK = 500
"""Samples between two looks at a signal's growth."""
LONG = 2000
"""Ticks of a run from which on C is worth its start where a solver goes from one to the next; no chunk is so long."""


class DivergenceError(SimulationError):
    """A response to a step grows without end."""


@explain_calls
@dataclass(frozen=True, eq=False)
class StepResponse:
    """Response to a step.

    Attributes
    ----------
    wire : str
        Wire to whose consumers the step is added.
    size : float
        Height of the step.
    t : (N,) ndarray
        Time since the step in s. The first sample is that before the step. Where a signal moves on between the samples
        of a sampled diagram, there are several instants in each sample.
    d : (N,) ndarray
        The step as the consumers got it.
    v : (N,) ndarray
        Change of the wire's own signal; −v/size is the response of T, 1 + v/size that of S.
    outputs : tuple of str
        Names of the other signals that were recorded, entry by entry.
    y : (N, K) ndarray
        Their changes.
    before : (K,) ndarray
        Their values before the step.
    wire_before : float
        The wire's value before the step.
    moved : float
        Largest change of the wire and of the outputs without the step, relative to 1 + their sizes.
    dt : float
        Seconds between two samples; a whole number of the steps of t.
    held : bool
        Whether the wire's signal is held between the samples, so that no peak lies between them.
    prediction : (N, 1 + K) ndarray, optional
        v and the outputs as the linear model predicts them; None where it can't, as at a wire that is renewed several
        times in the period of all clocks.
    final : (1 + K,) ndarray, optional
        Values that the linear model's v and outputs come to, NaN where they don't rest; None without a prediction.
    later : (2, 1 + K) ndarray, optional
        Smallest and largest values of the linear model's v and outputs after the record; None without a prediction.
    between : (1 + K,) ndarray, optional
        Largest size of the linear model's v and outputs between the instants of t, less that at these; 0 of signals
        that are held, NaN where it is not known. None without a prediction.
    steady : (1 + K,) ndarray of bool, optional
        Whether v and the outputs are held between the samples; without it as ``held`` says of v, and no output is.
    solved : bool
        Whether a solver of variable step has a part in it, whose error is more than rounding.
    unread : tuple of str
        FMUs that move on between their communication points, as the linear model shows, where a run has no outputs.
    """

    wire: str
    size: float
    t: np.ndarray
    d: np.ndarray
    v: np.ndarray
    outputs: tuple[str, ...]
    y: np.ndarray
    before: np.ndarray
    wire_before: float
    moved: float
    dt: float
    held: bool
    prediction: np.ndarray | None
    final: np.ndarray | None = None
    later: np.ndarray | None = None
    between: np.ndarray | None = None
    steady: np.ndarray | None = None
    solved: bool = False
    unread: tuple[str, ...] = ()

    def __repr__(self) -> str:
        facts = (
            f"height {self.size:g}",
            f"{self.t.size} samples to {self.t[-1] if self.t.size else 0:.4g} s",
            f"{len(self.outputs)} outputs",
        )
        return brief(f"response to a step at {self.wire!r}", *facts, then=".t, .v, .y, .prediction")

    def answer(self, to_output: bool = False, *, linear: bool = False) -> np.ndarray:
        """Return the response per unit of the step: −v/size, the loop's at the wire, or that of the first output.

        Parameters
        ----------
        to_output : bool
            Whether it is that of the first output.
        linear : bool
            Whether it is the linear model's prediction.

        Raises
        ------
        OptionError
            There is no prediction.
        """
        data = np.column_stack([self.v, self.y])
        if linear:
            if self.prediction is None:
                raise OptionError("found no prediction; expected one. Take the run's response.", port="linear")
            data = self.prediction
        return np.asarray(data[:, 1] if to_output else -data[:, 0]) / self.size

    def final_answer(self, to_output: bool = False) -> float:
        """Return the value per unit of the step that the linear model's response comes to; NaN where there is none."""
        if self.final is None:
            return math.nan
        return float(self.final[1] if to_output else -self.final[0]) / self.size

    def expected(self, column: int, unit: float = 1.0, since: int = 0) -> ExpectedStep | None:
        """Return the linear model's v (column 0) or output (1, …) in a unit, from a sample on; None without one."""
        if self.prediction is None or self.final is None or self.later is None or self.between is None:
            return None
        low, high = sorted(float(x) / unit for x in self.later[:, column])
        final, between = float(self.final[column]) / unit, float(self.between[column]) / abs(unit)
        return ExpectedStep(self.prediction[since:, column] / unit, final, low, high, between)

    def is_steady(self, column: int) -> bool:
        """Return whether v (0) or an output (1, …) is held between the samples, so that no peak lies between them."""
        return bool(self.steady[column]) if self.steady is not None else self.held and column == 0


@accepts(
    None,
    size=kinds.finite.where(lambda size: float(size) != 0.0).worded("a number that is not 0", "Give one."),
    length=kinds.positive.worded(step="Give one."),
)
def step_response(
    diagram: WiredDiagram,
    wire: str,
    *,
    size: float,
    length: float,
    at: PointLike = None,
    outputs: Iterable[str] = (),
    stairs: str | None = None,
) -> StepResponse:
    """Return the response of the running diagram to a step at a wire, and the linear model's."""
    point = operating_point(diagram, at, {})
    variant = diagram.replace(point.parameters) if point.parameters else diagram
    if point.residual <= EQUILIBRIUM and can_start_at(variant, point):
        variant = hold_sources(variant, point.values)
    sampled = diagram.has_clock or diagram.has_fmu
    longest = Fraction(max(1, round(length / SAMPLES * 1e9)), 10**9)
    begins = point if sampled else with_ticks(point, longest)
    flat = variant.flatten_like(begins)
    signal = find_signal(flat, wire)
    if len(signal.entries) != 1:
        raise OptionError(
            f"found {len(signal.entries)} entries; expected one. Name one of them: {signal.labels[0]}.",
            block=diagram.name,
            port=wire,
        )
    names = list(outputs)
    taps = [find_signal(flat, name) for name in names]
    if sampled:
        samples = SamplesAtWire.of(flat, signal, begins.tick, each_renewal=True)
    else:
        samples = SamplesAtWire(int(longest / flat.base), flat.base * int(longest / flat.base))
    count = max(2, math.ceil(length / float(samples.period)) + sampled)  # a step that is held begins a sample later
    # Signals that move on between the samples are read there, too, as far as FMUs take steps so short.
    follows = [flat.table.blocks[tap.port[0]].stepped or moves_between(flat, tap.port) for tap in (signal, *taps)]
    moves = np.repeat(follows, [1, *(len(tap.labels) for tap in taps)]) & sampled
    instants, unread = Instants(), tuple[str, ...]()
    within: WithinSamples | None = None
    if moves.any():
        instants = choose_instants(variant, begins, samples.every, count)
        if samples.is_renewed_once and (not diagram.has_fmu or instants.turns > SMOOTH):
            within = WithinSamples.of(variant, begins, instants.looked, wire, names, len(moves), stairs)
        if diagram.has_fmu:
            moving = within is not None and within.moves_by(count, moves) > BETWEEN
            unread = tuple(stepped_blocks(diagram.structure)) if moving else ()
            instants = instants if moving and can_step_finer(diagram) else Instants()
    begins = refine_ticks(variant, begins, instants.finer)
    options: dict[str, Any] = {"step": None if diagram.has_clock and instants.finer == 1 else begins.base}
    if flat.hybrid:
        options |= {"rtol": 1e-9, "atol": 1e-12}
        if sampled and count * samples.every >= LONG:
            options["compile"] = True
    made = inject_signal(variant, signal, 1, samples.held)

    def run_with(height: float) -> tuple[np.ndarray, np.ndarray, bool]:
        with InjectionRun(variant, made, signal, taps, begins, options) as run:
            return _record(run, samples, count, instants, height, size)

    # What the diagram does by itself is taken off.
    rest, _, _ = run_with(0.0)
    stepped, d, steady = run_with(size)
    change = stepped - rest
    t = float(samples.period / instants.count) * np.arange(len(change))
    if not sampled:
        d = np.full(len(t), size)
    prediction: np.ndarray | None = None
    final: np.ndarray | None = None
    later: np.ndarray | None = None
    between: np.ndarray | None = None
    with suppress(LoopwrightError):
        model, found = _predict(variant, point, wire, names, stairs, samples, instants, within, d, t)
        prediction, later, between = found
        final = size * find_final(model)
        if sampled:
            between = np.where(moves, math.nan if within is None else between, 0.0)
    is_held = samples.held is not None and steady and not follows[0]
    columns = [is_held]
    for tap, moving in zip(taps, follows[1:], strict=True):
        renewed = ticks_between_renewals(flat, [tap.port]) if sampled and not moving else None
        is_steady = renewed is not None and renewed % samples.every == 0 and not samples.wait
        columns += [is_steady] * len(tap.labels)
    return StepResponse(
        wire,
        float(size),
        t,
        d,
        change[:, 0],
        tuple(label for tap in taps for label in tap.labels),
        change[:, 1:],
        rest[0, 1:],
        float(rest[0, 0]),
        float(np.max(np.abs(rest - rest[0]) / (1.0 + np.abs(rest[0])), initial=0.0)),
        float(samples.period),
        is_held,
        prediction,
        final,
        later,
        between,
        np.array(columns),
        flat.hybrid,
        unread,
    )


def _record(
    run: InjectionRun, samples: SamplesAtWire, count: int, instants: Instants, height: float, size: float
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return v and the outputs at all instants of a run, the step as the consumers got it, and whether v is held.

    The run begins a sample before a step of the ``height``. ``size`` is that of the response, which limits its growth.
    """
    ticks, parts = samples.every * instants.finer, instants.count
    if samples.wait:
        run.go(samples.wait * instants.finer, 1)
    first = run.record(1, ticks, parts)
    found = [tuple(part[:1] for part in first)]
    if height:
        run.step(height, run.signal.entries[0])
    largest = GROWN * max(abs(size), float(np.max(np.abs(first[0]))))
    done = 0
    while done < count:
        some = run.record(min(CHUNK, count - done), ticks, parts)
        done += min(CHUNK, count - done)
        found.append(tuple(part[1:] for part in some) if len(found) > 1 else some)
        if not float(np.max(np.abs(some[0]))) <= largest:
            raise DivergenceError(
                f"found a response that has grown to {float(np.max(np.abs(some[0]))):.3g} after a step of {size:g}; "
                "expected one that settles: the diagram is not stable there. Look at linearize().poles.",
                block=run.signal.port[0],
                port=run.signal.port[1],
                t=run.t,
            )
    v, u, y = (np.concatenate(columns) for columns in zip(*found, strict=True))
    return np.hstack([v, y])[1:], (u - v)[1:, 0], run.held


def _predict(
    diagram: WiredDiagram,
    point: OperatingPoint,
    wire: str,
    names: Sequence[str],
    stairs: str | None,
    samples: SamplesAtWire,
    instants: Instants,
    within: WithinSamples | None,
    d: np.ndarray,
    t: np.ndarray,
) -> tuple[Linearization, Predicted]:
    """Return the linear model from a wire to it and the outputs, and its response; an error where it has none."""
    if not samples.is_renewed_once:
        raise OptionError("the wire is renewed off the period, or within it. Measure another one.", port=wire)
    model = linearize(diagram, point, inputs=[wire], outputs=[wire, *names], stairs=stairs)
    parts = instants.count
    if parts > 1 and within is None:
        raise OptionError("there is no linear model between the samples. Measure another wire.", port=wire)
    found = predict(model, d[::parts], t[::parts])
    if within is not None:
        shown = predict_within(within, d[::parts], parts)
        found = shown if parts > 1 else shown._replace(rows=found.rows)
    return model, found
