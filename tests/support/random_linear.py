"""Random linear diagrams as plain data; one reading of the data makes a diagram, the other one block matrices."""

from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cache, partial
from itertools import pairwise
from typing import Any

import numpy as np
from hypothesis import strategies as st
from scipy.linalg import expm

from loopwright.blocks import (
    Constant,
    Delay,
    DiscreteStateSpace,
    Gain,
    Integrator,
    Sine,
    StateSpace,
    Sum,
    TransferFunction,
    UnitDelay,
)
from loopwright.diagrams import Diagram, subsystem

BASE, PERIOD = 0.01, 30  # s of a tick; ticks after which all clocks have come round
CLOCKS = [(n, d) for n in (2, 3, 5, 6) for d in (0, 0, 1)]  # sample time and offset in ticks; the offset mostly none


@dataclass(frozen=True)
class Node:
    """A block: where it stands, what drives it, and its numbers."""

    kind: str
    frame: int
    size: int | None  # entries of its output, None for a scalar
    sources: tuple[tuple[int, Any], ...] = ()  # block and part of its output (None: all of it)
    numbers: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Spec:
    """A diagram: boxes as (box around, clock or None), box 0 is the diagram itself."""

    boxes: tuple[tuple[int, Any], ...]
    nodes: tuple[Node, ...]

    def clock(self, frame):
        """Return the clock of a box: its own, or that of the nearest box around it."""
        while frame and self.boxes[frame][1] is None:
            frame = self.boxes[frame][0]
        return self.boxes[frame][1]

    def flattened(self):
        """Return the same without nesting: one box for each clock."""
        clocks = sorted({self.clock(n.frame) for n in self.nodes} - {None})
        places = {None: 0, **{c: i + 1 for i, c in enumerate(clocks)}}
        nodes = tuple(replace(n, frame=places[self.clock(n.frame)]) for n in self.nodes)
        return Spec(((0, None), *((0, c) for c in clocks)), nodes)

    def scaled(self, factor):
        """Return the same with every gain made smaller."""
        weaker = [{k: v * factor if k in ("K", "B", "D") else v for k, v in n.numbers.items()} for n in self.nodes]
        return replace(self, nodes=tuple(replace(n, numbers=w) for n, w in zip(self.nodes, weaker, strict=True)))


# --- drawing -----------------------------------------------------------------------------------------------------------

SOURCES, DIRECT = ("constant", "sine"), ("gain", "matrix", "sum", "direct")  # outputs of DIRECT need their inputs
ANYWHERE = ("gain", "matrix", "sum", "direct", "strict", "lag", "integrator", *SOURCES)
SAMPLED = ("delay", "delays", "discrete")


@st.composite
def specs(draw, least=3, most=40, clocked=True, continuous=True):
    """Draw a diagram of at most so many blocks."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    boxes, outermost = [(0, None)], 0
    if not continuous:  # everything stands in one box that is sampled
        boxes, outermost = [*boxes, (0, draw(st.sampled_from(CLOCKS)))], 1
    for _ in range(draw(st.integers(0, 6))):
        options = [None, *(CLOCKS if clocked else [])]
        boxes.append((draw(st.integers(outermost, len(boxes) - 1)), draw(st.sampled_from(options))))
    count = draw(st.integers(least, most - 1))
    spec = Spec(tuple(boxes), ())
    nodes = [Node("constant", outermost, 3, (), {"value": rng.uniform(-1, 1, 3)}), sine(outermost, rng)]
    kinds = []
    while len(kinds) < count - 2:  # a sum is two of them: one more at most
        frame = draw(st.integers(outermost, len(boxes) - 1))
        kind = draw(st.sampled_from(ANYWHERE + (SAMPLED * 2 if spec.clock(frame) else ())))
        size = None if kind in ("sine", "lag") else draw(st.sampled_from([None, None, 2, 3]))
        if kind == "matrix" and size is None:
            kind = "gain"
        kinds.append((kind, frame, size))
        if kind == "sum":  # others take the gain behind it, so that every loop with a sum has a gain to be made smaller
            kinds.append(("gain of a sum", frame, size))
    every = [("constant", outermost, 3), ("sine", outermost, None), *kinds]
    for i, (kind, frame, size) in enumerate(kinds, 2):
        if kind in SOURCES:
            made = sine(frame, rng) if kind == "sine" else Node(kind, frame, size, (), {"value": normal(rng, size)})
            nodes.append(made)
            continue
        if kind == "gain of a sum":
            nodes.append(Node("gain", frame, size, ((i - 1, None),), {"K": rng.uniform(-1, 1)}))
            continue
        direct = (*DIRECT, "gain of a sum")  # these need their inputs at once: no loop of them alone
        allowed = [
            j
            for j, (other, _, _) in enumerate(every)
            if other != "sum" and (j < i or kind not in direct or other not in direct)
        ]

        def pick(wanted, allowed=allowed):
            fits = [j for j in allowed if wanted is None or (every[j][2] or 0) >= wanted]
            j = fits[draw(st.integers(0, len(fits) - 1))]
            have = every[j][2]
            if have == wanted:
                return j, None
            return j, int(rng.integers(have)) if wanted is None else slice(0, wanted)

        width = size  # entries of the input
        if kind in ("matrix", "direct", "strict", "discrete"):
            width = draw(st.sampled_from([None, 2, 3] if kind != "matrix" else [2, 3]))
        number = draw(st.integers(2, 4)) if kind == "sum" else 1
        nodes.append(
            Node(kind, frame, size, tuple(pick(width) for _ in range(number)), numbers(kind, size, width, number, rng))
        )
    return Spec(tuple(boxes), tuple(nodes))


def normal(rng, size):
    return float(rng.normal()) if size is None else rng.normal(size=size)


def sine(frame, rng):
    return Node(
        "sine", frame, None, (), {"frequency": rng.uniform(0.1, 3), "phase": rng.uniform(0, 6), "amplitude": 1.0}
    )


def numbers(kind, size, width, number, rng):
    """Draw the parameters of a block; matrices have the shapes that its class takes for scalars and vectors."""
    n = int(rng.integers(1, 4))
    rows, columns = () if size is None else (size,), () if width is None else (width,)
    if kind == "gain":
        return {"K": rng.uniform(-1, 1, rows) if rng.random() < 0.5 else rng.uniform(-1, 1)}
    if kind == "matrix":
        return {"K": rng.uniform(-1, 1, (size, width))}
    if kind == "sum":
        return {"signs": "".join(rng.choice(["+", "-"], number))}
    if kind == "lag":
        poles = [-rng.uniform(0.5, 10)] if n == 1 else [complex(-rng.uniform(0.5, 3), rng.uniform(1, 10))]
        return {"a": np.real(np.poly([*poles, *np.conj(poles[: n > 1])])), "B": rng.uniform(-2, 2, max(1, min(n, 2)))}
    if kind in ("strict", "direct", "discrete"):
        A = rng.normal(size=(n, n))
        largest = max(np.max(np.linalg.eigvals(A).real), -10.0)
        A = (
            A / (1.05 * np.max(np.abs(np.linalg.eigvals(A))))
            if kind == "discrete"
            else 3 * (A - (largest + 0.2) * np.eye(n))
        )
        D = 0.0 if kind == "strict" else rng.uniform(-1, 1, rows + columns)
        if kind == "discrete":
            D = 0.0
        return {
            "A": A,
            "B": rng.normal(size=(n, *columns)),
            "C": rng.normal(size=(*rows, n)),
            "D": D,
            "x": rng.normal(size=n),
        }
    made = {"x": normal(rng, size)}
    return {**made, "steps": int(rng.integers(2, 5))} if kind == "delays" else made


# --- the diagram -------------------------------------------------------------------------------------------------------


def block(i, node):
    """Return the block of a node."""
    v, name = node.numbers, f"b{i}"
    match node.kind:
        case "constant":
            return Constant(value=v["value"], name=name)
        case "sine":
            return Sine(frequency=v["frequency"], phase=v["phase"], amplitude=v["amplitude"], name=name)
        case "gain" | "matrix":
            return Gain(gain=v["K"], name=name)
        case "sum":
            return Sum(signs=v["signs"], name=name)
        case "lag":
            return TransferFunction(numerator=v["B"], denominator=v["a"], name=name)
        case "strict" | "direct" | "discrete":
            cls = DiscreteStateSpace if node.kind == "discrete" else StateSpace
            return cls(A=v["A"], B=v["B"], C=v["C"], D=v["D"], initial_state=v["x"], name=name)
        case "integrator":
            return Integrator(initial_value=v["x"], name=name)
        case "delay":
            return UnitDelay(initial_value=v["x"], name=name)
    return Delay(steps=v["steps"], initial_value=v["x"], name=name)


def diagram(spec, order=None, borders=True):
    """Build the diagram.

    Parameters
    ----------
    order : Generator, optional
        Shuffles in which order everything is defined, called and given to the diagram.
    borders : bool
        Whether signals cross the borders of boxes by their inputs and outputs, else straight.
    """
    count = len(spec.nodes)

    def shuffled(items):
        return list(items) if order is None else [items[k] for k in order.permutation(len(items))]

    blocks = {i: block(i, spec.nodes[i]) for i in shuffled(range(count))}
    within = {f: {i for i in range(count) if spec.nodes[i].frame == f} for f in range(len(spec.boxes))}
    for f in reversed(range(1, len(spec.boxes))):
        within[spec.boxes[f][0]] |= within[f]  # with everything in the boxes inside

    def inside(frame, /, **signals):
        fill(frame, {int(k[1:]): s for k, s in signals.items()})
        return {f"o{k}": blocks[k].y for k in sorted(within[frame])} if borders else ()

    def fill(frame, given):
        """Call what stands in a frame, with the signals that its inputs give; return the calls."""
        at_hand, calls = dict(given), []
        inner = [("box", f) for f in range(1, len(spec.boxes)) if spec.boxes[f][0] == frame]
        own = [("block", i) for i in range(count) if spec.nodes[i].frame == frame]
        for what, i in shuffled(own + inner):
            if what == "block":
                signals = (at_hand.get(j, blocks[j].y) for j, _ in spec.nodes[i].sources)
                parts = [
                    s if part is None else s[part] for s, (_, part) in zip(signals, spec.nodes[i].sources, strict=True)
                ]
                calls.append(blocks[i](*parts))
                continue
            needed = sorted({j for k in within[i] for j, _ in spec.nodes[k].sources} - within[i]) if borders else []
            clock = spec.boxes[i][1]
            rate = {} if clock is None else {"sample_time": Fraction(clock[0], 100), "offset": Fraction(clock[1], 100)}
            made = subsystem(name=f"box{i}", **rate)(partial(inside, i))
            call = made(**{f"s{j}": at_hand.get(j, blocks[j].y) for j in needed})
            calls.append(call)
            if borders:
                at_hand.update({k: getattr(call, f"o{k}") for k in within[i]})
        return calls

    return Diagram("random", *fill(0, {}))


# --- the oracle --------------------------------------------------------------------------------------------------------


class Matrices:
    """The same as linear maps of one vector z: the blocks' states, all outputs as held, and 1.

    At an instant y = G z + F u, u = W y, where an output that is held is its own row of z. A tick is a matrix, what lies
    between two of them a matrix exponential.
    """

    def __init__(self, spec):
        self.spec, nodes = spec, spec.nodes
        parts = [matrices(n) for n in nodes]
        self.clocks = [spec.clock(n.frame) for n in nodes]
        self.parts = [
            sampled(p, c[0] * BASE) if c is not None and n.kind not in (*SAMPLED, "sine") else p
            for p, c, n in zip(parts, self.clocks, nodes, strict=True)
        ]
        self.quiet = not set(self.clocks) - {None}
        self.x, self.y = slices(len(p[0]) for p in parts), slices(len(p[2]) for p in parts)
        n, m = self.x[-1].stop, self.y[-1].stop
        self.n, self.m, self.total = n, m, n + m + 1
        self.held = slice(n, n + m)
        self.wiring = []
        for node in nodes:
            W = []
            for j, part in node.sources:
                rows = np.atleast_1d(np.arange(m)[self.y[j]][slice(None) if part is None else part])
                W.append(np.eye(m)[rows])
            self.wiring.append(np.vstack(W) if W else np.zeros((0, m)))
        self.between, self.at_tick, self.output = map(cache, (self.between, self.at_tick, self.output))
        self.z0 = np.zeros(self.total)
        self.z0[-1] = 1.0
        for where, (_, _, _, _, x0) in zip(self.x, parts, strict=True):
            self.z0[where] = x0
        self.z0[self.held] = self.output(None) @ self.z0  # until its first tick a box gives what it gives at the start

    def acts(self, i, acting):
        """Whether a block is evaluated; ``acting`` holds the clocks that tick, None means all."""
        return acting is None or self.clocks[i] is None or self.clocks[i] in acting

    def output(self, acting):
        """Return Y: y = Y z."""
        G, F = np.zeros((self.m, self.total)), np.zeros((self.m, self.m))
        for i, (_, _, C, D, _) in enumerate(self.parts):
            rows = self.y[i]
            if self.acts(i, acting):
                G[rows, self.x[i]] = C
                F[rows] = D @ self.wiring[i]
            else:
                G[rows, self.held] = np.eye(self.m)[rows]
            if self.spec.nodes[i].kind == "constant" and self.acts(i, acting):
                G[rows, -1] = self.spec.nodes[i].numbers["value"]
        return np.linalg.solve(np.eye(self.m) - F, G)

    def at_tick(self, acting):
        """Return the matrix of a tick."""
        Y, M = self.output(acting), np.eye(self.total)
        M[self.held] = Y
        for i, (A, B, *_) in enumerate(self.parts):
            if self.clocks[i] in acting and self.spec.nodes[i].kind != "sine":
                M[self.x[i]] = B @ self.wiring[i] @ Y
                M[self.x[i], self.x[i]] += A
        return M

    def rates(self):
        """Return the matrix of what happens between ticks."""
        Y, M = self.output(frozenset()), np.zeros((self.total, self.total))
        for i, (A, B, *_) in enumerate(self.parts):
            if self.clocks[i] is None or self.spec.nodes[i].kind == "sine":
                M[self.x[i]] = B @ self.wiring[i] @ Y
                M[self.x[i], self.x[i]] += A
        return M

    def between(self, ticks):
        """Return the matrix of so many ticks' time."""
        return expm(self.rates() * BASE * ticks)

    def acting(self, k):
        return frozenset(c for c in set(self.clocks) - {None} if k >= c[1] and (k - c[1]) % c[0] == 0)

    def visited(self, last):
        """Return the ticks at which something acts, and the last one; all of them where nothing ever does."""
        return [k for k in range(last + 1) if self.quiet or self.acting(k) or k in (0, last)]

    def run(self, last):
        """Return the ticks that are visited, and all outputs there."""
        z, outputs, before = self.z0, [], 0
        ticks = self.visited(last)
        for k in ticks:
            z = self.between(k - before) @ z if k > before else z
            outputs.append(self.output(self.acting(k)) @ z)
            z, before = self.at_tick(self.acting(k)) @ z, k
        return ticks, np.array(outputs)

    def growth(self):
        """Return by how much the slowest mode grows at most from one coming round of the clocks to the next."""
        M, before = np.eye(self.total), 0
        for k in [k for k in range(PERIOD, 2 * PERIOD) if self.acting(k)] + [2 * PERIOD]:
            M = self.between(k - max(before, PERIOD)) @ M if k > max(before, PERIOD) else M
            M, before = self.at_tick(self.acting(k)) @ M if k < 2 * PERIOD else M, k
        return np.max(np.abs(np.linalg.eigvals(M)))


def slices(sizes):
    edges = np.cumsum([0, *sizes])
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]


def matrices(node):
    """Return (A, B, C, D, x0) of a block on flat vectors, in continuous time (of `SAMPLED` ones, the recurrence)."""
    v, p = node.numbers, node.size or 1
    none = np.zeros((0, 0))
    if node.kind == "constant":
        return none, np.zeros((0, 0)), np.zeros((p, 0)), np.zeros((p, 0)), []
    if node.kind == "sine":
        w = 2 * np.pi * v["frequency"]
        start = v["amplitude"] * np.array([np.sin(v["phase"]), np.cos(v["phase"])])
        return np.array([[0, w], [-w, 0]]), np.zeros((2, 0)), np.array([[1.0, 0]]), np.zeros((1, 0)), start
    if node.kind in ("gain", "matrix"):
        K = v["K"] if node.kind == "matrix" else np.diag(np.broadcast_to(v["K"], (p,)))
        return none, np.zeros((0, K.shape[1])), np.zeros((p, 0)), K, []
    if node.kind == "sum":
        D = np.hstack([np.eye(p) * (1 if s == "+" else -1) for s in v["signs"]])
        return none, np.zeros((0, D.shape[1])), np.zeros((p, 0)), D, []
    if node.kind == "lag":  # observable canonical form
        a, n = v["a"][1:] / v["a"][0], len(v["a"]) - 1
        A = np.hstack([-a[:, None], np.eye(n)[:, : n - 1]])
        B = np.concatenate([np.zeros(n - len(v["B"])), v["B"]])[:, None] / v["a"][0]
        return A, B, np.eye(n)[:1], np.zeros((1, 1)), np.zeros(n)
    if node.kind in ("strict", "direct", "discrete"):
        n = len(v["A"])
        B, C = v["B"].reshape(n, -1), v["C"].reshape(-1, n)
        D = np.zeros((p, B.shape[1])) + np.reshape(v["D"], (p, -1) if np.ndim(v["D"]) else np.shape(v["D"]))
        return v["A"], B, C, D, v["x"]
    x, eye, zero = np.atleast_1d(v["x"]), np.eye(p), np.zeros((p, p))
    if node.kind == "integrator":
        return zero, eye, eye, zero, x
    steps = v.get("steps", 1)  # the oldest first
    A = np.eye(steps * p, k=p)
    return A, np.eye(steps * p)[:, -p:], np.eye(steps * p)[:p], zero, np.tile(x, steps)


def sampled(part, T):
    """Return a block with its input held: the exponential of one block matrix."""
    A, B, C, D, x0 = part
    n, m = B.shape
    both = expm(np.vstack([np.hstack([A, B]), np.zeros((m, n + m))]) * T) if n + m else np.zeros((0, 0))
    return both[:n, :n], both[:n, n:], C, D, x0
