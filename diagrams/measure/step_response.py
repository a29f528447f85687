"""Responses of the running diagram to a step that is added to a wire, next to those of its linear model.

The consumers of the wire get its signal v plus a step d, as `frequency_response` adds sines: from the point on, and
held between the samples where the diagram is sampled. At an equilibrium the sources keep their values, so that a step
of the diagram's own doesn't meet the added one. A second run without the step is subtracted, so that a diagram which
moves by itself, such as one with a reference that turns, gives the step's part only.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from ...blocks.core import LoopwrightError, OptionError, SimulationError, accepts, brief, explain_calls, kinds
from ..flat import WiredDiagram
from ..frequency import advance_held
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
    ticks_to_renewal,
)
from ..results import ExpectedStep
from ..wiring import stepped_blocks
from .beginning import can_start_at, with_ticks
from .between_samples import BETWEEN, SMOOTH, Instants, WithinSamples, can_step_finer, choose_instants, moves_between
from .injection import InjectionRun, inject_signal

SAMPLES = 1000
"""Samples of the response of a diagram that is not sampled."""
GROWN = 1e6
"""Growth of a signal, relative to the step and to the signal before, that no stable loop makes."""
SLOWEST = 1e-6
"""Poles slower than that, relative to the fastest, are taken as integrators that nothing feeds back."""
CONSTANTS = 40.0
"""Time constants of the slowest other pole after which a linear model rests."""
FINER = 6
"""Halvings of a sample time within which the largest value between two samples is looked for."""
FINER_DELAYED = 3
"""Instants a sample at which a response with delays is looked at."""
LATER = 5.0
"""Parts of the longest delay for which a response is looked at after its last sample, at least."""
MOST_LATER = 10
"""Lengths of a response up to which it is looked at after its last sample."""
SAMPLES_LATER = 2000
"""Instants at which it is."""
FINEST = 40
"""Halvings of it right behind a sample, where a fast mode has decayed before the next one."""
DOUBLED = 200
"""Samples after the record for which a linear model is looked at before their distance is doubled."""
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
    begins, longest = point, Fraction(max(1, round(length / SAMPLES * 1e9)), 10**9)
    if not sampled:
        begins = with_ticks(point, longest)
    base = begins.base
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
    every = math.lcm(*(clock.every for clock in flat.distinct)) if sampled and flat.distinct else 1
    if not sampled:
        every = int(longest / base)
    own = ticks_between_renewals(flat, [signal.port]) if sampled and every > 1 else None
    slow = every // own if own and every % own == 0 else 1  # the wire's renewals in the period of all clocks
    every //= slow
    period = base * every
    wait = ticks_to_renewal(flat, [signal.port], point.tick) if sampled and every > 1 else 0
    held = (period, ((point.tick + wait) % every) * base) if sampled else None
    made = inject_signal(variant, signal, 1, held)
    count = max(2, math.ceil(length / float(period)) + sampled)  # a step that is held begins a sample later
    entries = 1 + sum(len(tap.labels) for tap in taps)
    follows = [flat.table.blocks[tap.port[0]].stepped or moves_between(flat, tap.port) for tap in (signal, *taps)]
    moves = np.repeat(follows, [1, *(len(tap.labels) for tap in taps)]) if sampled else np.zeros(entries, dtype=bool)
    instants, unread = Instants(), tuple[str, ...]()
    within: WithinSamples | None = None
    if moves.any():
        instants = choose_instants(variant, begins, every, count)
        if not wait and slow == 1 and (not diagram.has_fmu or instants.turns > SMOOTH):
            within = WithinSamples.of(variant, begins, instants.looked, wire, names, entries, stairs)
        if diagram.has_fmu:
            moving = within is not None and within.moves_by(count, moves) > BETWEEN
            unread = tuple(stepped_blocks(diagram.structure)) if moving else ()
            instants = instants if moving and can_step_finer(diagram) else Instants()
    begins, parts = refine_ticks(variant, begins, instants.finer), instants.count
    ticks = every * instants.finer  # of the run, in a sample
    options: dict[str, Any] = {"step": None if diagram.has_clock and instants.finer == 1 else begins.base}
    if flat.hybrid:
        options |= {"rtol": 1e-9, "atol": 1e-12}
        if sampled and count * every >= LONG:
            options["compile"] = True

    def run_with(height: float) -> tuple[np.ndarray, np.ndarray, bool]:
        with InjectionRun(variant, made, signal, taps, begins, options) as run:
            if wait:
                run.go(wait * instants.finer, 1)
            first = run.record(1, ticks, parts)
            found = [tuple(part[:1] for part in first)]
            if height:
                run.step(height, signal.entries[0])
            largest = GROWN * max(abs(size), float(np.max(np.abs(first[0]))))
            done = 0
            while done < count:
                some = run.record(min(CHUNK, count - done), ticks, parts)
                done += min(CHUNK, count - done)
                found.append(tuple(part[1:] for part in some) if len(found) > 1 else some)
                if not float(np.max(np.abs(some[0]))) <= largest:
                    raise DivergenceError(
                        f"found a response that has grown to {float(np.max(np.abs(some[0]))):.3g} after a step of "
                        f"{size:g}; expected one that settles: the diagram is not stable there. Look at "
                        "linearize().poles.",
                        block=signal.port[0],
                        port=signal.port[1],
                        t=run.t,
                    )
            v, u, y = (np.concatenate(columns) for columns in zip(*found, strict=True))
            return np.hstack([v, y])[1:], (u - v)[1:, 0], run.held

    rest, _, _ = run_with(0.0)
    stepped, d, steady = run_with(size)
    change = stepped - rest
    t = float(period / parts) * np.arange(len(change))
    if not sampled:
        d = np.full(len(t), size)
    moved = float(np.max(np.abs(rest - rest[0]) / (1.0 + np.abs(rest[0])), initial=0.0))
    prediction: np.ndarray | None = None
    final: np.ndarray | None = None
    later: np.ndarray | None = None
    between: np.ndarray | None = None
    try:
        if wait:
            raise OptionError("the wire is renewed off the period. Measure another one.", port=wire)
        if slow > 1:
            raise OptionError("the wire is renewed within the model's period. Measure another one.", port=wire)
        model = linearize(variant, point, inputs=[wire], outputs=[wire, *names], stairs=stairs)
        if parts > 1 and within is None:
            raise OptionError("there is no linear model between the samples. Measure another wire.", port=wire)
        prediction, later, between = predict(model, d[::parts], t[::parts])
        final = size * find_final(model)
        if within is not None:
            shown, later, between = predict_within(within, d[::parts], parts)
            prediction = shown if parts > 1 else prediction
        if sampled:
            between = np.where(moves, math.nan if within is None else between, 0.0)
    except LoopwrightError:
        pass
    labels = tuple(label for tap in taps for label in tap.labels)
    is_held = bool(held) and steady and not follows[0]
    columns = [is_held]
    for tap, moving in zip(taps, follows[1:], strict=True):
        renewed = ticks_between_renewals(flat, [tap.port]) if sampled and not moving else None
        columns += [renewed is not None and renewed % every == 0 and not wait] * len(tap.labels)
    return StepResponse(
        wire,
        float(size),
        t,
        d,
        change[:, 0],
        labels,
        change[:, 1:],
        rest[0, 1:],
        float(rest[0, 0]),
        moved,
        float(period),
        is_held,
        prediction,
        final,
        later,
        between,
        np.array(columns),
        flat.hybrid,
        unread,
    )


def predict(model: Linearization, d: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the outputs of a linear model with one input d: sampled as it is, or held from the first sample on.

    These are the rows at the samples, (N, K); the smallest and largest outputs after the last sample, with d held at
    its last value, (2, K); and the largest size of the outputs between the samples, less that at the samples, (K,),
    which is 0 of a sampled model.
    """
    if model.delays is not None:
        return _predict_with_delays(model, d, t)
    C, D, n = model.C, model.D[:, 0], len(model.A)
    h = float(t[1] - t[0])
    one = _advance_by(model, h)
    z, states = np.zeros(n + 1), np.zeros((len(d), n + 1))
    for k, value in enumerate(d):
        z[n] = value
        states[k] = z
        z = one @ z
    rows = states[:, :n] @ C.T + np.outer(d, D)
    later = _find_extremes(model, one, z, h)
    between = np.zeros(len(C))
    if not model.dt:
        size = np.max(np.abs(rows), axis=0)
        moves = [_advance_by(model, h * 0.5**k) for k in range(FINER + 2, FINEST, 2)]  # powers of one lose digits
        part = whole = _advance_by(model, h * 0.5**FINER)
        for _ in range(2**FINER - 1):
            moves.append(part)
            part = whole @ part
        for move in moves:
            inside = states @ (C @ move[:n]).T + np.outer(d, D)
            between = np.maximum(between, np.max(np.abs(inside), axis=0) - size)
    return rows, later, between


def predict_within(within: WithinSamples, d: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what `predict` returns, with ``count`` instants in each sample, over each of which d is held."""
    rows, state = within.respond(d)
    end, model = np.append(state, d[-1]), within.model
    later = _find_extremes(model, _advance_by(model, model.dt), end, model.dt).reshape(2, -1, within.outputs)
    return (
        within.read(rows, count),
        np.stack([later[0].min(axis=0), later[1].max(axis=0)]),
        within.between(rows, count),
    )


def _predict_with_delays(
    model: Linearization, d: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what `predict` returns of a continuous model with delays and a step at its first sample.

    Later outputs are looked at until the slowest pole has decayed, between the samples at three instants of each.
    """
    h, size, poles = float(t[1] - t[0]), float(d[0]), model.poles
    slowest = float(np.min(np.abs(poles.real), initial=np.inf)) if poles.size else np.inf
    after = max(LATER * float(np.max(model.delays.times)) if model.delays else 0.0, CONSTANTS / slowest, 4.0 * h)
    end = t[-1] + min(after, MOST_LATER * h * len(t))
    fine = h / FINER_DELAYED * np.arange(FINER_DELAYED * (len(t) - 1) + 1)
    times = np.concatenate([fine, np.linspace(fine[-1], end, SAMPLES_LATER)[1:]])
    found = size * model.system.step_response(times)
    rows, later = found[: len(fine) : FINER_DELAYED], found[len(fine) - 1 :]
    between = np.max(np.abs(found[: len(fine)]), axis=0) - np.max(np.abs(rows), axis=0)
    return rows, np.stack([later.min(axis=0), later.max(axis=0)]), between


def _advance_by(model: Linearization, h: float) -> np.ndarray:
    """Return the matrix that takes (x, d) of a linear model h seconds further with d held, or by its sample time."""
    A, B, n = model.A, model.B[:, :1], len(model.A)
    if model.dt:
        return np.block([[A, B], [np.zeros((1, n)), np.ones((1, 1))]])
    return advance_held(A, B, h)


def _find_extremes(model: Linearization, one: np.ndarray, z: np.ndarray, h: float) -> np.ndarray:
    """Return the smallest and the largest outputs of a linear model from (x, d) = z on, until it rests.

    After every `DOUBLED` samples, which are h seconds apart at first, their distance is doubled: what decays slowly is
    looked at as long as it lasts.
    """
    n, low, high = len(model.A), np.full(len(model.C), np.inf), np.full(len(model.C), -np.inf)
    slowest, elapsed = float(np.min(_find_rates(model), initial=np.inf)), 0.0
    with np.errstate(all="ignore"):
        while not elapsed * slowest > CONSTANTS:
            for _ in range(DOUBLED):
                y = model.C @ z[:n] + model.D[:, 0] * z[n]
                low, high = np.minimum(low, y), np.maximum(high, y)
                z = one @ z
            elapsed, h, one = elapsed + DOUBLED * h, 2.0 * h, one @ one
    return np.stack([low, high])


def _find_rates(model: Linearization) -> np.ndarray:
    """Return how fast the modes of a linear model decay or grow, in 1/s; those slower than `SLOWEST` are left out."""
    poles = np.linalg.eigvals(model.A)
    with np.errstate(divide="ignore"):
        rates = np.abs(np.log(np.abs(poles)) / model.dt if model.dt else poles.real)
    rates = np.minimum(rates, np.pi / model.dt) if model.dt else rates
    return np.asarray(rates[rates > SLOWEST * np.max(rates, initial=0.0)])


def find_final(model: Linearization) -> np.ndarray:
    """Return the values that a linear model's outputs come to after a unit step, NaN of those that don't rest.

    They are those after many time constants of its slowest pole; poles slower than `SLOWEST` of the fastest stay where
    they are.
    """
    if model.delays is not None:
        at_rest = model.characteristic.count_unstable() == 0
        final = np.atleast_1d(np.real(model.system(0.0, squeeze=False))).reshape(len(model.C), -1)[:, 0]
        return final if at_rest else np.full(len(model.C), np.nan)
    C, D, n, rates = model.C, model.D[:, 0], len(model.A), _find_rates(model)
    if not rates.size:
        return np.asarray(D, dtype=float)
    h = model.dt or 0.1 / float(np.max(np.abs(np.linalg.eigvals(model.A))))
    M = _advance_by(model, h)
    doublings = max(1, math.ceil(math.log2(CONSTANTS / float(np.min(rates)) / h)))
    for _ in range(doublings):
        M = M @ M
    with np.errstate(all="ignore"):
        size = np.sum(np.abs(C), axis=1) * np.max(np.abs(M[:n, n]), initial=0.0) + np.abs(D)
        once, twice = C @ M[:n, n] + D, C @ (M @ M)[:n, n] + D
        rests = np.abs(twice - once) <= 1e-9 * size + 1e-6 * np.maximum(np.abs(once), np.abs(twice))
    return np.where(rests & np.isfinite(once), once, np.nan)
