"""Integrators, PID controllers and delays in loops: whole diagrams, against closed forms."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import (
    PID,
    Clock,
    Compare,
    Constant,
    Delay,
    DiscreteStateSpace,
    DiscreteTransferFunction,
    DiscreteZeroPoleGain,
    Function,
    Integrator,
    LimitedIntegrator,
    PadeDelay,
    ResettableIntegrator,
    SampleTimeError,
    Saturation,
    StateSpace,
    Step,
    TransferFunction,
    TransportDelay,
    ZeroPoleGain,
)
from loopwright.diagrams import Diagram, subsystem


def simulate(*calls, duration, **options):
    return Diagram("test", *calls).simulate(duration, progress=False, **options)


def tight(*calls, duration, **options):
    return simulate(*calls, duration=duration, rtol=1e-11, atol=1e-12, **options)


@pytest.mark.slow
def test_an_integrator_that_resets_itself_is_a_sawtooth():
    tooth = ResettableIntegrator(name="tooth")
    full = Compare(relation=">", name="full")(tooth.y, Constant(value=0.7))
    run = tight(tooth(Constant(value=1.0), full), duration=3.0)
    times = [event.t for event in run.events if event.event == "restart"]
    assert times == pytest.approx([0.7, 1.4, 2.1, 2.8], abs=1e-9)
    assert run["tooth.y"][-1] == pytest.approx(0.2, abs=1e-9)


def test_at_ticks_it_resets_itself_by_its_value_before():
    @subsystem(sample_time=0.25)
    def box(u):
        tooth = ResettableIntegrator(name="tooth")
        return tooth(u, Compare(relation=">", name="full")(tooth.before, Constant(value=0.6)))

    run = simulate(box(Constant(value=1.0)), duration=2.0)
    assert run["box.tooth.y"].tolist() == [0.0, 0.25, 0.5, 0.0, 0.25, 0.5, 0.0, 0.25, 0.5]


@pytest.mark.slow
@pytest.mark.parametrize("T", [None, 0.01], ids=["continuous", "sampled"])
def test_a_limited_integrator_leaves_its_limit_at_once(T):
    @subsystem(sample_time=T)
    def box(t):
        drive = Function(np.cos, name="drive")(t)
        return LimitedIntegrator(upper=0.5, name="i")(drive)

    run = (tight if T is None else simulate)(box(Clock(unit="rad")()), duration=4.0)
    t, y = run.t, run["box.i.y"]
    want = np.where(t < np.pi / 6, np.sin(t), np.where(t < np.pi / 2, 0.5, np.sin(t) - 0.5))
    np.testing.assert_allclose(y, want, rtol=0, atol=1e-8 if T is None else 2 * 0.01)


def test_linear_blocks_in_a_loop_are_the_matrix_exponential():
    motor = TransferFunction(numerator=[2.0, 3.0], denominator=[1.0, 0.5, 4.0], name="motor")
    filtered = ZeroPoleGain(zeros=[-3.0], poles=[-5 + 2j, -5 - 2j], gain=4.0, name="filter")(motor.y)
    run = tight(motor(Step(times=0.0, values=1.0) - filtered), duration=3.0)
    num, den = np.polymul([2.0, 3.0], [1.0, 10.0, 29.0]), np.polymul([1.0, 0.5, 4.0], [1.0, 10.0, 29.0])
    a = np.polyadd(den, 4.0 * np.polymul([2.0, 3.0], [1.0, 3.0]))
    A = np.vstack([-a[1:] / a[0], np.eye(3, 4)])
    C = np.r_[np.zeros(4 - len(num)), num] / a[0]
    rest = -np.linalg.solve(A, np.eye(4)[0])
    want = [C @ (rest - expm(A * t) @ rest) for t in run.t]
    np.testing.assert_allclose(run["motor.y"], want, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_a_pid_at_ticks_tracks_its_set_point_through_a_saturated_actuator():
    plant = TransferFunction(numerator=1.0, denominator=[1.0, 1.0, 0.0], name="plant")

    @subsystem(sample_time=0.01)
    def tracking(r, y):
        pid = PID(kp=4.0, ki=3.0, kd=3.0, filter_time=0.05, tracking=True, tracking_time=0.5, name="pid")
        actuator = Saturation(limit=1.0, name="actuator")
        pid(r, y, actuator.y)
        return actuator(pid.u)

    @subsystem(sample_time=0.01)
    def own_limits(r, y):
        pid = PID(
            kp=4.0,
            ki=3.0,
            kd=3.0,
            filter_time=0.05,
            lower=-1.0,
            upper=1.0,
            tracking_time=0.5,
            initial_output=0.0,
            name="pid",
        )
        return pid(r, y)

    runs = []
    for controller in (tracking, own_limits):
        force = controller(Step(times=0.5, values=3.0), plant.y)
        runs.append(simulate(plant(force), duration=15.0)["plant.y"])
    assert np.abs(runs[0]).max() > 3.0
    np.testing.assert_allclose(runs[0], runs[1], rtol=0, atol=1e-9)  # the same limits, outside and inside
    assert runs[0][-1] == pytest.approx(3.0, abs=1e-2)


@pytest.mark.parametrize("anti_windup", ["back_calculation", "clamping"])
def test_a_pid_in_continuous_time_settles_after_its_limit(anti_windup):
    plant = TransferFunction(numerator=1.0, denominator=[1.0, 1.0, 0.0], name="plant")
    pid = PID(kp=4.0, ki=3.0, kd=3.0, filter_time=0.05, lower=-1.0, upper=1.0, anti_windup=anti_windup, name="pid")
    run = simulate(plant(pid(Constant(value=3.0), plant.y)), duration=20.0)
    assert run["plant.y"][-1] == pytest.approx(3.0, abs=1e-2)
    assert run["plant.y"].max() < 3.7
    assert run["pid.u"].max() == pytest.approx(1.0)


@pytest.mark.slow
def test_a_delay_in_a_loop_is_the_method_of_steps():
    # y' = −y(t − 1), y = 0 before, from y(0) = 1: 1, then 1 − (t − 1), then + (t − 2)²/2, …
    y = Integrator(initial_value=1.0, name="y")
    late = TransportDelay(delay=1.0, name="late")(y.y)
    run = tight(y(-1.0 * late), duration=3.5)
    t = run.t
    want = 1.0 - np.maximum(t - 1, 0) + np.maximum(t - 2, 0) ** 2 / 2 - np.maximum(t - 3, 0) ** 3 / 6
    np.testing.assert_allclose(run["y.y"], want, rtol=0, atol=1e-8)


def test_a_transport_delay_in_a_sampled_box_is_a_delay_by_samples():
    @subsystem(sample_time=0.1)
    def box(u):
        return {"late": TransportDelay(delay=0.3, name="a")(u), "steps": Delay(steps=3, initial_value=0.0, name="b")(u)}

    run = simulate(*box(1.0 + Clock()()), duration=1.0)
    np.testing.assert_array_equal(run["box.a.y"], run["box.b.y"])
    np.testing.assert_allclose(run["box.a.y"][[0, 2, 3, 10]], [0.0, 0.0, 1.0, 1.7], rtol=0, atol=1e-12)

    @subsystem(sample_time=0.1)
    def wrong(u):
        return TransportDelay(delay=0.25, name="a")(u)

    with pytest.raises(SampleTimeError, match=r"wrong\.a.*nearest: 0.2 s or 0.3 s"):
        simulate(wrong(Clock()()), duration=1.0)


@pytest.mark.slow
def test_a_pade_delay_of_a_smooth_signal_is_near_the_true_one():
    hump = Function(lambda t: np.exp(-((t - 1.5) ** 2) / 0.1), name="hump")(Clock()())
    run = tight(PadeDelay(delay=0.4, order=8, name="p")(hump), TransportDelay(delay=0.4, name="d")(hump), duration=3.0)
    np.testing.assert_allclose(run["p.y"], run["d.y"], rtol=0, atol=1e-6)


def test_a_discrete_system_stands_in_a_frame_of_its_sample_time():
    def build(T):
        @subsystem(sample_time=T)
        def box(u):
            return DiscreteStateSpace(A=[[0.5]], B=[1.0], C=[1.0], dt=0.2, name="d")(u)

        return simulate(box(Constant(value=1.0)), duration=2.0)

    assert build(0.2)["box.d.y"][2] == 1.5
    with pytest.raises(SampleTimeError, match=r"d.*found a sample time of 0.1 s in the subsystem; expected 0.2 s"):
        build(0.1)


@pytest.mark.parametrize("T", [0.1, 1.0], ids=str)
@pytest.mark.parametrize(
    "block",
    [
        DiscreteStateSpace(A=[[0.5]], B=[1.0], C=[1.0], dt=0.2, name="d"),
        DiscreteTransferFunction(numerator=1.0, denominator=[1.0, 0.5], dt=0.2, name="d"),
        DiscreteZeroPoleGain(poles=[0.5], dt=0.2, name="d"),
    ],
    ids=lambda block: type(block).__name__,
)
def test_a_system_of_another_sample_time_is_refused_when_the_diagram_is_built(block, T):
    @subsystem(sample_time=T)
    def box(u):
        return block(u)

    with pytest.raises(
        SampleTimeError, match=rf"^box\.d\.dt: found a sample time of {T:g} s in the subsystem; expected 0\.2 s"
    ):
        Diagram("d", box(Constant(value=1.0)))
    good = Diagram("d", box.replace(sample_time=0.2)(Constant(value=1.0)))
    with pytest.raises(SampleTimeError, match=r"^box\.d\.dt: found a sample time"):
        good.replace({"box.sample_time": T})


@pytest.mark.slow
def test_states_of_any_width_go_through_a_diagram():
    block = StateSpace(A=[[0, 1], [-4, -1]], B=np.eye(2), C=[[1, 0]], initial_state=[1, 0], name="s")
    run = tight(block([0.0, 0.0]), duration=2.0)
    want = [expm(np.array([[0, 1], [-4, -1]]) * t)[0] @ [1, 0] for t in run.t]
    np.testing.assert_allclose(run["s.y"][:, 0], want, rtol=0, atol=1e-9)
