"""Linear models over a period of ticks, from the models of its ticks (`tick_chain`).

The period is the base period or, with several rates, the least common period of all clocks. Three models are made:

- *over the period* (`model_period`): injected signals are held over the whole period, and measured at its beginning;
- *of a loop* (`model_loop`). A signal that is held over the whole period cuts a wire's loop only if the wire is renewed
  once in the period, at its beginning: the period of a loop begins at a tick at which the wire's source acts. Another
  signal is injected at every tick. Ticks between which the wire stays the same make one channel; a channel that
  nothing on the loop uses is left out. A wire that is renewed once has one channel, and L. A wire that is renewed N
  times has a periodic loop: no L at one rate, but a lifted L of N × N, with a channel for each renewal;
- *of each tick* (`model_ticks`), for an environment at the plant, which moves between them.

The loop of a fast wire with the slow loops open needs no lifting: the clocks slower than the wire's are frozen, and the
period is that of the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...blocks.core import ConfirmationError, Finding, PeriodicLoopError
from ..flat import NONE, FlatDiagram, TickPattern, WiredDiagram
from ..frequency import FourMatrices, LinearDelays
from ..results import OperatingPoint
from .derivatives import LocalDerivatives
from .flow_model import Model, model_continuous
from .left_out_effects import MemoryActs
from .plant_models import EQUILIBRIUM
from .taps import Tap, find_signal
from .tick_chain import Chain, period_of
from .wire_renewals import clock_of, find_slower_clocks, group_by_renewals, ticks_to_renewal

SAME_ROWS = 1e-12
"""Relative difference up to which a wire counts as unchanged from one tick to the next."""
SAME_POLES = 1e-6
"""Relative difference up to which two characteristic polynomials count as the same."""


def lift(steps: Sequence[FourMatrices], *, each_tick: bool, read_each: bool = False) -> FourMatrices:
    """Return the matrices over all ticks of a period, from those of each tick.

    With ``each_tick`` the inputs and outputs of all ticks follow one another. Else an input is held over the
    whole period, and the outputs are those of the first tick; with ``read_each`` those of all ticks.
    """
    n, m = steps[0][1].shape
    X, U = np.eye(n), np.zeros((n, m * len(steps) if each_tick else m), dtype=steps[0][1].dtype)
    C, D = [], []
    for k, (M, N, Cy, Dy) in enumerate(steps):
        own = slice(k * m, (k + 1) * m) if each_tick else slice(0, m)
        if each_tick or read_each or not k:
            by_d = Cy @ U
            by_d[:, own] += Dy
            C.append(Cy @ X)
            D.append(by_d)
        X, U = M @ X, M @ U
        U[:, own] += N
    return X, U, np.vstack(C), np.vstack(D)


def own_states(flat: FlatDiagram, chain: Chain) -> set[int]:
    """Return the numbers of the states of blocks and FMUs that are states of the model.

    Modes that only events change, states from which a block in continuous time only starts a search, and states of
    frozen clocks are not.
    """
    table = flat.table

    def acts(path: str) -> bool:
        subsystem = table.subsystem_of[path]
        return table.is_sampled(subsystem) and flat.clocks.get(subsystem) not in chain.frozen

    sampled = flat.states.entries(path for path in flat.states.slices if acts(path))
    return {*flat.continuous.tolist(), *sampled, *range(flat.width, flat.width + chain.n_p)}


def find_needed(steps: Sequence[FourMatrices], own: set[int]) -> list[int]:
    """Return the numbers of the own states, and of those of the other entries that act on anything in a step.

    The other entries are signals held since a tick and solutions of loops; many are only recorded. One that stays
    constant, whatever the others do, is a mode.
    """
    one = np.eye(len(steps[0][0]))
    acts = np.any([A != 0.0 for A, *_ in steps], axis=0) & (one == 0.0)  # on others
    shown = np.any([np.any(C, axis=0) for _, _, C, _ in steps], axis=0)
    changed = np.any([one != A for A, *_ in steps], axis=0)
    driven = np.any([np.any(B, axis=1) for _, B, *_ in steps], axis=0)
    keep = np.ones(len(one), dtype=bool)
    free = np.array([j not in own for j in range(len(one))], dtype=bool)
    while True:
        silent = ~acts[keep].any(axis=0) & ~shown
        constant = ~changed[:, keep].any(axis=1) & ~driven
        gone = keep & free & (silent | constant)
        if not gone.any():
            return np.flatnonzero(keep).tolist()
        keep &= ~gone


def _restrict(four: FourMatrices, keep: list[int]) -> FourMatrices:
    A, B, C, D = four
    return A[np.ix_(keep, keep)], B[keep], C[:, keep], D


def model_at(
    local: LocalDerivatives,
    at: OperatingPoint,
    way: str | None,
    name: str,
    *,
    discrete: bool,
    loop: str = "",
    frozen: frozenset[TickPattern] = NONE,
    read_each: bool = False,
    with_findings: bool = True,
) -> tuple[Model, list[str]]:
    """Return the linear model of a diagram at a point, and the names of a loop's channels where it has several ticks.

    A sampled diagram's model is the map over a period, a continuous one's the derivatives at the instant. ``loop`` is
    "one" or "lifted" where the model is that of a cut loop, ``name`` is the diagram's.
    """
    if not discrete:
        return model_continuous(local, at, way, name), []
    if loop and period_of(local.flat) > 1:
        return model_loop(local, at, way, lifted=loop == "lifted", frozen=frozen)
    return model_period(local, at, way, frozen, with_findings=with_findings, read_each=read_each), []


def model_period(
    local: LocalDerivatives,
    at: OperatingPoint,
    way: str | None,
    frozen: frozenset[TickPattern] = NONE,
    *,
    with_findings: bool = True,
    read_each: bool = False,
) -> Model:
    """Return the model over the least common period of all clocks; those that are frozen do not act.

    With ``read_each`` it has the outputs of all ticks, one tick after the other.
    """
    flat = local.flat
    period = period_of(flat, frozen)
    chain = Chain(local, at, way, period, frozen, every=read_each)
    chain.go_on()
    whole = lift(chain.steps, each_tick=False, read_each=read_each)
    names = chain.labels
    keep = find_needed([whole], own_states(flat, chain))
    memory, findings = _find_memory(flat, whole[0], names)
    findings += chain.findings(at.tick + period) if with_findings else []
    labels = [names[i] for i in keep]
    return Model(
        _restrict(whole, keep),
        float(flat.base * period),
        labels,
        chain.affine()[keep],
        chain.derivations,
        chain.uncertainty,
        tuple(m for m in memory if m in labels),
        tuple(findings),
    )


def _find_memory(flat: FlatDiagram, A: np.ndarray, names: list[str]) -> tuple[list[str], list[Finding]]:
    """Return the states that only start a search, without effect on the motion, and findings about those that act."""
    found, findings = list[str](), list[Finding]()
    scale = np.max(np.abs(A), initial=1.0)
    for path, where in flat.states.slices.items():
        if not flat.table.blocks[path].memory or where.stop == where.start:
            continue
        if np.max(np.abs(A[:, where])) <= EQUILIBRIUM * scale:
            found += names[where]
        else:
            findings.append(MemoryActs(path, float(np.max(np.abs(A[:, where])))))
    return found, findings


# --- loops -----------------------------------------------------------------------------------------------------------


def begin_loop(
    closed: LocalDerivatives,
    at: OperatingPoint,
    ports: Sequence[tuple[str, str]],
    way: str | None,
    slow: str,
    name: str,
    *,
    moves: bool = True,
) -> tuple[OperatingPoint, frozenset[TickPattern]]:
    """Return the point at which the period of a loop begins, and the clocks that are frozen in it.

    Wires are renewed at that point. ``closed`` are the derivatives with nothing cut, ``moves`` says whether the model
    has ticks. With ``slow="open"`` the clocks slower than the wires' are frozen.
    """
    flat = closed.flat
    frozen = find_slower_clocks(flat, ports, name) if slow == "open" else NONE
    count = ticks_to_renewal(flat, ports, at.tick) if moves and period_of(flat) > 1 else 0
    if not count:
        return at, frozen
    chain = Chain(closed, at, way, count)
    chain.go_on()
    return chain.here, frozen


def model_loop(
    local: LocalDerivatives,
    at: OperatingPoint,
    way: str | None,
    *,
    lifted: bool,
    frozen: frozenset[TickPattern] = NONE,
) -> tuple[Model, list[str]]:
    """Return the model from the injected to the returning signals at the same wires, and the names of its channels."""
    flat, m = local.flat, local.n_inputs
    period = period_of(flat, frozen)
    chain = Chain(local, at, way, period, frozen)
    chain.go_on()
    whole = lift(chain.steps, each_tick=True)
    keep = find_needed([whole], own_states(flat, chain))
    names, labels = chain.labels, [e for s in local.inputs for e in s.labels]
    A, B, C, D = _restrict(whole, keep)
    groups = _find_channels(A, B, C, D, m)
    many = [e for e in range(m) if len(groups[e]) > 1]
    if many and not lifted:
        signal = next(s for s in local.inputs if labels[many[0]] in s.labels)
        raise _make_error(signal, len(groups[many[0]]), float(flat.base * period))
    if many:  # all renewals, so that a delay of one is a shift by one channel
        renewals = group_by_renewals(flat, local.inputs, [k for k, _ in chain.ticks])
        groups = [renewals if renewals and len(group) > 1 else group for group in groups]
    chosen = [(e, j, group) for e in range(m) for j, group in enumerate(groups[e])]
    into = np.zeros((B.shape[1], len(chosen)))
    for column, (e, _, group) in enumerate(chosen):
        into[[k * m + e for k in group], column] = 1.0
    rows = [group[0] * m + e for e, _, group in chosen]
    model = Model(
        (A, B @ into, C[rows], D[rows] @ into),
        float(flat.base * period),
        [names[i] for i in keep],
        chain.affine()[keep],
        chain.derivations,
        chain.uncertainty,
    )
    return model, [f"{labels[e]}@{j}" if len(groups[e]) > 1 else labels[e] for e, j, _ in chosen]


def _make_error(signal: Tap, count: int, period: float) -> PeriodicLoopError:
    return PeriodicLoopError(
        f"{signal.name!r} is renewed {count} times in the model's period of {period:g} s; expected once: its loop is "
        f"periodic and has no L at one rate. Take loop({signal.name!r}, slow='open') for the loop at its own rate, "
        "with slower subsystems holding; with all loops closed take "
        f"periodic_margins(loop({signal.name!r}, lifted=True)).",
        block=signal.port[0],
        port=signal.port[1],
    )


def _find_channels(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, m: int) -> list[list[list[int]]]:
    """Return the channels of each entry: groups of ticks between which it stays the same, if they act on an output."""
    count = len(C) // m if m else 0
    seen = np.any(C, axis=0)
    while True:  # states on which an output depends
        more = seen | np.any(A[seen], axis=0)
        if np.array_equal(more, seen):
            break
        seen = more
    acts = np.any(B[seen], axis=0) | np.any(D, axis=0)
    both, found = np.hstack([C, D]), []
    for e in range(m):
        groups: list[list[int]] = []
        for k in range(count):
            row = both[k * m + e]
            before = both[(k - 1) * m + e]
            if k and np.max(np.abs(row - before), initial=0.0) <= SAME_ROWS * np.max(np.abs(row), initial=0.0):
                groups[-1].append(k)
            else:
                groups.append([k])
        used = [group for group in groups if any(acts[k * m + e] for k in group)]
        found.append(used or groups[:1])
    return found


def confirm_loop(
    cut: Model, A: np.ndarray, wires: tuple[str, ...], name: str, delays: LinearDelays | None = None
) -> None:
    """Compare the poles of the closed loop with those of the diagram, of matrix A with its delays."""
    Ac, B, C, D = cut.matrices
    back = np.eye(len(D)) - D
    if len(D) and not np.linalg.cond(back) < 1e12:
        return  # the closed loop has no unique solution, which its margins say
    late = cut.delays
    closed = Ac + B @ np.linalg.solve(back, C) if len(D) else Ac
    size = [float(np.max(np.abs(np.linalg.eigvals(a)), initial=0.0)) for a in (closed, A, 0.1 * Ac)]
    radius = 1.5 * max(size) or 1.0  # the open loop counts too: the poles of a deadbeat loop are rounding alone
    points = [radius * np.exp(1j * angle) for angle in (0.3, 1.1, 2.0)]
    if late is not None:  # where e^(−s τ) has a size near 1: to the left it overflows, far to the right it is nothing
        slow = 1.0 / float(np.max(late.times))
        points = [points[0], slow * (1.0 + 2.0j), slow + 0.7j * radius]
    worst = 0.0
    for z in points:  # det(I − A/z) does not count states at zero, such as values held for later
        if late is None or delays is None:
            both = [np.eye(len(a)) - a / z for a in (closed, A)]
        else:
            (closed, _, _, _), around = late.feed_back(cut.matrices, np.eye(len(D)), D[:, :0], D[:0])
            both = [_with_delays(a, own, z) for a, own in ((closed, around), (A, delays))]
        (s1, l1), (s2, l2) = map(np.linalg.slogdet, both)
        off = float(abs(s1 / s2 * np.exp(l1 - l2) - 1.0))
        worst = max(worst, math.inf if math.isnan(off) else off)
    if not worst <= SAME_POLES + 100 * cut.uncertainty / radius:
        raise ConfirmationError(
            f"the loop at {', '.join(map(repr, wires))}, closed, has the poles of another system than the diagram: "
            f"found characteristic polynomials that differ by {worst:.3g} of their size; expected the same. The "
            "margins of this loop are not those of the diagram. Cut another wire.",
            block=name,
        )


def _with_delays(A: np.ndarray, late: LinearDelays, s: complex) -> np.ndarray:
    """Return the matrix whose determinant is the characteristic function at s, over s to the number of states."""
    found = late.matrix_at(A, s)
    found[: len(A)] /= s
    return found


# --- each tick -------------------------------------------------------------------------------------------------------


class TickModel(NamedTuple):
    """Model of the rest of a diagram from one tick to the next, with the plant's outputs injected.

    The matrices lead from the states just before the tick and the injected signals to those before the next one, and
    to the signals that are measured at the tick.
    """

    matrices: FourMatrices
    duration: float  # time to the next tick in s
    steps: bool  # whether the plant exchanges signals at the tick: always, if it is no FMU
    # whether each injected wire is renewed at the tick; wires of continuous blocks and FMUs always are
    renews: tuple[bool, ...]


def model_ticks(
    diagram: WiredDiagram,
    at: OperatingPoint,
    path: str,
    inputs: Sequence[str],
    outputs: Sequence[str],
    openings: Sequence[str],
    stairs: str | None = None,
) -> tuple[tuple[TickModel, ...], list[str]]:
    """Return the models of all ticks of a sampled diagram's period, and the names of their states."""
    flat = diagram.flatten_like(at)
    injected, measured, cut = ([find_signal(flat, name) for name in names] for names in (inputs, outputs, openings))
    local = LocalDerivatives.at(flat, at, injected, measured, cut, stairs)
    chain = Chain(local, at, None, period_of(flat))
    chain.go_on()
    keep = find_needed(chain.steps, own_states(flat, chain))
    clocks = [clock_of(flat, tap) for tap in injected]
    mine = flat.plant_ticks.get(path)
    found = tuple(
        TickModel(
            _restrict(four, keep),
            float(flat.base * (following - k)),
            mine is None or any(clock.acts(k) for clock in mine),
            tuple(clock is None or clock.acts(k) for clock in clocks),
        )
        for (k, following), four in zip(chain.ticks, chain.steps, strict=True)
    )
    labels = chain.labels
    return found, [labels[i] for i in keep]
