"""The limits of the admittance filter, against recurrences of the path reference written by hand."""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import AdmittanceFilter, Block, Constant, Output, ParameterError
from loopwright.blocks._tracing import trace
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


def rates_by_hand(m, d, k, e, reference, drive, velocity_limit=np.inf, acceleration_limit=np.inf):
    """(e', e'') in continuous time: the acceleration of the path reference is cut, and never leads out of a speed limit."""
    _, r1, r2 = reference
    a = np.clip(r2 + (drive - d * e[1] - k * e[0]) / m, -acceleration_limit, acceleration_limit)
    v = r1 + e[1]
    if (v >= velocity_limit and a > 0) or (v <= -velocity_limit and a < 0):
        a = 0.0
    return np.array([e[1], a - r2])


@EVERY
@EACH
def test_in_continuous_time_the_acceleration_is_cut_and_never_leads_out_of_the_speed_limit(limits, m, d, k):
    rng = np.random.default_rng(22)
    continuous, cut, stopped = equations(AdmittanceFilter(mass=m, damping=d, stiffness=k, **limits), None), 0, 0
    for i in range(300):
        e, reference = rng.normal(0, (0.05, 0.15)), rng.normal(0, (0.5, 0.15, 1.0))
        if i % 3 == 0 and "velocity_limit" in limits:  # exactly at the limit
            side = rng.choice([-1.0, 1.0])
            e[1], reference[1] = 0.25 * side, 0.3 * side - 0.25 * side
        force, desired, offset = rng.normal(0, m * 2.0), rng.normal(0, m), rng.normal(0, 0.02)
        row, rates = continuous((*e, 0.0), reference, force, desired, offset)
        drive = force - desired + k * offset
        want = rates_by_hand(m, d, k, e, reference, drive, **limits)
        np.testing.assert_allclose(rates[:2], want, rtol=1e-12, atol=1e-12)
        if abs(reference[1] + e[1]) <= limits.get("velocity_limit", np.inf):
            np.testing.assert_allclose(row, reference + np.array([*e, want[1]]), rtol=1e-12, atol=1e-12)
        free = rates_by_hand(m, d, k, e, reference, drive)
        cut += bool(want[1] != free[1])
        stopped += bool(want[1] == -reference[2])
    assert cut > 30 if limits else cut == 0
    assert stopped > 20 if "velocity_limit" in limits else stopped == 0


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
