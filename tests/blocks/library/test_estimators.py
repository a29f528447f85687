"""State feedback and observers, against Riccati equations by SciPy, eigenvalues, and recursions by hand."""

import control
import numpy as np
import pytest
from scipy.linalg import solve_continuous_are, solve_discrete_are

from loopwright.blocks import (
    Constant,
    DiscreteObserver,
    DiscreteStateSpace,
    Gain,
    Observer,
    ParameterError,
    Recorded,
    SampleTimeError,
    ShapeError,
    StateFeedback,
    StateSpace,
)
from loopwright.diagrams import Diagram, subsystem

A, B, C = np.array([[0.0, 1.0], [2.0, -0.1]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])  # a pendulum, upright
PLANT = control.ss(A, B, C, 0.0)
T = 0.1
SAMPLED = control.c2d(PLANT, T)
Q, R, QN, RN = np.diag([3.0, 1.0]), np.array([[0.5]]), np.diag([0.2, 1.0]), np.array([[0.1]])
FORMS = ("predictor", "current")


# --- gains -------------------------------------------------------------------------------------------------------------


def test_all_that_lqr_returns_is_no_gain_and_the_error_says_which_part_is():
    found = control.lqr(PLANT, Q, R)
    with pytest.raises(
        ParameterError, match=r"StateFeedback\.gain: found .*; expected one matrix: .* give the first, \[0\]"
    ):
        StateFeedback(found)
    np.testing.assert_array_equal(StateFeedback(found[0]).gain, found[0])


def test_gains_solve_the_riccati_equations():
    P = solve_continuous_are(A, B, Q, R)
    np.testing.assert_allclose(StateFeedback.from_lqr(PLANT, Q, R).gain, np.linalg.solve(R, B.T @ P), rtol=1e-9)
    P = solve_continuous_are(A.T, C.T, QN, RN)
    np.testing.assert_allclose(Observer.from_lqe(PLANT, QN, RN).gain, P @ C.T / RN, rtol=1e-9)
    Ad, Bd = SAMPLED.A, SAMPLED.B
    P = solve_discrete_are(Ad, Bd, Q, R)
    gain = np.linalg.solve(R + Bd.T @ P @ Bd, Bd.T @ P @ Ad)
    np.testing.assert_allclose(StateFeedback.from_lqr(SAMPLED, Q, R).gain, gain, rtol=1e-9)
    P = solve_discrete_are(Ad.T, C.T, QN, RN)
    M = P @ C.T / (C @ P @ C.T + RN)
    np.testing.assert_allclose(DiscreteObserver.from_lqe(SAMPLED, QN, RN, form="current").gain, M, rtol=1e-9)
    np.testing.assert_allclose(DiscreteObserver.from_lqe(SAMPLED, QN, RN).gain, Ad @ M, rtol=1e-9)
    np.testing.assert_allclose(control.dlqe(Ad, np.eye(2), C, QN, RN)[0], Ad @ M, rtol=1e-9)  # its form: the predictor


def test_noise_enters_by_its_matrix():
    G = np.array([[0.0], [2.0]])
    want = Observer.from_lqe(PLANT, G @ G.T * 0.7, RN).gain
    np.testing.assert_allclose(Observer.from_lqe(PLANT, 0.7, 0.1, G=G).gain, want, rtol=1e-9)


def test_poles_are_placed():
    poles = np.array([-3.0, -4.0])
    K, L = StateFeedback.from_poles(PLANT, poles).gain, Observer.from_poles(PLANT, poles).gain
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(A - B @ K)), np.sort(poles), rtol=1e-9)
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(A - L @ C)), np.sort(poles), rtol=1e-9)
    Ad, z = SAMPLED.A, np.array([0.3, 0.6])
    L = DiscreteObserver.from_poles(SAMPLED, z).gain
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(Ad - L @ C)), z, rtol=1e-9)
    M = DiscreteObserver.from_poles(SAMPLED, z, form="current").gain
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(Ad - Ad @ M @ C)), z, rtol=1e-9)


# --- loops -------------------------------------------------------------------------------------------------------------


def test_the_loop_has_the_poles_of_feedback_and_observer():
    """The separation principle: eigenvalues of A − B K and of A − L C."""
    plant = StateSpace.from_control(PLANT, initial_state=(0.3, 0.0), name="plant")
    feedback, observer = StateFeedback.from_lqr(plant, Q, R), Observer.from_lqe(PLANT, QN, RN)
    diagram = Diagram("d", plant(feedback(observer(feedback.y, plant.y))))
    found = diagram.linearize().poles
    want = np.concatenate([np.linalg.eigvals(A - B @ feedback.gain), np.linalg.eigvals(A - observer.gain @ C)])
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(want.astype(complex)), rtol=1e-7)
    run = diagram.simulate(20.0, progress=False)
    assert abs(run["plant.y"][-1]) < 1e-4


@pytest.mark.parametrize("form", FORMS)
def test_the_sampled_loop_has_the_poles_of_feedback_and_observer(form):
    plant = StateSpace.from_control(PLANT, initial_state=(0.3, 0.0), name="plant")

    @subsystem(sample_time=T)
    def controller(y):
        feedback = StateFeedback.from_lqr(SAMPLED, Q, R, name="feedback")
        observer = DiscreteObserver.from_lqe(SAMPLED, QN, RN, form=form)
        return feedback(observer(feedback.y, y))

    found = Diagram("d", plant(controller(plant.y))).linearize().poles
    Ad, M = SAMPLED.A, DiscreteObserver.from_lqe(SAMPLED, QN, RN, form="current").gain
    K = StateFeedback.from_lqr(SAMPLED, Q, R).gain
    want = np.concatenate([np.linalg.eigvals(Ad - SAMPLED.B @ K), np.linalg.eigvals(Ad - Ad @ M @ C)])
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(want.astype(complex)), rtol=1e-7)


@pytest.mark.parametrize("form", FORMS)
def test_a_kalman_filter_is_the_recursion_of_the_literature(form):
    rng = np.random.default_rng(5)
    k = np.arange(20)
    u, y = rng.normal(size=20), rng.normal(size=20)
    observer = DiscreteObserver.from_lqe(SAMPLED, QN, RN, form=form, initial_state=(0.1, 0.2), name="kalman")

    @subsystem(sample_time=T)
    def box(u, y):
        return observer(u, y)

    sources = [Recorded(times=k * T, values=v, interpolation="previous", name=n) for n, v in (("u", u), ("y", y))]
    run = Diagram("d", box(*sources)).simulate(1.9, progress=False)
    x, gain = np.array([0.1, 0.2]), observer.gain[:, 0]
    for i in k:
        error = y[i] - x[0]
        estimate = x + gain * error if form == "current" else x
        np.testing.assert_allclose(run["box.kalman.x_hat"][i], estimate, rtol=1e-12)
        assert run["box.kalman.innovation"][i] == pytest.approx(error, rel=1e-12)
        x = SAMPLED.A @ estimate + SAMPLED.B[:, 0] * u[i] + (0.0 if form == "current" else gain * error)


def test_several_inputs_and_outputs():
    model = StateSpace(A=A, B=np.eye(2), C=np.eye(2), D=[[0.0, 0.5], [0.0, 0.0]])
    observer = Observer(model, gain=[[1.0, 2.0], [3.0, 4.0]], name="observer")
    u, y = Constant(value=(1.0, 2.0)), Constant(value=(3.0, 4.0))
    run = Diagram("d", observer(u, y)).simulate(0.1, step=0.1, progress=False)
    assert run["observer.innovation"][0].tolist() == [2.0, 4.0]
    feedback = StateFeedback([[1.0, 2.0], [3.0, 4.0]], name="feedback")
    call = feedback((10.0, 20.0), target=(9.0, 20.0), feedforward=(0.5, 0.0))
    run = Diagram("d", call).simulate(0.1, step=0.1, progress=False)
    assert run["feedback.y"][0].tolist() == [-0.5, -3.0]
    single = Diagram("d", StateFeedback(2.0, name="k")(Gain(gain=1.0)(3.0))).simulate(0.1, step=0.1, progress=False)
    assert single["k.y"][0] == -6.0


@pytest.mark.parametrize(
    ("make", "error", "text"),
    [
        (
            lambda: Observer(PLANT, [1.0, 2.0, 3.0]),
            ParameterError,
            r"observer\.gain: found shape \(3,\); expected \(2,\)",
        ),
        (lambda: Observer(PLANT, [[1.0, 2.0]]), ParameterError, r"found shape \(1, 2\); expected \(2,\).*Transpose"),
        (
            lambda: Observer(SAMPLED, [1.0, 2.0]),
            ParameterError,
            r"found a system in discrete time .*; expected continuous",
        ),
        (lambda: DiscreteObserver(PLANT, [1.0, 2.0]), ParameterError, r"found a system in continuous time"),
        (lambda: Observer("plant", [1.0]), ParameterError, r"found a str; expected a control\.StateSpace"),
        (lambda: DiscreteObserver(SAMPLED, [1.0, 2.0], form="filter"), ParameterError, r"form: found 'filter'"),
        (
            lambda: Diagram("d", StateFeedback([1.0, 2.0])((1.0, 2.0, 3.0))),
            ShapeError,
            r"state: found shape \(3,\); exp",
        ),
        (
            lambda: Diagram("d", sampled(0.2)),
            SampleTimeError,
            r"found a sample time of 0\.2 s in the subsystem; expected 0\.1",
        ),
    ],
)
def test_mistakes_are_named(make, error, text):
    with pytest.raises(error, match=text):
        make()


def sampled(time):
    @subsystem(sample_time=time)
    def box(y):
        return DiscreteObserver(DiscreteStateSpace.from_control(SAMPLED), [1.0, 2.0])(0.0, y)

    return box(Constant(value=1.0))
