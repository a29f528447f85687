"""Spring and damper, wall and hand, against their formulas and against integrals by SciPy."""

import pickle

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from loopwright.blocks import HandProfile, ParameterError, ShapeError, SpringDamper, Wall
from support.switching import Driven, at_ticks, in_time

RNG = np.random.default_rng(8)
T = 1e-3


def of(value):
    return lambda t: np.asarray(value, dtype=float)


def force(block, sampled=True, **given):
    return Driven(block, sampled, T, **{k: of(v) for k, v in given.items()}).outputs(0.0)["force"]


# --- spring and damper --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 3])
def test_a_spring_pulls_towards_its_anchor_and_a_damper_against_the_velocity(n):
    K, D = RNG.standard_normal((2, n, n))
    p, v, a, w, r = RNG.standard_normal((5, n))
    block = SpringDamper(stiffness=K, damping=D, rest=r)
    got = force(block, position=p, velocity=v, anchor=a, anchor_velocity=w)
    np.testing.assert_allclose(got, -K @ (p - a - r) - D @ (v - w), rtol=0, atol=1e-14)
    k, d = RNG.standard_normal((2, n))
    got = force(SpringDamper(stiffness=k, damping=d), position=p, velocity=v)
    np.testing.assert_allclose(got, [-k[i] * p[i] - d[i] * v[i] for i in range(n)], rtol=0, atol=1e-14)


def test_a_spring_of_one_number_serves_scalars_and_vectors():
    assert force(SpringDamper(stiffness=2.0, damping=3.0, rest=0.5), position=1.0, velocity=-1.0) == -2.0 * 0.5 + 3.0
    assert force(SpringDamper(stiffness=2.0), position=[1.0, 2.0]).tolist() == [-2.0, -4.0]


def test_shapes_that_do_not_fit_a_spring():
    with pytest.raises(
        ShapeError, match=r"spring_damper\.velocity: found shape \(3,\); expected a scalar, or \(2,\) as"
    ):
        force(SpringDamper(stiffness=1.0), position=np.zeros(2), velocity=np.zeros(3))
    with pytest.raises(
        ShapeError, match=r"spring_damper\.stiffness: found shape \(3, 3\) next to a position of shape \(2,\)"
    ):
        force(SpringDamper(stiffness=np.eye(3)), position=np.zeros(2))
    with pytest.raises(
        ParameterError, match=r"spring_damper\.stiffness: found an array of shape \(1, 2, 2\); expected at most"
    ):
        SpringDamper(stiffness=np.ones((1, 2, 2)))


# --- wall ---------------------------------------------------------------------------------------------------------------

WALL = {"stiffness": 2e3, "point": (0.5, 0.6), "normal": (3.0, -4.0)}


def test_a_wall_pushes_out_of_it_and_never_pulls():
    n = np.array([0.6, -0.8])
    for damping in (0.0, 40.0):
        wall = Wall(damping=damping, **WALL)
        for _ in range(200):
            p, v = np.array([0.5, 0.6]) + 0.05 * RNG.standard_normal(2), RNG.standard_normal(2)
            depth = n @ ([0.5, 0.6] - p)
            want = n * max(2e3 * depth - damping * (n @ v), 0.0) if depth > 0 else np.zeros(2)
            got = force(wall, position=p, velocity=v)
            np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)
            assert got @ n >= 0.0


def test_a_wall_for_a_scalar():
    wall = Wall(stiffness=10.0, damping=1.0, point=2.0, normal=-1.0)
    assert force(wall, position=2.5, velocity=1.0) == -10.0 * 0.5 - 1.0
    assert force(wall, position=1.9, velocity=1.0) == 0.0


def test_an_undamped_wall_has_the_event_of_contact_and_no_state():
    assert list(Wall(**WALL).events) == ["touch"]
    assert not Wall(**WALL).states
    assert list(Wall(damping=1.0, **WALL).events) == ["touch", "press"]


def test_contact_with_an_undamped_wall_lasts_while_the_body_is_in_it():
    # its output contact jumps although the force does not: in from arcsin 0.8, out at π − arcsin 0.8
    wall = Wall(stiffness=50.0, point=0.8, normal=-1.0)
    outputs, log = in_time(wall, 6.0, position=np.sin, velocity=np.cos)
    into = np.arcsin(0.8)
    assert [t for t, _ in log] == pytest.approx([into, np.pi - into], abs=1e-12)
    assert [float(outputs(t)["contact"]) for t in (0.5 * into, 0.5 * np.pi, 3.0)] == [0.0, 1.0, 0.0]


def test_contact_is_made_at_the_surface_and_lost_where_the_push_ends():
    # p = sin t along x against a wall at x = 0.8: in from arcsin 0.8; out where k (sin t − 0.8) + d cos t = 0
    k, d = 50.0, 10.0
    wall = Wall(stiffness=k, damping=d, point=0.8, normal=-1.0)
    outputs, log = in_time(wall, 6.0, position=np.sin, velocity=np.cos)
    phase = np.arctan2(d, k)
    into, out = np.arcsin(0.8), np.pi - np.arcsin(k * 0.8 / np.hypot(k, d)) - phase
    changed = [t for t, _ in log if outputs(t + 1e-9)["contact"] != outputs(t - 1e-9)["contact"]]
    assert changed == pytest.approx([into, out], abs=1e-13)
    assert outputs(into + 1e-12)["force"] == pytest.approx(-d * np.cos(into), rel=1e-9)
    for t in RNG.uniform(0.0, 6.0, 200):
        want = -(k * (np.sin(t) - 0.8) + d * np.cos(t)) if into < t < out else 0.0
        assert outputs(t)["force"] == pytest.approx(want, abs=1e-9)
        assert outputs(t)["depth"] == pytest.approx(np.sin(t) - 0.8, abs=1e-15)


def test_a_body_that_turns_before_it_is_out_is_pushed_again():
    # it retreats fast enough to lose the push while inside, then comes back
    position = lambda t: 1.0 + 0.05 * np.cos(20.0 * t)  # noqa: E731
    velocity = lambda t: -1.0 * np.sin(20.0 * t)  # noqa: E731
    wall = Wall(stiffness=100.0, damping=50.0, point=0.9, normal=-1.0)
    outputs, _ = in_time(wall, 1.0, grid=1e-3, position=position, velocity=velocity)
    for t in np.linspace(0.0, 0.999, 333):
        push = 100.0 * (position(t) - 0.9) + 50.0 * velocity(t)
        if abs(push) > 1e-6:
            assert outputs(t)["force"] == pytest.approx(-max(push, 0.0), abs=1e-9)


def test_a_start_in_the_wall_is_a_start_in_contact():
    for damping in (0.0, 5.0):
        assert force(Wall(damping=damping, **WALL), False, position=(0.4, 0.7)) @ [0.6, -0.8] == pytest.approx(280.0)


def test_shapes_that_do_not_fit_a_wall():
    with pytest.raises(
        ParameterError, match=r"wall\.normal: found normal=\[0\.0, 0\.0\] for point=\[0\.5, 0\.6\]; expected a"
    ):
        Wall(stiffness=1.0, point=(0.5, 0.6), normal=(0.0, 0.0))
    with pytest.raises(ParameterError, match=r"wall\.normal: found normal=\[1\.0, 0\.0, 0\.0\] for point"):
        Wall(stiffness=1.0, point=(0.5, 0.6), normal=(1.0, 0.0, 0.0))
    with pytest.raises(
        ShapeError, match=r"wall\.position: found shape \(3,\); expected \(2,\), as the wall's point has"
    ):
        force(Wall(**WALL), position=np.zeros(3))


def test_a_wall_lets_what_is_no_number_through():
    assert np.isnan(force(Wall(damping=1.0, **WALL), position=(np.nan, 0.0), velocity=(0.0, 0.0))).all()


# --- hand ---------------------------------------------------------------------------------------------------------------


def test_a_hand_rises_holds_and_lets_go():
    hand = HandProfile(
        start_time=1.0, rise_time=0.5, hold_time=2.0, release_time=0.25, peak_force=20.0, direction=(3.0, 4.0)
    )
    run = Driven(hand, False)

    def shape(t, t0, D):  # the 7th-order step as the integral of its rate, 140 z³(1 − z)³
        z = min(max((t - t0) / D, 0.0), 1.0)
        return quad(lambda s: 140.0 * s**3 * (1.0 - s) ** 3, 0.0, z, epsabs=1e-13)[0]

    for t in np.linspace(0.0, 5.0, 101):
        want = 20.0 * (shape(t, 1.0, 0.5) - shape(t, 3.5, 0.25)) * np.array([0.6, 0.8])
        np.testing.assert_allclose(run.outputs(t)["force"], want, rtol=0, atol=1e-11)


def test_a_hand_tells_its_corners():
    hand = HandProfile(start_time=1.0, rise_time=0.5, hold_time=2.0, release_time=0.25, peak_force=20.0)
    corners, t = [], -1.0
    while np.isfinite(t := hand.next_instant(t)):
        corners.append(t)
    assert corners == [1.0, 1.5, 3.5, 3.75]


def test_a_hand_without_direction_pushes_along_a_line():
    made = at_ticks(HandProfile(rise_time=1e-3, hold_time=1.0, peak_force=-7.0), T, 3)
    assert made["force"].tolist() == [0.0, -7.0, -7.0]
    with pytest.raises(ParameterError, match=r"hand_profile\.direction: found \[0\.0, 0\.0\]; expected a direction"):
        HandProfile(hold_time=1.0, peak_force=1.0, direction=(0.0, 0.0))


def test_a_mass_against_an_undamped_wall_leaves_as_fast_as_it_came():
    # the block as the right-hand side of a mass of 1 kg: half a period of √k in the wall
    k, y = 400.0, np.array([0.5, 1.0])
    wall = Wall(stiffness=k, point=1.0, normal=-1.0)
    run = Driven(wall, False, position=lambda t: y[0], velocity=lambda t: y[1])

    def rhs(t, state):
        y[:] = state
        return [state[1], float(run.outputs(t)["force"])]

    made = solve_ivp(rhs, (0.0, 2.0), [0.5, 1.0], rtol=1e-10, atol=1e-12, max_step=1e-2)
    leaving = 0.5 + np.pi / np.sqrt(k)
    assert made.y[:, -1] == pytest.approx([1.0 - (2.0 - leaving), -1.0], abs=1e-7)


@pytest.mark.parametrize(
    "block",
    [SpringDamper(stiffness=1.0), Wall(damping=1.0, **WALL), HandProfile(hold_time=1.0, peak_force=1.0)],
    ids=lambda b: type(b).__name__,
)
def test_they_are_values(block):
    assert pickle.loads(pickle.dumps(block)) == block
    assert block.replace() == block
