"""Contacts of diagrams that aren't Fig. 3, against Routh's criterion and matrices of our own."""

import math

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from loopwright.blocks import Block, Constant, ForceSensor, Gain, Input, OptionError, Output, TransferFunction
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.contact.contact_loop import Modes
from loopwright.diagrams.contact.stability_limits import growth_rounding
from loopwright.fmus import Fmu, build, scara
from loopwright.types import TrialMethod
from support.carts import DRAG, SHARE, TAU, Cart, M, cart_contact, cart_diagram

# --- another diagram: a cart whose drive lags behind the force that it shows -----------------------------------------


def test_a_cart_has_the_limits_of_routh():
    # (τ s + 1)((M + m) s² + b s + k) + DRAG s + SHARE (m s² + b s + k) = 0
    here = cart_contact()
    assert here.sample_time == 0.0
    limit = here.stability_limit()
    k = DRAG / (TAU * SHARE)
    assert limit.value == pytest.approx(k, rel=1e-10)
    assert limit.frequency == pytest.approx(math.sqrt((k * TAU + DRAG) / (M * TAU)), rel=1e-9)
    assert limit.direction == (1.0,)
    # (M + m + SHARE m)(k τ + DRAG) = (M + m) τ k (1 + SHARE), above the limit: masses make it stable
    k = 1.5 * k
    stable_from = M * (TAU * k * SHARE - DRAG) / ((1 + SHARE) * (k * TAU + DRAG) - TAU * k * (1 + SHARE))
    found = here.stability_limit("mass", stiffness=k)
    assert found.value == 0.0
    assert found.restabilizes == pytest.approx([stable_from], rel=1e-9)
    assert found.frequency == pytest.approx(cubic_frequency(k, 1e-4), rel=1e-9)


def cubic_frequency(k, m):
    roots = np.roots([(M + m) * TAU, M + m + SHARE * m, k * TAU + DRAG, k * (1 + SHARE)])
    return float(abs(roots[np.argmax(roots.real)].imag))


def test_a_cart_on_a_damper_has_the_limit_of_routh():
    b = 5.0
    # (M + b τ)(b + k τ + DRAG + SHARE b) = M τ k (1 + SHARE)
    k = (M + b * TAU) * (b * (1 + SHARE) + DRAG) / (M * TAU * (1 + SHARE) - (M + b * TAU) * TAU)
    assert cart_contact().stability_limit(damping=b).value == pytest.approx(k, rel=1e-10)


@pytest.mark.slow
def test_a_cart_without_friction_bounces_on_any_spring_for_ever():
    # M s² + k = 0: undamped for every k, which is not unstable
    cart, hand = Cart(name="cart"), Constant(value=0.0, unit="N", name="hand")
    felt = Gain(gain=1.0, name="sensor")(hand).named("felt")
    here = Diagram("cart", cart(motor=0.0 * felt, push=hand)).contact(
        "cart.push", direction=[1.0], position="cart.position", velocity="cart.velocity", force="felt"
    )
    found = here.stability_limit()
    assert found.value == math.inf
    assert "the motion does not decay" in found.confirmed_by
    # (τ s + 1)(M s² + b s + k) + DRAG s = 0 with DRAG = 0 and any damper is stable
    assert here.stability_limit("damping", stiffness=100.0).value == math.inf


def test_a_mass_moves_no_mode_of_a_free_cart():
    # (M + m) s² = 0: a drift for every mass, which is no growth
    cart, hand = Cart(name="cart"), Constant(value=0.0, unit="N", name="hand")
    off = Constant(value=0.0, unit="N", name="off")
    here = Diagram("cart", cart(motor=off, push=hand)).contact(
        "cart.push", direction=[1.0], position="cart.position", velocity="cart.velocity", force="hand.y"
    )
    for vary, held in (("mass", {}), ("tool_mass", {}), ("mass", {"tool_mass": 1.0})):
        found = here.stability_limit(vary, **held)
        assert found.value == math.inf
        assert found.confirmed_by == "no mode of the loop is moved by such an environment"
    assert here.stability_limit("mass", damping=1.0).value == math.inf
    grid = here.stability_map([0.1, 1.0], [0.5, 2.0], x="mass", y="tool_mass")
    assert (grid.growth == -math.inf).all()


def test_the_least_growth_of_such_a_cart_is_no_rounding():
    """M s² − c s + k = 0 grows by c/2M: 5e-9 of the least frequency of the scan, 5e-14 of the largest."""
    cart, hand = Cart(name="cart"), Constant(value=0.0, unit="N", name="hand")
    felt = Gain(gain=0.0, name="sensor")(hand).named("felt")
    here = Diagram("cart", cart(motor=Gain(gain=1e-9, name="pump")(cart.velocity) + felt, push=hand)).contact(
        "cart.push", direction=[1.0], position="cart.position", velocity="cart.velocity", force="felt"
    )
    found = here.stability_limit()
    assert found.value == 0.0
    assert found.growth_above == pytest.approx(0.5e-9 / M, rel=1e-6)


@pytest.mark.parametrize("k", [1e-6, 1e-2, 1.0, 37.0, 1e4, 1e8])
def test_the_rounding_of_a_growth_rate_covers_that_of_any_machine(k):
    """An undamped mode beside a faster and a slower one, with errors of 1e-15 of what stands beside each entry."""
    ω = math.sqrt(k)
    A = np.array([[0.0, 1.0, 0.0, 0.0], [-k, 0.0, 0.0, 0.0], [0.3 * k, 0.0, -40 * ω, 0.0], [0.0, ω, 0.0, -0.01 * ω]])
    modes = Modes(np.eye(4), np.eye(4), np.zeros(0), np.zeros(0, dtype=bool))
    bound = growth_rounding(modes, lambda B: np.linalg.eigvals(B).real.max(axis=-1), A)
    scale = np.array([1.0, ω, 1.0, 1.0])  # of states that make it ω times numbers
    sizes = ω * np.where(A != 0.0, 1.0, 0.0)
    sizes[:2, :2] = ω
    draws = np.random.default_rng(1).uniform(-1.0, 1.0, (500, 4, 4))
    machines = A + 1e-15 * draws * sizes * scale[:, None] / scale
    found = np.abs(np.linalg.eigvals(machines).real.max(axis=-1))
    assert found.max() < bound < 1e-12 * ω
    assert found.max() > 3e-16 * ω


def test_without_damping_a_spring_breaks_the_loop_where_the_admittance_is_no_longer_passive():
    here = cart_contact()
    limit, w = here.stability_limit(), here.passivity().frequency
    assert limit.frequency == pytest.approx(w, rel=1e-9)
    assert limit.value == pytest.approx(w / abs(here.admittance(w).rendered), rel=1e-8)
    assert limit.second_look == pytest.approx(DRAG / (TAU * SHARE), rel=1e-8)
    assert math.isnan(here.stability_limit(damping=1.0).second_look)
    s = 1j * w
    Y = (1 + SHARE / (TAU * s + 1)) / (M * s + DRAG / (TAU * s + 1))
    assert here.admittance(w).rendered == pytest.approx(Y, rel=1e-12)


@pytest.mark.parametrize("made", ["block", pytest.param("fmu", marks=pytest.mark.slow)])
def test_a_carts_limit_holds_in_the_run_of_the_solver(made):
    ports = {"position": "cart.position", "velocity": "cart.velocity", "force": "felt"}
    here = cart_contact()
    if made == "fmu":  # its signals are exchanged within the solver's steps, though it has co-simulation, too
        plant = Fmu(build(Cart(), name="cart"), name="cart")
        here = cart_diagram(plant).contact("cart.push", direction=[1.0], **ports)
    found = here.confirm(here.stability_limit())
    assert found.method is TrialMethod.SOLVER
    for trial in found.trials:
        k = trial.value
        growth = np.roots([M * TAU, M, k * TAU + DRAG, k * (1 + SHARE)]).real.max()
        assert trial.predicted == pytest.approx(growth, rel=1e-9)
        assert trial.measured == pytest.approx(growth, rel=0.01)


def test_a_force_that_is_not_measured_leaves_the_drag():
    ports = {"position": "cart.position", "velocity": "cart.velocity", "force": None}
    here = cart_diagram().contact("cart.push", direction=[1.0], **ports)
    assert here.stability_limit().value == math.inf
    s = 2.0j
    assert here.admittance(2.0).rendered == pytest.approx(1 / (M * s + DRAG / (TAU * s + 1)), rel=1e-12)


# --- a slow mode of the controller's own, near z = 1 --------------------------------------------------------------------

LEAK, GAIN = 0.13, 0.02
"""Rate of the mode in 1/s, which is z = 1 - 1.3e-4 at 1 kHz, and gain from the force to it."""


def test_a_slow_mode_that_the_environment_moves_is_told_from_a_drift_beside_it():
    cart, hand = Cart(name="cart"), Constant(value=0.0, unit="N", name="hand")

    @subsystem(sample_time=1e-3)
    def drive(velocity, push):
        felt = Gain(gain=1.0, name="sensor")(push).named("felt")
        slow = TransferFunction(numerator=(1.0,), denominator=(1.0, LEAK), name="slow")
        return -1.0 * Gain(gain=GAIN * 10, name="share")(slow(felt)) - Gain(gain=DRAG, name="drag")(velocity)

    ports = {"position": "cart.position", "velocity": "cart.velocity", "force": "felt"}
    made = Diagram("cart", cart(motor=drive(cart.velocity, hand), push=hand))
    here = made.contact("cart.push", direction=[1.0], **ports)
    found = here.stability_limit("damping")
    # at s = 0: (DRAG + b) v = g b v / LEAK, with the gain g; the position drifts, whatever the damper
    g = 10 * GAIN
    assert found.value == pytest.approx(LEAK * DRAG / (g - LEAK), rel=1e-7)
    assert found.frequency == pytest.approx(0.0, abs=1e-6)
    modes = here.loop("damping").modes
    assert np.min(np.abs(modes.fixed - 1.0)) < 1e-12  # the drift
    kept = np.linalg.eigvals(modes.reduce(here.loop("damping").close(np.float64(0.0)).A))
    assert np.min(np.abs(kept - np.exp(-LEAK * 1e-3))) < 1e-9
    assert found.growth_below < 0.0 < found.growth_above


def test_a_scan_goes_from_soft_to_stiff():
    here = cart_contact()
    assert here.stability_limit().scanned[1] == 1e8  # N/m
    with pytest.raises(OptionError, match="found 29 points in a decade; expected at least 30"):
        here.stability_limit(per_decade=29)


# --- an arm: joints that are not the axes of the force ---------------------------------------------------------------

ANGLES, STIFF, DAMPED, AMPLIFIED = np.array([0.07072564, 1.0852782]), 400.0, 30.0, 2.0
ARM = scara.nominal
JACOBIAN = np.array(ARM.dh(ANGLES))


class JointController(Block):
    angle = Input(shape=(2,), unit="rad")
    rate = Input(shape=(2,), unit="rad/s")
    force = Input(shape=(2,), unit="N")
    torque = Output(shape=(2,), unit="N.m")

    def output(self, t, x, u):
        return AMPLIFIED * (JACOBIAN.T @ u.force) - STIFF * (u.angle - ANGLES) - DAMPED * u.rate


def arm_diagram(sample_time=1e-3):
    arm = Fmu(scara.build(), name="arm")
    push = Constant(value=(0.0, 0.0), unit="N", name="push")

    @subsystem(sample_time=sample_time)
    def joints(angle, rate, acceleration, push):
        felt = ForceSensor(name="sensor", tool_mass=0.1)(push, acceleration).named("felt")
        return JointController(name="law")(angle, rate, felt)

    torque = joints(arm.joint_angle, arm.joint_velocity, arm.acceleration, push)
    return Diagram("arm", arm(motor_torque=torque, external_force=push))


def arm_growth(k, b, m, direction, T=1e-3, tool=0.1):
    """ln|z|/T of the arm's slowest pole: M q̈ = τ − D q̇ + Jᵀ F, F = −d (k dᵀp + b dᵀṗ + m dᵀp̈), p = J δq."""
    d, J = direction[:, None], JACOBIAN
    along = J.T @ d @ d.T @ J
    friction = np.diag(ARM.viscous_friction + ARM.coulomb_friction / ARM.friction_width)
    M, C, K = np.array(ARM.inertia(ANGLES)) + m * along, friction + b * along, k * along
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    B = np.vstack([np.zeros((2, 2)), np.linalg.inv(M)])
    held = expm(T * np.block([[A, B], [np.zeros((2, 6))]]))
    # measured: −d (k dᵀp + b dᵀṗ + m dᵀp̈) − tool p̈, with p̈ = J q̈ under the last torque
    pick = np.vstack([np.zeros((2, 2)), np.eye(2)]).T
    on_a = m * d @ d.T @ J + tool * J
    by_x = -d @ d.T @ J @ np.hstack([k * np.eye(2), b * np.eye(2)]) - on_a @ pick @ A
    by_u = -on_a @ pick @ B
    law = np.hstack([-STIFF * np.eye(2), -DAMPED * np.eye(2)]) + AMPLIFIED * J.T @ by_x
    u = np.hstack([law, AMPLIFIED * J.T @ by_u])
    closed = np.vstack([np.hstack([held[:4, :4], np.zeros((4, 2))]) + held[:4, 4:] @ u, u])
    return np.log(np.abs(np.linalg.eigvals(closed)).max()) / T


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.6, 0.8)])
@pytest.mark.parametrize(("vary", "held"), [("stiffness", {"damping": 5.0}), ("mass", {"stiffness": 50.0})])
def test_an_arm_has_the_limits_of_its_own_matrices(direction, vary, held):
    ports = {"position": "arm.position", "velocity": "arm.velocity", "force": "felt"}
    found = arm_diagram().contact("arm.external_force", direction=direction, **ports).stability_limit(vary, **held)
    names = {"stiffness": 0.0, "damping": 0.0, "mass": 0.0, **held}

    def growth(value):
        k, b, m = (names | {vary: value}).values()
        return arm_growth(k, b, m, np.array(direction))

    assert growth(0.99 * found.value) < 0.0 < growth(1.01 * found.value)
    expected = brentq(growth, 0.9 * found.value, 1.1 * found.value, xtol=1e-300, rtol=1e-14)
    assert found.value == pytest.approx(expected, rel=1e-9)
    assert found.growth_below == pytest.approx(growth(0.97 * found.value), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["inside", "held"])
@pytest.mark.parametrize(("vary", "held"), [("stiffness", {"damping": 5.0}), ("mass", {"stiffness": 50.0})])
def test_an_arms_limits_hold_in_the_nonlinear_run_with_an_environment(vary, held, method):
    ports = {"position": "arm.position", "velocity": "arm.velocity", "force": "felt"}
    here = arm_diagram().contact("arm.external_force", direction=(0.6, 0.8), **ports)
    found = here.confirm(here.stability_limit(vary, **held), push=1e-8, method=method)
    assert found.below.measured < 0 < found.above.measured
    if method == "held":
        assert found.tried == pytest.approx(found.limit.value, rel=0.1)  # T/10 of more delay
        return
    names = {"stiffness": 0.0, "damping": 0.0, "mass": 0.0, **held}
    k, b, m = (names | {vary: found.above.value}).values()
    assert found.above.measured == pytest.approx(arm_growth(k, b, m, np.array((0.6, 0.8))), rel=0.02)
    assert found.below.measured < 0 < found.above.measured


@pytest.mark.parametrize("delay", [None, 0])
def test_a_command_of_the_plant_is_no_measured_force(delay):
    cart, hand = Cart(name="cart"), Constant(value=0.0, unit="N", name="hand")
    felt = Gain(gain=1.0, name="sensor")(hand).named("felt")

    def drive(f, v):
        return (Gain(gain=SHARE, name="share")(f) - Gain(gain=DRAG, name="drag")(v)).named("command")

    made = drive if delay is None else subsystem(sample_time=1e-3, delay=delay, name="drive")(drive)
    here = Diagram("cart", cart(motor=made(felt, cart.velocity), push=hand))
    name = "command" if delay is None else "drive.command"
    ports = {"position": "cart.position", "velocity": "cart.velocity"}
    with pytest.raises(OptionError, match=rf"cart.push: found '{name}', which drives cart.motor; .*force=…"):
        here.contact("cart.push", direction=[1.0], force=name, **ports)
