"""States that a block's parameters leave out: errors that name them say why, and parameters that bring them back."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import PID, Constant, LoopwrightError, TransferFunction
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.linearization import copy_point

T, END = 0.01, 0.5
REASON = "has no state 'integral': with ki = 0, .* give ki a value"


def p_loop(sampled=True, **gains):
    """A lag 1 / (s + 1) under a P controller, with a set-point of 1."""
    plant = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="plant")
    pid = PID(name="pid", **{"kp": 4.0, **gains})
    if not sampled:
        return Diagram("loop", plant(pid(Constant(value=1.0, name="r"), plant.y)))

    @subsystem(sample_time=T)
    def controller(y):
        return pid(Constant(value=1.0, name="r"), y)

    return Diagram("loop", plant(controller(plant.y)))


def expected_end(ki):
    """y at the end of the sampled loop, by its recurrence: the lag is exact between the ticks."""
    y = integral = 0.0
    for _ in range(round(END / T)):
        u = 4.0 * (1.0 - y) + integral
        integral += T * ki * (1.0 - y)
        y = np.exp(-T) * y + (1.0 - np.exp(-T)) * u
    return y


def test_a_p_loop_has_no_pole_at_zero():
    np.testing.assert_allclose(p_loop(sampled=False).linearize().poles, [-5.0], rtol=1e-12)
    decay = np.exp(-T)
    np.testing.assert_allclose(p_loop().linearize().poles, [decay - 4.0 * (1.0 - decay)], rtol=1e-12)


def test_its_runs_have_the_numbers_of_the_closed_forms():
    assert p_loop().simulate(END)["plant.y"][-1] == pytest.approx(expected_end(0.0), abs=1e-12)
    run = p_loop(sampled=False).simulate(END, rtol=1e-10, atol=1e-12)
    assert run["plant.y"][-1] == pytest.approx(0.8 * (1.0 - np.exp(-5.0 * END)), abs=1e-9)


@pytest.mark.parametrize(
    "use",
    [
        lambda d: d.simulate(END, record=["pid.integral"]),
        lambda d: d.simulate(END)["integral"],
        lambda d: d.sweep({"pid.kp": [1.0, 2.0]}, END, signals=["pid.integral"]),
        lambda d: d.linearize(outputs="pid.integral"),
        lambda d: d.linearize(openings="controller.pid.integral"),
        lambda d: d.linearize().loop("pid.integral"),
        lambda d: d.trim(fixed=["pid.integral"]),
        lambda d: d.trim(rates={"pid.integral": None}),
        lambda d: d.operating_point(0.0, states={"pid.integral": 1.0}),
        lambda d: d.simulate(END, start=d.replace({"pid.ki": 1.0}).simulate(END).final_state),
        lambda d: d.linearize(d.replace({"pid.ki": 1.0}).operating_point(0.0)),
    ],
    ids=range(11),
)
def test_a_name_of_a_state_that_is_left_out_is_refused_with_the_reason(use):
    with pytest.raises(LoopwrightError, match=REASON):
        use(p_loop())


def test_saved_states_count_by_their_names():
    # a PI and a filtered PD controller have one state each
    pi, pd = {"ki": 1.0}, {"kd": 0.1, "filter_time": 0.05}
    state, point = p_loop(**pi).simulate(END).final_state, p_loop(**pi).operating_point(0.0)
    with pytest.raises(LoopwrightError, match=REASON):
        p_loop(**pd).simulate(END, start=state)
    with pytest.raises(LoopwrightError, match=REASON):
        p_loop(**pd).linearize(point)
    with pytest.raises(LoopwrightError, match=r"It lacks the state 'controller.pid.integral'"):
        p_loop(**pi).linearize(p_loop().operating_point(0.0))


@pytest.mark.parametrize("base", [0.0, 2.0])
@pytest.mark.parametrize("form", [{"workers": 1}, {"workers": 2}, {"workers": 1, "lanes": 2}], ids=str)
def test_a_sweep_gives_the_gain_values_and_takes_them_away(base, form):
    values = [0.0, 1.0, 3.0, 0.0]
    options = {"solver": "rk4", "step": T / 4, "compile": True} if "lanes" in form else {"rtol": 1e-10, "atol": 1e-12}
    found = p_loop(ki=base).sweep({"pid.ki": values}, END, signals=["plant.y"], **form, **options)
    assert not found.failures
    ends = [outcome.signals["plant.y"][-1] for outcome in found.outcomes]
    np.testing.assert_allclose(ends, [expected_end(ki) for ki in values], rtol=0, atol=1e-9)


def test_a_replaced_gain_traces_again():
    loop = p_loop(sampled=False).replace({"pid.ki": 3.0})
    A = np.array([[0.0, -3.0], [1.0, -5.0]])
    np.testing.assert_allclose(np.sort(loop.linearize().poles), np.sort(np.linalg.eigvals(A)), rtol=1e-12)
    run = loop.simulate(END, rtol=1e-10, atol=1e-12)
    rest = np.array([1.0, 1.0])  # I = 1, y = 1: from x = 0 it decays as e^(At)
    assert run["plant.y"][-1] == pytest.approx((rest - expm(A * END) @ rest)[1], abs=1e-9)
    assert loop.replace({"pid.ki": 0.0}).linearize().states == ("plant.x[1]",)


def test_a_point_of_another_gain_keeps_the_states_that_both_have():
    loop = p_loop(kd=0.1, filter_time=0.05)
    point, other = loop.operating_point(END), loop.replace({"pid.ki": 1.0})
    copied = copy_point(loop.wired, point, other.wired)
    names = other.linearize(copied).states
    assert "controller.pid.integral" in names
    where = other.wired.flatten_like(copied).states.each.slices
    filtered = loop.wired.flatten_like(point).states.each.slices["controller.pid.filtered"]
    assert copied.x[where["controller.pid.filtered"]] == point.x[filtered] != 0.0
    assert copied.x[where["controller.pid.integral"]] == 0.0


def test_a_gain_of_zero_can_be_freed_in_a_trim_and_tried_in_a_worst_case():
    found = p_loop(sampled=False).trim(free={"pid.ki": (0.1, 10.0)}, targets={"plant.y": 1.0})
    assert found.parameters["pid.ki"] > 0.0
    assert found.values["pid.u"] == pytest.approx(1.0)
    worst = p_loop(sampled=False).worst_case({"pid.ki": (0.0, 5.0)}, "pid.u", quantity="phase_margin_deg", count=3)
    # |L| = |(4 jω + 5)| / |jω (jω + 1)| = 1
    w = np.sqrt((15.0 + np.sqrt(15.0**2 + 4.0 * 25.0)) / 2.0)
    L = (4.0j * w + 5.0) / (1j * w * (1j * w + 1.0))
    assert abs(L) == pytest.approx(1.0)
    assert worst.worst.value == pytest.approx(180.0 + np.degrees(np.angle(L)), abs=1e-6)


def test_what_a_zero_leaves_out_has_no_derivative():
    with pytest.raises(LoopwrightError, match=r"found 0, which is structure .* diagram.replace\(\{'pid.ki': …\}\)"):
        p_loop(sampled=False).sensitivities("pid.u", ["pid.ki"])
    with pytest.raises(LoopwrightError, match=r"pid.ki came out as 0, which is structure"):
        p_loop(sampled=False).trim(free=["pid.ki"], targets={"plant.y": 0.9})
