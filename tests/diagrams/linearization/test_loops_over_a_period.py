"""Loops cut in a model over several ticks: the oracle is the diagram itself, with a gain put in at the wire."""

import numpy as np
import pytest
import scipy.optimize

from loopwright.blocks import PID, Constant, Gain, Integrator, TransferFunction
from loopwright.blocks.core.errors import ConfirmationError, WiringError
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.linearization.over_a_period import Model, confirm_loop, find_needed, lift
from loopwright.diagrams.report.pages.definitions import definition
from loopwright.frequency import margins


def offset(phase, gain=1.0, behind=False):
    plant = TransferFunction(numerator=[2.0], denominator=[1.0, 3.0, 2.0], name="plant")

    @subsystem(sample_time=0.1, offset=phase)
    def box(r, y):
        return Gain(gain=gain, name="k")(PID(kp=3.0, ki=2.0)(r, y)).named("u")

    u = box(Constant(value=0.0), plant.y.named("y"))
    return Diagram("offset", plant(Gain(gain=1.0, name="after")(u).named("after_hold") if behind else u))


def cascade(inner=1.0, outer=1.0):
    """A current loop at 2 ms in a speed loop at 10 ms."""
    electric = TransferFunction(numerator=[1.0], denominator=[0.02, 1.0], name="electric")
    mechanic = TransferFunction(numerator=[5.0], denominator=[1.0, 0.2], name="mechanic")

    @subsystem(sample_time=0.01)
    def speed_loop(r, y):
        return Gain(gain=outer, name="k")(PID(kp=2.0, ki=3.0)(r, y)).named("reference")

    @subsystem(sample_time=0.002)
    def current_loop(r, y):
        return Gain(gain=inner, name="k")(PID(kp=2.0, ki=60.0)(r, y)).named("voltage")

    voltage = current_loop(speed_loop(Constant(value=0.0), mechanic.y), electric.y)
    return Diagram("cascade", mechanic(electric(voltage)))


def limit(diagram_with):
    """The gain at which the diagram's own poles reach the unit circle."""
    return scipy.optimize.brentq(lambda k: np.abs(diagram_with(k).linearize().poles).max() - 1.0, 1.5, 100.0)


def lifted_limit(L):
    def beyond(k):
        poles = np.linalg.eigvals(L.A - L.B @ np.linalg.solve(np.eye(L.ninputs) / k + L.D, L.C))
        return np.abs(poles).max() - 1.0

    return scipy.optimize.brentq(beyond, 1.5, 100.0)


@pytest.mark.slow
@pytest.mark.drawn
@pytest.mark.parametrize("wire", ["u", "y", "after_hold"])
@pytest.mark.parametrize("phase", [0.03, 0.07, 0.09])
def test_an_offset_of_the_only_clock_does_not_change_the_loop(phase, wire):
    behind = wire == "after_hold"
    model = offset(phase, behind=behind).linearize()
    L, same = model.loop(wire), offset(0.0, behind=behind).linearize().loop(wire)
    for w in (0.5, 2.0, 10.0):
        z = np.exp(0.1j * w)
        assert L(z) == pytest.approx(same(z), rel=1e-10)
        assert model.sensitivity(wire)(z) == pytest.approx(1.0 / (1.0 + L(z)), rel=1e-10)
        assert model.complementary(wire)(z) == pytest.approx(L(z) / (1.0 + L(z)), rel=1e-10)


@pytest.mark.slow
def test_the_gain_margin_with_an_offset_is_where_the_diagram_becomes_unstable():
    found = margins(offset(0.03).linearize().loop("u")).gain_margin_high.value
    assert found == pytest.approx(limit(lambda k: offset(0.03, k)), rel=1e-9)


@pytest.mark.slow
def test_a_wire_that_is_renewed_once_in_the_period_has_the_gain_margin_of_the_diagram():
    model = cascade().linearize()
    L, z = model.loop("reference"), np.exp(0.3j)
    assert margins(L).gain_margin_high.value == pytest.approx(limit(lambda k: cascade(outer=k)), rel=1e-8)
    assert model.sensitivity("reference")(z) == pytest.approx(1.0 / (1.0 + L(z)), rel=1e-10)


@pytest.mark.slow
def test_a_signal_that_changes_often_but_is_read_once_in_the_period_has_a_loop():
    L = cascade().linearize().loop("mechanic.y")
    assert L.ninputs == 1
    assert margins(L).gain_margin_high.value == pytest.approx(limit(lambda k: cascade(outer=k)), rel=1e-8)


@pytest.mark.parametrize("wire", ["voltage"])
def test_a_wire_that_is_renewed_several_times_in_the_period_is_refused(wire):
    with pytest.raises(WiringError, match=r"^current_loop\.k\.y: 'voltage' is renewed 5 times .* lifted=True"):
        cascade().linearize().loop(wire)


@pytest.mark.slow
def test_the_lifted_loop_has_the_gain_limit_and_the_poles_of_the_diagram():
    model = cascade().linearize()
    L = model.loop("voltage", lifted=True)
    assert L.ninputs == 5
    assert L.input_labels[0].endswith("@0")
    assert L.dt == pytest.approx(0.01)
    assert lifted_limit(L) == pytest.approx(limit(lambda k: cascade(inner=k)), rel=1e-8)
    poles = np.linalg.eigvals(L.A - L.B @ np.linalg.solve(np.eye(5) + L.D, L.C))
    largest = np.sort(np.abs(poles))[::-1][: len(model.poles)]
    assert largest == pytest.approx(np.sort(np.abs(model.poles))[::-1][: len(largest)], abs=1e-9)


def test_lifting_a_wire_that_is_renewed_once_changes_nothing():
    model, z = cascade().linearize(), np.exp(0.3j)
    assert model.loop("reference", lifted=True)(z) == pytest.approx(model.loop("reference")(z), rel=1e-12)


def test_a_loop_that_does_not_close_to_the_diagram_is_refused():
    one = np.eye(1)
    cut = Model((0.5 * one, one, -0.2 * one, 0 * one), 0.1, ["x"], np.zeros(1))
    confirm_loop(cut, 0.3 * one, ("u",), "d")
    confirm_loop(cut, np.diag([0.3, 0.0]), ("u",), "d")  # what is only held for later does not count
    with pytest.raises(ConfirmationError, match="'u', closed, has the poles of another system"):
        confirm_loop(cut, 0.31 * one, ("u",), "d")


@pytest.mark.slow
def test_an_injection_at_a_box_with_an_offset_measures_the_loop():
    diagram = offset(0.03)
    found = diagram.frequency_response("u", [2.0, 10.0], amplitude=0.01)
    assert found.held
    for of in "LST":
        assert found.compare(diagram.linearize(), of) <= 1e-6


@pytest.mark.slow
def test_a_report_has_the_margins_of_a_periodic_wire_with_slow_loops_open_and_closed_and_does_not_inject_there():
    report = cascade().report(only=("inner", "injection"))
    text = [line for s in report.sections for line in (*s.text, *(t for part in s.sections for t in part.text))]
    assert sum("current_loop.voltage" in line and "renewed several times" in line for line in text) >= 2
    assert sum("the loop is periodic" in line for line in text) == 1
    numbers = report.numbers()
    assert "inner.voltage.sampled_d0.gain_margin_high" not in numbers
    assert not [name for name in numbers if name.startswith("injection.voltage")]
    assert numbers["inner.voltage.sampled_d0.periodic.gain_margin_high"].value == pytest.approx(
        limit(lambda k: cascade(inner=k)), rel=1e-8
    )
    alone = margins(cascade().linearize().loop("voltage", slow="open")).numbers()
    for name in ("gain_margin_high", "phase_margin_deg", "disk_margin"):
        assert numbers[f"inner.voltage.sampled_d0.slow_open.{name}"].value == pytest.approx(alone[name].value, rel=1e-9)
        assert definition(f"inner.voltage.sampled_d0.periodic.{name}")[0] == name
        assert definition(f"inner.voltage.sampled_d0.slow_open.control.{name}")[0] == "control"
    assert numbers["inner.reference.sampled_d0.gain_margin_high"].value == pytest.approx(
        limit(lambda k: cascade(outer=k)), rel=1e-8
    )
    assert numbers["injection.reference.sampled_d0.deviation"].value < 1e-5


@pytest.mark.slow
def test_a_report_names_the_state_that_keeps_an_operating_point_from_rest():
    angle = Integrator(name="angle", initial_value=0.0)
    plant = TransferFunction(numerator=[2.0], denominator=[1.0, 1.0], name="plant")

    @subsystem(sample_time=0.1)
    def box(r, y):
        return PID(kp=1.0, ki=2.0)(r, y).named("u")

    diagram = Diagram("turning", angle(plant(box(Constant(value=1.0), plant.y))))
    report = diagram.report(only=("injection",), point=diagram.operating_point(20.0))
    (text,) = [line for s in report.sections if s.key == "injection" for line in s.text if line.startswith("as it is")]
    assert "at box.u: not done, as the operating point is not at rest: angle.y moves by 0.1 in a period" in text


# --- ticks put together ----------------------------------------------------------------------------------------------


def go_through(steps, x, inputs):
    """The state after all ticks, and the outputs of each, tick by tick."""
    outputs = []
    for (A, B, C, D), d in zip(steps, inputs, strict=True):
        outputs.append(C @ x + D @ d)
        x = A @ x + B @ d
    return x, np.concatenate(outputs)


@pytest.mark.parametrize("count", [1, 4])
def test_a_lifted_model_leads_where_its_ticks_lead_one_after_the_other(count):
    rng = np.random.default_rng(count)
    sizes = ((3, 3), (3, 2), (2, 3), (2, 2))
    steps = [tuple(rng.standard_normal(size) for size in sizes) for _ in range(count)]
    x, inputs = rng.standard_normal(3), rng.standard_normal((count, 2))
    A, B, C, D = lift(steps, each_tick=True)
    after, outputs = go_through(steps, x, inputs)
    np.testing.assert_allclose(A @ x + B @ inputs.ravel(), after, rtol=1e-12)
    np.testing.assert_allclose(C @ x + D @ inputs.ravel(), outputs, rtol=1e-12)
    held = lift(steps, each_tick=False)
    after, outputs = go_through(steps, x, [inputs[0]] * count)
    np.testing.assert_allclose(held[0] @ x + held[1] @ inputs[0], after, rtol=1e-12)
    np.testing.assert_allclose(held[2] @ x + held[3] @ inputs[0], outputs[:2], rtol=1e-12)


def test_states_stay_that_are_needed_at_one_tick_of_a_period():
    # 0 is a state; 1 is held from the first tick and read at the second; 2 is recorded alone; 3 is a mode; 4 is a mode
    # that the input moves
    first, second = np.eye(5), np.eye(5)
    first[1], first[2] = [1, 0, 0, 0, 0], [1, 0, 0, 0, 0]
    second[0, 1], second[0, 3], second[0, 4] = 0.5, 2.0, 1.0
    none, moved = np.zeros((5, 1)), np.array([[0], [0], [0], [0], [1.0]])
    C, D = np.array([[1.0, 0, 0, 0, 0]]), np.zeros((1, 1))
    steps = [(first, moved, C, D), (second, none, C, D)]
    assert find_needed(steps, {0}) == [0, 1, 4]
    assert find_needed([lift(steps, each_tick=False)], {0}) == [0, 4]  # from period to period nothing reads 1
