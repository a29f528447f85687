"""Linear models of random diagrams, against matrices made from the wiring alone."""

from dataclasses import dataclass
from math import lcm

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.linalg import block_diag, expm

from loopwright.blocks import Constant, DiscreteStateSpace, Function, Gain, StateSpace
from loopwright.diagrams import Diagram, subsystem
from support.linear import by_simulation
from support.random_cases import random_cases

NEAR = 1e-10
seeds = st.integers(0, 2**32 - 1)


def close(got, want, bound=NEAR):
    """To so much of the largest entry."""
    assert got.shape == want.shape
    assert np.max(np.abs(got - want), initial=0.0) <= bound * max(np.max(np.abs(want), initial=0.0), 1e-3)


def mixer(blocks_of, name):
    """A block that puts out the sum of its inputs, each times a matrix."""
    names = tuple(f"a{i}" for i in range(len(blocks_of)))
    return Function(
        lambda *given: sum(K @ a for K, a in zip(blocks_of, given, strict=True)), arguments=names, name=name
    )


@dataclass
class Node:
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray


class Net:
    """Linear systems whose inputs are matrices times the outputs of all of them, u = K y."""

    def __init__(self, seed, *, loops=False, radius=0.6):
        r = np.random.default_rng(seed)
        self.n = int(r.integers(3, 6))
        self.ins, self.outs, orders = (r.integers(1, 3, self.n) for _ in range(3))
        self.nodes = []
        for n, m, p in zip(orders, self.ins, self.outs, strict=True):
            A = r.normal(size=(n, n))
            A *= radius / max(np.max(np.abs(np.linalg.eigvals(A))), 0.1)
            D = r.normal(size=(p, m)) * 0.3 * float(loops or r.random() < 0.5)
            self.nodes.append(Node(A, r.normal(size=(n, m)), r.normal(size=(p, n)), D))
        self.K = [[r.normal(size=(m, p)) * 0.5 for p in self.outs] for m in self.ins]
        if not loops:  # what feeds through acts only on what comes later
            for j, node in enumerate(self.nodes):
                if np.any(node.D):
                    for i in range(j + 1):
                        self.K[i][j] = np.zeros_like(self.K[i][j])

    def wire(self, kind, sources=None):
        """Return the call of every node."""
        boxes = [kind(A=v.A, B=v.B, C=v.C, D=v.D, name=f"n{i}") for i, v in enumerate(self.nodes)]
        outs = [box.y for box in boxes]
        calls = []
        for i, box in enumerate(boxes):
            used = [j for j in range(self.n) if np.any(self.K[i][j])]
            if not used:
                calls.append(box(Constant(value=np.zeros(self.ins[i]), name=f"zero{i}")))
                continue
            calls.append(box(mixer([self.K[i][j] for j in used], f"u{i}")(*(outs[j] for j in used))))
        return calls

    @property
    def whole(self):
        """All nodes side by side, and K."""
        A, B, C, D = (block_diag(*(getattr(v, name) for v in self.nodes)) for name in "ABCD")
        return A, B, C, D, np.block(self.K)

    def entries(self, *which):
        first = np.cumsum([0, *self.outs])
        return [int(e) for i in which for e in range(first[i], first[i + 1])]

    def model(self, cut=()):
        """A, B, C, D from what is added to the outputs y, ahead of the consumers, to y; entries ``cut`` cut."""
        A, B, C, D, K = self.whole
        S = np.diag([0.0 if e in self.entries(*cut) else 1.0 for e in range(len(C))])
        R = np.linalg.inv(np.eye(len(C)) - D @ K @ S)
        y_x, y_d = R @ C, R @ D @ K
        return A + B @ K @ S @ y_x, B @ K @ (S @ y_d + np.eye(len(C))), y_x, y_d

    @property
    def wires(self):
        return [f"n{i}.y" for i in range(self.n)]


def check(lin, want):
    for got, expected in zip((lin.A, lin.B, lin.C, lin.D), want, strict=True):
        close(got, expected)


def all_of(net, diagram, **options):
    check(diagram.linearize(inputs=net.wires, outputs=net.wires, **options), net.model())
    check(diagram.linearize(inputs=net.wires, outputs=net.wires, openings="n0.y", **options), net.model(cut=(0,)))
    cut = diagram.linearize(inputs="n1.y", outputs="n1.y", openings=["n0.y", "n1.y"], **options)
    A, B, C, D = net.model(cut=(0, 1))
    e = net.entries(1)
    check(cut, (A, B[:, e], C[e], D[np.ix_(e, e)]))


@random_cases(2, 30, seeds, fresh=True)
def test_continuous_diagrams(seed):
    net = Net(seed)
    diagram = Diagram("net", *net.wire(StateSpace))
    all_of(net, diagram)
    lin = diagram.linearize()
    assert lin.dt == 0.0
    assert lin.is_equilibrium
    close(np.poly(lin.poles), np.poly(net.model()[0]))


@random_cases(2, 30, seeds, fresh=True)
def test_sampled_diagrams(seed):
    net = Net(seed)
    diagram = Diagram("net", sampled(net)())
    all_of(net, diagram)
    assert diagram.linearize().dt == 0.01


def sampled(net):
    @subsystem(sample_time=0.01)
    def box():
        return net.wire(DiscreteStateSpace)[-1]

    return box


@random_cases(2, 30, seeds, fresh=True)
def test_solved_algebraic_loops(seed):
    net = Net(seed, loops=True)
    all_of(net, Diagram("net", *net.wire(StateSpace), loops="solve"))
    all_of(net, Diagram("net", sampled(net)(), loops="solve"))


# --- a plant, and sampled boxes around it -------------------------------------------------------------------------------


class Loop:
    """A continuous plant, and sampled controllers between its outputs and its inputs, each with its own ticks."""

    def __init__(self, seed, clocks):
        r = np.random.default_rng(seed)
        self.clocks, self.base = clocks, 1e-2
        n = int(r.integers(2, 5))
        self.m = len(clocks)
        self.A, self.B, self.C = r.normal(size=(n, n)), r.normal(size=(n, self.m)), r.normal(size=(self.m, n))
        self.boxes = []
        for _ in clocks:
            k = int(r.integers(1, 3))
            self.boxes.append(
                Node(0.5 * r.normal(size=(k, k)), r.normal(size=(k, 1)), r.normal(size=(1, k)), r.normal(size=(1, 1)))
            )

    def diagram(self, deep=False, bend=None):
        """Return the diagram; with a function ``bend`` its forces go through it, and it does not begin at rest."""
        start = 0.0 if bend is None else np.linspace(0.5, 1.5, len(self.A))
        plant = StateSpace(A=self.A, B=self.B, C=self.C, initial_state=start, name="plant")
        forces = []
        for i, ((every, offset), v) in enumerate(zip(self.clocks, self.boxes, strict=True)):
            block = DiscreteStateSpace(A=v.A, B=v.B, C=v.C, D=v.D, name="c")

            @subsystem(sample_time=round(every * self.base, 9), offset=round(offset * self.base, 9), name=f"box{i}")
            def box(y, block=block):
                if bend is not None:
                    return Function(bend, name="bend")(block(y))
                if not deep:
                    return block(y)

                @subsystem(name="inner")
                def inner(u):
                    return Gain(gain=1.0, name="one")(block(u))

                return inner(y)

            forces.append(box(plant.y[i : i + 1]).named(f"u{i}"))
        total = mixer([np.eye(self.m)[:, [i]] for i in range(self.m)], "all")(*forces)
        call = plant(total if bend is None else Function(lambda f: f + 0.1 * f**2, name="curve")(total))
        return Diagram("loop", call)

    def model(self, cut=()):
        """Over the least common period: from what is added to the forces u, to u at the first tick."""
        n, sizes = len(self.A), [len(v.A) for v in self.boxes]
        held = n + sum(sizes)
        width = held + self.m
        big = np.zeros((n + self.m, n + self.m))
        big[:n] = np.hstack([self.A, self.B])
        flow = expm(big * self.base)[:n]
        period = lcm(*(every for every, _ in self.clocks))
        M, N = np.eye(width), np.zeros((width, self.m))
        C, D = np.zeros((self.m, width)), np.zeros((self.m, self.m))
        for k in range(period):
            T, at = np.eye(width), n
            for i, ((every, offset), v) in enumerate(zip(self.clocks, self.boxes, strict=True)):
                mine = slice(at, at + sizes[i])
                at += sizes[i]
                if (k - offset) % every:
                    continue
                T[mine] = 0
                T[mine, mine], T[mine, :n] = v.A, v.B @ self.C[[i]]
                T[held + i] = 0
                T[[held + i], mine], T[[held + i], :n] = v.C, v.D @ self.C[[i]]
            if k == 0:
                C = T[held:]
            S = np.diag([0.0 if i in cut else 1.0 for i in range(self.m)])
            F = np.eye(width)
            F[:n, :n], F[:n, held:] = flow[:, :n], flow[:, n:] @ S
            G = np.zeros((width, self.m))
            G[:n] = flow[:, n:]
            M, N = F @ T @ M, F @ T @ N + G
        return M, N, C, D

    def check(self, cut=(), deep=False):
        wires = [f"u{i}" for i in range(self.m)]
        lin = self.diagram(deep).linearize(inputs=wires, outputs=wires, openings=[f"u{i}" for i in cut])
        M, N, C, D = self.model(cut)
        x, y = N, lin.B
        close(lin.D, D)
        for _ in range(12):  # the states are chosen differently; what goes out is not
            close(lin.C @ y, C @ x)
            x, y = M @ x, lin.A @ y
            scale = max(1.0, np.max(np.abs(x)))
            x, y = x / scale, y / scale
        assert lin.dt == pytest.approx(self.base * lcm(*(every for every, _ in self.clocks)), rel=1e-15)
        own = [s for s in lin.states if not s.startswith("held(")]
        assert len(own) == len(self.A) + sum(len(v.A) for v in self.boxes)
        return lin, M


@random_cases(3, 30, seeds, st.booleans(), fresh=True)
def test_a_sampled_controller_around_a_continuous_plant(seed, deep):
    loop = Loop(seed, [(1, 0)])
    lin, M = loop.check(deep=deep)
    loop.check(cut=(0,))
    n = len(lin.A)
    close(np.poly(lin.A), np.poly(M)[: n + 1])
    # the very matrices, in the states' own order: block "box0.…c", then the plant
    order = [n - len(loop.A) + i for i in range(len(loop.A))] + list(range(n - len(loop.A)))
    close(lin.A[np.ix_(order, order)], M[:n, :n] + 0.0)


RATES = st.lists(st.integers(1, 4), min_size=2, max_size=3).flatmap(
    lambda every: st.tuples(*(st.tuples(st.just(e), st.integers(0, e - 1)) for e in every))
)


@pytest.mark.slow
@random_cases(3, 30, seeds, RATES, fresh=True)
def test_several_rates_and_offsets(seed, clocks):
    loop = Loop(seed, clocks)
    for cut in ((0,), (0, 1)):
        loop.check(cut)
    lin, M = loop.check()
    poles, want = np.poly(lin.A), np.poly(M)
    close(poles, want[: len(poles)], 1e-9)


@pytest.mark.slow
@random_cases(2, 30, seeds, fresh=True)
def test_the_poles_do_not_depend_on_the_tick_at_which_the_period_begins(seed):
    diagram = Loop(seed, [(2, 1), (3, 0)]).diagram()
    found = [diagram.linearize(k * 1e-2, step=1e-2).A for k in range(6)]
    want = np.poly(found[0])
    for A in found[1:]:
        size = min(len(A), len(found[0])) + 1
        close(np.poly(A)[:size], want[:size], 1e-9)


@pytest.mark.slow
@random_cases(2, 12, seeds, RATES, st.integers(0, 3), fresh=True)
def test_bent_ones_on_the_move_against_differences_of_the_simulation(seed, clocks, k):
    diagram = Loop(seed, clocks).diagram(bend=np.sin)
    t = k * float(diagram.flatten().base)
    period = float(lcm(*(every for every, _ in clocks))) * 1e-2
    A, moved = by_simulation(diagram, t, period)
    lin = diagram.linearize(t, rtol=1e-11, atol=1e-13)
    everything = diagram.flatten().labels
    keep = [everything.index(name) for name in lin.states]
    gone = [i for i in range(len(A)) if i not in keep]
    close(lin.A, A[np.ix_(keep, keep)], 1e-7)
    close(lin.affine, moved[keep], 1e-7)
    assert np.abs(A[np.ix_(keep, gone)]).max(initial=0.0) < 1e-9
    assert not lin.is_equilibrium


# --- boxes that are enabled ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("T", [None, 0.01], ids=["continuous", "sampled"])
@pytest.mark.parametrize("on", [0.0, 1.0])
@random_cases(3, 30, seed=seeds, fresh=True)
def test_an_enabled_box_counts_as_it_is_at_the_operating_point(T, on, seed):
    net, kind = Net(seed), StateSpace if T is None else DiscreteStateSpace
    first, second = net.nodes[:2]
    K = [np.random.default_rng(seed).normal(size=s) for s in ((net.ins[1], net.outs[0]), (net.ins[0], net.outs[1]))]

    @subsystem(enabled="held")
    def gated(u):
        return kind(A=second.A, B=second.B, C=second.C, name="second")(mixer([K[0]], "in")(u))

    @subsystem(sample_time=T)
    def around(switch):
        a = kind(A=first.A, B=first.B, C=first.C, name="first")
        back = gated(a.y.named("y"), enable=switch).named("v")
        return a(mixer([K[1]], "out")(back))

    lin = Diagram("d", around(Constant(value=on))).linearize(inputs="y", outputs=["y", "v"])
    n1, n2 = len(first.A), len(second.A)
    idle = np.zeros_like(second.A) if T is None else np.eye(n2)
    A = np.block(
        [
            [first.A, first.B @ K[1] @ second.C * on],
            [second.B @ K[0] @ first.C * on, second.A if on else idle],
        ]
    )
    B = np.vstack([np.zeros((n1, net.outs[0])), second.B @ K[0] * on])
    C = block_diag(first.C, second.C * on)
    own = [lin.states.index(s) for s in lin.states if not s.startswith("held")]
    order = sorted(own, key=lambda i: "second" in lin.states[i])
    close(lin.A[np.ix_(order, order)], A)
    close(lin.B[order], B)
    close(lin.C[:, order], C)
