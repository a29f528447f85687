"""The limits of the admittance filter, against recurrences of the path reference written by hand."""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from loopwright.blocks import AdmittanceFilter, Block, Constant, Output, ParameterError
from loopwright.blocks.tracing.traced import trace
from loopwright.diagrams import Diagram, subsystem

LIMITS = {
    "none": {},
    "velocity": {"velocity_limit": 0.3},
    "acceleration": {"acceleration_limit": 2.0},
    "both": {"velocity_limit": 0.3, "acceleration_limit": 2.0},
}
EVERY = pytest.mark.parametrize("limits", LIMITS.values(), ids=LIMITS)
FILTERS = {"along": (0.5, 2.7, 10.0), "across": (2.0, 12.0, 200.0), "free": (2.0, 12.0, 0.0)}  # m, d, k
EACH = pytest.mark.parametrize(("m", "d", "k"), FILTERS.values(), ids=FILTERS)


@cache
def free_motion(m, d, k, T):
    """(e, e') at the next tick from (e, e', drive), the drive held: the exponential with the drive as a third state."""
    return expm(np.array([[0, 1, 0], [-k / m, -d / m, 1 / m], [0, 0, 0]]) * T)[:2]


def tick_by_hand(m, d, k, T, state, reference, drive, velocity_limit=np.inf, acceleration_limit=np.inf, euler=False):
    """The path reference (p, v, a) at a tick, the state at the next one, and whether a limit acts.

    The state is the deviation from the reference and its rate, (e, e', 0), and after a tick in which a limit acted
    position and velocity of the path reference, (p, v, 1). Free, the deviation moves by the exact hold (or the velocity,
    then the position by Euler). Where the acceleration of the path reference is too large, or its velocity would be at
    the next tick, as far as the reference's rate and acceleration tell, the acceleration is cut to what is admissible:
    v + a T within the limit of the velocity, and in any case within its own; the path reference then moves as under a
    constant acceleration, by v T + a T^2/2 and a T. A velocity that was not foreseen is cut too.
    """
    r, r1, r2 = reference
    e, e1 = (state[0] - r, state[1] - r1) if state[2] else state[:2]
    p, v = r + e, np.clip(r1 + e1, -velocity_limit, velocity_limit)
    e1 = v - r1
    a = r2 + (drive - d * e1 - k * e) / m
    if euler:
        rate = e1 + T * (a - r2)
        free = np.array([e + T * rate, rate])
    else:
        free = free_motion(m, d, k, T) @ [e, e1, drive]
    if abs(a) <= acceleration_limit and abs(r1 + r2 * T + free[1]) <= velocity_limit:
        return np.array([p, v, a]), np.array([*free, 0.0]), False
    a = np.clip(a, (-velocity_limit - v) / T, (velocity_limit - v) / T)
    a = np.clip(a, -acceleration_limit, acceleration_limit)
    return np.array([p, v, a]), np.array([p + v * T + a * T**2 / 2, v + a * T, 1.0]), True


def equations(block, T, method="exact"):
    """A function of state, reference, force, desired force and offset, that gives the path reference and next (or e', e'')."""
    shapes = {name: (3,) if name == "reference" else () for name in block.inputs}
    made = trace(block, shapes, sampled=T is not None, method=method)
    p = ca.DM(made.pack(block, np.nan if T is None else T))

    def evaluate(state, reference, force, desired=0.0, offset=0.0):
        given = {"force": force, "reference": ca.DM(reference), "desired_force": desired, "offset": offset}
        n = len(block.states)  # without limits, none can have acted
        found = made.function.call([0.0, ca.DM(state[:n]), *(given[name] for name in block.inputs), p])
        row, after = (np.array(value).ravel() for value in found[:2])
        return [row, np.concatenate([after, np.zeros(3 - n)])]

    return evaluate


# --- sampled ----------------------------------------------------------------------------------------------------------


@pytest.mark.drawn(2)
@EVERY
@EACH
@pytest.mark.parametrize("method", ["exact", "semi_implicit"])
def test_a_tick_is_free_or_cut_to_the_admissible_acceleration(limits, m, d, k, method):
    # random states around the limits: some free, some over one limit, some over both, some already too fast
    rng = np.random.default_rng(21)
    acted, T = [], 0.02
    tick = equations(AdmittanceFilter(mass=m, damping=d, stiffness=k, **limits), T, method)
    for _ in range(300):
        e, reference = rng.normal(0, (0.05, 0.3)), rng.normal(0, (0.5, 0.3, 1.0))
        was_cut = bool(limits) and rng.random() < 0.5
        state = (*(e + reference[:2]), 1.0) if was_cut else (*e, 0.0)
        force, desired, offset = rng.normal(0, m * 2.0), rng.normal(0, m), rng.normal(0, 0.02)
        row, after = tick(state, reference, force, desired, offset)
        drive = force - desired + k * offset
        want = tick_by_hand(m, d, k, T, state, reference, drive, euler=method == "semi_implicit", **limits)
        np.testing.assert_allclose(row, want[0], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(after, want[1], rtol=1e-12, atol=1e-13)
        acted.append(want[2])
    assert (30 < sum(acted) < 290) if limits else not any(acted)


class Given(Block):
    """A force that swings and steps, and a reference that moves."""

    force = Output(unit="N")
    reference = Output(shape=(3,), unit=("m", "m/s", "m/s2"))

    def output(self, t, x, u):
        w = 2.0
        moving = np.stack([0.1 * np.sin(w * t), 0.1 * w * np.cos(w * t), -0.1 * w**2 * np.sin(w * t)])
        return np.where(t >= 1.0, 4.0, 0.0) + 3.0 * np.sin(7.0 * t), moving


@pytest.mark.slow
@EVERY
@pytest.mark.parametrize("method", ["exact", "semi_implicit"])
def test_a_run_goes_by_the_recurrence_into_the_limits_and_out_of_them(limits, method):
    m, d, k, T, ticks = 0.5, 2.7, 10.0, 5e-3, 800

    @subsystem(sample_time=T, method=method)
    def box(force, reference):
        return AdmittanceFilter(name="filter", mass=m, damping=d, stiffness=k, **limits)(force, reference)

    given = Given(name="given")()
    run = Diagram("admittance", box(given.force, given.reference)).simulate(ticks * T, progress=False)
    state, rows, acted = np.zeros(3), [], []
    for i in range(ticks + 1):
        t = i * T
        force, w = (4.0 if t >= 1.0 else 0.0) + 3.0 * np.sin(7.0 * t), 2.0
        reference = (0.1 * np.sin(w * t), 0.1 * w * np.cos(w * t), -0.1 * w**2 * np.sin(w * t))
        row, state, acts = tick_by_hand(m, d, k, T, state, reference, force, euler=method == "semi_implicit", **limits)
        rows.append(row)
        acted.append(acts)
    np.testing.assert_allclose(run["filter.path_reference"], rows, rtol=0, atol=1e-11)
    assert np.abs(np.diff(acted)).sum() >= 4 if limits else not any(acted)  # in and out, more than once
    _, v, a = run["filter.path_reference"].T
    assert np.abs(v).max() <= limits.get("velocity_limit", np.inf) + 1e-12
    assert np.abs(a).max() <= limits.get("acceleration_limit", np.inf) + 1e-12


def test_at_rest_under_a_constant_force_it_brakes_at_the_limit_and_stays_there():
    # 6 N on 0.5 kg: 12 m/s2, cut to 2 m/s2 for 0.15 s up to 0.3 m/s, then at that speed: no drag, no spring
    @subsystem(sample_time=1e-3)
    def box(force):
        block = AdmittanceFilter(name="f", mass=0.5, damping=0.0, stiffness=0.0, **LIMITS["both"])
        return block(force, np.zeros(3))

    run = Diagram("d", box(Constant(value=6.0, unit="N"))).simulate(0.5, progress=False)
    p, v, a = run["f.path_reference"].T
    t, top = run.t, np.minimum(run.t, 0.15)
    np.testing.assert_allclose(v, 2.0 * top, atol=1e-12)
    np.testing.assert_allclose(p, top**2 + 0.3 * (t - top), atol=1e-12)
    np.testing.assert_allclose(a[:150], 2.0, atol=1e-12)
    np.testing.assert_allclose(a[151:], 0.0, atol=1e-9)  # what rounding of v leaves, over T


# --- continuous -------------------------------------------------------------------------------------------------------


def rates_by_hand(m, d, k, e, reference, drive, held, acceleration_limit=np.inf):
    """(e', e'') in continuous time: the acceleration of the path reference is cut, and zero at a speed limit."""
    _, _, r2 = reference
    a = 0.0 if held else np.clip(r2 + (drive - d * e[1] - k * e[0]) / m, -acceleration_limit, acceleration_limit)
    return np.array([e[1], a - r2])


@pytest.mark.slow
@pytest.mark.drawn(4)
@EVERY
@EACH
def test_in_continuous_time_the_acceleration_is_cut_and_zero_at_the_speed_limit(limits, m, d, k):
    """With a speed limit the states are the path reference itself, else the deviation from the reference."""
    rng = np.random.default_rng(22)
    continuous, cut, stopped = equations(AdmittanceFilter(mass=m, damping=d, stiffness=k, **limits), None), 0, 0
    has_speed, most = "velocity_limit" in limits, limits.get("acceleration_limit", np.inf)
    for i in range(300):
        e, reference = rng.normal(0, (0.05, 0.03)), rng.normal(0, (0.5, 0.03, 1.0))
        held = has_speed and i % 3 == 0
        if held:
            e[1] = 0.3 * rng.choice([-1.0, 1.0]) - reference[1]
        force, desired, offset = rng.normal(0, m * 2.0), rng.normal(0, m), rng.normal(0, 0.02)
        state = (*(e + reference[:2]), 1.0 + held) if has_speed else (*e, 0.0)
        row, rates = continuous(state, reference, force, desired, offset)
        drive = force - desired + k * offset
        want = rates_by_hand(m, d, k, e, reference, drive, held, most)
        path = reference[1:] if has_speed else np.zeros(2)
        np.testing.assert_allclose(rates[:2], want + path, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(row, reference + np.array([*e, want[1]]), rtol=1e-12, atol=1e-12)
        cut += bool(want[1] != rates_by_hand(m, d, k, e, reference, drive, held)[1])
        stopped += held
    assert cut > 30 if "acceleration_limit" in limits else cut == 0
    assert stopped == 100 * has_speed


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize("name", ["velocity", "both"])
def test_in_continuous_time_it_runs_into_the_speed_limit_and_out_of_it_at_events(name):
    """Against SciPy's solution of the two motions, at the limit and below it, one after the other."""
    m, d, k, limits, end = 0.5, 2.7, 10.0, LIMITS[name], 4.0
    top, most = limits["velocity_limit"], limits.get("acceleration_limit", np.inf)

    def wanted(t, s):
        w = 2.0
        r, v, a = 0.1 * np.sin(w * t), 0.1 * w * np.cos(w * t), -0.1 * w**2 * np.sin(w * t)
        force = 4.0 * np.sin(3.0 * t) + 3.0 * np.sin(7.0 * t)
        return np.clip(a + (force - d * (s[1] - v) - k * (s[0] - r)) / m, -most, most)

    class Moves(Block):
        force = Output(unit="N")
        reference = Output(shape=(3,), unit=("m", "m/s", "m/s2"))

        def output(self, t, x, u):
            w = 2.0
            moving = np.stack([0.1 * np.sin(w * t), 0.1 * w * np.cos(w * t), -0.1 * w**2 * np.sin(w * t)])
            return 4.0 * np.sin(3.0 * t) + 3.0 * np.sin(7.0 * t), moving

    given = Moves(name="given")()
    block = AdmittanceFilter(name="f", mass=m, damping=d, stiffness=k, **limits)
    diagram = Diagram("d", block(given.force, given.reference))
    run = diagram.simulate(end, step=1e-2, rtol=1e-11, atol=1e-13, progress=False)

    t, s, held, rows, instants = 0.0, np.array([0.0, 0.2]), 0, [], []
    while t < end:
        rate, event = (
            (lambda t, s: [s[1], 0.0], lambda t, s, side=held: side * wanted(t, s))
            if held
            else (lambda t, s: [s[1], wanted(t, s)], lambda t, s: abs(s[1]) - top)
        )
        event.terminal, event.direction = True, -1 if held else 1
        part = solve_ivp(
            rate, (t, end), s, "DOP853", rtol=1e-12, atol=1e-14, events=event, max_step=0.02, dense_output=True
        )
        rows += [part.sol(time) for time in run.t[(run.t >= t) & (run.t < part.t[-1])]]
        t, s = part.t[-1], part.y[:, -1]
        held = 0 if held else int(np.sign(s[1]))
        if t < end:
            instants.append(t)
            s = np.array([s[0], held * top if held else s[1]])
    rows.append(s)
    assert len(instants) >= 6
    found = [e.t for e in run.events]
    assert [e.event for e in run.events] == (["reached", "released"] * len(found))[: len(found)]
    np.testing.assert_allclose(found, instants, rtol=0, atol=1e-9)
    np.testing.assert_allclose(run["f.path_reference"][:, :2], rows, rtol=0, atol=1e-9)
    sampled = [
        np.max(np.abs(diagram.sampled(T).simulate(end, progress=False)["f.path_reference"][:, 0] - at[:, 0]))
        for T, at in ((T, diagram.simulate(end, step=T, progress=False)["f.path_reference"]) for T in (1e-2, 5e-3))
    ]
    assert 1.8 < sampled[0] / sampled[1] < 2.2  # the sampled one is of first order


@pytest.mark.parametrize("sampled", [False, True])
def test_a_reference_that_starts_too_fast_is_followed_at_the_limit(sampled):
    class Fast(Block):
        reference = Output(shape=(3,), unit=("m", "m/s", "m/s2"))

        def output(self, t, x, u):
            return np.stack([0.25 + 2.0 * t, 2.0 + 0.0 * t, 0.0 * t])

    block = AdmittanceFilter(name="f", mass=1.0, damping=0.0, stiffness=0.0, velocity_limit=0.5)
    diagram = Diagram("d", block(0.0, Fast(name="fast").reference))
    diagram = diagram.sampled(0.125) if sampled else diagram
    run = diagram.simulate(1.0, step=0.125, progress=False)
    p, v, a = run["f.path_reference"].T
    np.testing.assert_allclose(p, 0.25 + 0.5 * run.t, rtol=0, atol=1e-12)
    np.testing.assert_allclose(v, 0.5, rtol=0, atol=1e-12)
    np.testing.assert_allclose(a, 0.0, rtol=0, atol=1e-12)


@EACH
def test_in_continuous_time_its_rates_are_those_of_the_impedance(m, d, k):
    # m e'' + d e' + k e = F - F^d + k offset, whatever the reference does
    rng = np.random.default_rng(23)
    continuous = equations(AdmittanceFilter(mass=m, damping=d, stiffness=k), None)
    for _ in range(20):
        e, reference = rng.normal(size=2), rng.normal(size=3)
        force, desired, offset = rng.normal(size=3)
        _, rates = continuous((*e, 0.0), reference, force, desired, offset)
        balance = m * rates[1] + d * e[1] + k * e[0] - (force - desired + k * offset)
        assert rates[0] == e[1]
        assert abs(balance) < 1e-13 * (abs(force) + abs(desired) + k + d + m) * 10


def test_a_ratio_is_the_damping_of_the_impedance():
    # d = 2 zeta sqrt(m k) (E7): Table III gives 2.68328 and 12 N s/m
    for m, zeta, k, d in ((0.5, 0.6, 10.0, 2.6832815729997477), (2.0, 0.3, 200.0, 12.0)):
        by_ratio, by_number = (
            equations(AdmittanceFilter(mass=m, stiffness=k, **given), 0.01)((0.1, -0.4, 0.0), (0.0, 0.0, 0.0), 1.5)
            for given in ({"damping_ratio": zeta}, {"damping": d})
        )
        np.testing.assert_allclose(by_ratio[0], by_number[0], rtol=1e-14)
        np.testing.assert_allclose(by_ratio[1], by_number[1], rtol=1e-14)


@pytest.mark.parametrize("name", ["velocity_limit", "acceleration_limit", "mass"])
@pytest.mark.parametrize("value", [0.0, -1.0])
def test_limits_and_masses_that_are_not_positive_are_refused(name, value):
    with pytest.raises(ParameterError, match=rf"AdmittanceFilter\.{name}: found .*; expected a value above 0"):
        AdmittanceFilter(**{"mass": 1.0, "stiffness": 1.0, "damping": 1.0, name: value})
