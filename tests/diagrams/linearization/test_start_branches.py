"""Operating points at the start are past the branches that blocks have there: the loop works in the linear model."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.blocks import (
    Block,
    Constant,
    Encoder,
    ForceSensor,
    Function,
    Gain,
    Input,
    Integrator,
    Output,
    ShapeError,
    SimulationError,
    State,
    Sum,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.frequency import margins

T, KP, KD = 1e-3, 400.0, 40.0


def servo(angle=0.0, speed=0.0, offset=0):
    """A double integrator under u = −KP p − KD v, with p and v of an encoder."""
    v = Integrator(name="speed", initial_value=speed)
    x = Integrator(name="angle", initial_value=angle)

    @subsystem(sample_time=T, offset=offset)
    def drive(x, v):
        p, w = Encoder(quantum=1e-6, name="encoder")(x, v)
        return Sum(signs="--")(Gain(gain=KP, name="kp")(p), Gain(gain=KD, name="kd")(w)).named("torque")

    return Diagram("servo", x(v.y), v(drive(x.y, v.y)))


def phase_margin():
    """Phase margin in deg by the closed form: the held double integrator, and the difference of two positions."""

    def L(w):
        z = np.exp(1j * w * T)
        return T**2 / 2 * (z + 1) / (z - 1) ** 2 * (KP + KD * (z - 1) / (T * z))

    w = brentq(lambda w: abs(L(w)) - 1.0, 1.0, 300.0, xtol=1e-13)
    return float(np.degrees(np.angle(-L(w))))


@pytest.mark.parametrize("start", [(0.0, 0.0), (0.3, 0.0), (0.3, 0.2)])
@pytest.mark.slow
def test_the_speed_of_an_encoder_is_fed_back_in_the_model_of_the_start(start):
    diagram = servo(*start)
    for point in (None, 0.0, diagram.operating_point(0.0), diagram.operating_point(states={"angle.y": 0.7})):
        lin = diagram.linearize(point, stairs="gain")
        assert margins(lin.loop("torque")).phase_margin_deg.value == pytest.approx(phase_margin(), abs=1e-8)
        assert max(abs(lin.poles)) < 1.0
        assert lin.notes == diagram.linearize(0.02, stairs="gain").notes


def test_the_point_stays_that_of_the_start():
    diagram = servo(0.3, 0.2)
    point, run = diagram.operating_point(0.0), diagram.simulate(T, progress=False)
    for name, value in point.values.items():
        assert value == pytest.approx(run[name][0], rel=1e-10), name
    assert point.values["drive.encoder.measured_velocity"] == pytest.approx(0.2, rel=1e-10)
    assert point.t == 0.0
    again = diagram.simulate(0.05, start=point, progress=False)
    whole = diagram.simulate(0.05, progress=False)
    assert again["angle.y"] == pytest.approx(whole["angle.y"], abs=1e-9)


def test_the_start_of_a_diagram_at_rest_is_at_rest():
    point = servo().operating_point()
    assert point.residual == 0.0


def test_a_subsystem_that_begins_later_is_past_its_start_too():
    diagram = servo(0.3, 0.0, offset=Fraction(1, 2000))
    early, late = (diagram.linearize(t, stairs="gain") for t in (0.0, 0.02))
    assert early.states == late.states
    assert pytest.approx(late.A, abs=1e-9) == early.A


def test_given_states_of_an_encoder_stay():
    point = servo().operating_point(states={"angle.y": 0.5, "drive.encoder.last": 0.499, "drive.encoder.running": 1.0})
    assert point.values["drive.encoder.measured_velocity"] == pytest.approx(1.0, rel=1e-9)  # (0.5 − 0.499)/T


def test_a_copied_point_has_the_velocity_that_it_has():
    from loopwright.diagrams.linearization import copy_point

    plain, v, x = servo(0.3), Integrator(name="speed", initial_value=0.1), Integrator(name="angle", initial_value=0.8)
    other = Diagram("servo", x(v.y), v(Gain(gain=-1.0)(x.y)))
    point = copy_point(other.wired, other.operating_point(0.0, step=T), plain.wired)
    where = plain.wired.flatten_like(point).states.of_block["drive.encoder"]
    assert point.x[where.slices["last"]] == pytest.approx(0.8 - 0.1 * T, abs=1e-12)


TAU, TOOL, K = 0.02, 0.4, 3.0


def felt(*, sampled):
    """A lagging acceleration under K times the force of the tool on the sensor."""
    a = Integrator(name="a", initial_value=[0.0, 0.0])

    def wired(a):
        sensor = ForceSensor(name="sensor", tool_mass=TOOL)
        return Gain(gain=K)(sensor(Constant(value=[0.0, 0.0], unit="N"), a).measured)

    box = subsystem(sample_time=T)(wired) if sampled else wired
    lag = Function(lambda u, a: (u - a) / TAU, name="lag")
    return Diagram("felt", a(lag(box(a.y), a.y)))


def test_a_force_sensor_feels_its_tool_at_the_start_too():
    lin = felt(sampled=False).linearize()
    assert pytest.approx(-(1 + K * TOOL) / TAU * np.eye(2), rel=1e-12) == lin.A
    lin, e = felt(sampled=True).linearize(), np.exp(-T / TAU)
    assert pytest.approx((e - (1 - e) * K * TOOL) * np.eye(2), rel=1e-12) == lin.A
    assert lin.findings == ()


def test_the_run_keeps_the_branch_of_the_start():
    run = servo(0.3, 0.2).simulate(2 * T, progress=False)
    assert run["drive.encoder.measured_velocity"][0] == 0.2


class Late(Block):
    """Zero at the start, −u from then on."""

    u = Input()
    y = Output()

    def output(self, t, x, u):
        return np.where(t > 0.0, -u.u, 0.0)

    def after_start(self, x, u, T):
        return ()


class Waiting(Late):
    """Zero at its first tick."""

    running = State()

    def output(self, t, x, u):
        return np.where(x.running > 0.5, -u.u, 0.0)

    def update(self, t, x, u):
        return 1.0 + 0.0 * t

    def after_start(self, x, u, T):
        return 1.0


class Wrong(Waiting):
    """Gives a state of another shape."""

    def after_start(self, x, u, T):
        return np.ones(3)


def around(block):
    x = Integrator(name="x")

    @subsystem(sample_time=T)
    def box(x):
        return block(x)

    return Diagram("d", x(box(x.y)))


@pytest.mark.parametrize("block", [Late(), Waiting()])
def test_a_block_of_ones_own_says_that_it_has_such_a_branch(block):
    lin = around(block).linearize()
    assert lin.findings == ()
    assert lin.A[-1, -1] == pytest.approx(1.0 - T, rel=1e-12)


def test_states_of_another_shape_are_refused():
    with pytest.raises(ShapeError, match=r"box\.wrong\.running: its after_start gives shape \(3,\); expected \(\)"):
        around(Wrong()).linearize()
    failing = type("Failing", (Waiting,), {"after_start": lambda self, x, u, T: 1.0 / 0.0})
    with pytest.raises(SimulationError, match=r"its after_start\(x, u, T\) failed: ZeroDivisionError"):
        around(failing()).linearize()
