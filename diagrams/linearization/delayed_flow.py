"""Transport delays between ticks: the flow of a sampled diagram, exact with what the past still has to say.

Between two ticks the continuous blocks are ẋ = A x + B u + G w, z = C x + D u + H w, u held and wᵢ(t) = zᵢ(t − τᵢ).
If no delay acts back on itself without a tick in between, each z is known from past ticks: it is the output of an
autonomous linear system that starts from the state and the held signals at a tick, and from the systems of the delays
ahead of it. A delay that is no multiple of the sample time divides the interval between two ticks. Nothing jumps within
a part, so a matrix exponential is exact there (the modified z-transform; Åström and Wittenmark, Computer-Controlled
Systems, 3.2). Past signals are states of the model, in a line as long as the longest way through the delays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from functools import cached_property

import numpy as np

from ...blocks.core import OptionError
from ..flat import NONE, FlatDiagram
from .chain_slopes import Slopes
from .delay_channels import DelayChannels, find_loops, reaches
from .derivatives import LocalDerivatives, Numbers
from .plant_models import EQUILIBRIUM

SAME_SLOPES = 1e-9
"""Difference of two derivatives, relative to 1 + the largest, up to which they are the same."""
Past = dict[int, np.ndarray]
"""A quantity as a sum over ticks of the past: number of a tick to the matrix that multiplies the signals there."""


def acts_back(J: Numbers, continuous: np.ndarray, channels: DelayChannels) -> np.ndarray:
    """Return which delays act on which between ticks, (i, j) where j acts on the input of i."""
    A, G = J["dx", "x"][:, continuous], J["dx", "w"][:, channels.outputs]
    C, H = J["z", "x"][np.ix_(channels.inputs, continuous)], J["z", "w"][np.ix_(channels.inputs, channels.outputs)]
    through = ((C != 0.0).astype(int) @ reaches(A).astype(int) @ (G != 0.0).astype(int)) > 0
    return np.asarray(through | (H != 0.0))


class DelayedFlow:
    """The flow of a sampled diagram between the ticks of a period, with transport delays.

    ``J`` are the derivatives between ticks, the same at all of them; ``ticks`` are the times in s of the ticks of a
    period from its first one on.
    """

    def __init__(
        self,
        channels: DelayChannels,
        continuous: np.ndarray,
        J: Numbers,
        ticks: Sequence[Fraction],
        period: Fraction,
    ):
        self.channels, self.ticks, self.period = channels, list(ticks), period
        xc, wd, zd = continuous, channels.outputs, channels.inputs
        m = J["dx", "d"].shape[1]
        rest = np.setdiff1d(np.arange(J["dx", "x"].shape[1]), xc)
        others = np.setdiff1d(np.arange(J["dx", "w"].shape[1]), wd)
        self.held = rest, others, np.arange(m)
        self.continuous = xc
        self.A, self.G = J["dx", "x"][:, xc], J["dx", "w"][:, wd]
        self.B = np.hstack([J["dx", "x"][:, rest], J["dx", "w"][:, others], J["dx", "d"]])
        self.C, self.H = J["z", "x"][np.ix_(zd, xc)], J["z", "w"][np.ix_(zd, wd)]
        self.D = np.hstack([J["z", "x"][np.ix_(zd, rest)], J["z", "w"][np.ix_(zd, others)], J["z", "d"][zd]])
        self.acts = acts_back(J, xc, channels)
        self._refuse_loops()
        self._systems: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._breaks: dict[int, list[Fraction]] = {}
        self._starts: dict[tuple[int, Fraction], Past] = {}

    def check_same(self, J: Numbers) -> None:
        """Refuse derivatives at a later tick that are not those of the first."""
        later = DelayedFlow(self.channels, self.continuous, J, self.ticks, self.period)
        for mine, other in zip(self._matrices(), later._matrices(), strict=True):
            if np.max(np.abs(mine - other), initial=0.0) > SAME_SLOPES * (1.0 + np.max(np.abs(mine), initial=0.0)):
                raise OptionError(
                    "found a transport delay between ticks at which the continuous blocks have different linear "
                    "models; expected one model: a delay's output was its input at an earlier tick. Linearize at rest.",
                    block=self.channels.paths[0],
                )

    def _matrices(self) -> tuple[np.ndarray, ...]:
        return self.A, self.B, self.G, self.C, self.D, self.H

    def _refuse_loops(self) -> None:
        for i in find_loops(self.acts):
            raise OptionError(
                "found that its output acts back on its input between ticks: a continuous loop with a dead time of "
                f"{float(self.channels.times[i]):.6g} s inside a sampled one, which has no model with finitely many "
                "states; expected a tick on the way. Take PadeDelay(delay=…, order=…) in its place, or the continuous "
                "design, diagram.continuous().",
                block=self.channels.paths[i],
            )

    @property
    def width(self) -> int:
        """Number of the signals at a tick: continuous states and what is held."""
        return int(len(self.A) + self.B.shape[1])

    def _ahead(self, i: int) -> list[int]:
        """Return the delays that act on the input of a delay, or all for the continuous states (−1)."""
        return np.flatnonzero(self.acts[i]).tolist() if i >= 0 else list(range(len(self.channels)))

    def _system(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the autonomous system behind the input of a delay, M and its row c; −1 are the continuous states.

        Its states are the continuous ones, the held signals, and those of the systems of the delays ahead.
        """
        if i not in self._systems:
            n, m = self.B.shape
            blocks = [self._system(j) for j in self._ahead(i)]
            size = n + m + sum(len(M) for M, _ in blocks)
            M = np.zeros((size, size), dtype=np.result_type(self.A, self.B, self.G))
            M[:n, :n], M[:n, n : n + m] = self.A, self.B
            c = np.zeros((1, size), dtype=M.dtype)
            if i >= 0:
                c[0, :n], c[0, n : n + m] = self.C[i], self.D[i]
            begin = n + m
            for j, (Mj, cj) in zip(self._ahead(i), blocks, strict=True):
                where = slice(begin, begin + len(Mj))
                M[where, where] = Mj
                M[:n, where] = self.G[:, [j]] @ cj
                if i >= 0:
                    c[0, where] = self.H[i, j] * cj[0]
                begin += len(Mj)
            self._systems[i] = M, c
        return self._systems[i]

    def _breaks_of(self, i: int) -> list[Fraction]:
        """Return the times in a period at which the input of a delay, or the flow (−1), may jump or bend."""
        if i not in self._breaks:
            late = ((b + self.channels.times[j]) % self.period for j in self._ahead(i) for b in self._breaks_of(j))
            self._breaks[i] = sorted({*(t % self.period for t in self.ticks), *late})
        return self._breaks[i]

    def _tick_before(self, t: Fraction) -> tuple[int, Fraction]:
        """Return the number of the last tick up to a time, and its time."""
        whole, inside = divmod(t - self.ticks[0], self.period)
        place = max(k for k, tick in enumerate(self.ticks) if tick - self.ticks[0] <= inside)
        return int(whole) * len(self.ticks) + place, whole * self.period + self.ticks[place]

    def _breaks_between(self, i: int, low: Fraction, high: Fraction) -> Iterator[Fraction]:
        """Yield the times above ``low`` and below ``high`` at which the input of a delay may jump or bend."""
        whole = low // self.period
        while whole * self.period < high:
            yield from (t for b in self._breaks_of(i) if low < (t := b + whole * self.period) < high)
            whole += 1

    def _start(self, i: int, t: Fraction) -> Past:
        """Return the states at a time, from the right, of the system behind the input of a delay."""
        if (i, t) not in self._starts:
            k, time = self._tick_before(t)
            x = {k: np.eye(len(self.A), self.width)}
            for end in [*self._breaks_between(i, time, t), *([t] if t > time else [])]:
                x = self._advance(i, self._join(i, k, time, x), end - time)
                time = end
            self._starts[i, t] = self._join(i, k, t, x)
        return self._starts[i, t]

    def _join(self, i: int, k: int, t: Fraction, x: Past) -> Past:
        """Return the states of a system from the continuous ones at a time after tick k."""
        n, m = self.B.shape
        parts: list[Past] = [x, {k: np.eye(m, self.width, n)}]
        parts += [self._start(j, t - self.channels.times[j]) for j in self._ahead(i)]
        sizes = [n, m, *(len(self._system(j)[0]) for j in self._ahead(i))]
        every = sorted({tick for part in parts for tick in part})
        none = [np.zeros((size, self.width)) for size in sizes]
        return {
            tick: np.vstack([part.get(tick, zero) for part, zero in zip(parts, none, strict=True)]) for tick in every
        }

    def _advance(self, i: int, start: Past, time: Fraction) -> Past:
        """Return the continuous states a time after a start at which nothing jumps."""
        from scipy.linalg import expm

        M, _ = self._system(i)
        n = len(self.A)
        E = np.where(reaches(M), expm(M * float(time)), 0.0)[:n]
        return _without_zeros({tick: E @ value for tick, value in start.items()})

    def end_of(self, place: int) -> Past:
        """Return the continuous states just before the tick after that of this place in the period.

        Numbers of ticks are relative to the place: 0 is this tick, −1 the one before.
        """
        begin = self.ticks[place]
        last = place + 1 == len(self.ticks)
        end = self.ticks[0] + self.period if last else self.ticks[place + 1]
        x, time = {place: np.eye(len(self.A), self.width)}, begin
        for stop in [*self._breaks_between(-1, begin, end), end]:
            x = self._advance(-1, self._join(-1, place, time, x), stop - time)
            time = stop
        return {k - place: value for k, value in x.items()}

    def outputs_at(self, place: int) -> Past:
        """Return the outputs of the delays at the tick of a place in the period; see `end_of`."""
        found: dict[int, np.ndarray] = {}
        for i, tau in enumerate(self.channels.times):
            _, c = self._system(i)
            for k, value in self._start(i, self.ticks[place] - tau).items():
                rows = found.setdefault(k - place, np.zeros((len(self.channels), self.width), dtype=c.dtype))
                rows[i] = (c @ value)[0]
        return _without_zeros(found)

    @cached_property
    def tables(self) -> list[tuple[Past, Past]]:
        """`end_of` and `outputs_at` of all places."""
        return [(self.end_of(place), self.outputs_at(place)) for place in range(len(self.ticks))]


def _without_zeros(past: Past) -> Past:
    return {tick: value for tick, value in past.items() if np.any(value)}


class DelayLine:
    """The states of a model that are signals of the past, and how a tick moves them.

    The line keeps either the held signals and continuous states at the last ticks, or what the past will add to
    continuous states and to outputs of delays at the next ticks, whichever needs fewer states.
    """

    def __init__(self, flow: DelayedFlow, flat: FlatDiagram, injected: Sequence[str]):
        self.flow, n = flow, len(flow.A)
        rows, columns = np.zeros(n + len(flow.channels), dtype=bool), np.zeros(flow.width, dtype=bool)
        self.length = 0
        for whole in flow.tables:
            for begin, past in zip((0, n), whole, strict=True):
                for k, value in past.items():
                    if k < 0:
                        rows[begin : begin + len(value)] |= np.any(value, axis=1)
                        columns |= np.any(value, axis=0)
                        self.length = max(self.length, -k)
        self.ahead = int(rows.sum()) < int(columns.sum())
        self.kept = np.flatnonzero(rows if self.ahead else columns)
        rest, others, _ = flow.held
        states = flat.continuous_labels
        signals = [*states, *(flat.labels[i] for i in rest), *(flat.plant_outputs.labels[i] for i in others), *injected]
        names = [*states, *flow.channels.labels] if self.ahead else signals
        word = "coming" if self.ahead else "past"
        self.labels = [f"{word}({names[i]}, {k + 1})" for k in range(self.length) for i in self.kept]

    def __len__(self) -> int:
        return len(self.labels)

    def _rows_of(self, place: int, lag: int) -> np.ndarray:
        """Return what the signals of a tick add, ``lag`` ticks later, to the kept rows at the tick of a place."""
        end, out = self.flow.tables[place % len(self.flow.tables)]
        zero = np.zeros((len(self.flow.A), self.flow.width)), np.zeros((len(self.flow.channels), self.flow.width))
        return np.vstack([end.get(-lag, zero[0]), out.get(-lag, zero[1])])

    def _read(self, place: int) -> np.ndarray:
        """Return what the line adds to the continuous states at the end of the flow, and to the outputs of delays."""
        if self.ahead or not self.length:
            found = np.zeros((len(self.flow.A) + len(self.flow.channels), len(self)), dtype=self.flow.A.dtype)
            found[self.kept, np.arange(len(self.kept))] = 1.0
            return found
        return np.hstack([self._rows_of(place, k + 1)[:, self.kept] for k in range(self.length)])

    def outputs(self, place: int) -> np.ndarray:
        """Return the matrix from the line to the outputs of the delays at the tick of a place in the period."""
        return self._read(place)[len(self.flow.A) :]

    def signals(self, x: Slopes, W: np.ndarray) -> Slopes:
        """Return the signals of a tick: the continuous states after it, and what is held until the next one.

        ``x`` are all states after the tick, W are the outputs of FMUs.
        """
        rest, others, injected = self.flow.held
        xc, m = self.flow.continuous, len(injected)
        by_state = np.vstack([x.by_state[xc], x.by_state[rest], W[others], np.zeros((m, W.shape[1]))])
        by_d = np.vstack([x.by_d[xc], x.by_d[rest], np.zeros((len(others), m)), np.eye(m)])
        return Slopes(by_state, by_d)

    def flow_over(self, place: int, signals: Slopes) -> Slopes:
        """Return the continuous states at the end of the flow."""
        now = self.flow.tables[place][0].get(0, np.zeros((len(self.flow.A), self.flow.width)))
        found: Slopes = now @ signals
        found.by_state[:, found.by_state.shape[1] - len(self) :] += self._read(place)[: len(self.flow.A)]
        return found

    def move(self, place: int, signals: Slopes) -> Slopes:
        """Return the line at the next tick."""
        m, size = len(self.kept), len(self)
        if self.ahead and self.length:
            new = np.vstack([self._rows_of(place + 1 + k, k + 1)[self.kept] for k in range(self.length)])
        else:
            new = np.zeros((size, self.flow.width))
            new[np.arange(min(m, size)), self.kept[: min(m, size)]] = 1.0
        found: Slopes = new @ signals
        found.by_state[:, found.by_state.shape[1] - size :] += np.eye(size, k=m if self.ahead else -m)
        return found


def find_steady_slopes(
    local: LocalDerivatives, channels: DelayChannels, t: float, x: np.ndarray, w: np.ndarray
) -> Numbers:
    """Return the derivatives between ticks, which must be constant: a delay puts out its input of another instant."""
    J = local.differentiate(NONE, t, x, w)
    moves = np.max(np.abs(np.real(J["dx"])) / (1.0 + np.abs(x[local.flat.continuous])), initial=0.0) > EQUILIBRIUM
    if moves and not local.has_constant_slopes:
        raise OptionError(
            "found a transport delay in a nonlinear plant that is not at rest; expected a point at rest, or linear "
            "blocks: a delay's output was its input at an earlier point, with other slopes. Linearize at rest, with "
            "diagram.trim(…) or at a later t.",
            block=channels.paths[0],
            t=t,
        )
    return J
