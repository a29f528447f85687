"""Loops between ports whose entries do not wait for themselves are none: they run, and others are refused or solved."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Constant, Function, Gain, PythonFunction, Sine, StateSpace, UnitDelay
from loopwright.diagrams import AlgebraicLoopError, Diagram, NonFiniteError, subsystem

PAIR = Function(lambda a, b: np.stack([a, b]), name="pair")

A, D = np.array([[-1.0, 0.3], [0.2, -2.0]]), np.array([[0.0, 1.0], [0.0, 0.0]])


def plant(D=D, name="plant"):
    return StateSpace(A=A, B=np.eye(2), C=np.eye(2), D=D, name=name)


def closed(D=D, **options):
    """Return u₀ = −3 y₀, u₁ = 1 around a state space with two inputs and outputs."""
    system = plant(D)
    feedback = Gain(gain=-3.0, name="feedback")(system.y[0])
    return Diagram("closed", system(PAIR(feedback, Constant(value=1.0))), **options)


def test_a_state_space_with_a_sparse_feedthrough_is_no_algebraic_loop():
    # y₀ = x₀ + u₁ and u₀ = −3 y₀: ẋ = A x + (−3 (x₀ + 1), 1)
    F, g = A + np.array([[-3.0, 0.0], [0.0, 0.0]]), np.array([-3.0, 1.0])
    x = expm(np.block([[F, g[:, None]], [np.zeros((1, 3))]]))[:2, 2]
    diagram = closed()
    run = diagram.simulate(1.0, rtol=1e-10, atol=1e-12)
    assert run["plant.y"][-1] == pytest.approx([x[0] + 1.0, x[1]], rel=1e-8)
    assert pytest.approx(F, abs=1e-14) == diagram.linearize().A


@pytest.mark.parametrize("entry", [(0, 0), (0, 1)])
def test_an_entry_that_waits_for_itself_is_refused(entry):
    feedthrough = np.zeros((2, 2))
    feedthrough[entry] = 1.0
    if entry == (0, 0):
        with pytest.raises(AlgebraicLoopError, match=r"plant\.y is wired to feedback\.u"):
            closed(feedthrough)
    else:
        closed(feedthrough)


@pytest.mark.slow
def test_an_entry_that_waits_for_itself_is_solved():
    # y₀ = x₀ + 0.5 u₀ + u₁ and u₀ = −3 y₀: y₀ = (x₀ + 1)/2.5
    run = closed(np.array([[0.5, 1.0], [0.0, 0.0]]), loops="solve").simulate(1.0, rtol=1e-10, atol=1e-12)
    F, g = A + np.array([[-3 / 2.5, 0.0], [0.0, 0.0]]), np.array([-3 / 2.5, 1.0])
    x = expm(np.block([[F, g[:, None]], [np.zeros((1, 3))]]))[:2, 2]
    assert run["plant.y"][-1] == pytest.approx([(x[0] + 1.0) / 2.5, x[1]], rel=1e-8)


def test_a_vector_that_is_made_of_its_own_entries_is_evaluated_entry_by_entry():
    double = Gain(gain=np.array([2.0, 3.0, 5.0, 7.0]), name="double")
    y = double.y
    run = Diagram(
        "chain",
        double(Function(lambda a, b, c, d: np.stack([a, b, c, d]), name="all")(y[3], y[0], Constant(value=1.0), y[2])),
    ).simulate(0.1, step=0.1)
    # y₂ = 5, y₃ = 7 y₂, y₀ = 2 y₃, y₁ = 3 y₀
    assert run["double.y"][-1] == pytest.approx([70.0, 210.0, 5.0, 35.0])


def test_slices_of_vectors_are_ordered_too():
    double = Gain(gain=2.0, name="double")
    join = Function(lambda a, b: np.concatenate([a, b]), name="join")
    run = Diagram("slices", double(join(Constant(value=np.array([1.0, 2.0])), double.y[0:2]))).simulate(0.1, step=0.1)
    assert run["double.y"][-1] == pytest.approx([2.0, 4.0, 4.0, 8.0])


def test_in_a_sampled_subsystem_with_states_behind_the_loop():
    @subsystem(sample_time=0.1)
    def controller(r):
        double = Gain(gain=2.0, name="double")
        y = double(PAIR(double.y[1], UnitDelay(name="last", initial_value=0.0)(double.y[0]) + r))
        return y[0]

    run = Diagram("sampled", Gain(gain=1.0)(controller(Constant(value=1.0))).named("y")).simulate(0.3)
    # y₁ = 2 (y₀ of the last tick + 1), y₀ = 2 y₁
    expected, last = [], 0.0
    for _ in range(4):
        last = 4 * (last + 1.0)
        expected.append(last)
    assert run["y"] == pytest.approx(expected)


def test_an_opaque_block_may_depend_on_all_of_its_inputs():
    double = PythonFunction(lambda u: 2.0 * u, name="double", results={"y": (2,)})
    with pytest.raises(AlgebraicLoopError):
        Diagram("opaque", double(PAIR(double.y[1], Constant(value=1.0))))


def test_numbers_that_stand_in_for_inputs_to_come_do_no_harm():
    # while y₁ = 1/u₁ is not there yet, u₁ is zero
    inverse = Function(lambda u: np.stack([u[0] + 1.0, 1.0 / u[1]]), name="inverse")
    wave = Sine(amplitude=1.0, frequency=0.5, bias=3.0, name="wave")
    run = Diagram("inverse", inverse(PAIR(wave, inverse.y[0]))).simulate(0.5, step=0.1)
    u = 3.0 + np.sin(np.pi * run.t)
    assert run["inverse.y"] == pytest.approx(np.stack([u + 1.0, 1.0 / (u + 1.0)], axis=1))


def test_a_value_that_is_not_finite_is_named_at_the_block_that_makes_it():
    inverse = Function(lambda u: np.stack([u[0] - 1.0, 1.0 / u[1]]), name="inverse")
    after = Function(lambda u: np.sqrt(u - 2.0), name="after")
    made = inverse(PAIR(Constant(value=3.0), inverse.y[0]))  # 1/2, after zero had stood in
    with pytest.raises(NonFiniteError, match=r"^after\."):
        Diagram("named", after(made[1])).simulate(0.1, step=0.1)


def test_the_order_does_not_depend_on_how_the_diagram_is_written():
    def diagram(first):
        a, b = Gain(gain=2.0, name="a"), Gain(gain=3.0, name="b")
        calls = [
            lambda: a(PAIR.replace(name="pa")(b.y[1], Constant(value=1.0, name="one"))),
            lambda: b(PAIR.replace(name="pb")(a.y[0], a.y[1])),
        ]
        return Diagram("both", *(calls[i]() for i in ((0, 1) if first else (1, 0))))

    runs = [diagram(first).simulate(0.1, step=0.1) for first in (False, True)]
    assert runs[0]["b.y"][-1] == pytest.approx([36.0, 6.0])
    assert np.array_equal(runs[0]["b.y"], runs[1]["b.y"])
