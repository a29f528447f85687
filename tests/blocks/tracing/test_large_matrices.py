"""A product with a large matrix is one operation: it is built quickly, and gives what NumPy and SciPy give."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Block, Constant, Gain, Input, Output, StateSpace, parameter
from loopwright.blocks.tracing import has_large_product, trace
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.linearization import StepsOnly
from loopwright.types import Array

N = 500
FEW = 50
"""Operations of a block with one large matrix; entry by entry there were 250,000 (benchmarks/matrices.py has times)."""


def matrix(seed=0, n=N):
    """Return a stable matrix; its one exact zero stands where no other seed has it, so that no trace is shared."""
    made = -np.eye(n) + np.random.default_rng(seed).standard_normal((n, n)) * 0.1 / np.sqrt(n)
    made[0, 1 + seed] = 0.0
    return made


CLOSED_OVER = matrix()


class Closed(Block):
    """y = A u with a matrix of the module."""

    u = Input(shape=(N,))
    y = Output(shape=(N,))

    def output(self, t, x, u):
        return CLOSED_OVER @ u.u


class Own(Block):
    """y = A ⌊u⌋ + 1, or A u + 1."""

    A: Array = parameter(description="A")
    whole: bool = parameter(default=False, description="whether u is rounded down")
    u = Input(shape=None)
    y = Output(shape=None)

    def output(self, t, x, u):
        return self.A @ (np.floor(u.u) if self.whole else u.u) + 1.0


def state_space(A):
    return StateSpace(A=A, B=np.ones(len(A)), C=np.ones(len(A)) / len(A), name="s")


def held(A):
    @subsystem(sample_time=0.01)
    def controller(r):
        return state_space(A)(r)

    return Diagram("held", Gain(gain=1.0)(controller(Constant(value=1.0)).named("y")))


def count_operations(diagram):
    """Count the operations of all blocks but sources."""
    return sum(t.function.n_instructions() for t in diagram.wired.checked.traced.values() if t.inputs)


@pytest.mark.drawn(1)
@pytest.mark.parametrize(
    "block",
    [lambda seed: Gain(gain=matrix(seed)), lambda seed: Closed(), lambda seed: Own(A=matrix(seed))],
    ids=["gain", "closed over", "parameter"],
)
def test_a_product_with_500_by_500_entries_is_a_few_operations(block):
    u, made = np.linspace(-1, 1, N), block(4)
    diagram = Diagram("product", made(Constant(value=u)).named("y"))
    assert count_operations(diagram) < FEW
    A = CLOSED_OVER if isinstance(made, Closed) else matrix(4)
    run = diagram.simulate(0.01, step=0.01)
    assert run["y"][-1] == pytest.approx(A @ u + isinstance(made, Own), rel=1e-12, abs=1e-12)


def test_a_state_space_of_500_states_is_a_few_operations():
    assert count_operations(Diagram("large", state_space(matrix(5))(Constant(value=1.0)).named("y"))) < FEW


def test_a_large_state_space_runs_as_the_matrix_exponential_and_is_linearized_to_its_matrix():
    A, n, end = matrix(6, 100), 100, 0.5
    diagram = Diagram("large", state_space(A)(Constant(value=1.0)).named("y"))
    whole = expm(np.block([[A, np.ones((n, 1))], [np.zeros((1, n + 1))]]) * end)
    run = diagram.simulate(end, rtol=1e-9, atol=1e-12)
    assert run["y"][-1] == pytest.approx(np.mean(whole[:n, n]), rel=1e-7)
    assert np.array_equal(diagram.linearize().A, A)


def test_a_large_state_space_in_a_sampled_subsystem_is_held_exactly():
    A, T = matrix(7, 80), 0.01
    run = held(A).simulate(0.05)
    whole = expm(np.block([[A, np.ones((80, 1))], [np.zeros((1, 81))]]) * T)
    x, expected = np.zeros(80), []
    for _ in range(6):
        expected.append(np.mean(x))
        x = whole[:80, :80] @ x + whole[:80, 80]
    assert run["y"][:6] == pytest.approx(expected, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.5, 0.99])
def test_exact_zeros_of_a_large_matrix_are_structure(share):
    A = matrix(8)
    A[np.random.default_rng(1).random(A.shape) < share] = 0.0
    u = np.linspace(-1, 1, N)
    diagram = Diagram("sparse", Gain(gain=A, name="gain")(Constant(value=u)).named("y"))
    assert count_operations(diagram) < FEW
    assert diagram.simulate(0.01, step=0.01)["y"][-1] == pytest.approx(A @ u, rel=1e-12, abs=1e-12)
    changed = diagram.replace({"gain.gain": 2.0 * matrix(9)})  # zeros that are no more
    assert changed.simulate(0.01, step=0.01)["y"][-1] == pytest.approx(2.0 * matrix(9) @ u, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("n", [64, 65])
def test_matrices_on_both_sides_of_the_size_give_the_same(n):
    A, u = matrix(2, n), np.linspace(-1, 1, n)
    traced = trace(Gain(gain=A), {"u": (n,)}, sampled=False)
    assert has_large_product(traced.function) == (n > 64)
    made = np.ravel(np.array(traced.function(0.0, np.zeros(0), u, traced.pack(Gain(gain=A), np.nan))[0]))
    assert made == pytest.approx(A @ u, rel=1e-13, abs=1e-14)


@pytest.mark.slow
def test_a_small_block_beside_a_large_matrix_keeps_its_bits():
    def diagram(large):
        wave = StateSpace(A=[[0.0, 1.0], [-40.0, -0.4]], B=[0.0, 1.0], C=[1.0, 0.3], name="wave")(Constant(value=1.0))
        beside = Gain(gain=matrix(1) if large else 1.0)(Constant(value=np.ones(N)))
        return Diagram("both", wave.named("wave"), beside)

    one, other = (diagram(large).simulate(0.1, step=1e-3, solver="rk4")["wave"] for large in (False, True))
    assert np.array_equal(one, other)


@pytest.mark.parametrize("whole", [False, True])
def test_a_large_block_that_acts_in_steps_only_is_found(whole):
    n = 70
    diagram = Diagram(
        "steps", Own(A=matrix(3, n), whole=whole, name="own")(Constant(value=np.linspace(-1, 1, n) + 0.1))
    )
    findings = diagram.linearize(step=0.01).findings
    assert [type(f) for f in findings if "own" in str(f)] == [StepsOnly] * whole
