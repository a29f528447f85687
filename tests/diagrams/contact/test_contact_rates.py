"""Contacts in several rates, against matrices of our own and runs of the diagram."""

import math
from functools import cache

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm
from scipy.optimize import brentq

from loopwright.blocks import (
    Block,
    Constant,
    ForceSensor,
    Gain,
    Input,
    Output,
    State,
    TransferFunction,
    UnknownNameError,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, StepOptions, build, scara
from loopwright.types import TrialMethod

M, KV, WEIGHT, DRAG = 3.0, 400.0, 1.5, 20.0
"""Mass of the cart in kg, gain of the servo in N s/m; mass in kg and damping in N s/m of the impedance."""
FAST, SLOW = 0.002, 0.01
"""Sample times of the servo, and of force sensor and impedance, in s."""
PORTS = {"position": "cart.position", "velocity": "cart.velocity", "force": "felt"}


class Cart(Block):
    motor = Input(unit="N")
    push = Input(unit="N")
    position = State(unit="m", start=0.0, output=True)
    velocity = State(unit="m/s", start=0.0, output=True)

    def derivative(self, t, x, u):
        return x.velocity, (u.motor + u.push) / M


def diagram(fast=FAST, slow=SLOW, cart=None, watched=None):
    cart = Cart(name="cart") if cart is None else cart
    hand = Constant(value=0.0, unit="N", name="hand")

    @subsystem(sample_time=slow)
    def impedance(push):
        felt = Gain(gain=1.0, name="sensor")(push).named("felt")
        return TransferFunction(numerator=(1.0,), denominator=(WEIGHT, DRAG), name="filter")(felt)

    @subsystem(sample_time=fast)
    def servo(wanted, velocity):
        return Gain(gain=KV, name="kv")(wanted - velocity)

    moved = cart(motor=servo(impedance(hand), cart.velocity), push=hand)
    if watched is None:
        return Diagram("cart", moved)

    @subsystem(sample_time=watched)
    def watch(position):
        return Gain(gain=2.0, name="twice")(position).named("seen")

    return Diagram("cart", moved, watch(cart.position))


@cache
def contact(**options):
    return diagram(**options).contact("cart.push", direction=[1.0], **PORTS)


def monodromy(k, b=0.0, m=0.0, fast=FAST, slow=SLOW):
    """Position, velocity, the filter's state and the last command over a period of the impedance.

    The filter WEIGHT v' + DRAG v = F is exact for a held force. The force is measured under the last command.
    """
    total = M + m
    A, B = np.array([[0.0, 1.0], [-k / total, -b / total]]), np.array([[0.0], [1.0 / total]])
    held = expm(fast * np.block([[A, B], [np.zeros((1, 3))]]))
    decay = math.exp(-DRAG / WEIGHT * slow)
    columns = []
    for p, v, wanted, last in np.eye(4):
        felt = -k * p - b * v - m * (last - k * p - b * v) / total
        for _ in range(round(slow / fast)):
            last = KV * (wanted - v)
            p, v, _ = held @ [p, v, last]
        columns.append([p, v, decay * wanted + (1.0 - decay) / DRAG * felt, last])
    return np.transpose(columns)


def growth(k, b=0.0, m=0.0, **rates):
    return math.log(np.max(np.abs(np.linalg.eigvals(monodromy(k, b, m, **rates))))) / rates.get("slow", SLOW)


@pytest.mark.drawn(1)
@pytest.mark.parametrize(
    ("vary", "held"),
    [("stiffness", {}), ("stiffness", {"damping": 10.0}), ("stiffness", {"mass": 0.5}), ("mass", {"stiffness": 50.0})],
)
@pytest.mark.parametrize("slow", [0.01, 0.02])
def test_limits_in_two_rates_are_those_of_the_monodromy_matrix(vary, held, slow):
    found = contact(slow=slow).stability_limit(vary, **held)
    names = {"stiffness": 0.0, "damping": 0.0, "mass": 0.0, **held}

    def sigma(value):
        return growth(*(names | {vary: value}).values(), slow=slow)

    expected = brentq(sigma, 0.9 * found.value, 1.1 * found.value, xtol=1e-300, rtol=1e-14)
    assert found.value == pytest.approx(expected, rel=1e-9)
    assert found.growth_below == pytest.approx(sigma(0.97 * found.value), rel=1e-6)
    assert found.growth_below < 0.0
    assert found.growth_above == pytest.approx(sigma(1.03 * found.value), rel=1e-6)
    poles = np.linalg.eigvals(monodromy(*(names | {vary: found.value}).values(), slow=slow))
    angle = abs(np.angle(poles[np.argmax(np.abs(poles))]))
    assert found.frequency == pytest.approx(angle / slow, rel=1e-6)
    assert found.direction == (1.0,)


@pytest.mark.slow
def test_a_period_of_equal_ticks_has_the_numbers_of_one_rate():
    one = contact(fast=0.002, slow=0.002)
    same = diagram(0.002, 0.002, watched=0.01).contact("cart.push", direction=[1.0], **PORTS)
    assert (len(same.parts.ticks), same.sample_time, one.parts.ticks) == (5, pytest.approx(0.01), ())
    for held in ({}, {"damping": 10.0}, {"mass": 0.3}):
        a, b = same.stability_limit(high=1e5, **held), one.stability_limit(high=1e5, **held)
        assert a.value == pytest.approx(b.value, rel=1e-9)
        assert a.frequency == pytest.approx(b.frequency, rel=1e-8)
        assert a.growth_above == pytest.approx(b.growth_above, rel=1e-6)
    w = np.array([1.0, 30.0, 500.0, 1500.0])
    np.testing.assert_allclose(same.admittance(w).rendered, one.admittance(w).rendered, rtol=1e-9)


def test_the_admittance_in_two_rates_is_the_fundamental_of_the_steady_state():
    here = contact()
    fast, slow, decay = FAST, SLOW, math.exp(-DRAG / WEIGHT * SLOW)
    for w in (3.0, 40.0, 700.0):
        # states (p, v, filter), each relative to e^{jωt} at the beginning of the period; F moves x by its exact response
        A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([0.0, 1.0 / M])

        def motion(x, u, t, tau, w=w, A=A, B=B):
            """State after tau with held u and the force e^{jω(t + s)}."""
            free = expm(A * tau)
            forced = np.array(
                [(np.exp(1j * w * tau) - 1 - 1j * w * tau) / (1j * w) ** 2, np.expm1(1j * w * tau) / 1j / w]
            )
            return free @ x + np.array([tau**2 / 2, tau]) / M * u + forced * np.exp(1j * w * t) / M

        def period(s, part=None, w=w):
            (p, v, wanted), total = s, 0.0
            x, felt = np.array([p, v]), 1.0
            for j in range(5):
                u, t = KV * (wanted - x[1]), j * fast
                if part:
                    total += quad_vec(
                        lambda q, x=x, u=u, t=t: motion(x, u, t, q)[1] * np.exp(-1j * w * (t + q)),
                        0.0,
                        fast,
                        epsabs=1e-14,
                    )[0]
                x = motion(x, u, t, fast)
            return total / slow if part else np.array([*x, decay * wanted + (1 - decay) / DRAG * felt])

        forced = period(np.zeros(3, dtype=complex))
        free = np.transpose([period(e) - forced for e in np.eye(3, dtype=complex)])
        steady = np.linalg.solve(np.exp(1j * w * slow) * np.eye(3) - free, forced)
        expected = period(steady, part=True)
        assert here.admittance(w).rendered == pytest.approx(expected, rel=1e-8)
    assert "several rates" in here.passivity().caveat


def test_the_frequency_of_a_limit_is_no_alias_of_the_common_period():
    # the force is not measured: the slow impedance has no part in the loop, and the servo's own rate decides
    two = diagram().contact("cart.push", direction=[1.0], **(PORTS | {"force": None})).stability_limit()
    one = diagram(FAST, FAST).contact("cart.push", direction=[1.0], **(PORTS | {"force": None})).stability_limit()
    assert two.value == pytest.approx(one.value, rel=1e-8)
    assert two.frequency == pytest.approx(one.frequency, rel=1e-8)
    assert two.frequency > 2.0 * math.pi / SLOW  # poles over the period tell it up to multiples of that
    A = np.array([[0.0, 1.0], [-two.value / M, 0.0]])
    held = expm(FAST * np.block([[A, np.array([[0.0], [1 / M]])], [np.zeros((1, 3))]]))
    closed = held[:2, :2] + held[:2, 2:] @ [[0.0, -KV]]
    assert np.max(np.abs(np.linalg.eigvals(closed))) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("made", ["block", "fmu"])
def test_limits_in_two_rates_hold_in_the_run(made):
    cart = None if made == "block" else Fmu(build(Cart(), name="cart"), name="cart")
    here = diagram(cart=cart).contact("cart.push", direction=[1.0], **PORTS)
    found = here.confirm(here.stability_limit(damping=10.0))
    assert found.method is TrialMethod.SOLVER
    for trial in found.trials:
        assert trial.predicted == pytest.approx(growth(trial.value, 10.0), rel=1e-6)
        assert trial.measured == pytest.approx(trial.predicted, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("fast", "slow"), [(0.002, 0.003), (0.002, 0.016)])
def test_limits_hold_in_the_run_where_ticks_are_not_even(fast, slow):
    here = diagram(fast, slow).contact("cart.push", direction=[1.0], **PORTS)
    limit = here.stability_limit(damping=10.0)
    found = here.confirm(limit)
    assert found.above.measured == pytest.approx(found.above.predicted, rel=0.02)


# --- an arm whose force sensor is slower than its joints ---------------------------------------------------------------

ANGLES = np.array([0.07072564, 1.0852782])
JACOBIAN = np.array(scara.nominal.dh(ANGLES))


class JointController(Block):
    angle = Input(shape=(2,), unit="rad")
    rate = Input(shape=(2,), unit="rad/s")
    force = Input(shape=(2,), unit="N")
    torque = Output(shape=(2,), unit="N.m")

    def output(self, t, x, u):
        return 2.0 * (JACOBIAN.T @ u.force) - 400.0 * (u.angle - ANGLES) - 30.0 * u.rate


def arm_diagram(slow=5e-3, tool=0.1, offset=0.0, stepping=None):
    options = {} if stepping is None else {"stepping": StepOptions(communication_step=stepping)}
    arm = Fmu(scara.build(), name="arm", **options)
    push = Constant(value=(0.0, 0.0), unit="N", name="push")

    @subsystem(sample_time=slow, offset=offset)
    def sensors(acceleration, push):
        return ForceSensor(name="sensor", tool_mass=tool)(push, acceleration).named("felt")

    @subsystem(sample_time=1e-3)
    def joints(angle, rate, force):
        return JointController(name="law")(angle, rate, force)

    torque = joints(arm.joint_angle, arm.joint_velocity, sensors(arm.acceleration, push))
    return Diagram("arm", arm(motor_torque=torque, external_force=push))


def arm_growth(k, b, d, slow, tool):
    """Growth in 1/s of the arm's fastest mode: M q̈ = τ − D q̇ + Jᵀ F, with the force of the last slow tick."""
    ARM, J, along = scara.nominal, JACOBIAN, np.outer(d, d) @ JACOBIAN
    inertia = np.array(ARM.inertia(ANGLES))
    friction = np.diag(ARM.viscous_friction + ARM.coulomb_friction / ARM.friction_width)
    A = np.zeros((4, 4))
    A[:2, 2:] = np.eye(2)
    A[2:] = -np.linalg.solve(inertia, np.hstack([k * J.T @ along, friction + b * J.T @ along]))
    B = np.vstack([np.zeros((2, 2)), np.linalg.inv(inertia)])
    held = expm(1e-3 * np.block([[A, B], [np.zeros((2, 6))]]))
    columns = []
    for e in np.eye(6):
        x, u = e[:4], e[4:]
        felt = -np.outer(d, d) @ J @ (k * x[:2] + b * x[2:]) - tool * J @ (A @ x + B @ u)[2:]
        for _ in range(round(slow / 1e-3)):
            u = 2.0 * J.T @ felt - 400.0 * x[:2] - 30.0 * x[2:]
            x = held[:4] @ np.concatenate([x, u])
        columns.append(np.concatenate([x, u]))
    return math.log(np.max(np.abs(np.linalg.eigvals(np.transpose(columns))))) / slow


@pytest.mark.slow
@pytest.mark.parametrize("method", ["inside", "held"])
def test_an_arm_with_a_slow_force_sensor_has_the_limit_of_its_own_matrices_and_of_the_run(method):
    ports = {"position": "arm.position", "velocity": "arm.velocity", "force": "felt"}
    d = np.array([0.6, 0.8])
    here = arm_diagram().contact("arm.external_force", direction=d, **ports)
    limit = here.stability_limit(damping=5.0)
    assert arm_growth(0.999 * limit.value, 5.0, d, 5e-3, 0.1) < 0.0 < arm_growth(1.001 * limit.value, 5.0, d, 5e-3, 0.1)
    expected = brentq(lambda k: arm_growth(k, 5.0, d, 5e-3, 0.1), 0.9 * limit.value, 1.1 * limit.value, rtol=1e-14)
    assert limit.value == pytest.approx(expected, rel=1e-8)
    found = here.confirm(limit, push=1e-8, method=method)
    assert found.below.measured < 0.0 < found.above.measured


@pytest.mark.slow
def test_ports_of_an_fmu_whose_names_have_dots_are_those_of_a_contact():
    names = {"external_force": "tool.force", "position": "tool.position", "velocity": "tool.velocity"}
    arm, push = Fmu(scara.build(), name="arm", rename=names), Constant(value=(0.0, 0.0), unit="N", name="push")

    @subsystem(sample_time=1e-3)
    def joints(angle, rate, force):
        return JointController(name="law")(angle, rate, force)

    torque = joints(arm.joint_angle, arm.joint_velocity, push)
    made = Diagram("arm", arm(motor_torque=torque, **{"tool.force": push}))
    here = made.contact(
        "arm.tool.force", position="arm.tool.position", velocity="arm.tool.velocity", force=None, direction=(0.6, 0.8)
    )
    assert here.ports.plant == "arm"
    assert here.ports.force == "tool.force"
    with pytest.raises(UnknownNameError, match="found no block with the input 'leg.tool.force'"):
        made.contact("leg.tool.force", direction=(0.6, 0.8))


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{"stepping": 5e-4}, {"stepping": 2e-3}, {"offset": 5e-4}, {"slow": 2e-3, "at": 0.013}], ids=str
)
def test_communication_steps_of_their_own_and_offsets_hold_in_the_run(options):
    options = dict(options)
    at = options.pop("at", None)
    plain, made = arm_diagram(1e-3), arm_diagram(**{"slow": 1e-3, **options})
    ports = {"position": "arm.position", "velocity": "arm.velocity", "force": "felt", "direction": (0.6, 0.8)}
    here = made.contact("arm.external_force", at=at, **ports)
    assert len(here.parts.ticks) == 2
    limit = here.stability_limit(damping=5.0)
    if options.get("stepping") == 5e-4:  # points at which nothing acts
        same = plain.contact("arm.external_force", **ports).stability_limit(damping=5.0)
        assert limit.value == pytest.approx(same.value, rel=1e-9)
    found = here.confirm(limit, push=1e-8)
    assert found.method is TrialMethod.INSIDE
    for trial in found.trials:
        assert trial.measured == pytest.approx(trial.predicted, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("vary", ["mass", "tool_mass"])
def test_masses_in_two_rates_hold_in_the_run(vary):
    ports = {"position": "arm.position", "velocity": "arm.velocity", "force": "felt", "direction": (0.6, 0.8)}
    here = arm_diagram(2e-3).contact("arm.external_force", **ports)
    found = here.confirm(here.stability_limit(vary, stiffness=50.0), push=1e-8)
    assert found.below.measured < 0.0 < found.above.measured
