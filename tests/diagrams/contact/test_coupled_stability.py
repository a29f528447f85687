"""Coupled stability: poles against polynomials, limits against the running co-simulation."""

import math
import pickle
import re

import mpmath
import numpy as np
import pytest

from loopwright.blocks import AdmittanceFilter, Ellipse, OptionError, ParameterError
from loopwright.blocks.core.errors import UnknownNameError
from loopwright.diagrams import (
    AdmittanceLoop,
    ConfirmationError,
    experiments,
    growth_rate,
    poles,
    rendered_admittance,
    rule_of_thumb,
    stability_limit,
    stability_map,
    stiffness_limits,
)
from loopwright.diagrams.contact.stability_limits import CoupledLoop, GrowthScan, find_first_limit
from loopwright.fmus import gantry_contact
from loopwright.fmus.models.scara import nominal as scara
from support import reduced_loop
from support.contact import (
    FORCE_TRACKING,
    MIDDLE,
    PATH,
    ROUGH,
    SMOOTH,
    deviation,
    diagram,
    loop,
    measured_growth,
    moored_run,
    parameters,
)

SIDE = pytest.mark.parametrize("side", ["par", "perp"])
ELLIPSE = Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5))
MORE_FRICTION = ROUGH.replace(coulomb_scale=1.2)

# --- the coupled loop ------------------------------------------------------------------------------------------------


@SIDE
@pytest.mark.parametrize("share", [1.0, 0.4])
@pytest.mark.parametrize("xi", [0.0, -0.025])
@pytest.mark.drawn(1)
def test_continuous_poles_are_the_roots_of_the_characteristic_polynomial(side, share, xi):
    # M p̈ = M̂ q v + (Ĉ − C) ṗ + F − β F_meas, all by polynomials in s: p times each of them
    plant = ROUGH.replace(coulomb_scale=1.3, translational_mass=(9.0, 5.0))
    model = loop(
        side,
        ROUGH,
        plant=plant,
        path=ELLIPSE,
        eta=0.0,
        xi=xi,
        implementation="continuous",
        cancelled=share,
        feed_forward=0.7,
        tool_mass=0.4,
    )
    axis = 1 if side == "par" else 0  # at the end of the major axis the tangent is z
    q = 1.0 - xi / 0.075 if side == "par" else 1.0
    k, b, m_e = 3000.0, 7.0, 1.5
    friction = [
        p.coulomb_scale * p.coulomb_friction[axis] / p.friction_width + p.viscous_friction[axis] for p in (plant, ROUGH)
    ]
    a, pid = model.admittance, model.pid
    D = [a.mass, a.effective_damping, a.stiffness]
    F, F_meas = [-m_e, -b, -k], [-m_e - 0.4, -b, -k]
    # times s, to make the integral a polynomial; e = F_meas/D p, w = p/q
    on_e, on_w = [0.7, pid.a2, pid.a1, pid.a0], [0.0, pid.a2, pid.a1, pid.a0]
    M, M_hat = plant.mass[axis], ROUGH.mass[axis]
    left = np.polyadd([M, friction[0] - friction[1], 0.0], np.polysub(np.multiply(share, F_meas), F))
    polynomial = np.polymul(np.polymul(left, [1.0, 0.0]), D)
    polynomial = np.polysub(polynomial, M_hat * q * np.polysub(np.polymul(on_e, F_meas), np.polymul(on_w, D) / q))
    got = np.poly(poles(model, stiffness=k, damping=b, mass=m_e))
    np.testing.assert_allclose(got, polynomial / polynomial[0], rtol=1e-9)


@SIDE
def test_ideal_poles_are_those_of_two_impedances_in_parallel(side):
    model = loop(side, implementation="ideal", tool_mass=0.2, path=ELLIPSE, eta=0.0, xi=-0.025)
    q = 4.0 / 3.0 if side == "par" else 1.0
    a = model.admittance
    want = [a.mass / q + 0.2 + 1.0, a.effective_damping / q + 5.0, a.stiffness / q + 100.0]
    got = np.poly(poles(model, stiffness=100.0, damping=5.0, mass=1.0))
    np.testing.assert_allclose(got, np.divide(want, want[0]), rtol=1e-12)


@SIDE
def test_the_contact_of_an_ideal_loop_feels_another_tool(side):
    model = loop(side, implementation="ideal", tool_mass=0.2)
    a, held = model.admittance, {"stiffness": 100.0, "damping": 5.0, "mass": 0.5}
    for tool in (0.0, 0.2, 1.7):
        want = np.roots([a.mass + 0.5 + tool, a.effective_damping + 5.0, a.stiffness + 100.0]).real.max()
        assert model.contact.loop("tool_mass", **held).growth_at(tool) == pytest.approx(want, rel=1e-12)


VARIANTS = {
    "d0": {},
    "d1": {"delay": 1},
    "rough": {"model": ROUGH},
    "less friction": {"model": ROUGH, "plant": ROUGH.replace(coulomb_scale=0.8)},
    "semi-implicit": {"method": "semi_implicit"},
    "2 ms": {"sample_time": 2e-3},
    "tool": {"tool_mass": 0.3},
    "force tracking": {"tracking": True},
    "ellipse": {"path": ELLIPSE, "eta": 0.1, "xi": 0.02, "model": ROUGH},
    "ellipse, force tracking": {"path": ELLIPSE, "eta": 0.2, "tracking": True},
}
ENVIRONMENT = {"stiffness": 2000.0, "damping": 20.0, "mass": 0.2}


def from_the_start(model, push, ticks, **environment):
    """Velocities towards the environment by the powers of the reduced model's matrix."""
    n, i = len(model.directions), model.directions.index(model.side)
    p, v = np.zeros(n), push * np.eye(n)[i]
    k, b = environment["stiffness"], environment["damping"]
    there = np.diag(np.eye(n)[i])
    last = model.motions[0].damping @ v + b * there @ v + k * there @ p  # no acceleration is measured at t = 0
    parts = [p, v, last, np.zeros(3 * n)]
    if model.delay:  # u₀ acts in the first two ticks
        at_once = reduced_loop.controller_matrices(model.replace(delay=0)).D
        parts.append(at_once @ np.concatenate([p, v, -b * there @ v - k * there @ p]))
    x, A = np.concatenate(parts), reduced_loop.close_loop(model, **environment)
    found = []
    for _ in range(ticks):
        found.append(x[n + i])
        x = A @ x
    return np.array(found)


@pytest.mark.slow
@pytest.mark.drawn(3)
@SIDE
@pytest.mark.parametrize("name", VARIANTS)
def test_the_reduced_model_moves_as_the_running_co_simulation(side, name):
    # The friction is linear to (v/w)²/3 = 3e-9, the FMU's internal steps are exact to 1e-10.
    model = loop(side, **VARIANTS[name])
    run = moored_run(model, 0.3, **ENVIRONMENT)
    want = from_the_start(model, 1e-6, len(run.t), **ENVIRONMENT)
    np.testing.assert_allclose(deviation(model, run, "velocity"), want, atol=2e-7 * 1e-6, rtol=0.0)


OTHERS = {
    "ideal": {"implementation": "ideal", "tool_mass": 0.2},
    "continuous": {"implementation": "continuous", "model": ROUGH, "plant": MORE_FRICTION, "tool_mass": 0.1},
    "continuous, ellipse": {"path": ELLIPSE, "eta": 0.1, "xi": -0.02, "implementation": "continuous", "tool_mass": 0.1},
    "shares": {"feed_forward": 0.6, "cancelled": 0.8, "tool_mass": 0.2, "delay": 2},
    "moving": {"model": ROUGH, "velocity": (0.5, 0.1)},
    "next to the ellipse": {
        "path": ELLIPSE,
        "eta": 0.2,
        "xi": 0.03,
        "model": ROUGH,
        "plant": MORE_FRICTION,
        "delay": 1,
    },
}
ENVIRONMENTS = (
    {},
    {"stiffness": 500.0},
    ENVIRONMENT,
    {"stiffness": 3e4, "tool_mass": 0.15},
    {"damping": 40.0, "mass": 2.0},
)


@SIDE
@pytest.mark.parametrize("name", [*VARIANTS, *OTHERS])
@pytest.mark.drawn(1)
def test_growth_and_admittance_are_those_of_the_reduction_by_hand(side, name):
    model = loop(side, **{**VARIANTS, **OTHERS}[name])
    for environment in ENVIRONMENTS:
        want = reduced_loop.growth_rate(model, **environment)
        assert growth_rate(model, **environment) == pytest.approx(float(want), rel=1e-7, abs=1e-7)
    omega = np.geomspace(0.1, 1500.0, 7)
    want = reduced_loop.rendered_admittance(model, omega)
    np.testing.assert_allclose(rendered_admittance(model, omega), want, rtol=1e-8, atol=1e-10 * np.abs(want).max())


def test_the_friction_slope_is_that_at_the_operating_velocity():
    at_rest, moving = loop("par", ROUGH), loop("par", ROUGH, velocity=(0.5, 0.0))
    assert float(at_rest.motions[0].damping[0, 0]) == pytest.approx(65.42 / 0.01 + 175.93, rel=1e-12)
    assert float(moving.motions[0].damping[0, 0]) == pytest.approx(175.93, rel=1e-12)
    assert stability_limit(moving).value > 2.0 * stability_limit(at_rest).value


@pytest.mark.slow
@SIDE
@pytest.mark.drawn(1)
def test_continuous_poles_depend_on_neither_path_point_nor_offset(side):
    # without environment, and with matched parameters: the paper's claim
    want = np.sort_complex(poles(loop(side, implementation="continuous")))
    for eta, xi in ((0.0, -0.025), (0.3, 0.02), (0.5, 0.0)):
        model = loop(side, ROUGH, path=ELLIPSE, eta=eta, xi=xi, implementation="continuous")
        both = [p for s in model.directions for p in (-20.0 if s == "par" else -40.0,) * 3]
        filters = [(0.5, model.admittance_par), (2.0, model.admittance_perp)]
        filters = [f for s, f in zip(("par", "perp"), filters, strict=True) if s in model.directions]
        quadratics = [r for m, a in filters for r in np.roots([m, a.effective_damping, a.stiffness])]
        np.testing.assert_allclose(np.poly(poles(model)), np.poly([*both, *quadratics]).real, rtol=1e-9)
        if len(model.directions) == 1:
            np.testing.assert_allclose(np.poly(poles(model)), np.poly(want), rtol=1e-9)


def test_directions_are_coupled_off_the_axes_alone():
    assert loop("perp").directions == ("perp",)
    assert loop("perp", path=ELLIPSE, eta=0.0).directions == ("perp",)
    assert loop("perp", path=ELLIPSE, eta=0.2).directions == ("par", "perp")
    assert loop("perp", path=ELLIPSE, eta=0.2, implementation="ideal").directions == ("perp",)


def test_growth_rates_of_arrays_are_those_of_their_numbers():
    k, b = np.geomspace(10.0, 1e5, 7), np.array([0.0, 10.0])
    for model in (loop(), loop(implementation="ideal"), loop(path=ELLIPSE, eta=0.2, model=ROUGH)):
        table = growth_rate(model, stiffness=k[None, :], damping=b[:, None])
        want = [[growth_rate(model, stiffness=float(x), damping=float(y)) for x in k] for y in b]
        np.testing.assert_allclose(table, want, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.drawn(2)
def test_python_controls_interconnection_has_the_same_growth(name):
    model = loop(**VARIANTS[name])
    for k in (100.0, 5000.0, 1e5):
        by_control = model.contact.loop("stiffness").growth_by_control(k)
        assert by_control == pytest.approx(growth_rate(model, stiffness=k), abs=1e-6)


# --- limits ----------------------------------------------------------------------------------------------------------

CONTINUOUS = {"implementation": "continuous"}


@pytest.mark.drawn(1)
@pytest.mark.parametrize("side", ["par", "perp"])
@pytest.mark.parametrize("implementation", ["ideal", "continuous"])
@pytest.mark.parametrize("over", ["stiffness", "mass", "tool_mass"])
def test_a_continuous_model_hides_every_limit(side, implementation, over):
    limit = stability_limit(loop(side, ROUGH, implementation=implementation), over)
    assert limit.value == math.inf
    assert limit.confirmed_by == "no change of sign of the growth rate on the scan"
    assert stability_limit(loop(side, ROUGH), over).value < 1e5


def routh_limit(D, rest):
    """Stiffness at which D(s) + k N(s) has roots on the imaginary axis first, for pairs (D, N)."""
    den, num = (np.array(c, complex) for c in (D, rest))
    den, num = (c * 1j ** np.arange(len(c))[::-1] for c in (den, num))
    cross = np.polymul(den, num.conj()).imag  # where D/N is real on s = jω
    omega = [r.real for r in np.roots(cross) if abs(r.imag) < 1e-8 * abs(r) and r.real > 1e-6]
    k = [-np.polyval(den, w) / np.polyval(num, w) for w in omega]
    return min(v.real for v in k if v.real > 0)


@pytest.mark.parametrize(("side", "told"), [("par", 184.0), ("perp", 2150.0)])
def test_without_feed_forward_the_stiffness_is_limited_as_in_the_errata(side, told):
    model = loop(side, feed_forward=0.0, **CONTINUOUS)  # E5
    limit = stability_limit(model)
    assert limit.value == pytest.approx(told, rel=5e-3)
    a, pid = model.admittance, model.pid
    D = np.polymul([1.0, pid.a2, pid.a1, pid.a0], [a.mass, a.effective_damping, a.stiffness])
    expected = routh_limit(D, [0, 0, 0, pid.a2, pid.a1, pid.a0])
    assert limit.value == pytest.approx(expected, rel=1e-9)
    assert limit.second_look == pytest.approx(expected, rel=1e-9)
    assert limit.rule_of_thumb == math.inf


@pytest.mark.parametrize(("side", "told"), [("par", 298.0), ("perp", 1400.0)])
def test_the_misprinted_cancellation_limits_the_stiffness_as_in_the_errata(side, told):
    mass = SMOOTH.mass[("par", "perp").index(side)]
    model = loop(side, cancelled=mass, **CONTINUOUS)  # E2: M F in the place of F
    limit = stability_limit(model)
    assert limit.value == pytest.approx(told, rel=2e-2)
    a, pid = model.admittance, model.pid
    filtered, inner = [a.mass, a.effective_damping, a.stiffness], [1.0, pid.a2, pid.a1, pid.a0]
    on_k = np.polyadd(inner, (1.0 - mass) / mass * np.polymul([1.0, 0.0], filtered))
    assert limit.value == pytest.approx(routh_limit(np.polymul(inner, filtered), np.pad(on_k, (2, 0))), rel=1e-8)


def test_a_sampled_limit_is_that_of_many_digits():
    # d0, no friction, across the path: all in closed form, the eigenvalues by 40 digits
    model = loop()
    limit = stability_limit(model)
    a, pid, M, T = model.admittance, model.pid, mpmath.mpf(SMOOTH.mass[1]), mpmath.mpf(1) / 1000
    m, k_a = mpmath.mpf(a.mass), mpmath.mpf(a.stiffness)
    d = 2 * mpmath.mpf(a.damping_ratio) * mpmath.sqrt(m * k_a)
    p = mpmath.mpf(40)

    def growth(k):
        w = mpmath.sqrt(k / M)
        c, s = mpmath.cos(w * T), mpmath.sin(w * T)
        plant = mpmath.matrix([[c, s / w], [-w * s, c]])
        push = mpmath.matrix([(1 - c) / k, s / w / M])
        filtered = mpmath.expm(mpmath.matrix([[0, 1, 0], [-k_a / m, -d / m, 1], [0, 0, 0]]) * T)
        v = mpmath.matrix([-k / m - 3 * p**2, -3 * p, -(p**3), 3 * p**2 - k_a / m, 3 * p - d / m])
        u = M * v
        u[0] += k  # the measured force, −k p, is cancelled
        A = mpmath.zeros(5)
        for i in range(2):
            for j in range(5):
                A[i, j] = push[i] * u[j] + (plant[i, j] if j < 2 else 0)
                A[3 + i, j] = filtered[i, j - 3] if j >= 3 else (-filtered[i, 2] * k / m if j == 0 else 0)
        A[2, 0], A[2, 2], A[2, 3] = T, 1, -T
        return mpmath.log(max(abs(z) for z in mpmath.eig(A, left=False, right=False)))

    with mpmath.workdps(40):
        want = mpmath.findroot(growth, (limit.value * 0.999, limit.value * 1.001), solver="anderson", tol=1e-25)
        assert pid.a0 == 64000.0
        assert abs(limit.value - want) < limit.tolerance
    assert limit.tolerance < 1e-9 * limit.value


def test_a_limit_says_what_it_is():
    limit = stability_limit(loop(), damping=10.0)
    assert (limit.over, limit.unit, limit.environment) == ("stiffness", "N/m", {"damping": 10.0})
    assert limit.scanned == (1e-2, 1e8)
    assert limit.confirmed_by == "closed-loop eigenvalues of python-control's interconnection at 0.99 and 1.01"
    assert limit.growth_below < 0.0 < limit.growth_above
    beyond = growth_rate(loop(), stiffness=1.03 * limit.value, damping=10.0)
    assert limit.growth_above == pytest.approx(beyond, rel=1e-9)
    number = limit.number.as_dict()
    assert number == {
        "value": limit.value,
        "unit": "N/m",
        "tolerance": limit.tolerance,
        "confirmed_by": limit.confirmed_by,
    }
    assert pickle.loads(pickle.dumps(limit)) == limit
    assert pickle.loads(pickle.dumps(stability_limit(loop(), "mass"))) == stability_limit(loop(), "mass")


def test_the_rule_of_thumb_counts_the_hold_and_the_delay():
    # d = 12 N s/m, T_d = 0.5 ms or 1.5 ms
    assert rule_of_thumb(loop()) == pytest.approx(24000.0, rel=1e-12)
    assert rule_of_thumb(loop(delay=1), damping=3.0) == pytest.approx(10000.0, rel=1e-12)
    assert rule_of_thumb(loop("par", path=ELLIPSE, eta=0.0, xi=-0.025)) == pytest.approx(
        2.0 * 0.6 * math.sqrt(5.0) / (4.0 / 3.0) / 0.5e-3, rel=1e-12
    )
    assert stability_limit(loop()).rule_of_thumb == rule_of_thumb(loop())
    assert math.isnan(stability_limit(loop(), "mass").rule_of_thumb)


@SIDE
@pytest.mark.drawn(1)
def test_the_tool_may_weigh_about_the_virtual_mass(side):
    limit = stability_limit(loop(side), "tool_mass")  # E25
    assert limit.value == pytest.approx(loop(side).admittance.mass, rel=0.15)
    assert limit.frequency == pytest.approx(math.pi / 1e-3, rel=1e-9)


def test_a_limit_that_is_confirmed_by_nothing_is_an_error(monkeypatch):
    monkeypatch.setattr(CoupledLoop, "growth_by_control", lambda loop, value: -1.0)
    with pytest.raises(
        ConfirmationError, match=r"stiffness 26118.9 N/m is no limit: python-control's .* growth rates -1"
    ):
        stability_limit(loop())


def test_the_first_limit_is_found_where_the_loop_becomes_stable_again():
    # 20 % more friction than is compensated, a tool of 0.3 kg: stable, unstable, stable, unstable
    model = loop("par", ROUGH, plant=MORE_FRICTION, tool_mass=0.3)
    limit = stability_limit(model)
    again, last = limit.restabilizes
    assert limit.value < 200.0 < 600.0 < again < 1e5 < last
    for k, stable in (
        (0.99 * limit.value, True),
        (400.0, False),
        (0.99 * again, False),
        (1.01 * again, True),
        (1.01 * last, False),
    ):
        assert (growth_rate(model, stiffness=k) < 0.0) is stable
    assert stability_limit(model, low=again * 1.01).value == pytest.approx(last, rel=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_island_between_two_points_of_the_scan_is_found(sign):
    def at(x):
        return sign * (1e-4 - (math.log(x) - 1.03) ** 2)

    grid = np.geomspace(0.5, 20.0, 9)  # 0.46 apart in ln x, the island is 0.02 wide
    edges = [
        x
        for pair in GrowthScan(grid, np.array([at(x) for x in grid]), at, lambda _: 1e-14).find_brackets()
        for x in pair[:2]
    ]
    assert edges[0] < math.exp(1.02) < edges[1] == edges[2] < math.exp(1.04) < edges[3]


def test_a_loop_that_is_unstable_from_the_start_has_the_limit_zero():
    limit = stability_limit(loop(delay=20))
    assert (limit.value, limit.restabilizes) == (0.0, ())
    assert limit.confirmed_by.startswith("unstable from the start of the scan, σ = ")


def test_limits_stand_side_by_side_by_the_names_of_a_report():
    found = stiffness_limits(loop(delay=7), (0.0, 10.0))
    assert list(found)[::3] == ["admittance.perp.ke_limit.continuous.be_0", "admittance.perp.ke_limit.sampled_d0.be_10"]
    assert found["admittance.perp.ke_limit.continuous.be_10"].value == math.inf
    own = stability_limit(loop(delay=1), damping=10.0).value
    assert found["admittance.perp.ke_limit.sampled_d1.be_10"].value == pytest.approx(own, rel=1e-9)
    assert len(found) == 6


def test_acceleration_that_is_fed_back_with_the_wrong_sign_has_no_continuous_solution():
    # half of the force too much is cancelled: (M + m) p̈ = … + 1.5 m p̈ has one up to m = 2 M
    model = loop(feed_forward=0.0, cancelled=1.5, **CONTINUOUS)
    mass = 2.0 * SMOOTH.mass[1]
    assert math.isfinite(growth_rate(model, mass=0.99 * mass))
    assert growth_rate(model, mass=1.01 * mass) == math.inf
    assert model.contact.loop("mass").growth_by_control(1.01 * mass) == math.inf


def test_a_map_holds_growth_and_limits():
    k, b = np.geomspace(100.0, 1e6, 30), np.array([0.0, 10.0, 100.0])
    found = stability_map(loop(delay=1), k, b)
    assert found.growth.shape == (3, 30)
    for row, limit in zip(found.growth, found.limits, strict=True):
        np.testing.assert_array_equal(row < 0.0, k < limit.value)
    other = stability_map(
        loop(), np.geomspace(0.1, 5.0, 12), np.array([0.1, 0.5]), x="mass", y="tool_mass", stiffness=500.0
    )
    assert other.limits[0].environment == {"tool_mass": 0.1, "stiffness": 500.0}
    assert [limit.over for limit in other.limits] == ["mass", "mass"]
    assert [limit.rule_of_thumb for limit in found.limits] == [rule_of_thumb(loop(delay=1), float(v)) for v in b]
    np.testing.assert_array_equal(other.growth[1] < 0.0, other.x_values < other.limits[1].value)


# --- what may be given -----------------------------------------------------------------------------------------------


def test_the_loop_of_a_diagram_has_its_parameters():
    d = experiments.force_tracking(delay=1, tool_mass=0.1, admittance_method="semi_implicit").diagram
    found = AdmittanceLoop.of(d, "perp", eta=0.3)
    assert (found.delay, found.tool_mass, found.method, found.sample_time) == (1, 0.1, "semi_implicit", 1e-3)
    assert found.admittance is d["admittance_perp"]
    assert found.pid is d["pid_perp"]
    assert (found.admittance.stiffness, found.admittance.effective_damping) == (0.0, pytest.approx(12.0))
    assert (found.path, found.model) == (experiments.ELLIPSE, d["feedback_linearization"].model)
    with pytest.raises(UnknownNameError, match="admittance_par"):
        AdmittanceLoop.of(experiments.path_following().diagram)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"side": "up"}, "side: found 'up'; expected 'par' or 'perp'"),
        ({"implementation": "digital"}, "implementation: found 'digital'; expected 'ideal'"),
        ({"path": ELLIPSE, "eta": 0.0, "xi": 0.08}, "xi: found 0.08 m; expected an offset within the reach"),
        ({"model": scara}, "Scara, which is not Cartesian; expected"),
        ({"pid_par": AdmittanceFilter(mass=1, stiffness=0, damping=1)}, "pid_par: found "),
        (
            {"path": ELLIPSE, "eta": 0.0, "velocity": (0.0, 0.1)},
            "velocity: found [0.0, 0.1] m/s where the path is curved",
        ),
        ({"delay": -1}, "delay: found -1; expected a value at least 0"),
        ({"method": "euler"}, "method: found the method 'euler'; expected one of exact, forward"),
    ],
)
def test_what_can_not_be_reduced_is_refused(change, text):
    with pytest.raises(ParameterError, match=re.escape(text)):
        loop().replace(**change)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"over": "stifness"}, "an environment has no 'stifness'. Did you mean 'stiffness'?"),
        ({"damper": 1.0}, "an environment has no 'damper'. Did you mean"),
        ({"over": "mass", "mass": 1.0}, "mass: found it among the held properties, as 1.0"),
        ({"low": 10.0, "high": 1.0}, "found a scan from 10.0 to 1.0; expected 0 < low < high"),
    ],
)
def test_a_limit_over_nothing_is_refused(arguments, text):
    with pytest.raises(OptionError, match=re.escape(text)):
        stability_limit(loop(), **arguments)


# --- the nonlinear co-simulation at 0.97 and 1.03 --------------------------------------------------------------------

LIMITS = {
    "par d0": (loop("par"), {}),
    "perp d1": (loop(delay=1), {}),
    "perp d0, friction at rest, damped": (loop(model=ROUGH), {"damping": 10.0}),
    "perp d0": (loop(), {}),
    "par d1, damped": (loop("par", delay=1), {"damping": 10.0}),
    "par d0, friction at rest": (loop("par", ROUGH), {}),
    "par d1, friction at rest": (loop("par", ROUGH, delay=1), {}),
    "perp d1, friction at rest, damped": (loop(model=ROUGH, delay=1), {"damping": 10.0}),
    "perp d0, force tracking": (loop(tracking=True), {}),
    "par d1, force tracking, damped": (loop("par", tracking=True, delay=1), {"damping": 5.0}),
    "perp d0, force tracking, friction at rest": (loop(model=ROUGH, tracking=True), {}),
    "perp d0, tool": (loop(tool_mass=0.5), {}),
    "perp d0, semi-implicit": (loop(method="semi_implicit"), {}),
    "perp d0, load": (loop(), {"mass": 1.0}),
    "perp d0, less friction": (loop(model=ROUGH, plant=ROUGH.replace(coulomb_scale=0.8)), {"damping": 10.0}),
    "par d0, more friction, tool": (loop("par", ROUGH, plant=MORE_FRICTION, tool_mass=0.3), {}),
    "par on the ellipse, next to it": (loop("par", ROUGH, path=ELLIPSE, eta=0.18, xi=-0.03), {"damping": 5.0}),
    "perp on the ellipse, d1": (loop(path=ELLIPSE, eta=0.09, delay=1), {"damping": 5.0}),
}
QUICK = 1
GROWTH = 2e-3  # of the factor over 1 s: a fifth of what is asked for


@pytest.mark.parametrize(
    "name", [n if i < QUICK else pytest.param(n, marks=pytest.mark.slow) for i, n in enumerate(LIMITS)]
)
def test_the_co_simulation_grows_as_predicted_on_both_sides_of_a_limit(name):
    model, environment = LIMITS[name]
    limit = stability_limit(model, **environment)
    for factor, sigma in ((0.97, limit.growth_below), (1.03, limit.growth_above)):
        run = moored_run(model, 6.5, push=1e-5, stiffness=factor * limit.value, **environment)
        growth = measured_growth(deviation(model, run), model.sample_time, 4.0)
        assert math.exp(growth) == pytest.approx(math.exp(sigma), rel=GROWTH)
        assert bool(growth < 0.0) is (factor < 1.0)


@pytest.mark.slow
def test_the_co_simulation_is_stable_again_beyond_an_unstable_region():
    model = loop("par", ROUGH, plant=MORE_FRICTION, tool_mass=0.3)
    again = stability_limit(model).restabilizes[0]
    for factor in (0.97, 1.03):
        run = moored_run(model, 6.5, stiffness=factor * again)
        growth = measured_growth(deviation(model, run), model.sample_time, 4.0)
        assert math.exp(growth) == pytest.approx(math.exp(growth_rate(model, stiffness=factor * again)), rel=GROWTH)
        assert bool(growth < 0.0) is (factor > 1.0)


MASSES = {
    "perp d0, load": (loop(), "mass", {}),
    "par d0, load on a spring": (loop("par"), "mass", {"stiffness": 1000.0}),
    "perp d0, tool": (loop(), "tool_mass", {}),
    "par d1, tool on a spring": (loop("par", delay=1), "tool_mass", {"stiffness": 500.0}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MASSES)
def test_the_co_simulation_grows_as_predicted_on_both_sides_of_a_mass_limit(name):
    # Beyond, the sign of the force alternates and grows by 1e7 to 1e13 in 1 s: 0.3 s are taken, of the acceleration.
    model, over, environment = MASSES[name]
    limit = stability_limit(model, over, **environment)
    run = moored_run(model, 0.9, push=1e-9, **environment, **{over: 1.03 * limit.value})
    growth = measured_growth(deviation(model, run, "acceleration"), model.sample_time, 0.3, span=0.3, window=0.2)
    assert growth == pytest.approx(limit.growth_above, abs=GROWTH)
    run = moored_run(model, 5.0, **environment, **{over: 0.97 * limit.value})
    early, late = (np.abs(deviation(model, run)[a:b]).max() for a, b in ((0, 500), (4500, 5001)))
    assert late < math.exp(0.8 * limit.growth_below * 4.0) * early < early


@pytest.mark.slow
@pytest.mark.parametrize("damping", [0.0, pytest.param(20.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("plant", [SMOOTH, pytest.param(ROUGH, marks=pytest.mark.slow)], ids=["smooth", "rough"])
def test_force_tracking_against_the_wall_of_the_contact_plant(plant, damping):
    # pressed with 5 N against the wall at z = 0, in contact throughout
    model = loop(model=plant, tracking=True)
    limit = stability_limit(model, damping=damping)
    for factor, sigma in ((0.97, limit.growth_below), (1.03, limit.growth_above)):
        k = factor * limit.value
        pressed = model.replace(xi=5.0 / k)
        start = parameters(plant) | {"position": (0.0, 5.0 / k), "velocity": (0.0, 1e-6), "contact": 1.0}
        start |= {"wall_point": (0.0, 0.0), "wall_normal": (0.0, -1.0), "wall_stiffness": k, "wall_damping": damping}
        file = gantry_contact.build(internal_step=1e-4)
        run = diagram(pressed, start, desired_force=-5.0, file=file).simulate(6.5, progress=False)
        growth = measured_growth(deviation(pressed, run), 1e-3, 4.0)
        assert math.exp(growth) == pytest.approx(math.exp(sigma), rel=GROWTH)
        assert np.all(run["plant.contact_force"][:, 1] < 0.0)


def test_force_tracking_keeps_the_damping():
    assert FORCE_TRACKING["perp"].effective_damping == pytest.approx(12.0)
    assert PATH.length / 2.0 == MIDDLE


@pytest.mark.parametrize("implementation", ["ideal", "continuous", "sampled"])
@pytest.mark.parametrize(
    "environment",
    [{"damping": math.nan}, {"damping": -100.0}, {"mass": -50.0}, {"tool_mass": -1.0}, {"mass": math.inf}],
)
@pytest.mark.drawn
def test_an_environment_that_is_none_is_refused(implementation, environment):
    (name,) = environment
    made = loop().replace(implementation=implementation)
    for call in (growth_rate, stability_limit):
        with pytest.raises(ParameterError, match=rf"environment\.{name}: found .*not negative"):
            call(made, **environment)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("limit", [math.inf, 100.0, 123.4])
@pytest.mark.drawn
def test_a_rate_that_is_zero_but_for_rounding_is_not_unstable(limit, seed):
    """σ is 0, up to rounding of either sign that differs between a stack of values and a single one; then it grows."""
    noise, grid = 1e-13, np.geomspace(1e-2, 1e4, 241)  # 100 is a point of the grid

    def rate(x, salt):
        rounding = np.random.default_rng([seed, salt, int.from_bytes(np.float64(x).tobytes())]).uniform(-noise, noise)
        return rounding + (0.02 * (x / limit - 1.0) if x > limit else 0.0)

    stacked = np.array([rate(x, 1) for x in grid])
    found = find_first_limit(
        "stiffness", grid, stacked, lambda x: rate(x, 2), lambda x: rate(x, 3), lambda _: 2.0 * noise
    )
    assert found.restabilizes == ()
    if limit == math.inf:
        assert found.value == math.inf
        assert "at 241 of its 241 values the motion does not decay" in found.confirmed_by
    else:
        assert found.value == pytest.approx(limit, rel=1e-10)
