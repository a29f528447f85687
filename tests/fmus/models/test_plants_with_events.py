"""The plants with events: a ball that bounces, and the gantry with a wall, against closed forms and SciPy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.fmus import Fmu, bouncing_ball, gantry_contact
from support.plants import C_V, F_C, FREE, WEIGHT, M, run

# --- bouncing_ball ----------------------------------------------------------------------------------------------------

G, E = 9.81, 0.7


def falls(t, h0, speed=0.01):
    """Height, velocity, bounces and rest at the times t, from rest at h0: parabolas between impacts."""
    at, v, n = 0.0, 0.0, 0
    h, result = h0, []
    until = np.sqrt(2 * h0 / G)
    for now in t:
        while now >= at + until and v is not None:
            at, v, h, n = at + until, E * (np.sqrt(2 * G * h0) if n == 0 else v), 0.0, n + 1
            if v < speed:
                v = None  # it rests
            else:
                until = 2 * v / G
        s = now - at
        result.append((0.0, 0.0, n, 1) if v is None else (h + v * s - G * s**2 / 2, v - G * s, n, 0))
    return np.array(result, dtype=float)


def test_the_ball_follows_its_parabolas_to_rest():
    T, n = 1e-2, 300
    file = bouncing_ball.build()
    got = ball(file, T, n)
    t = T * np.arange(n + 1)
    want = falls(t, 1.0)
    assert np.abs(got["height"] - want[:, 0]).max() < 1e-13
    assert np.abs(got["velocity"] - want[:, 1]).max() < 1e-11  # times of impact to rounding
    assert np.array_equal(got["bounces"], want[:, 2])
    assert np.array_equal(got["resting"], want[:, 3])
    last = int(np.ceil(np.log(0.01 / np.sqrt(2 * G)) / np.log(E)))
    assert got["bounces"][-1] == last == 18
    assert [got[name][-1] for name in ("resting", "height", "velocity")] == [1.0, 0.0, 0.0]


def test_all_bounces_fall_within_one_long_step():
    # from 1 m it rests after 2.55 s; one communication step of 3 s has all eighteen impacts
    got = ball(bouncing_ball.build(), 3.0, 1)
    assert got["bounces"].tolist() == [0.0, 18.0]
    assert got["height"].tolist() == [1.0, 0.0]


@pytest.mark.parametrize(("resting_speed", "bounces"), [(0.0102, 18), (0.0104, 17)])
def test_the_ball_rests_where_an_impact_would_leave_too_slowly(resting_speed, bounces):
    # the 17th impact leaves with 0.7^17 sqrt(2 g) = 10.3 mm/s
    assert ball(bouncing_ball.build(), 3.0, 1, resting_speed=resting_speed)["bounces"][-1] == bounces


def test_an_elastic_ball_keeps_its_energy():
    got = ball(bouncing_ball.build(), 1e-2, 1000, restitution=1.0)
    energy = G * got["height"] + got["velocity"] ** 2 / 2
    assert got["bounces"][-1] == 11  # 2 sqrt(2 h/g) = 0.903 s each, the first after half of that
    assert np.ptp(energy) < 1e-11


def ball(file, T, n, **start):
    plant = Fmu(file, name="ball", start=start)
    y, names = np.zeros(4), list(plant.outputs)
    with plant.instantiate([], n * T) as instance:
        instance.bind(np.zeros(0), y)
        instance.begin()
        rows = [y.copy()]
        for k in range(n):
            instance.step(k * T, T)
            rows.append(y.copy())
    return dict(zip(names, np.array(rows).T, strict=True))


# --- gantry_contact ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_bounce_on_the_wall_is_half_a_damped_oscillation():
    # z alone, without friction and weight: M delta'' + d delta' + k delta = 0 from delta = 0 on, until the force ends at
    # omega_d tau = pi - 2 asin(zeta), and the mass leaves with e^(-zeta omega tau) of its speed
    T, n, v, k, d = 1e-3, 200, 0.53, 2e4, 400.0
    start = {**FREE, "position": (0.5, 0.62), "velocity": (0.0, v), "wall_stiffness": k, "wall_damping": d}
    still = np.zeros((n, 2))
    got = run(gantry_contact.build(), T, start, motor_force=still, external_force=still)
    omega = np.sqrt(k / M[1])
    zeta = d / (2 * M[1] * omega)
    omega_d = omega * np.sqrt(1 - zeta**2)
    t, hit = T * np.arange(n + 1), 0.02 / v
    leave = (np.pi - 2 * np.arcsin(zeta)) / omega_d
    tau = np.clip(t - hit, 0.0, leave)
    decay = np.exp(-zeta * omega * tau)
    depth = v / omega_d * decay * np.sin(omega_d * tau)
    rate = v * decay * (np.cos(omega_d * tau) - zeta * omega / omega_d * np.sin(omega_d * tau))
    inside = (t > hit) & (t < hit + leave)
    depth += np.minimum(t - hit, 0.0) * v + np.maximum(t - hit - leave, 0.0) * rate
    assert 0.05 < zeta < 0.5
    assert inside.sum() > 50
    assert np.array_equal(got["contact"], inside)
    assert np.abs(got["penetration"] - depth).max() < 1e-12
    assert np.abs(got["position"][:, 1] - 0.64 - depth).max() < 1e-12
    assert np.abs(got["velocity"][:, 1] - rate).max() < 1e-11
    assert rate[-1] == pytest.approx(-v * np.exp(-zeta * omega * leave), rel=1e-12)
    force = -np.where(inside, k * depth + d * rate, 0.0)
    assert np.abs(got["contact_force"] - force[:, None] * [0.0, 1.0]).max() < 1e-8
    assert np.abs(got["acceleration"][:, 1] - force / M[1]).max() < 1e-9
    assert got["contact_force"][:, 1].max() <= 0.0  # it never pulls


def touching(t_end, x0, u, wall):
    """The gantry with a wall by SciPy: phases between events, u(t) constant in pieces of 50 ms; states at 1 ms."""
    point, normal, k, d = wall
    normal = np.array(normal) / np.hypot(*normal)

    def depth(x):
        return normal @ (point - x[:2])

    def push(x):
        return k * depth(x) - d * normal @ x[2:]

    def rhs(t, x, force, contact):
        v = x[2:]
        wall_force = normal * push(x) if contact else 0.0
        rub = F_C * np.tanh(v / 0.01) + C_V * v
        return np.concatenate([v, (force - rub - WEIGHT + wall_force) / M])

    def event(function, direction):
        def crossing(t, x, force, contact):
            return function(x)

        crossing.direction, crossing.terminal = direction, True
        return crossing

    made, left = event(lambda x: min(k * depth(x), push(x)), 1), event(push, -1)
    rows, contacts, kinds, x, contact, t = [np.array(x0)], [0.0], [], np.array(x0, dtype=float), False, 0.0
    for piece in range(round(t_end / 0.05)):
        end, force = 0.05 * (piece + 1), u[piece]
        grid = 0.05 * piece + 1e-3 * np.arange(1, 51)
        grid[-1] = end
        while t < end:
            events = left if contact else made
            here = grid[grid > t]
            options = {"rtol": 1e-12, "atol": 1e-14, "max_step": 1e-2, "args": (force, contact)}
            s = solve_ivp(rhs, (t, end), x, "DOP853", here, events=events, **options)
            rows += list(s.y.T)
            contacts += [float(contact)] * s.y.shape[1]
            if s.status == 0:
                t, x = end, s.y[:, -1]
                continue
            t, x = s.t_events[0][0], s.y_events[0][0]
            kinds.append("release" if contact else "touch" if depth(x) < 1e-9 else "press")
            contact = not contact
    return np.array(rows), np.array(contacts), kinds


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wall", "pattern", "kinds"),
    [
        # a hard wall, oblique to the axes: it bounces, lies on, and is pulled off
        (((0.55, 0.6), (-0.6, -0.8), 1e5, 150.0), [160, 160, 160, 160, 160, -160], {"touch", "release"}),
        # a slow one: the robot is pulled off and pushed back before the surface has followed
        (((0.55, 0.6), (-3.0, 4.0), 500.0, 1500.0), [160, 160, 160, 160, -120, 160], {"touch", "release", "press"}),
    ],
)
def test_contact_is_made_and_broken_as_by_scipy(wall, pattern, kinds):
    pieces, normal = 20, np.array(wall[1]) / np.hypot(*wall[1])
    u = -np.outer(np.resize(pattern, pieces), normal) + WEIGHT
    x0 = [*(np.array(wall[0]) + 0.012 * normal), 0.0, 0.0]
    want, contact, found = touching(0.05 * pieces, x0, u, wall)
    assert set(found) == kinds
    assert len(found) > 6
    names = ("wall_point", "wall_normal", "wall_stiffness", "wall_damping")
    start = {**dict(zip(names, wall, strict=True)), "position": x0[:2], "internal_step": 5e-5}
    held = np.repeat(u, 50, axis=0)
    got = run(gantry_contact.build(), 1e-3, start, motor_force=held, external_force=np.zeros_like(held))
    assert np.abs(got["position"] - want[:, :2]).max() < 1e-11
    assert np.abs(got["velocity"] - want[:, 2:]).max() < 3e-10
    assert np.array_equal(got["contact"], contact)
    assert (got["contact_force"] @ normal).min() >= -1e-9


def test_the_walls_normal_needs_no_length():
    still = np.tile([0.0, 200.0], (100, 1))
    start = {"position": (0.5, 0.635)}
    one, ten = (
        run(
            gantry_contact.build(),
            1e-3,
            {**start, "wall_normal": (0.0, -length)},
            motor_force=still,
            external_force=0 * still,
        )
        for length in (1.0, 10.0)
    )
    assert one["contact"].max() == 1.0
    assert np.abs(one["contact_force"] - ten["contact_force"]).max() < 1e-9
