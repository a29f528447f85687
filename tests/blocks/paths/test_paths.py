"""Paths against closed forms, mpmath and SciPy; traced against NumPy; searches against brute force."""

from __future__ import annotations

import copy
import pickle

import casadi as ca
import mpmath as mp
import numpy as np
import pytest
from casadi import ArrayInterface
from scipy.integrate import quad
from scipy.interpolate import CubicSpline as Interpolant
from scipy.interpolate import PPoly
from scipy.special import ellipeinc

from loopwright.blocks import DefinitionError, ParameterError, PathDomainError, TraceError, parameter
from loopwright.blocks.library.piecewise_functions import is_traced, jet, piecewise, wrap
from loopwright.blocks.paths import UNLIMITED, Circle, CubicSpline, Ellipse, Line, Path
from loopwright.blocks.paths.reach import TouchingCircles


class Bean(Path):
    """A path of one's own: everything but σ and the period comes from the base."""

    radius: float = parameter(unit="m", above=0.0)
    bend: float = parameter(default=0.3)
    period = 2.0 * np.pi

    def sigma(self, theta, order=0):
        turn = order * np.pi / 2.0
        y = np.cos(theta + turn) + self.bend * 2.0**order * np.cos(2.0 * theta + turn)
        return self.radius * np.stack([y, np.sin(theta + turn)])


class PlainEllipse(Ellipse):
    """The ellipse by the general methods, for comparison with its closed forms."""

    _fourier = None
    length = Path.length
    reach = Path.reach
    project = Path.project


def ring(n, closed=True):
    t = np.arange(n) / n * 2.0 * np.pi
    r = 0.3 * (1.0 + 0.2 * np.cos(3.0 * t) + 0.1 * np.sin(5.0 * t + 1.0))
    return CubicSpline(points=np.stack([0.4 + r * np.cos(t), 0.5 + r * np.sin(t)], axis=1), closed=closed)


A, B, LENGTH = 0.3, 0.15, 1.4532672330821512
PAPER = Ellipse(semi_axes=(A, B), center=(0.5, 0.5))
PATHS = {
    "ellipse": PAPER,
    "clockwise ellipse": Ellipse(semi_axes=(0.2, 0.35), center=(-0.1, 0.2), clockwise=True),
    "long ellipse": Ellipse(semi_axes=(0.5, 0.01), center=(0.5, 0.5)),
    "circle": Circle(radius=0.2, center=(0.1, 0.2)),
    "clockwise circle": Circle(radius=0.2, center=(0.1, 0.2), clockwise=True),
    "line": Line(start=(0.1, 0.2), end=(0.7, -0.1)),
    "closed spline": ring(14),
    "open spline": ring(12, closed=False),
    "two points": CubicSpline(points=[(0, 0), (0.3, 0.4)]),
    "three points, closed": CubicSpline(points=[(0, 0), (0.3, 0.4), (-0.2, 0.3)], closed=True),
    "bean": Bean(radius=0.2),
}
SPLINES = ["closed spline", "open spline", "three points, closed"]
EVERY = pytest.mark.parametrize("path", PATHS.values(), ids=PATHS.keys())


def parameters(path, n=60, laps=3):
    """Random parameters: over several laps and negative ones, or inside and beyond an open path's ends."""
    low, high = (-laps * path.period, laps * path.period) if path.closed else path.domain
    span = 0.0 if path.closed else 0.3 * (high - low)
    return np.random.default_rng(7).uniform(low - span, high + span, n)


def traced(function, *examples):
    """Trace a function of scalars and vectors, and return it as a function of numbers."""
    symbols = [ca.MX.sym(f"a{i}", np.size(e)) for i, e in enumerate(examples)]
    inputs = [ArrayInterface(s.T if np.ndim(e) else s, ndim=np.ndim(e)) for s, e in zip(symbols, examples, strict=True)]
    results = function(*inputs)
    results = results if isinstance(results, tuple) else (results,)
    shapes = [r.shape for r in results]
    compiled = ca.Function("f", symbols, [ca.vec(r.to_casadi()) for r in results])

    def evaluate(*numbers):
        values = compiled.call([ca.DM(np.asarray(n, dtype=float)) for n in numbers])
        return [v.full().reshape(s) for v, s in zip(values, shapes, strict=True)]

    return evaluate, compiled


# --- piecewise polynomials --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("pieces", "functions", "degree"), [(1, 1, 0), (1, 2, 3), (7, 3, 4), (150, 1, 9)])
def test_piecewise_polynomials_agree_with_scipy_in_numpy_and_in_a_trace(pieces, functions, degree):
    rng = np.random.default_rng(pieces)
    breaks = np.cumsum(rng.uniform(0.1, 1.0, pieces + 1))
    coefficients = rng.standard_normal((pieces, functions, degree + 1))
    oracle = PPoly(np.moveaxis(coefficients[:, :, ::-1], 2, 0), breaks, extrapolate=True)
    s = np.concatenate([rng.uniform(breaks[0] - 0.3, breaks[-1] + 0.3, 40), breaks])
    values = jet(breaks, coefficients, s, 3)
    evaluate, _ = traced(lambda z: jet(breaks, coefficients, z, 3), 0.0)
    for order in range(4):
        expected = oracle(s, nu=order).T if order else oracle(s).T
        np.testing.assert_allclose(values[order], expected, rtol=1e-11, atol=1e-11 * degree**order)
    for i, number in enumerate(s):
        for order, value in enumerate(evaluate(number)):
            assert value.shape == (functions,)
            np.testing.assert_allclose(value, values[order][:, i], rtol=1e-13, atol=1e-13)
    assert piecewise(breaks, coefficients, s.reshape(1, -1)).shape == (functions, 1, len(s))
    assert piecewise(breaks, coefficients, 0.3).shape == (functions,)


def test_a_lookup_refuses_what_it_cant_trace():
    breaks, coefficients = np.array([0.0, 1.0]), np.ones((1, 1, 2))
    with pytest.raises(
        TraceError, match="of 1 dimensions and of the kind MX for a table; expected a scalar of the kind MX"
    ):
        piecewise(breaks, coefficients, ArrayInterface(ca.MX.sym("s", 1, 3), ndim=1))
    with pytest.raises(TraceError, match="of the kind SX for a table; expected a scalar of the kind MX"):
        piecewise(breaks, coefficients, ArrayInterface(ca.SX.sym("s"), ndim=0))
    assert is_traced(ArrayInterface(ca.MX.sym("s"), ndim=0))
    assert not is_traced(1.0)
    assert not is_traced(np.ones(2))


def test_wrapping_counts_laps():
    lap, rest = wrap(np.array([-0.5, 0.0, 1.5, 4.5]), 0.0, 2.0)
    assert lap.tolist() == [-1, 0, 0, 2]
    assert rest.tolist() == [1.5, 0.0, 1.5, 0.5]


# --- the curves and their derivatives ---------------------------------------------------------------------------------


def horner(coefficients, u):
    value = mp.mpf(0)
    for c in coefficients:
        value = value * u + c
    return value


def exact_ellipse(path):
    a, b = (mp.mpf(float(v)) for v in path.semi_axes)
    b = -b if path.clockwise else b
    y, z = (mp.mpf(float(v)) for v in path.center)
    return lambda t: y + a * mp.cos(t), lambda t: z + b * mp.sin(t)


def exact_curvature(x, y):
    def kappa(t):
        x1, y1, x2, y2 = mp.diff(x, t), mp.diff(y, t), mp.diff(x, t, 2), mp.diff(y, t, 2)
        return (x1 * y2 - y1 * x2) / mp.hypot(x1, y1) ** 3

    return kappa, lambda t: mp.diff(kappa, t) / mp.hypot(mp.diff(x, t), mp.diff(y, t))


def curves():
    for name in ("ellipse", "clockwise ellipse", "long ellipse"):
        yield name, PATHS[name], exact_ellipse(PATHS[name])
    for name in ("circle", "clockwise circle"):
        c = PATHS[name]
        yield name, c, exact_ellipse(Ellipse(semi_axes=(c.radius, c.radius), center=c.center, clockwise=c.clockwise))
    yield "line", PATHS["line"], (lambda t: 0.1 + (mp.mpf(0.7) - 0.1) * t, lambda t: 0.2 + (mp.mpf(-0.1) - 0.2) * t)
    r, e = mp.mpf(0.2), mp.mpf(0.3)
    yield "bean", PATHS["bean"], (lambda t: r * (mp.cos(t) + e * mp.cos(2 * t)), lambda t: r * mp.sin(t))


@pytest.mark.parametrize(("path", "exact"), [c[1:] for c in curves()], ids=[c[0] for c in curves()])
def test_derivatives_and_frames_agree_with_extended_precision(path, exact):
    with mp.workdps(60):
        kappa, kappa_s = exact_curvature(*exact)
        for theta in parameters(path, 8, laps=1):
            t = mp.mpf(float(theta))
            frame = path.frame(theta)
            for order in range(4):
                expected = [float(mp.diff(f, t, order)) for f in exact]
                np.testing.assert_allclose(path.sigma(theta, order), expected, rtol=0, atol=1e-14)
            s1 = [mp.diff(f, t) for f in exact]
            speed = mp.hypot(*s1)
            assert frame.speed == pytest.approx(float(speed), rel=1e-13)
            np.testing.assert_allclose(frame.tangent, [float(v / speed) for v in s1], atol=2e-14)
            np.testing.assert_allclose(frame.normal, [-frame.tangent[1], frame.tangent[0]], atol=0)
            k, ks = float(kappa(t)), float(kappa_s(t))
            assert frame.curvature == pytest.approx(k, rel=1e-11, abs=1e-12)
            assert frame.curvature_rate == pytest.approx(ks, rel=1e-10, abs=1e-10 * abs(k) + 1e-12)


@pytest.mark.parametrize("name", SPLINES)
def test_splines_agree_with_scipys_pieces(name):
    path = PATHS[name]
    points = np.vstack([path.points, path.points[:1]]) if path.closed else path.points
    places = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    oracle = Interpolant(places, points, bc_type="periodic" if path.closed else "natural")
    theta = parameters(path, 200)
    inside = theta % places[-1] if path.closed else theta[(theta > 0) & (theta < places[-1])]
    theta = theta if path.closed else inside
    for order in range(4):
        scale = np.max(np.abs(oracle(inside, order)))
        np.testing.assert_allclose(path.sigma(theta, order), oracle(inside, order).T, atol=2e-13 * scale)
    np.testing.assert_allclose(path.sigma(places[: len(path.points)]), path.points.T, atol=1e-15)
    with mp.workdps(50):
        for t in inside[:6]:
            i = np.searchsorted(places, t, side="right") - 1
            c = [[mp.mpf(float(v)) for v in oracle.c[:, i, k]] for k in (0, 1)]
            kappa, kappa_s = exact_curvature(*(lambda u, p=p: horner(p, u) for p in c))
            u = mp.mpf(float(t)) - mp.mpf(float(places[i]))
            frame = path.frame(t)
            assert frame.curvature == pytest.approx(float(kappa(u)), rel=1e-11, abs=1e-11)
            assert frame.curvature_rate == pytest.approx(float(kappa_s(u)), rel=1e-10, abs=1e-10)


def test_a_spline_is_twice_continuously_differentiable_and_an_open_one_goes_straight_on():
    for name in [*SPLINES, "two points"]:
        path = PATHS[name]
        for knot in path.knots:
            before, after = path.derivatives(np.nextafter(knot, -1.0), 2), path.derivatives(knot, 2)
            for order in range(3):
                np.testing.assert_allclose(before[order], after[order], atol=[1e-14, 1e-13, 2e-12][order])
    path = PATHS["open spline"]
    last = path.domain[1]
    beyond = path.frame(np.array([-0.7, -0.1, last + 0.1, last + 3.0]))
    assert np.all(beyond.curvature == 0)
    np.testing.assert_allclose(beyond.tangent[:, 0], path.frame(0.0).tangent, atol=1e-15)
    gap = path.sigma(last + 3.0) - path.sigma(last)
    np.testing.assert_allclose(gap, 3.0 * path.sigma(last, 1), atol=1e-14)


def test_signs_of_circles():
    left, right = PATHS["circle"].frame(0.0), PATHS["clockwise circle"].frame(0.0)
    np.testing.assert_allclose([left.curvature, right.curvature], [5.0, -5.0], rtol=1e-14)
    np.testing.assert_allclose(left.tangent, [0, 1], atol=1e-15)
    np.testing.assert_allclose(right.tangent, [0, -1], atol=1e-15)
    np.testing.assert_allclose(left.normal, [-1, 0], atol=1e-15)  # inwards
    np.testing.assert_allclose(right.normal, [1, 0], atol=1e-15)  # outwards
    assert PATHS["circle"].reach(1.0) == (0.2, UNLIMITED)
    assert PATHS["clockwise circle"].reach(1.0) == (UNLIMITED, 0.2)


@EVERY
def test_the_frame_obeys_frenets_equations_by_differentiating_the_trace(path):
    """With respect to arc length: σ_s = t, t_s = κ n, n_s = −κ t, κ_s; and g′ = ‖σ′‖."""
    theta = ca.MX.sym("theta")
    argument = ArrayInterface(theta, ndim=0)
    frame = path.frame(argument)
    columns = [frame.sigma, frame.tangent, frame.normal, frame.curvature, path.arc_length(argument)]
    slopes = ca.Function("s", [theta], [ca.densify(ca.jacobian(ca.vec(c.to_casadi()), theta)) for c in columns])
    for value in parameters(path, 25):
        f = path.frame(value)
        sigma, tangent, normal, kappa, length = (d.full().ravel() / f.speed for d in slopes(value))
        scale = 1.0 + abs(f.curvature) ** 2
        np.testing.assert_allclose(sigma, f.tangent, atol=1e-13)
        np.testing.assert_allclose(tangent, f.curvature * f.normal, atol=1e-12 * scale)
        np.testing.assert_allclose(normal, -f.curvature * f.tangent, atol=1e-12 * scale)
        np.testing.assert_allclose(kappa, f.curvature_rate, atol=1e-12 * scale**1.5)
        np.testing.assert_allclose(length, 1.0, atol=2e-13)


# --- arc length -------------------------------------------------------------------------------------------------------


def exact_length(a, b, theta):
    """Integral of ‖σ′‖ of the ellipse from 0 to θ: from the incomplete elliptic integral, counted from the axis."""
    with mp.workdps(40):
        a, b, t = mp.mpf(float(a)), mp.mpf(float(b)), mp.mpf(float(theta))
        m = 1 - (a / b) ** 2  # ‖σ′‖ = b sqrt(1 − m sin²θ)
        laps = mp.floor(t / mp.pi + mp.mpf(1) / 2)
        rest = t - laps * mp.pi
        return b * (mp.ellipe(rest, m) + 2 * laps * mp.ellipe(m))


def test_perimeter_of_the_papers_ellipse():
    assert PAPER.length == pytest.approx(LENGTH, abs=3e-16)
    assert PAPER.arc_length(2 * np.pi) == pytest.approx(LENGTH, abs=5e-16)
    assert Ellipse(semi_axes=(1, 1)).length == pytest.approx(2 * np.pi, rel=1e-15)


@pytest.mark.slow
@pytest.mark.drawn(3)
@pytest.mark.parametrize("axes", [(A, B), (B, A), (0.4, 0.4), (0.7, 0.1), (0.8, 0.1), (1.0, 0.01), (1.0, 1e-4)])
def test_arc_length_of_ellipses_agrees_with_elliptic_integrals(axes):
    path = Ellipse(semi_axes=axes, center=(3.0, -1.0))
    theta = np.concatenate([np.random.default_rng(1).uniform(-20, 20, 60), np.pi * np.arange(-4, 5) / 2.0])
    expected = np.array([float(exact_length(*axes, t)) for t in theta])
    np.testing.assert_allclose(path.arc_length(theta), expected, rtol=0, atol=2e-14)
    inside = theta[np.abs(theta) < np.pi / 2]
    scipys = axes[1] * ellipeinc(inside, 1 - (axes[0] / axes[1]) ** 2)
    np.testing.assert_allclose(path.arc_length(inside), scipys, rtol=0, atol=1e-12)
    reverse = path.replace(clockwise=True)
    np.testing.assert_allclose(reverse.arc_length(theta), expected, rtol=0, atol=2e-14)


@pytest.mark.parametrize("name", [*SPLINES, "bean", "two points"])
def test_arc_length_agrees_with_quadrature(name):
    path = PATHS[name]

    def speed(t):
        return float(np.hypot(*path.sigma(t, 1)))

    assert path.arc_length(0.0) == 0.0
    total = 0.0
    for low, high in zip(path.knots[:-1], path.knots[1:], strict=True):
        middle = low + 0.37 * (high - low)
        assert path.arc_length(middle) - total == pytest.approx(
            quad(speed, low, middle, epsabs=1e-15, epsrel=2e-14)[0], abs=1e-13
        )
        total += quad(speed, low, high, epsabs=1e-15, epsrel=2e-14)[0]
        assert path.arc_length(high) == pytest.approx(total, abs=2e-13)
    assert path.length == pytest.approx(total, abs=2e-13)


def test_arc_length_of_a_spline_agrees_with_extended_precision():
    path = PATHS["closed spline"]
    points = np.vstack([path.points, path.points[:1]])
    pieces = Interpolant(path.knots, points, bc_type="periodic").c
    with mp.workdps(30):
        total = mp.mpf(0)
        for i, h in enumerate(np.diff(path.knots)):
            rates = [[mp.mpf(float(v)) * k for v, k in zip(pieces[:3, i, j], (3, 2, 1), strict=True)] for j in (0, 1)]
            ends = mp.linspace(0, mp.mpf(float(h)), 5)
            total += mp.quad(lambda u, r=rates: mp.hypot(horner(r[0], u), horner(r[1], u)), ends)
        assert path.length == pytest.approx(float(total), abs=5e-15)


@EVERY
def test_arc_length_counts_laps_and_is_inverted(path):
    theta = parameters(path, 200)
    np.testing.assert_allclose(path.parameter_at(path.arc_length(theta)), theta, atol=1e-12)
    low, high = (-4 * path.length, 4 * path.length) if path.closed else (-0.5 * path.length, 1.5 * path.length)
    s = np.append(np.random.default_rng(2).uniform(low, high, 300), [0.0, path.length])
    np.testing.assert_allclose(path.arc_length(path.parameter_at(s)), s, atol=1e-12)
    assert path.parameter_at(float(s[0])) == pytest.approx(path.parameter_at(s)[0], abs=1e-14)
    if path.closed:
        lifted = path.arc_length(theta + path.period) - path.arc_length(theta)
        np.testing.assert_allclose(lifted, path.length, atol=1e-13)
        seam = path.period * np.array([1 - 1e-15, 1.0, 1 + 1e-15, -1e-18])
        np.testing.assert_allclose(path.arc_length(seam), path.length * np.array([1, 1, 1, 0]), atol=1e-13)
    else:
        assert path.domain[0] == 0.0
        assert path.arc_length(path.domain[1]) == pytest.approx(path.length, abs=1e-14)


# --- reach ------------------------------------------------------------------------------------------------------------


def test_reach_of_the_papers_ellipse_is_the_medial_axis():
    theta = np.array([0, 0.1, 0.3, np.pi / 6, np.pi / 4, np.pi / 3, np.pi / 2])
    left, right = PAPER.reach(theta)
    np.testing.assert_allclose(left, [0.0750, 0.07611, 0.08425, 0.09922, 0.11859, 0.13521, 0.1500], atol=6e-6)
    assert np.all(right == UNLIMITED)
    theta = np.linspace(-7, 7, 2001)
    medial = B * np.sqrt((A * np.sin(theta)) ** 2 + (B * np.cos(theta)) ** 2) / A
    np.testing.assert_allclose(PAPER.reach(theta)[0], medial, atol=1e-15)
    right, left = PAPER.replace(clockwise=True).reach(theta)
    np.testing.assert_allclose(left, medial, atol=1e-15)
    assert np.all(right == UNLIMITED)
    tall = Ellipse(semi_axes=(B, A)).reach(theta + np.pi / 2)[0]
    np.testing.assert_allclose(tall, medial, atol=1e-15)


@pytest.mark.parametrize("clockwise", [False, True])
def test_a_tabulated_reach_is_close_to_the_medial_axis_and_on_the_safe_side(clockwise):
    path = PlainEllipse(semi_axes=(A, B), center=(0.5, 0.5), clockwise=clockwise)
    theta = np.linspace(-7, 7, 4001)
    tabulated, exact = path.reach(theta), PAPER.replace(clockwise=clockwise).reach(theta)
    for found, expected in zip(tabulated, exact, strict=True):
        assert np.all(found <= expected)
        assert np.all(found >= 0.98 * expected)


def test_contact_curvatures_are_exact_where_they_are_tabulated():
    path = PlainEllipse(semi_axes=(A, B), center=(0.5, 0.5))
    theta = np.linspace(0.0, 2 * np.pi, 500)
    inverse = TouchingCircles(path).inverse_reach(theta)
    np.testing.assert_allclose(1.0 / inverse[:, 0], PAPER.reach(theta)[0], rtol=1e-7)
    assert np.all(inverse[:, 1] == 1.0 / UNLIMITED)


def test_contact_curvature_is_smooth_where_its_series_takes_over():
    contact = TouchingCircles(PAPER)
    x, y = exact_ellipse(PAPER)
    theta = 0.6
    phi = theta + np.array([-1.0, 1.0])[:, None] * contact.near * np.array([0.03, 0.5, 0.99, 1.01, 3.0, 9.0]) / 0.21
    found = contact.curvature(np.array([theta]), phi.reshape(1, -1), PAPER.sigma(phi.reshape(1, -1)))[0]
    assert np.any(np.abs(found - PAPER.frame(theta).curvature) > 1e-4)
    with mp.workdps(50):
        t = mp.mpf(theta)
        dx, dy = mp.diff(x, t), mp.diff(y, t)
        for value, p in zip(found, phi.ravel(), strict=True):
            d = x(mp.mpf(float(p))) - x(t), y(mp.mpf(float(p))) - y(t)
            exact = 2 * (dx * d[1] - dy * d[0]) / mp.hypot(dx, dy) / (d[0] ** 2 + d[1] ** 2)
            assert value == pytest.approx(float(exact), rel=1e-6)


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize("name", ["closed spline", "open spline", "bean", "three points, closed"])
def test_up_to_its_reach_a_point_is_the_nearest_and_beyond_it_is_not(name):
    path = PATHS[name]
    low, high = (0.0, path.period) if path.closed else path.domain
    dense = path.sigma(np.linspace(low, high, 40001))
    checked = 0
    for theta in np.linspace(low, high, 61)[1:-1] + 1e-3:
        frame = path.frame(theta)
        for side, reach in zip((1.0, -1.0), path.reach(theta), strict=True):
            assert reach <= 1.0 / max(side * frame.curvature, 1e-9)
            for part, nearest in ((0.999, True), (1.025, False)):
                distance = part * reach
                if distance > 20.0:
                    continue
                centre = frame.sigma + side * distance * frame.normal
                best = np.sqrt(np.min(np.sum((dense - centre[:, None]) ** 2, axis=0)))
                if nearest:
                    assert best >= distance - 1e-9
                else:
                    assert best < distance
                checked += 1
    assert checked > 100


def test_reach_where_nothing_limits_it():
    for name in ("line", "two points"):
        np.testing.assert_allclose(PATHS[name].reach(np.array([-0.1, 0.0, 0.2, 0.5, 2.0])), UNLIMITED)


# --- projection -------------------------------------------------------------------------------------------------------


def brute_force(path, y, samples=1_000_000):
    low, high = (0.0, path.period) if path.closed else path.domain
    theta = np.linspace(low, high, samples + 1)
    distance = np.sqrt(np.sum((path.sigma(theta) - y[:, None]) ** 2, axis=0))
    i = np.argmin(distance)
    return theta[i], distance[i], theta[1] * np.max(np.hypot(*path.sigma(theta[::1000], 1)))


@pytest.mark.drawn(1)
@EVERY
def test_projection_is_the_global_minimum(path):
    rng = np.random.default_rng(3)
    middle, size = np.mean(path.sampled, axis=1), np.ptp(path.sampled, axis=1).max()
    for y in middle + size * rng.uniform(-0.7, 0.7, (12, 2)):
        theta = path.project(y)
        at, least, spacing = brute_force(path, y)
        found = np.hypot(*(path.sigma(theta) - y))
        assert found <= least + 1e-12
        assert found >= least - spacing**2 / max(least, spacing) - 1e-12
        assert np.hypot(*(path.sigma(theta) - path.sigma(at))) < 1e-3
        slope = np.dot(y - path.sigma(theta), path.sigma(theta, 1))
        if path.closed or path.domain[0] < theta < path.domain[1]:
            assert abs(slope) < 1e-13
        assert 0.0 <= theta < path.period if path.closed else path.domain[0] <= theta <= path.domain[1]


@pytest.mark.drawn(2)
@EVERY
def test_projection_undoes_going_off_the_path_within_reach(path):
    rng = np.random.default_rng(4)
    low, high = (0.0, path.period) if path.closed else path.domain
    theta = rng.uniform(low, high, 60)
    frame = path.frame(theta)
    for side, reach in zip((1.0, -1.0), path.reach(theta), strict=True):
        xi = side * rng.uniform(0.0, 0.95, 60) * np.minimum(reach, 2.0)
        projected = path.project(frame.sigma + xi * frame.normal)
        np.testing.assert_allclose(path.sigma(projected), frame.sigma, atol=1e-11)
        np.testing.assert_allclose(projected, theta, atol=1e-9)


@pytest.mark.parametrize("name", ["open spline", "two points", "line"])
def test_projection_beyond_an_end_is_exactly_the_end(name):
    path = PATHS[name]
    for theta, sign in zip(path.domain, (-1.0, 1.0), strict=True):
        frame = path.frame(theta)
        for distance in (1e-3, 0.01, 0.02):
            assert path.project(frame.sigma + sign * distance * frame.tangent + 0.01 * frame.normal) == theta


@pytest.mark.parametrize("name", ["open spline", "two points", "line"])
def test_projection_finds_foot_points_close_to_an_end(name):
    path = PATHS[name]
    span = path.domain[1]
    for part in (1e-7, 1e-5, 1e-4, 1e-3, 5e-3):
        for theta in (part * span, (1.0 - part) * span):
            frame = path.frame(theta)
            assert path.project(frame.sigma + 0.02 * frame.normal) == pytest.approx(theta, abs=1e-12)


def test_projection_takes_the_right_one_of_two_branches_beside_the_medial_axis():
    """Inside the evolute (6) has two minima, mirrored at the major axis."""
    for path in (PAPER, PlainEllipse(semi_axes=(A, B), center=(0.5, 0.5)), PAPER.replace(clockwise=True)):
        for u in np.append(np.linspace(-0.22, 0.22, 12), [0.2249999, -0.2249999]):
            for v in (1e-3, 1e-6, 1e-9, -1e-9, -1e-6, -1e-3):
                theta = path.project(np.array([0.5 + u, 0.5 + v]))
                assert np.sign(path.sigma(theta)[1] - 0.5) == np.sign(v)
                expected = A * A * u / (A * A - B * B)  # foot point for v → 0
                if abs(u) < 0.2201 and abs(v) < 1e-5:
                    assert path.sigma(theta)[0] - 0.5 == pytest.approx(expected, abs=20.0 * abs(v) + 1e-7)


@pytest.mark.parametrize("phase", [0.0, 0.0013, 0.0031, 0.0047])
def test_projection_separates_two_minima_that_are_closer_than_the_samples(phase):
    class Shifted(PlainEllipse):
        def sigma(self, theta, order=0):
            return super().sigma(theta + phase, order)

    path = Shifted(semi_axes=(A, B))
    for foot in (0.003, 0.005, 0.007):
        u = (A * A - B * B) / A * np.cos(foot)
        for v in (1e-11, -1e-11):
            theta = path.project(np.array([u, v]))
            assert path.sigma(theta)[1] == pytest.approx(np.sign(v) * B * np.sin(foot), abs=0.01 * B * foot)


def test_the_ellipses_own_projection_agrees_with_the_general_one():
    y = 0.5 + np.random.default_rng(5).uniform(-0.5, 0.5, (2, 300))
    for clockwise in (False, True):
        own = PAPER.replace(clockwise=clockwise).project(y)
        general = PlainEllipse(semi_axes=(A, B), center=(0.5, 0.5), clockwise=clockwise).project(y)
        np.testing.assert_allclose(own, general, atol=1e-13)


@EVERY
def test_the_samples_that_searches_start_from_are_dense(path):
    theta, lengths = path.sampling
    frame = path.frame(theta)
    assert np.all(np.diff(lengths) > 0)
    assert np.max(np.diff(lengths)) < 1.01 * path.length / 400.0
    turn = np.abs(np.sum(frame.tangent[:, :-1] * frame.normal[:, 1:], axis=0))
    assert np.max(turn) < 0.0501


def test_projection_of_special_points():
    centre = np.array([0.5, 0.5])
    assert PAPER.sigma(PAPER.project(centre))[1] == pytest.approx(0.65)  # an end of the minor axis
    assert PATHS["circle"].project(np.array([0.1, 0.2])) == 0.0
    assert PATHS["circle"].project(np.array([0.4, 0.2])) == 0.0
    assert PATHS["line"].project(np.array([-1.0, 1.0])) == 0.0
    assert PATHS["line"].project(np.array([2.0, -1.0])) == 1.0
    open_spline = PATHS["open spline"]
    first = open_spline.frame(0.0)
    assert open_spline.project(first.sigma - 0.02 * first.tangent) == 0.0
    rounds = CubicSpline(points=[(1, 0), (0, 1), (-1, 0), (0, -1)], closed=True)
    assert np.hypot(*rounds.sigma(rounds.project(np.zeros(2)))) == pytest.approx(
        np.min(np.hypot(*rounds.sigma(np.linspace(0, rounds.period, 100001)))), abs=1e-9
    )
    for path in PATHS.values():
        assert np.isnan(path.project(np.array([np.nan, 0.0])))
        assert path.project(np.ones((2, 3))).shape == (3,)


@pytest.mark.slow
@EVERY
def test_newton_converges_quadratically_to_the_foot_point(path):
    rng = np.random.default_rng(6)
    low, high = (-2 * path.period, 2 * path.period) if path.closed else path.domain
    for theta in rng.uniform(low, high, 20):
        frame = path.frame(theta)
        reach = min(0.3 * min(path.reach(theta)), 0.1)
        y = frame.sigma + reach * frame.normal
        start = theta + 1e-3 * reach / frame.speed
        found, residual = path.newton(start, y, 4)
        assert found == pytest.approx(theta, abs=1e-11)
        assert residual < 1e-13 * (1 + abs(theta))
        before, remaining = path.newton(start, y, 0)
        assert before == start
        assert remaining == pytest.approx(abs(path.newton(start, y, 1)[0] - start), rel=1e-6)


# --- traced as in NumPy -----------------------------------------------------------------------------------------------


@pytest.mark.drawn(2)
@EVERY
def test_every_traced_equation_agrees_with_numpy(path):
    equations = {
        "sigma": lambda t, y: tuple(path.sigma(t, order) for order in range(4)),
        "frame": lambda t, y: tuple(path.frame(t)),
        "arc_length": lambda t, y: path.arc_length(t),
        "reach": lambda t, y: path.reach(t),
        "newton": lambda t, y: path.newton(t, y, 3),
    }
    theta = parameters(path, 40, laps=4)
    offset = np.random.default_rng(8).standard_normal((2, 40)) * 0.005
    for name, equation in equations.items():
        evaluate, _ = traced(equation, 0.0, np.zeros(2))
        for t, d in zip(theta, offset.T, strict=True):
            y = path.sigma(t) + d
            expected = equation(t, y)
            expected = expected if isinstance(expected, tuple) else (expected,)
            for value, wanted in zip(evaluate(t, y), expected, strict=True):
                assert value.shape == np.shape(wanted), name
                np.testing.assert_allclose(value, wanted, rtol=1e-11, atol=1e-12, err_msg=name)


@pytest.mark.drawn(6)
@EVERY
def test_arrays_of_parameters_give_columns(path):
    theta = parameters(path, 9)
    frame = path.frame(theta)
    assert frame.sigma.shape == frame.tangent.shape == frame.normal.shape == (2, 9)
    assert frame.speed.shape == frame.curvature.shape == frame.curvature_rate.shape == (9,)
    one = path.frame(theta[4])
    for whole, single in zip(frame, one, strict=True):
        np.testing.assert_allclose(whole[..., 4], single, rtol=1e-13, atol=1e-13)
    assert path.arc_length(theta).shape == (9,)
    assert all(r.shape == (9,) and np.all(r > 0) for r in path.reach(theta))
    assert np.all(np.isnan(path.sigma(np.array([np.nan, np.nan]))))
    assert np.isnan(path.arc_length(np.nan))


def test_the_paths_in_closed_form_expand_to_scalar_operations():
    for name in ("ellipse", "clockwise ellipse", "circle", "line"):
        path = PATHS[name]
        _, function = traced(lambda t, p=path: (p.arc_length(t), *p.frame(t), *p.reach(t)), 0.0)
        assert function.expand().is_a("SXFunction")


# --- back to the plane ------------------------------------------------------------------------------------------------


@EVERY
def test_path_coordinates_go_to_the_plane_and_back(path):
    rng = np.random.default_rng(9)
    eta = rng.uniform(0.0, path.length, 30) + (2 * path.length if path.closed else 0.0)
    xi = rng.uniform(-0.01, 0.01, 30) * (0.001 if path is PATHS["long ellipse"] else 1.0)
    eta2, xi2 = rng.standard_normal((2, 30))
    position, velocity = path.to_state((eta, eta2), (xi, xi2))
    assert np.array_equal(position, path.to_plane(eta, xi))
    theta = path.project(position)
    f = path.frame(theta)
    np.testing.assert_allclose(np.sum(f.normal * (position - f.sigma), axis=0), xi, atol=1e-13)
    if path.closed:
        np.testing.assert_allclose(path.arc_length(theta) + 2 * path.length, eta, atol=1e-11)
    # η̇₁ = tᵀẏ/q and ξ̇₁ = nᵀẏ
    np.testing.assert_allclose(np.sum(f.tangent * velocity, axis=0) / (1 - f.curvature * xi), eta2, atol=1e-9)
    np.testing.assert_allclose(np.sum(f.normal * velocity, axis=0), xi2, atol=1e-9)
    single = path.to_state((eta[0], eta2[0]), (xi[0], xi2[0]))
    np.testing.assert_allclose(single[1], velocity[:, 0], atol=1e-13)
    # the velocity is the derivative of the position along (η, ξ)
    h = 1e-6
    ahead, behind = path.to_plane(eta + h * eta2, xi + h * xi2), path.to_plane(eta - h * eta2, xi - h * xi2)
    scale = 1.0 + np.max(np.abs(f.curvature)) ** 2
    np.testing.assert_allclose((ahead - behind) / (2 * h), velocity, atol=1e-8 * scale)


def test_beyond_the_reach_there_are_no_path_coordinates():
    with pytest.raises(PathDomainError) as caught:
        PAPER.to_plane(LENGTH, 0.08)
    error = caught.value
    assert error.xi == 0.08
    assert error.reach == pytest.approx(0.075, abs=1e-12)
    assert error.theta == pytest.approx(2 * np.pi, abs=1e-12)
    np.testing.assert_allclose(error.position, [0.72, 0.5], atol=1e-12)
    text = str(error)
    assert "found xi = 0.08 m at eta = 1.45327 m" in text
    assert "expected less than 0.075 m to the left of the Ellipse" in text
    assert "Stay closer to the path" in text
    again = pickle.loads(pickle.dumps(error))
    assert (again.position, again.theta, again.xi, again.reach) == (error.position, error.theta, error.xi, error.reach)
    with pytest.raises(PathDomainError):
        PAPER.to_plane(0.0, 0.075)
    assert PAPER.to_plane(0.0, 0.0749)[0] == pytest.approx(0.8 - 0.0749)
    assert PAPER.to_plane(0.0, -3.0)[0] == pytest.approx(3.8)
    with pytest.raises(PathDomainError, match="to the right of the Circle"):
        PATHS["clockwise circle"].to_plane(0.0, -0.3)
    with pytest.raises(PathDomainError) as caught:
        PAPER.to_plane(np.array([0.0, 0.1, 0.2]), np.array([0.0, 0.3, 0.4]))
    assert caught.value.xi == 0.3
    with pytest.raises(PathDomainError):
        PAPER.to_plane(0.0, np.nan)


@pytest.mark.parametrize("name", ["line", "open spline"])
def test_beyond_an_end_there_are_no_path_coordinates(name):
    path = PATHS[name]
    np.testing.assert_allclose(path.to_plane(path.length, 0.0), path.sigma(path.domain[1]), atol=1e-14)
    for eta in (-1e-6, path.length + 1e-6):
        with pytest.raises(PathDomainError, match=r"expected 0 to .* m, the length of the open") as caught:
            path.to_plane(eta, 0.001)
        assert caught.value.xi == 0.001


# --- values -----------------------------------------------------------------------------------------------------------


@pytest.mark.drawn(1)
@EVERY
def test_paths_are_values_whatever_has_been_tabulated(path):
    fresh = path.replace()

    def results(p):
        return p.length, p.reach(0.3), p.project(np.zeros(2)), p.parameter_at(0.1), p.closed

    tables = results(path)
    assert fresh == path
    assert hash(fresh) == hash(path)
    assert path.parameters.keys() == type(path).parameter_specs.keys()
    for other in (pickle.loads(pickle.dumps(path)), copy.copy(path), copy.deepcopy(path)):
        assert other == path
        assert hash(other) == hash(path)
        assert repr(other) == repr(path)
        assert results(other) == tables
    assert len(pickle.dumps(path)) == len(pickle.dumps(fresh))
    with pytest.raises(ParameterError, match="is a value and can't be changed"):
        path.closed = True


def test_different_paths_differ():
    assert PAPER.replace(clockwise=True) != PAPER
    assert PAPER.replace(center=(0, 0)) != PAPER
    assert PATHS["circle"] != Ellipse(semi_axes=(0.2, 0.2), center=(0.1, 0.2))
    points = PATHS["closed spline"].points
    assert CubicSpline(points=points, closed=True) == PATHS["closed spline"]
    assert CubicSpline(points=points) != PATHS["closed spline"]
    assert repr(PAPER) == "Ellipse(semi_axes=[0.3, 0.15], center=[0.5, 0.5])"
    assert repr(Circle(radius=2)) == "Circle(radius=2)"


def test_closed_paths_have_a_period_and_open_ones_a_domain():
    for path in PATHS.values():
        assert path.closed == (path.period is not None) == (path.domain is None)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Ellipse(semi_axes=(0.3, 0.0)), "Ellipse.semi_axes: found .*; expected a value above 0 in m"),
        (lambda: Ellipse(semi_axes=(0.3, -0.1)), "Ellipse.semi_axes: "),
        (lambda: Ellipse(semi_axes=(0.3, np.nan)), "Ellipse.semi_axes: .*finite"),
        (lambda: Ellipse(semi_axes=(1, 2, 3)), "expected shape"),
        (Ellipse, "Ellipse.semi_axes: it is required"),
        (lambda: Ellipse(semi_axis=(1, 2)), "has no parameter 'semi_axis'. Did you mean 'semi_axes'"),
        (lambda: Circle(radius=0.0), "Circle.radius: found 0; expected a value above 0 in m"),
        (
            lambda: Line(start=(1, 2), end=(1, 2)),
            r"Line.end: found start and end both at \[1.0, 2.0\]; expected two differ",
        ),
        (lambda: CubicSpline(points=[(0, 0)]), r"found an array of shape \(1, 2\); expected \(N, 2\) with at least 2"),
        (lambda: CubicSpline(points=[(0, 0), (1, 1)], closed=True), "at least 3 points for a closed spline"),
        (lambda: CubicSpline(points=[1, 2, 3]), r"found an array of shape \(3,\); expected \(N, 2\)"),
        (lambda: CubicSpline(points=0.5), r"found an array of shape \(\); expected \(N, 2\)"),
        (lambda: CubicSpline(points=np.zeros((4, 3))), r"found an array of shape \(4, 3\)"),
        (
            lambda: CubicSpline(points=[(0, 0), (1, 1), (1, 1), (2, 0)]),
            r"points 1 and 2 are both \[1.0, 1.0\]; expected",
        ),
        (lambda: CubicSpline(points=np.zeros((3, 2))), "points 0 and 1 are both"),
        (
            lambda: CubicSpline(points=[(0, 0), (1, 1), (2, 0), (0, 0)], closed=True),
            "points 3 and 0 are both .* Leave the last one out",
        ),
        (lambda: CubicSpline(points=[(0, 0), (1, 0), (0, 0)]), "speed falls to .* at theta = 1 m.*turns back"),
        (lambda: PAPER.sigma(0.0, 4), "Ellipse.sigma: found order 4; expected 0, 1, 2 or 3"),
        (lambda: PATHS["open spline"].sigma(0.0, -1), "CubicSpline.sigma: found order -1"),
    ],
)
def test_wrong_parameters_are_refused(make, text):
    with pytest.raises(ParameterError, match=text):
        make()


def test_a_path_without_its_curve_says_what_is_missing():
    class Nothing(Path):
        pass

    with pytest.raises(DefinitionError, match=r"Nothing: found no sigma\(theta, order\); expected a path to define it"):
        Nothing().sigma(0.0)
    with pytest.raises(DefinitionError, match="found no period and no domain; expected"):
        Nothing().length  # noqa: B018
