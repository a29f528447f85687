"""Free motions: the integrators that nothing feeds back, and everything that looks like one at a point and is none."""

from fractions import Fraction
from functools import partial

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.special import lambertw

from loopwright.blocks import (
    PID,
    Block,
    Constant,
    DeadZone,
    Encoder,
    Gain,
    Input,
    Integrator,
    LimitedIntegrator,
    Output,
    Product,
    Requirement,
    Saturation,
    Sine,
    State,
    StateSpace,
    Step,
    StopCondition,
    TransferFunction,
    TransportDelay,
    parameter,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, FmuError, build, dc_motor
from support.hidden_states import Hidden

T = 0.01


def sorted_poles(values):
    return np.array(sorted(values, key=lambda s: (np.real(s), np.imag(s))))


def assert_poles(found, wanted, atol=1e-9):
    np.testing.assert_allclose(sorted_poles(found), sorted_poles(wanted), rtol=0, atol=atol)


def control(body, sample_time):
    return body if sample_time is None else subsystem(sample_time=sample_time)(body)


def states_of(diagram, required=(), at=None, **options):
    return tuple(m.state for m in diagram.linearize(at, **options).free_motions(required).motions)


# --- drives -----------------------------------------------------------------------------------------------------------


def speed_drive(sample_time=None, *, more=lambda angle: [], name="drive", kp=2.0, ki=5.0):
    """A motor 1/(s + 1) under a PI controller of its speed; its angle runs on."""
    motor = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name=f"{name}_motor")
    angle = Integrator(name=f"{name}_angle")

    def controller(speed):
        return PID(kp=kp, ki=ki, name=f"{name}_pi")(Constant(value=1.0, name=f"{name}_r"), speed)

    voltage = control(controller, sample_time)(motor.y)
    return [angle(motor(voltage)), *more(angle.y)]


@pytest.mark.parametrize("sample_time", [None, T], ids=["continuous", "sampled"])
def test_the_angle_of_a_speed_drive_is_free_and_the_other_poles_are_those_without_it(sample_time):
    model = Diagram("d", *speed_drive(sample_time)).linearize()
    free = model.free_motions()
    (motion,) = free.motions
    assert (motion.state, motion.by_model_alone) == ("drive_angle.y", ())
    assert str(motion) == "drive_angle.y drifts: nothing feeds it back"
    A = np.array([[-1.0 - 2.0, 1.0], [-5.0, 0.0]])  # speed and integral
    if sample_time is not None:
        whole = expm(np.array([[-1.0, 1.0], [0.0, 0.0]]) * T)  # the motor with a held voltage
        a, b = whole[0]
        A = np.array([[a - 2.0 * b, b], [-5.0 * T, 1.0]])
    assert_poles(model.poles_without(free), np.linalg.eigvals(A))
    assert_poles(np.linalg.eigvals(free.reduce(model.A)), np.linalg.eigvals(A))
    np.testing.assert_allclose(free.P @ free.Q, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(free.P @ free.V, 0.0, atol=1e-12)


def test_two_drives_side_by_side_are_two_free_angles():
    drives = [*speed_drive(name="left"), *speed_drive(name="right", kp=3.0)]
    model = Diagram("d", *drives).linearize()
    free = model.free_motions()
    assert {m.state for m in free.motions} == {"left_angle.y", "right_angle.y"}
    A = [np.array([[-1.0 - kp, 1.0], [-5.0, 0.0]]) for kp in (2.0, 3.0)]
    assert_poles(model.poles_without(free), np.concatenate([np.linalg.eigvals(a) for a in A]))


def test_what_is_computed_from_an_angle_and_acts_on_nothing_follows_it():
    # a lag follows with slope 1; its state belongs to the direction
    drive = speed_drive(
        more=lambda angle: [TransferFunction(numerator=[2.0], denominator=[0.5, 1.0], name="lag")(angle)]
    )
    model = Diagram("d", *drive).linearize()
    (motion,) = model.free_motions().motions
    assert motion.state == "drive_angle.y"
    assert len(motion.entries) == 2
    assert_poles(model.poles_without(model.free_motions()), [-2.0, *np.linalg.eigvals([[-3.0, 1.0], [-5.0, 0.0]])])


def test_a_required_angle_is_not_free():
    diagram = Diagram("d", *speed_drive())
    assert states_of(diagram) == ("drive_angle.y",)
    assert states_of(diagram, "drive_angle.y") == ()
    assert states_of(diagram, ["drive_motor.y"]) == ("drive_angle.y",)


class Fence(Block):
    """A guard on a signal, and nothing else."""

    u = Input()
    y = Output()

    def output(self, t, x, u):
        return u.u

    def guards(self, t, x, u):
        return {"inside": 5.0 - u.u}


def test_a_condition_on_the_angle_requires_it():
    sampled = control(lambda angle: StopCondition(name="stop")(angle - 5.0), T)
    within = Requirement("the angle stays below 50", upper=50.0, name="within")
    for more in (
        lambda angle: [StopCondition(name="stop")(angle - 5.0)],
        lambda angle: [sampled(angle)],
        lambda angle: [within(angle)],
        lambda angle: [Fence(name="fence")(angle)],
    ):
        assert states_of(Diagram("d", *speed_drive(more=more))) == ()


def test_an_angle_with_limits_is_not_free():
    motor = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor")
    angle = LimitedIntegrator(name="angle", lower=-1.0, upper=1.0)
    u = PID(kp=2.0, ki=5.0, name="pi")(Constant(value=0.0, name="r"), motor.y)
    assert states_of(Diagram("d", angle(motor(u)))) == ()


def encoder_drive(rates):
    motor = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor")
    angle = Integrator(name="angle")

    @subsystem(sample_time=rates[1])
    def encoder(position, velocity):
        return Encoder(quantum=1e-3, name="encoder")(position, velocity).measured_velocity

    @subsystem(sample_time=rates[0])
    def controller(speed):
        return PID(kp=2.0, ki=5.0, name="pi")(Constant(value=0.0, name="r"), speed)

    return Diagram("d", angle(motor(controller(encoder(angle.y, motor.y)))))


@pytest.mark.parametrize("stairs", [None, "gain"])
@pytest.mark.parametrize("rates", [(1e-2, 1e-2), (1e-2, 1e-3)], ids=["one rate", "two rates"])
@pytest.mark.drawn(1)
def test_a_speed_that_an_encoder_takes_from_the_angle_leaves_it_free(rates, stairs):
    model = encoder_drive(rates).linearize(0.02, stairs=stairs)
    free = model.free_motions()
    (motion,) = free.motions
    assert motion.state == "angle.y"
    assert {name for name, _ in motion.entries} == {"angle.y", "encoder.encoder.last"}
    assert np.max(np.abs(model.poles_without(free))) < 1.0 - 1e-3
    assert len(model.poles_without(free)) == len(model.poles) - 1


def test_the_poles_of_a_drive_without_its_angle_are_those_of_the_speed_alone():
    """A drive 1/(s + 1) with u = −2 (p[k] − p[k−1])/T, by hand in the speed and the mean speed of the last sample."""
    motor, angle, T = (
        TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor"),
        Integrator(name="angle"),
        0.1,
    )

    @subsystem(sample_time=T)
    def controller(position, velocity):
        return Gain(gain=-2.0, name="kp")(Encoder(quantum=1e-4, name="encoder")(position, velocity).measured_velocity)

    model = Diagram("d", angle(motor(controller(angle.y, motor.y)))).linearize(0.5)
    a = np.exp(-T)
    # v⁺ = a v + (1 − a) u, m⁺ = ((1 − a) v + (T − 1 + a) u)/T with u = −2 m
    by_hand = [[a, -2.0 * (1.0 - a)], [(1.0 - a) / T, -2.0 * (T - 1.0 + a) / T]]
    found = model.poles_without(model.free_motions())
    assert_poles(found[np.abs(found) > 1e-6], np.linalg.eigvals(by_hand))


def test_a_position_that_an_encoder_measures_and_a_loop_uses_is_not_free():
    """The dead zone hides the feedback of the position at this point, not that of the speed."""
    motor, angle = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor"), Integrator(name="angle")

    @subsystem(sample_time=0.01)
    def controller(position, velocity):
        p, v = Encoder(quantum=1e-3, name="encoder")(position, velocity)
        return -2.0 * v - 5.0 * DeadZone(lower=-10.0, upper=10.0, name="play")(p)

    assert states_of(Diagram("d", angle(motor(controller(angle.y, motor.y)))), at=0.02) == ()


class HiddenDeadZone(Block):
    """A dead zone with a memory of its input: no answer to a shift of both at this point only."""

    u = Input(unit="1")
    y = Output(unit="1")
    last = State(unit="1")

    def output(self, t, x, u):
        d = u.u - 0.5 * x.last
        return np.where(np.abs(d) < 10.0, 0.0, d)

    def update(self, t, x, u):
        return u.u


class DifferenceWithADeadZone(HiddenDeadZone):
    """A dead zone of the difference of an input and the last one: the same answer to a shift of both everywhere."""

    def output(self, t, x, u):
        d = u.u - x.last
        return np.where(np.abs(d) < 10.0, 0.0, d)


class GatedPosition(Block):
    """A position that is fed back at speeds beyond 1 only: at rest no shift of it has any answer, nor any slope."""

    u = Input(unit="1")
    speed = Input(unit="1")
    y = Output(unit="1")
    last = State(unit="1")

    def output(self, t, x, u):
        return u.u * np.maximum(0.0, u.speed - 1.0)

    def update(self, t, x, u):
        return u.u


def test_a_feedback_of_the_position_at_other_speeds_alone_is_one():
    motor, angle = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor"), Integrator(name="angle")

    @subsystem(sample_time=0.01)
    def controller(position, velocity):
        return -2.0 * velocity - 5.0 * GatedPosition(name="gated")(position, velocity)

    assert states_of(Diagram("d", angle(motor(controller(angle.y, motor.y)))), at=0.02) == ()


@pytest.mark.parametrize(("block", "found"), [(HiddenDeadZone, ()), (DifferenceWithADeadZone, ("angle.y",))])
def test_a_shift_has_to_be_answered_alike_at_every_point(block, found):
    motor, angle = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor"), Integrator(name="angle")

    @subsystem(sample_time=0.01)
    def controller(position, velocity):
        return -2.0 * velocity - 5.0 * block(name="block")(position)

    assert states_of(Diagram("d", angle(motor(controller(angle.y, motor.y)))), at=0.02) == found


@pytest.mark.drawn(1)
@pytest.mark.parametrize("rates", [(1e-2, 1e-2), (1e-2, 1e-3)], ids=["one rate", "two rates"])
def test_an_encoder_that_only_shows_an_angle_moves_with_it(rates):
    @subsystem(sample_time=rates[1])
    def shown(position, velocity):
        return Encoder(quantum=1e-3, name="encoder")(position, velocity).measured_velocity

    drive = speed_drive(rates[0], more=lambda angle: [shown(angle, Constant(value=0.0, name="none"))])
    model = Diagram("d", *drive).linearize(0.02, stairs="gain")
    free = model.free_motions()
    (motion,) = free.motions
    assert motion.state == "drive_angle.y"
    assert {name for name, _ in motion.entries} == {"drive_angle.y", "shown.encoder.last"}
    assert {round(share, 9) for _, share in motion.entries} == {1.0}
    assert np.sum(np.abs(model.poles_without(free) - 1.0) < 1e-9) == np.sum(np.abs(model.poles - 1.0) < 1e-9) - 1


def test_entries_of_a_wire_that_nobody_on_the_loop_takes_may_move():
    plant = StateSpace(A=[[0.0, 1.0], [0.0, -1.0]], B=[0.0, 1.0], C=np.eye(2), D=[0.0, 0.0], name="plant")
    by_entry = Diagram("d", plant(Gain(gain=-2.0, name="gain")(plant.y[1])))
    assert states_of(by_entry) == ("plant.x[1]",)
    both = Diagram("d", plant(Gain(gain=np.array([[0.0, -2.0]]), name="gain")(plant.y)[0]))
    assert states_of(both) == ()


def test_a_drive_with_a_dead_time_keeps_its_rightmost_pole_without_its_angle():
    # s + 1 + 2 exp(−0.1 s) = 0, by Lambert's function: s = −1 + W(−0.2 exp(0.1))/0.1
    motor = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor")
    late, angle = TransportDelay(delay=0.1, name="late"), Integrator(name="angle")
    model = Diagram("d", angle(motor(late(Gain(gain=-2.0, name="gain")(motor.y))))).linearize()
    free = model.free_motions()
    assert [m.state for m in free.motions] == ["angle.y"]
    rightmost = -1.0 + lambertw(-0.2 * np.exp(0.1)) / 0.1
    found = model.poles_without(free)
    assert found[0] == pytest.approx(rightmost, abs=1e-9)
    assert model.characteristic_without(free).count_unstable() == 0


def test_an_angle_that_a_dead_time_integrates_is_not_free():
    late = TransportDelay(delay=0.1, name="late")
    assert states_of(Diagram("d", *speed_drive(more=lambda angle: [Integrator(name="i")(late(angle))]))) == ()


# --- motors that are FMUs ---------------------------------------------------------------------------------------------


def fmu_drive(**options):
    motor = Fmu(dc_motor.build(), name="motor", **options)

    @subsystem(sample_time=1e-3)
    def speed_loop(reference, speed):
        return PID(kp=0.05, ki=0.8, lower=-3.0, upper=3.0)(reference, speed).named("current_reference")

    @subsystem(sample_time=1e-4)
    def current_loop(reference, current):
        return PID(kp=1.0, ki=400.0, lower=-24.0, upper=24.0)(reference, current).named("voltage")

    voltage = current_loop(speed_loop(Constant(value=100.0, unit="rad/s"), motor.speed), motor.current)
    return Diagram("drive", motor(voltage=voltage, load_torque=Constant(value=0.0, unit="N.m")))


@pytest.mark.parametrize("at", [0.0, 0.4], ids=["standing", "running"])
@pytest.mark.parametrize("interface", ["co_simulation", "model_exchange"])
@pytest.mark.slow
def test_the_angle_of_a_motor_that_is_an_fmu_is_free(interface, at):
    model = fmu_drive(interface=interface).linearize(at)
    free = model.free_motions()
    assert [m.state for m in free.motions] == ["motor.angle"]
    assert free.motions[0].by_model_alone == ()
    assert np.max(np.abs(model.poles_without(free))) < 1.0 - 1e-4
    assert len(model.poles_without(free)) == len(model.poles) - 1


@pytest.mark.slow
def test_an_fmu_whose_states_can_not_be_shifted_is_judged_by_its_linear_model_and_says_so(monkeypatch):
    def refuse(block, **how):
        raise FmuError("its state has no exact start value")

    monkeypatch.setattr("loopwright.diagrams.linearization.shifted_diagram.take_shifted_steps", refuse)
    (motion,) = fmu_drive().linearize(0.0).free_motions().motions
    assert motion.by_model_alone == ("motor",)
    assert str(motion) == (
        "motor.angle drifts: nothing feeds it back (by the linear model alone: the states of motor can't be shifted)"
    )


@pytest.mark.slow
@pytest.mark.parametrize("sample_time", [None, T], ids=["continuous", "sampled"])
@pytest.mark.parametrize("kind", ["none", "play", "cogging"])
def test_what_an_fmu_hides_is_found_by_its_steps(kind, sample_time):
    plant = Fmu(build(Inside(kind=kind), name=f"inside_{kind}"), name="plant")
    gain = control(lambda y: Gain(gain=-2.0, name="gain")(y), sample_time)
    options = {} if sample_time else {"at": 0.0}
    found = states_of(Diagram("d", plant(gain(plant.y))), **options)
    assert found == (("plant.angle",) if kind == "none" else ())


# --- what must not pass -----------------------------------------------------------------------------------------------


def test_an_angle_and_its_integral_are_a_ramp():
    drive = speed_drive(more=lambda angle: [Integrator(name="integral")(angle)])
    assert states_of(Diagram("d", *drive)) == ()


def test_a_drive_beside_a_ramp_is_free_and_the_ramp_is_not():
    ramp = speed_drive(name="left", more=lambda angle: [Integrator(name="integral")(angle)])
    model = Diagram("d", *ramp, *speed_drive(name="right")).linearize()
    free = model.free_motions()
    assert len(free.motions) == 1
    left = np.sort(np.abs(model.poles_without(free)))
    assert left[1] < 1e-6 < left[2]  # the double pole of the ramp stays


def test_a_cart_under_a_pendulum_without_position_feedback_is_a_ramp():
    # x'' = u - φ, φ'' = 11 φ - u (all masses and lengths 1, g = 10); u = 60 φ + 12 φ'
    A = np.array([[0.0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1], [0, 0, 11, 0]])
    plant = StateSpace(A=A, B=[0.0, 1.0, 0.0, -1.0], C=np.eye(4), D=np.zeros(4), name="plant")
    u = Gain(gain=60.0, name="k1")(plant.y[2]) + Gain(gain=12.0, name="k2")(plant.y[3])
    diagram = Diagram("d", plant(u))
    assert states_of(diagram) == ()
    poles = np.sort(np.abs(diagram.linearize().poles))
    assert poles[1] < 1e-6 < poles[2]


@pytest.mark.parametrize(
    "hidden",
    [{"growth": 0.5}, {"frequency": 4.0 * np.pi / 3.0}, {"growth": 1e-3, "frequency": 4.0 * np.pi / 3.0}],
    ids=str,
)
@pytest.mark.parametrize("sample_time", [None, T, Fraction(3, 2)], ids=["continuous", "sampled", "at 2π/T"])
@pytest.mark.drawn(2)
def test_hidden_states_count_as_ever(sample_time, hidden):
    plant = Hidden(**hidden, name="plant")
    gain = control(lambda y: Gain(gain=-0.2, name="gain")(y), sample_time)
    model = Diagram("d", plant(gain(plant.y))).linearize()
    free = model.free_motions()
    assert [m.state for m in free.motions] == ["plant.angle"]
    s = complex(hidden.get("growth", 0.0), hidden.get("frequency", 0.0))
    wanted = [s, s.conjugate()] if s.imag else [s, s]
    left = model.poles_without(free)
    for value in wanted if sample_time is None else np.exp(np.array(wanted) * float(sample_time)):
        assert np.min(np.abs(left - value)) < 1e-8
    assert len(left) == 3


@pytest.mark.slow
def test_a_discrete_oscillation_over_the_whole_period_is_not_free():
    # a rotation by 2π/10 a tick of 1 ms, in a period of 10 ms: z = 1 over the period
    c, s = np.cos(0.2 * np.pi), np.sin(0.2 * np.pi)

    def build(body):
        drive = speed_drive(1e-2)
        return Diagram("d", *drive, body(Constant(value=0.0, name="zero")))

    class Rotation(Block):
        u = Input()
        y = Output()
        a = State()
        b = State()

        def output(self, t, x, u):
            return u.u

        def update(self, t, x, u, T):
            return c * x.a - s * x.b, s * x.a + c * x.b

    rotation = subsystem(sample_time=1e-3)(lambda y: Rotation(name="rotation")(y))
    model = build(rotation).linearize()
    assert model.dt == 1e-2
    assert np.sum(np.abs(model.poles - 1.0) < 1e-9) == 3
    free = model.free_motions()
    assert [m.state for m in free.motions] == ["drive_angle.y"]
    assert np.sum(np.abs(model.poles_without(free) - 1.0) < 1e-9) == 2


def position_loop(link, reference=0.0):
    """A motor 1/(s (s + 1)) whose angle goes through something into a P controller."""
    motor = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor")
    angle = Integrator(name="angle")
    error = Constant(value=reference, name="r") - angle.y
    return Diagram("d", angle(motor(link(error))))


@pytest.mark.parametrize(
    ("link", "reference"),
    [
        (Saturation(lower=-1.0, upper=1.0, name="link"), 10.0),
        (DeadZone(lower=-1e-3, upper=1e-3, name="link"), 0.0),
        (lambda error: Cube(name="link")(error), 0.0),
    ],
    ids=["saturated actuator", "dead zone", "cube"],
)
def test_a_feedback_that_is_zero_at_this_point_alone_is_no_free_motion(link, reference):
    diagram = position_loop(link, reference)
    model = diagram.linearize()
    assert np.min(np.abs(model.poles)) < 1e-12
    assert model.free_motions().motions == ()


def test_a_feedback_that_is_switched_on_later_is_no_free_motion():
    # its wire is on a loop of the port graph, whatever the product is now
    motor = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="motor")
    angle, switch = Integrator(name="angle"), Step(times=5.0, values=1.0, name="switch")
    u = Product(name="product")(switch, Constant(value=0.0, name="r") - angle.y)
    model = Diagram("d", angle(motor(u))).linearize()
    assert np.min(np.abs(model.poles)) < 1e-12
    assert model.free_motions().motions == ()


class Cube(Block):
    u = Input()
    y = Output()

    def output(self, t, x, u):
        return u.u**3


class Inside(Block):
    """A speed loop with a torque inside that follows the angle, or hides it at one point."""

    kind: str = parameter(default="none")
    u = Input()
    y = State(output=True)
    angle = State()

    def torque(self, x, u):
        a = x.angle
        if self.kind == "cube":
            return -(a**3)
        if self.kind == "play":
            return -1e3 * (np.maximum(a - 0.01, 0.0) + np.minimum(a + 0.01, 0.0))
        if self.kind == "far stops":
            return -1e3 * (np.maximum(a - 100.0, 0.0) + np.minimum(a + 100.0, 0.0))
        if self.kind == "detents":
            return -1e-3 * np.floor(a / 0.3 + 0.5)
        if self.kind == "cogging":
            return 1e-3 * (1.0 - np.cos(2.0 * np.pi * a))
        if self.kind == "commutation":  # the torque constant follows the angle
            return u.u * (np.cos(a) - 1.0)
        if self.kind == "stuck":  # stiction holds up to 1, whatever spring pulls
            pull = -0.2 * a
            return pull - np.clip(pull, -1.0, 1.0)
        return 0.0 * a

    def derivative(self, t, x, u):
        return u.u - x.y + self.torque(x, u), x.y


@pytest.mark.parametrize("kind", ["none", "cube", "play", "far stops", "detents", "cogging", "commutation", "stuck"])
@pytest.mark.parametrize("sample_time", [None, T], ids=["continuous", "sampled"])
@pytest.mark.drawn(4)
def test_a_torque_that_is_zero_at_this_angle_alone_is_found_by_finite_shifts(sample_time, kind):
    plant = Inside(kind=kind, name="plant")
    gain = control(lambda y: Gain(gain=-2.0, name="gain")(y), sample_time)
    found = states_of(Diagram("d", plant(gain(plant.y))))
    assert found == (("plant.angle",) if kind == "none" else ())


def test_two_angles_that_act_together_are_not_free():
    class Product(Block):
        u = Input()
        y = State(output=True)
        left = State()
        right = State()

        def derivative(self, t, x, u):
            return u.u - x.y + x.left**2 * x.right**2, 0.0 * x.y, 0.0 * x.y

    plant = Product(name="plant")
    assert states_of(Diagram("d", plant(Gain(gain=-2.0, name="gain")(plant.y)))) == ()


def test_a_slow_pole_is_none_at_zero():
    lag = partial(TransferFunction, numerator=[1.0], name="leak")
    drive = speed_drive(more=lambda angle: [])
    slow = Diagram("d", *drive, lag(denominator=[1e7, 1.0])(Sine(amplitude=1.0, frequency=1.0, name="sine")))
    model = slow.linearize()
    assert [m.state for m in model.free_motions().motions] == ["drive_angle.y"]
    assert np.min(np.abs(model.poles_without(model.free_motions()) + 1e-7)) < 1e-15
