"""Contacts of users' own plants against closed forms: a haptic wall, a flexible joint, and a mass that changes with its place."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.blocks import Block, Constant, Gain, Input, OptionError, Output, State, parameter
from loopwright.diagrams import Diagram, subsystem
from loopwright.types import Array
from support.haptic import DRAG, HANDLE, MASS, T, haptic

# --- a haptic device: Colgate and Schenkel, b > K T/2 + |B| ------------------------------------------------------------


@pytest.mark.parametrize(
    ("damping", "delay", "limit"),
    [
        (0.0, 0, 2.0 * DRAG / T),
        (-0.2, 0, 2.0 * (DRAG - 0.2) / T),
        (0.0, 1, 2.0 * DRAG / (3.0 * T)),  # T/2 Re((1 − 1/z)/z K)/(1 − cos ωT) = K T (1 + 2 cos ωT)/2
    ],
)
@pytest.mark.drawn(1)
def test_a_virtual_wall_is_passive_up_to_the_stiffness_of_colgate_and_schenkel(damping, delay, limit):
    for factor in (0.999, 1.001):
        here = haptic(factor * limit, damping, delay).contact("handle.push", direction=[1.0], **HANDLE)
        w = np.array([0.1, 1.0, 3.0]) if factor > 1.0 else np.geomspace(0.1, 0.999 * math.pi / T, 60)
        Y = here.admittance(w).rendered
        assert np.all((Y.real < 0.0) if factor > 1.0 else (Y.real > 0.0))
        assert (here.passivity().frequency == math.inf) is (factor < 1.0)
        if factor < 1.0:  # a passive device is stable against every passive environment
            for vary in ("stiffness", "damping", "mass"):
                assert here.stability_limit(vary).value == math.inf


def test_the_fundamental_of_a_damped_wall_does_not_prove_passivity():
    # b > K T/2 + B is violated at the Nyquist frequency alone, where the aliases carry power
    limit = 2.0 * (DRAG - 0.3) / T
    here = haptic(1.2 * limit, 0.3).contact("handle.push", direction=[1.0], **HANDLE)
    found = here.passivity()
    assert found.frequency == math.inf
    assert "doesn't prove it" in found.caveat


def wall_growth(k, stiffness, delay):
    """Growth in 1/s of the handle on a spring k, whose wall is held: the poles of the sampled loop."""
    from scipy.linalg import expm

    A = np.array([[0.0, 1.0, 0.0], [-k / MASS, -DRAG / MASS, 1.0 / MASS], [0.0, 0.0, 0.0]])
    held = expm(A * T)[:2]
    columns = []
    for p, v, late in np.eye(3):
        x = held @ [p, v, -stiffness * (late if delay else p)]
        columns.append([*x, p])
    return math.log(np.max(np.abs(np.linalg.eigvals(np.transpose(columns))))) / T


@pytest.mark.parametrize("delay", [0, 1])
def test_a_wall_that_is_too_stiff_is_stable_from_a_stiffness_of_the_hand(delay):
    stiffness = 1.05 * 2.0 * DRAG / T / (1 + 2 * delay)
    here = haptic(stiffness, delay=delay).contact("handle.push", direction=[1.0], **HANDLE)
    found = here.stability_limit("stiffness")
    assert found.value == 0.0
    assert found.growth_above == pytest.approx(wall_growth(found.scanned[0], stiffness, delay), rel=1e-5)
    (first, *_) = found.restabilizes or (math.nan,)
    if found.restabilizes:
        assert first == pytest.approx(brentq(lambda k: wall_growth(k, stiffness, delay), 0.9 * first, 1.1 * first))


# --- two masses with a flexible joint ----------------------------------------------------------------------------------

MOTOR, LINK, JOINT, LOSS, KP, KD, SHARE = 1.5, 0.8, 3e3, 2.0, 400.0, 30.0, 1.5


class FlexibleJoint(Block):
    drive = Input(unit="N")
    push = Input(unit="N")
    motor = State(unit="m", start=0.0, output=True)
    motor_rate = State(unit="m/s", start=0.0, output=True)
    link = State(unit="m", start=0.0, output=True)
    link_rate = State(unit="m/s", start=0.0, output=True)

    def derivative(self, t, x, u):
        joint = JOINT * (x.link - x.motor) + LOSS * (x.link_rate - x.motor_rate)
        return x.motor_rate, (u.drive + joint) / MOTOR, x.link_rate, (u.push - joint) / LINK


@cache
def flexible():
    joint, hand = FlexibleJoint(name="arm"), Constant(value=0.0, unit="N", name="hand")
    felt = Gain(gain=1.0, name="sensor")(hand).named("felt")
    held = Gain(gain=KP, name="kp")(joint.motor) + Gain(gain=KD, name="kd")(joint.motor_rate)
    made = Diagram("flexible", joint(drive=Gain(gain=SHARE, name="share")(felt) - held, push=hand))
    ports = {"position": "arm.link", "velocity": "arm.link_rate", "force": "felt"}
    return made.contact("arm.push", direction=[1.0], **ports)


def flexible_poles(k=0.0, b=0.0, m=0.0, tool=0.0):
    """P (Q + E) − J (J − SHARE (E + tool s²)) = 0, with the environment E = m s² + b s + k."""
    s = np.polynomial.Polynomial([0.0, 1.0])
    P, Q, J = MOTOR * s**2 + (KD + LOSS) * s + KP + JOINT, LINK * s**2 + LOSS * s + JOINT, LOSS * s + JOINT
    E = m * s**2 + b * s + k
    return (P * (Q + E) - J * (J - SHARE * (E + tool * s**2))).roots()


@pytest.mark.parametrize(
    ("vary", "held"),
    [
        ("stiffness", {}),
        ("stiffness", {"damping": 3.0}),
        ("stiffness", {"mass": 0.2}),
        ("mass", {"stiffness": 50.0}),
        ("damping", {"stiffness": 200.0}),
        ("tool_mass", {"stiffness": 20.0}),
    ],
)
@pytest.mark.drawn(1)
def test_a_flexible_joint_has_the_limits_of_its_polynomial(vary, held):
    found = flexible().stability_limit(vary, **held)
    names = {"stiffness": "k", "damping": "b", "mass": "m", "tool_mass": "tool"}

    def growth(value):
        return max(flexible_poles(**{names[n]: v for n, v in {**held, vary: value}.items()}).real)

    grid = np.geomspace(*found.scanned, 200)
    sigma = np.array([growth(v) for v in grid])
    assert 0.0 < found.value < math.inf or np.all(sigma < 0.0) or sigma[0] > 0.0
    if 0.0 < found.value < math.inf:
        i = int(np.flatnonzero(sigma > 0.0)[0])
        assert found.value == pytest.approx(brentq(growth, grid[i - 1], grid[i], xtol=1e-300, rtol=1e-13), rel=1e-8)
        poles = flexible_poles(**{names[n]: v for n, v in {**held, vary: found.value}.items()})
        assert found.frequency == pytest.approx(abs(poles[np.argmax(poles.real)].imag), rel=1e-6)
    else:
        assert (found.value == 0.0) is bool(sigma[0] > 0.0)


def test_a_limit_of_the_tool_is_not_tried_where_no_force_sensor_carries_a_tool():
    here = flexible()
    loop = here.loop("tool_mass", stiffness=20.0)
    rates = {"growth_below": loop.growth_at(0.97), "growth_above": loop.growth_at(1.03)}
    limit = replace(here.stability_limit("tool_mass", stiffness=20.0), value=1.0, frequency=10.0, **rates)
    with pytest.raises(OptionError, match="arm.tool_mass: found no ForceSensor on the way of the measured force"):
        here.confirm(limit)


def test_the_admittance_and_a_map_of_a_flexible_joint_are_those_of_its_polynomial():
    s = 1j * np.geomspace(0.1, 1e4, 30)
    P, Q, J = MOTOR * s**2 + (KD + LOSS) * s + KP + JOINT, LINK * s**2 + LOSS * s + JOINT, LOSS * s + JOINT
    expected = s * (P + SHARE * J) / (P * Q - J * J)
    np.testing.assert_allclose(flexible().admittance(s.imag).rendered, expected, rtol=1e-9)
    w = flexible().passivity().frequency
    k, b = np.geomspace(10.0, 1e5, 5), np.array([0.0, 5.0])
    found = flexible().stability_map(k, b)
    np.testing.assert_allclose(found.growth, [[max(flexible_poles(x, y).real) for x in k] for y in b], rtol=1e-7)
    if math.isfinite(w):
        assert flexible().admittance(0.999 * w).rendered.real > 0.0 > flexible().admittance(1.001 * w).rendered.real


# --- two directions, and a mass that changes with its place -------------------------------------------------------------


class Plate(Block):
    """A mass that grows with its place along the first axis, and another along the second."""

    heavier: float = parameter(default=2.0, unit="1/m2")
    drive = Input(shape=(2,), unit="N")
    push = Input(shape=(2,), unit="N")
    start_place: Array = parameter(default=(0.0, 0.0), shape=(2,), unit="m")
    place = State(shape=(2,), unit="m", start="start_place", output=True)
    rate = State(shape=(2,), unit="m/s", start=(0.0, 0.0), output=True)

    def derivative(self, t, x, u):
        force = u.drive + u.push
        mass = 2.0 * (1.0 + self.heavier * x.place[0] ** 2)
        return x.rate, np.stack([force[0] / mass, force[1] / 5.0])


class Servo(Block):
    wanted: Array = parameter(default=(0.0, 0.0), shape=(2,), unit="m")
    place = Input(shape=(2,), unit="m")
    rate = Input(shape=(2,), unit="m/s")
    force = Input(shape=(2,), unit="N")
    drive = Output(shape=(2,), unit="N")

    def output(self, t, x, u):
        return 3.0 * u.force - 300.0 * (u.place - self.wanted) - 40.0 * u.rate


PLATE_T = 2e-3


def plate_growth(k, first, direction):
    """Growth in 1/s of the sampled loop with a spring along a direction, at a place on the first axis."""
    from scipy.linalg import expm

    d, W = np.array(direction), np.diag([1.0 / (2.0 * (1.0 + 2.0 * first**2)), 0.2])
    K = k * np.outer(d, d)
    whole = np.zeros((6, 6))
    whole[:2, 2:4], whole[2:4, :2], whole[2:4, 4:] = np.eye(2), -W @ K, W
    held = expm(whole * PLATE_T)
    law = np.hstack([-3.0 * K - 300.0 * np.eye(2), -40.0 * np.eye(2)])
    return math.log(np.max(np.abs(np.linalg.eigvals(held[:4, :4] + held[:4, 4:] @ law)))) / PLATE_T


@pytest.mark.parametrize("first", [0.0, 0.7])
@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, -2.0), (0.6, 0.8)])
@pytest.mark.drawn(1)
def test_directions_and_operating_points_of_a_plate(first, direction):
    plate = Plate(name="plate", start_place=(first, 0.3))
    hand = Constant(value=(0.0, 0.0), unit="N", name="hand")

    @subsystem(sample_time=PLATE_T)
    def servo(place, rate, push):
        felt = Gain(gain=1.0, name="sensor")(push).named("felt")
        return Servo(name="law", wanted=(first, 0.3))(place, rate, felt)

    made = Diagram("plate", plate(drive=servo(plate.place, plate.rate, hand), push=hand))
    ports = {"position": "plate.place", "velocity": "plate.rate", "force": "felt"}
    found = made.contact("plate.push", direction=direction, **ports).stability_limit()
    unit = np.array(direction) / np.linalg.norm(direction)
    expected = brentq(lambda k: plate_growth(k, first, unit), 0.9 * found.value, 1.1 * found.value, rtol=1e-13)
    assert found.value == pytest.approx(expected, rel=1e-8)
    if 0.0 in direction:
        np.testing.assert_allclose(np.abs(found.direction), np.abs(unit), atol=1e-9)
    away = made.replace({"plate.start_place": (first + 0.5, 0.3), "servo.law.wanted": (first + 0.5, 0.3)})
    other = away.contact("plate.push", direction=direction, at=away.operating_point(0.01), **ports).stability_limit()
    expected = brentq(lambda k: plate_growth(k, first + 0.5, unit), 0.8 * other.value, 1.2 * other.value, rtol=1e-13)
    assert other.value == pytest.approx(expected, rel=1e-8)
