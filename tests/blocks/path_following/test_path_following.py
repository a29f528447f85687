"""Path following and compliance blocks against mpmath, closed forms and SciPy.

The oracles are written from the definitions: foot points by Newton's method, arc lengths by quadrature, rates by
differences along the motion, an arm's dynamics by Lagrange's equation from its energies, all with 60 digits.
"""

from __future__ import annotations

import re
from itertools import pairwise

import casadi as ca
import mpmath as mp
import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import (
    AdmittanceFilter,
    Block,
    Circle,
    Constant,
    CubicSpline,
    Ellipse,
    ErrorDynamics,
    FeedbackLinearization,
    ForceProjection,
    HandForce,
    Line,
    Output,
    ParameterError,
    PathDomainError,
    PathProjection,
    PathSpring,
    PlanarModel,
    TransverseTransform,
    parameter,
)
from loopwright.blocks.tracing.traced import GUARDS, NEXT, bundle, trace
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import gantry

STEP = mp.mpf(10) ** -15  # of differences: they are off by its square, 1e-30, and rounding leaves 1e-60/1e-30


@pytest.fixture(autouse=True)
def digits():
    with mp.workdps(60):
        yield


# --- paths, and the same in mpmath ------------------------------------------------------------------------------------


def ring(n):
    t = np.arange(n) / n * 2.0 * np.pi
    r = 0.3 * (1.0 + 0.15 * np.cos(3.0 * t) + 0.05 * np.sin(2.0 * t + 1.0))
    return np.stack([0.4 + r * np.cos(t), 0.5 + r * np.sin(t)], axis=1).round(6)


PATHS = {
    "ellipse": Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5)),
    "clockwise ellipse": Ellipse(semi_axes=(0.2, 0.35), center=(0.6, 0.4), clockwise=True),
    "circle": Circle(radius=0.2, center=(0.5, 0.6)),
    "clockwise circle": Circle(radius=0.2, center=(0.5, 0.6), clockwise=True),
    "line": Line(start=(0.3, 0.4), end=(0.8, 0.6)),
    "closed spline": CubicSpline(points=ring(11), closed=True),
    "open spline": CubicSpline(points=ring(9)[:7]),
}
EVERY = pytest.mark.parametrize("kind", PATHS)
CLOSED = [kind for kind, path in PATHS.items() if path.closed]


class Conic:
    """c + (a cos theta, b sin theta); b < 0 is clockwise."""

    def __init__(self, center, a, b):
        self.center, self.a, self.b = [mp.mpf(float(c)) for c in center], mp.mpf(float(a)), mp.mpf(float(b))
        self.pieces = [k * mp.pi / 4 for k in range(9)]

    def sigma(self, theta, order=0):
        turned = theta + order * mp.pi / 2
        y = [self.a * mp.cos(turned), self.b * mp.sin(turned)]
        return y if order else [self.center[0] + y[0], self.center[1] + y[1]]


class Straight:
    def __init__(self, start, end):
        self.start = [mp.mpf(float(v)) for v in start]
        self.way = [mp.mpf(float(e)) - s for e, s in zip(end, self.start, strict=True)]
        self.pieces = [mp.mpf(0), mp.mpf(1)]

    def sigma(self, theta, order=0):
        if order > 1:
            return [mp.mpf(0), mp.mpf(0)]
        return list(self.way) if order else [s + theta * w for s, w in zip(self.start, self.way, strict=True)]


class Spline:
    """Cubic spline over chord length: slopes from the continuity of the second derivative, natural or periodic ends."""

    def __init__(self, points, closed):
        points = [[mp.mpf(float(v)) for v in p] for p in points]
        points += [points[0]] if closed else []
        h = [mp.hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(points)]
        self.pieces = [mp.fsum(h[:i]) for i in range(len(points))]
        n = len(h)
        A, rhs = mp.zeros(n + 1), mp.zeros(n + 1, 2)
        for i in range(1, n):
            self._smooth(A, rhs, i, i - 1, i, i + 1, h[i - 1], h[i], points[i - 1], points[i], points[i + 1])
        if closed:
            self._smooth(A, rhs, 0, n - 1, 0, 1, h[-1], h[0], points[n - 1], points[0], points[1])
            A[n, 0], A[n, n] = 1, -1
        else:
            for row, i, j in ((0, 0, 1), (n, n, n - 1)):  # 2 s_i + s_j = 3 (slope of the chord)
                k = min(i, j)
                A[row, i], A[row, j] = 2, 1
                for d in (0, 1):
                    rhs[row, d] = 3 * (points[k + 1][d] - points[k][d]) / h[k]
        slopes = [mp.lu_solve(A, rhs[:, d]) for d in (0, 1)]
        self.cubics = []
        for i in range(n):
            both = []
            for d in (0, 1):
                chord, s0, s1 = (points[i + 1][d] - points[i][d]) / h[i], slopes[d][i], slopes[d][i + 1]
                both.append([points[i][d], s0, (3 * chord - 2 * s0 - s1) / h[i], (s0 + s1 - 2 * chord) / h[i] ** 2])
            self.cubics.append(both)
        self.closed = closed

    @staticmethod
    def _smooth(A, rhs, row, before, at, after, h0, h1, p0, p1, p2):
        A[row, before], A[row, at], A[row, after] = 1 / h0, 2 / h0 + 2 / h1, 1 / h1
        for d in (0, 1):
            rhs[row, d] = 3 * ((p1[d] - p0[d]) / h0**2 + (p2[d] - p1[d]) / h1**2)

    def sigma(self, theta, order=0):
        if self.closed:
            theta = theta - mp.floor(theta / self.pieces[-1]) * self.pieces[-1]
        i = next((i for i in range(len(self.cubics)) if theta < self.pieces[i + 1]), len(self.cubics) - 1)
        u = theta - self.pieces[i]
        factor = [[1, 1, 1, 1], [0, 1, 2, 3], [0, 0, 2, 6], [0, 0, 0, 6]][order]
        return [
            mp.fsum(f * c * u ** (k - order) for k, (f, c) in enumerate(zip(factor, cs, strict=True)) if f)
            for cs in self.cubics[i]
        ]


def exact(path):
    if isinstance(path, Ellipse):
        return Conic(path.center, path.semi_axes[0], path.semi_axes[1] * (-1 if path.clockwise else 1))
    if isinstance(path, Circle):
        return Conic(path.center, path.radius, path.radius * (-1 if path.clockwise else 1))
    return Straight(path.start, path.end) if isinstance(path, Line) else Spline(path.points, path.closed)


def foot(curve, y, theta):
    """Newton's method on (6), (y - sigma)' sigma' = 0."""
    theta = mp.mpf(theta)
    for _ in range(40):
        s0, s1, s2 = (curve.sigma(theta, k) for k in range(3))
        d = [y[0] - s0[0], y[1] - s0[1]]
        step = (d[0] * s1[0] + d[1] * s1[1]) / (s1[0] ** 2 + s1[1] ** 2 - d[0] * s2[0] - d[1] * s2[1])
        theta += step
        if abs(step) < mp.mpf(10) ** -50:
            return theta
    raise AssertionError("no foot point")


def length_between(curve, a, b):
    """The arc length between two parameters that are in one smooth piece."""
    return mp.quad(lambda theta: mp.hypot(*curve.sigma(theta, 1)), [a, b], method="gauss-legendre", maxdegree=5)


def arc_length(curve, theta):
    """The arc length from the path's start, laps counted."""
    total = mp.mpf(0)
    period, laps = curve.pieces[-1], 0
    if not isinstance(curve, Straight) and getattr(curve, "closed", True):
        laps = int(mp.floor(theta / period))
    rest = theta - laps * period
    with mp.workdps(25):
        for a, b in pairwise(curve.pieces):
            whole = length_between(curve, a, b) if laps else 0
            total += laps * whole + (length_between(curve, a, min(b, rest)) if rest > a else 0)
    return total


def coordinates(curve, y, start, theta0):
    """eta_1 relative to that of theta0, and xi_1, from the definitions."""
    theta = foot(curve, y, start)
    s, s1 = curve.sigma(theta), curve.sigma(theta, 1)
    normal = [-s1[1] / mp.hypot(*s1), s1[0] / mp.hypot(*s1)]
    return length_between(curve, theta0, theta), normal[0] * (y[0] - s[0]) + normal[1] * (y[1] - s[1])


def rates(curve, motion, start):
    """(eta_2, eta_1''), (xi_2, xi_1'') along a motion y(t), by central differences at t = 0."""
    theta0 = foot(curve, motion(mp.mpf(0)), start)
    back, here, ahead = (coordinates(curve, motion(t), theta0, theta0) for t in (-STEP, mp.mpf(0), STEP))
    return [((ahead[i] - back[i]) / (2 * STEP), (ahead[i] - 2 * here[i] + back[i]) / STEP**2) for i in (0, 1)]


def numbers(values):
    return [mp.mpf(float(v)) for v in values]


# --- the blocks, evaluated as they run --------------------------------------------------------------------------------


def evaluate(block, state=(), t=0.0, T=1e-3, method="exact", **inputs):
    """The outputs, next state and guards of a block by name, from its traced function."""
    made = trace(block, {name: np.shape(v) for name, v in inputs.items()}, sampled=True, method=method)
    results = made.function.call([t, np.ravel(state), *(np.ravel(v) for v in inputs.values()), made.pack(block, T)])
    flat = {name: np.array(r).ravel() for name, r in zip([*made.outputs, NEXT, GUARDS], results, strict=True)}
    return {name: v.reshape(made.outputs[name]) if name in made.outputs else v for name, v in flat.items()}


def all_inputs(block, **given):
    return {name: given.get(name, port.default) for name, port in block.inputs.items()}


def foot_of(path, y, start=None):
    """The path parameter as PathProjection finds it, from the global arg min or tracked from ``start``."""
    block = PathProjection(path)
    state = block.initial(bundle("u", {"position": np.asarray(y)})) if start is None else start
    return float(evaluate(block, [state], position=np.asarray(y))["theta"])


def states(path, rng, n, margin=0.6):
    """Random parameters and distances within the reach, away from knots, with velocities."""
    low, high = path.domain or (-2.0 * path.period, 2.0 * path.period)
    while n:
        theta = rng.uniform(low, high)
        if np.abs(path.knots - (theta if path.domain else theta % path.period)).min() < 1e-6:
            continue
        left, right = (min(float(r), 0.3) for r in path.reach(theta))
        n -= 1
        yield theta, rng.uniform(-margin * right, margin * left), rng.uniform(-1.0, 1.0, 2)


def on_plane(path, theta, xi):
    f = path.frame(theta)
    return np.asarray(f.sigma + f.normal * xi)


# --- an arm -----------------------------------------------------------------------------------------------------------


class Arm(PlanarModel):
    """Two links in a vertical plane, relative joint angles, viscous joint friction; the masses at c_i along the links."""

    coordinate_unit = "rad"
    input_unit = "N.m"
    lengths: np.ndarray = parameter(default=(0.7, 0.6), shape=(2,), unit="m")
    centers: np.ndarray = parameter(default=(0.31, 0.26), shape=(2,), unit="m")
    masses: np.ndarray = parameter(default=(4.3, 2.9), shape=(2,), unit="kg")
    inertias: np.ndarray = parameter(default=(0.19, 0.11), shape=(2,), unit="kg.m2")
    friction: np.ndarray = parameter(default=(0.8, 0.5), shape=(2,), unit="N.m.s/rad")
    gravity: float = parameter(default=9.81, unit="m/s2")

    def inertia(self, x_c):
        l1, (c1, c2), (m1, m2), (i1, i2) = self.lengths[0], self.centers, self.masses, self.inertias
        cross = m2 * l1 * c2 * np.cos(x_c[1])
        both = i2 + m2 * c2**2
        one = i1 + m1 * c1**2 + m2 * l1**2 + both + 2.0 * cross
        return np.stack([np.stack([one, both + cross]), np.stack([both + cross, both + 0.0 * cross])])

    def G_v(self, x_c):
        m = self.inertia(x_c)
        det = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
        return np.stack([np.stack([m[1, 1], -m[0, 1]]), np.stack([-m[1, 0], m[0, 0]])]) / det

    def f_v(self, x_c, x_v):
        l1, (c1, c2), (m1, m2) = self.lengths[0], self.centers, self.masses
        bend = m2 * l1 * c2 * np.sin(x_c[1])
        coriolis = np.stack([-bend * (2.0 * x_v[0] * x_v[1] + x_v[1] ** 2), bend * x_v[0] ** 2])
        outer = m2 * c2 * np.cos(x_c[0] + x_c[1])
        weight = self.gravity * np.stack([(m1 * c1 + m2 * l1) * np.cos(x_c[0]) + outer, outer])
        return -self.G_v(x_c) @ (coriolis + weight + self.friction * x_v)

    def h(self, x_c):
        (l1, l2), both = self.lengths, x_c[0] + x_c[1]
        return np.stack([l1 * np.cos(x_c[0]) + l2 * np.cos(both), l1 * np.sin(x_c[0]) + l2 * np.sin(both)])

    def dh(self, x_c):
        y, outer = self.h(x_c), self.lengths[1] * np.stack([np.cos(x_c[0] + x_c[1]), np.sin(x_c[0] + x_c[1])])
        return np.stack([np.stack([-y[1], -outer[1]]), np.stack([y[0], outer[0]])])

    def dh_rate(self, x_c, x_v):
        dy, outer = self.dh(x_c) @ x_v, self.lengths[1] * np.stack([np.cos(x_c[0] + x_c[1]), np.sin(x_c[0] + x_c[1])])
        d_outer = np.stack([-outer[1], outer[0]]) * (x_v[0] + x_v[1])
        return np.stack([np.stack([-dy[1], -d_outer[1]]), np.stack([dy[0], d_outer[0]])])


def tip(x):
    l1, l2 = mp.mpf(0.7), mp.mpf(0.6)
    return [l1 * mp.cos(x[0]) + l2 * mp.cos(x[0] + x[1]), l1 * mp.sin(x[0]) + l2 * mp.sin(x[0] + x[1])]


def arm_acceleration(x, v, torque, force):
    """Lagrange's equation with the energies' derivatives by differences, the tip's Jacobian too."""
    l1, (c1, c2), g = mp.mpf(0.7), numbers((0.31, 0.26)), mp.mpf(9.81)
    (m1, m2), (i1, i2), friction = numbers((4.3, 2.9)), numbers((0.19, 0.11)), numbers((0.8, 0.5))

    def kinetic(x, v):
        w1, w2 = v[0], v[0] + v[1]
        second = [
            -l1 * mp.sin(x[0]) * w1 - c2 * mp.sin(x[0] + x[1]) * w2,
            l1 * mp.cos(x[0]) * w1 + c2 * mp.cos(x[0] + x[1]) * w2,
        ]
        return (m1 * (c1 * w1) ** 2 + m2 * (second[0] ** 2 + second[1] ** 2) + i1 * w1**2 + i2 * w2**2) / 2

    def potential(x):
        return g * (m1 * c1 * mp.sin(x[0]) + m2 * (l1 * mp.sin(x[0]) + c2 * mp.sin(x[0] + x[1])))

    def moved(x, i, h):
        return [x[j] + (h if j == i else 0) for j in (0, 1)]

    def momentum(x, v, i):  # the energy is quadratic in v: exact with any step
        return (kinetic(x, moved(v, i, 1)) - kinetic(x, moved(v, i, -1))) / 2

    M, rhs = mp.zeros(2), mp.zeros(2, 1)
    for i in (0, 1):
        rhs[i] = torque[i] - friction[i] * v[i]
        rhs[i] += (kinetic(moved(x, i, STEP), v) - kinetic(moved(x, i, -STEP), v)) / (2 * STEP)
        rhs[i] -= (potential(moved(x, i, STEP)) - potential(moved(x, i, -STEP))) / (2 * STEP)
        ahead, back = ([x[j] + s * STEP * v[j] for j in (0, 1)] for s in (1, -1))
        rhs[i] -= (momentum(ahead, v, i) - momentum(back, v, i)) / (2 * STEP)
        for j in (0, 1):
            M[i, j] = momentum(x, [1, 0] if j == 0 else [0, 1], i)
            rhs[i] += (tip(moved(x, i, STEP))[j] - tip(moved(x, i, -STEP))[j]) / (2 * STEP) * force[j]
    return list(mp.lu_solve(M, rhs))


def gantry_acceleration(x, v, motor, force):
    mass, weight = numbers((7.61 + 29.26, 4.41 + 16.79)), (0, mp.mpf(9.81) * mp.mpf(4.41))
    coulomb, viscous, w = numbers((65.42, 37.69)), numbers((175.93, 62.83)), mp.mpf(0.01)
    drag = [c * mp.tanh(s / w) + d * s for c, d, s in zip(coulomb, viscous, v, strict=True)]
    return [(u - f - g + e) / m for u, f, g, e, m in zip(motor, drag, weight, force, mass, strict=True)]


def joint_angles(y):
    """The arm's angles with its tip at y (elbow down)."""
    bend = np.arccos((y @ y - 0.7**2 - 0.6**2) / (2 * 0.7 * 0.6))
    return np.array([np.arctan2(y[1], y[0]) - np.arctan2(0.6 * np.sin(bend), 0.7 + 0.6 * np.cos(bend)), bend])


MODELS = {
    "gantry": (gantry.nominal, gantry_acceleration, lambda x: x, lambda y: y),
    "arm": (Arm(), arm_acceleration, tip, joint_angles),
}
MODEL = pytest.mark.parametrize("model", MODELS)


def test_the_arm_of_these_tests_obeys_lagrange():
    # the arm as a PlanarModel, whose formulas are written out, against its energies
    rng = np.random.default_rng(1)
    for _ in range(5):
        x, v, torque, force = rng.uniform(-2, 2, (4, 2))
        got = Arm().coordinate_acceleration(x, v, torque, force)
        want = arm_acceleration(*map(numbers, (x, v, torque, force)))
        np.testing.assert_allclose(got, [float(w) for w in want], rtol=1e-12, atol=1e-12)


# --- exact linearization ----------------------------------------------------------------------------------------------


@pytest.mark.drawn(2)
@MODEL
@EVERY
def test_the_linearization_is_exact(kind, model):
    # u is of the order of 1000 N with 1e-16 of relative rounding, divided by masses of 20 kg (arm: inertias of 0.2 kg m2):
    # 1e-9 leaves three digits and more to the conditioning of dh and of kappa_s
    path, (plant, acceleration, output, inverse) = PATHS[kind], MODELS[model]
    curve, rng = exact(path), np.random.default_rng(5)
    law, transform = FeedbackLinearization(path, plant), TransverseTransform(path, plant)
    for theta0, xi, velocity in states(path, rng, 12):
        x_c = np.array(inverse(on_plane(path, theta0, xi)))
        x_v = velocity if model == "gantry" else 2.0 * velocity
        force, v_par, v_perp = rng.uniform(-20, 20, 2), *rng.uniform(-10, 10, 2)
        y = plant.h(x_c)
        theta = foot_of(path, y, theta0)
        u = evaluate(law, theta=theta, position=x_c, velocity=x_v, force=force, v_par=v_par, v_perp=v_perp)[
            "motor_force"
        ]
        x, v = numbers(x_c), numbers(x_v)
        a = acceleration(x, v, numbers(u), numbers(force))
        (eta2, eta_dd), (xi2, xi_dd) = rates(
            curve, lambda t, x=x, v=v, a=a: output([x[i] + v[i] * t + a[i] * t**2 / 2 for i in (0, 1)]), theta
        )
        assert abs(eta_dd - mp.mpf(v_par)) < 1e-9
        assert abs(xi_dd - mp.mpf(v_perp)) < 1e-9
        seen = evaluate(transform, theta=theta, position=x_c, velocity=x_v)
        assert abs(seen["eta"][1] - eta2) < 1e-12
        assert abs(seen["xi"][1] - xi2) < 1e-12


def test_a_model_at_a_singular_position_stops_by_its_guard():
    law = FeedbackLinearization(PATHS["circle"], Arm())
    inputs = {"theta": 0.0, "velocity": np.zeros(2), "force": np.zeros(2), "v_par": 0.0, "v_perp": 0.0}
    stretched = evaluate(law, **{k: inputs.get(k, np.array([0.4, 0.0])) for k in law.inputs})
    bent = evaluate(law, **{k: inputs.get(k, np.array([0.4, 1.0])) for k in law.inputs})
    assert stretched[GUARDS][0] < 0 < bent[GUARDS][0]


def test_a_linearization_needs_a_model():
    with pytest.raises(ParameterError, match="expected a PlanarModel, such as gantry.nominal"):
        FeedbackLinearization(PATHS["circle"], 3.0)


# --- the coordinate transform, its inverse and its derivatives --------------------------------------------------------


@pytest.mark.drawn(2)
@EVERY
def test_path_coordinates_are_those_of_the_definition(kind):
    # eta_1 to 1e-12 (the arc length's accuracy); rates at speeds of 1 m/s and q > 0.4 to rounding
    path, rng = PATHS[kind], np.random.default_rng(3)
    curve, transform = exact(path), TransverseTransform(path)
    for theta0, xi, velocity in states(path, rng, 8):
        y = on_plane(path, theta0, xi)
        theta = foot_of(path, y, theta0)
        seen = evaluate(transform, theta=theta, position=y, velocity=velocity)
        position, v = numbers(y), numbers(velocity)
        want = foot(curve, position, theta)
        assert abs(theta - want) < 1e-13 * max(1.0, abs(theta))
        _, distance = coordinates(curve, position, want, want)
        (eta2, _), (xi2, _) = rates(curve, lambda t, y=position, v=v: [y[i] + v[i] * t for i in (0, 1)], want)
        assert abs(seen["eta"][0] - arc_length(curve, want)) < 1e-12
        assert abs(seen["xi"][0] - distance) < 1e-15
        assert abs(seen["eta"][1] - eta2) < 1e-12
        assert abs(seen["xi"][1] - xi2) < 1e-12


def full_jacobian(path):
    """d(eta, xi)/d(position, velocity) of projection and transform together, by CasADi."""
    y, v, start = ca.MX.sym("y", 2), ca.MX.sym("v", 2), ca.MX.sym("start")
    projection, transform = PathProjection(path), TransverseTransform(path)
    first = trace(projection, {"position": (2,)}, sampled=True)
    second = trace(transform, {"theta": (), "position": (2,), "velocity": (2,)}, sampled=True)
    theta = first.function.call([0.0, start, y, first.pack(projection, 1e-3)])[0]
    eta, xi = second.function.call([0.0, np.zeros(0), theta, y, v, second.pack(transform, 1e-3)])[:2]
    return ca.Function("J", [start, y, v], [ca.jacobian(ca.vertcat(eta, xi), ca.vertcat(y, v))])


@pytest.mark.drawn(3)
@EVERY
def test_all_derivatives_of_the_transform_are_those_of_the_definition(kind):
    # Entries: d eta_2/dy holds kappa_s xi/q^2, with reaches of 0.1 m about 1e3; the foot point's rounding (1e-16) times the
    # rate of change of such entries, 1e4 or so, is well below 1e-9
    path, rng = PATHS[kind], np.random.default_rng(4)
    curve, jacobian = exact(path), full_jacobian(path)
    for theta0, xi, velocity in states(path, rng, 4):
        y = on_plane(path, theta0, xi)
        theta = foot_of(path, y, theta0)
        position, v = numbers(y), numbers(velocity)
        origin = foot(curve, position, theta)
        values = {}
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                moved = [position[0] + i * STEP, position[1] + j * STEP]
                values[i, j] = coordinates(curve, moved, origin, origin)
        want = np.zeros((4, 4))
        for row in (0, 1):  # eta_1, xi_1 and with them the rates gradient' v
            g = {k: w[row] for k, w in values.items()}
            gradient = [(g[1, 0] - g[-1, 0]) / (2 * STEP), (g[0, 1] - g[0, -1]) / (2 * STEP)]
            yy, zz = (g[1, 0] - 2 * g[0, 0] + g[-1, 0]) / STEP**2, (g[0, 1] - 2 * g[0, 0] + g[0, -1]) / STEP**2
            yz = (g[1, 1] - g[1, -1] - g[-1, 1] + g[-1, -1]) / (4 * STEP**2)
            want[2 * row, :2] = want[2 * row + 1, 2:] = [float(d) for d in gradient]
            want[2 * row + 1, :2] = [float(yy * v[0] + yz * v[1]), float(yz * v[0] + zz * v[1])]
        got = np.array(jacobian(theta, y, velocity))
        scale = max(1.0, np.abs(want).max())
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-11 * scale)
        q = float(evaluate(PathProjection(path), [theta], position=y)["q"])
        assert abs(np.linalg.det(got)) == pytest.approx(1 / q**2, rel=1e-9)  # notes, paragraph 2


@pytest.mark.drawn(2)
@EVERY
def test_the_inverse_transform_is_the_inverse_by_the_definition(kind):
    path, rng = PATHS[kind], np.random.default_rng(8)
    curve = exact(path)
    for theta0, xi1, (eta2, xi2) in states(path, rng, 6):
        eta1 = float(path.arc_length(theta0))
        y, dy = path.to_state((eta1, eta2), (xi1, xi2))
        np.testing.assert_array_equal(y, path.to_plane(eta1, xi1))
        position, v = numbers(y), numbers(dy)
        theta = foot(curve, position, theta0)
        _, distance = coordinates(curve, position, theta, theta)
        (eta_rate, _), (xi_rate, _) = rates(curve, lambda t, y=position, v=v: [y[i] + v[i] * t for i in (0, 1)], theta)
        assert abs(arc_length(curve, theta) - eta1) < 2e-12
        assert abs(distance - xi1) < 1e-14
        assert abs(eta_rate - eta2) < 1e-11
        assert abs(xi_rate - xi2) < 1e-11


# --- projection -------------------------------------------------------------------------------------------------------


def test_the_first_foot_point_inside_the_evolute_is_the_global_one():
    # inside the evolute (a y)^(2/3) + (b z)^(2/3) < (a^2 - b^2)^(2/3) equation (6) has four roots, two of them minima (E18)
    path, (a, b), rng = PATHS["ellipse"], (0.3, 0.15), np.random.default_rng(2)
    theta = np.linspace(0.0, 2 * np.pi, 200_001)
    points = np.stack([0.5 + a * np.cos(theta), 0.5 + b * np.sin(theta)])
    tried = 0
    while tried < 40:
        y, z = rng.uniform(-0.22, 0.22), rng.uniform(-0.12, 0.12)
        if np.cbrt((a * y) ** 2) + np.cbrt((b * z) ** 2) > np.cbrt((a**2 - b**2) ** 2) or abs(z) < 1e-3:
            continue
        tried += 1
        distance = np.hypot(points[0] - 0.5 - y, points[1] - 0.5 - z)
        found = foot_of(path, [0.5 + y, 0.5 + z])
        assert 0.0 <= found < 2 * np.pi
        assert found == pytest.approx(theta[np.argmin(distance)], abs=2e-3)  # flat minimum: cell 3e-5 over q > 0.01
        assert np.hypot(0.3 * np.cos(found) - y, 0.15 * np.sin(found) - z) <= distance.min() + 1e-15


@pytest.mark.parametrize("side", [1, -1])
def test_a_tracked_foot_point_stays_on_its_branch_beyond_the_medial_axis(side):
    # between medial axis (0.15 m) and evolute (0.6 m) at theta = +-pi/2 the other half is nearer, tracking stays
    path = PATHS["ellipse"]
    theta = side * np.pi / 2 + 0.1
    for depth in np.linspace(0.0, 0.2, 40):
        y = on_plane(path, side * np.pi / 2, depth)
        theta = foot_of(path, y, theta)
    assert theta == pytest.approx(side * np.pi / 2, abs=1e-12)
    assert np.cos(foot_of(path, y) + side * np.pi / 2) == pytest.approx(1.0)  # from the start on: the other half


class Laps(Block):
    """A position that runs along a path at a distance: theta = rate t from `start` on."""

    path: object = parameter(kw_only=False)
    rate: float = parameter()
    start: float = parameter(default=0.0)
    distance: float = parameter(default=0.0)
    drift: float = parameter(default=0.0, description="rate of the distance")
    position = Output(shape=(2,), unit="m")
    velocity = Output(shape=(2,), unit="m/s")

    def output(self, t, x, u):
        f = self.path.frame(self.start + self.rate * t)
        xi = self.distance + self.drift * t
        along = f.speed * self.rate * (1.0 - f.curvature * xi)
        return f.sigma + f.normal * xi, f.tangent * along + f.normal * self.drift


def tracked(source, path, **options):
    @subsystem(sample_time=1e-3)
    def measuring(position, velocity):
        theta = PathProjection(path, **options)(position).named("theta")
        return TransverseTransform(path)(theta, position, velocity).named("eta", "xi")

    return Diagram("laps", *measuring(*source()))


@pytest.mark.parametrize("direction", [1.0, -1.0], ids=["forth", "back"])
@pytest.mark.parametrize("kind", CLOSED)
@pytest.mark.drawn(3)
def test_laps_are_counted(kind, direction):
    # three laps and a half at half the reach, 0.7 s a lap: the arc length is lifted with the parameter
    path = PATHS[kind]
    rate = direction * path.period / 0.7
    start = 0.3 * path.period
    distance = 0.5 * min(0.2, *(float(r) for t in path.sampling[0] for r in path.reach(t)))
    run = tracked(Laps(path, rate=rate, start=start, distance=distance), path).simulate(2.45, progress=False)
    theta = start + rate * run.t
    laps = np.floor(theta / path.period)
    eta = laps * path.length + path.arc_length(theta - laps * path.period)
    assert abs(laps[-1]) >= 3
    # from 2 m/s a tick moves 2 mm; four Newton iterations from there leave rounding errors alone
    np.testing.assert_allclose(run["theta"], theta, rtol=0, atol=1e-12 * max(1.0, path.period))
    np.testing.assert_allclose(run["eta"][:, 0], eta, rtol=0, atol=1e-12 * max(1.0, path.length))
    np.testing.assert_allclose(run["eta"][:, 1], np.hypot(*path.sigma(theta, 1)) * rate, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(run["xi"], np.outer(np.ones(len(theta)), [distance, 0.0]), rtol=0, atol=1e-11)


def test_a_start_a_rounding_error_before_the_seam_counts_as_after_it():
    path = PATHS["ellipse"]
    assert foot_of(path, [0.8, 0.5 - 1e-12]) == pytest.approx(0.0, abs=1e-10)
    assert foot_of(path, [0.8, 0.5 - 1e-4]) == pytest.approx(2 * np.pi, abs=1e-2)


# --- the end of the domain --------------------------------------------------------------------------------------------


def stopped(source, path, duration=2.0, **options):
    with pytest.raises(PathDomainError) as caught:
        tracked(source, path, **options).simulate(duration, progress=False)
    return caught.value


def test_q_below_its_minimum_stops_the_run():
    # circle of 0.2 m: q = 1 - xi/0.2 is below 0.4 from xi = 0.12 on; 0.1 m/s from 0.05 m: at 0.7 s, found a tick later
    path = PATHS["circle"]
    error = stopped(Laps(path, rate=0.0, start=1.0, distance=0.05, drift=0.1), path, minimum_q=0.4)
    assert error.t == pytest.approx(0.7, abs=1.1e-3)
    assert error.xi == pytest.approx(0.05 + 0.1 * error.t, abs=1e-12)
    assert error.theta == pytest.approx(1.0, abs=1e-12)
    assert error.reach == pytest.approx(0.2, rel=1e-12)  # the medial axis is the centre
    where = np.array([0.5, 0.6]) + (0.2 - error.xi) * np.array([np.cos(1.0), np.sin(1.0)])
    np.testing.assert_allclose(error.position, where, rtol=0, atol=1e-12)
    assert len(error.run.t) == round(error.t / 1e-3)  # every sample until then
    text = str(error)
    assert re.search(r"path_projection.*t = 0\.7.*q = 1 − κ ξ = 0\.(4|39).* is below 0\.4", text)
    for number in (f"θ = {error.theta:.6g}", f"ξ = {error.xi:.6g} m", "reach on that side 0.2 m"):
        assert number in text


@pytest.mark.parametrize("clockwise", [False, True])
def test_the_default_minimum_of_q_is_a_twentieth(clockwise):
    path = Circle(radius=0.2, center=(0.5, 0.6), clockwise=clockwise)
    inwards = -1.0 if clockwise else 1.0
    error = stopped(Laps(path, rate=0.0, start=1.0, distance=0.18 * inwards, drift=0.1 * inwards), path)
    assert error.t == pytest.approx(0.1, abs=1.1e-3)
    assert error.xi == pytest.approx(0.19 * inwards, abs=1.1e-4)
    assert error.reach == pytest.approx(0.2, rel=1e-12)


@pytest.mark.parametrize("theta", [np.pi / 6, np.pi / 4, np.pi / 3, np.pi / 2, 4.0])
def test_the_medial_axis_stops_the_run(theta):
    # at b S/a, S = sqrt(a^2 sin^2 + b^2 cos^2), before the evolute at S^3/(a b); the error shows the nearest foot point,
    # which from there on is the mirror image
    path, (a, b) = PATHS["ellipse"], (0.3, 0.15)
    axis = b / a * np.hypot(a * np.sin(theta), b * np.cos(theta))
    error = stopped(Laps(path, rate=0.0, start=theta, distance=axis - 0.01, drift=0.1), path)
    assert error.t == pytest.approx(0.1, abs=1.1e-3)
    xi = axis - 0.01 + 0.1 * error.t
    assert xi >= axis - 1e-12
    y = np.array([a * np.cos(theta), b * np.sin(theta)])
    normal = np.array([-b * np.cos(theta), -a * np.sin(theta)]) * xi / np.hypot(a * np.sin(theta), b * np.cos(theta))
    np.testing.assert_allclose(error.position, 0.5 + y + normal, rtol=0, atol=1e-12)
    assert error.xi == pytest.approx(axis, abs=1.1e-4)
    assert error.reach == pytest.approx(axis, abs=1e-4)
    assert abs(np.sin(error.theta)) == pytest.approx(abs(np.sin(theta)), abs=5e-3)
    assert "at or beyond the medial axis" in str(error)


@pytest.mark.parametrize(("kind", "end"), [("line", 1), ("line", 0), ("open spline", 1), ("open spline", 0)])
def test_leaving_an_open_path_by_an_end_stops_the_run(kind, end):
    path = PATHS[kind]
    low, high = path.domain
    limit, sign = (high, 1.0) if end else (low, -1.0)
    span = high - low
    start, rate = limit - sign * 0.1 * span, sign * span
    xi = 0.01
    error = stopped(Laps(path, rate=rate, start=start, distance=xi), path)
    assert error.t == pytest.approx(0.1, abs=1.1e-3)
    assert error.theta == pytest.approx(limit, abs=1e-12)  # the end is the nearest point
    beyond = np.hypot(*path.sigma(limit, 1)) * (span * error.t - 0.1 * span)
    assert beyond >= 0
    f = path.frame(limit)
    where = f.sigma + sign * beyond * f.tangent + xi * f.normal  # straight on, by the spline's contract
    np.testing.assert_allclose(error.position, where, rtol=0, atol=1e-9)
    assert error.xi == pytest.approx(xi, abs=1e-9)
    reach = float(path.reach(limit)[0])
    assert error.reach == (np.inf if kind == "line" else pytest.approx(reach, rel=1e-9))  # a line's is unlimited
    assert ("beyond the end" if end else "before the start") in str(error)


def test_a_jump_of_the_position_stops_the_run():
    # to the other side of the ellipse within a tick: Newton's method does not arrive, or finds the farthest point
    path = PATHS["ellipse"]

    class Jump(Block):
        position = Output(shape=(2,), unit="m")
        velocity = Output(shape=(2,), unit="m/s")

        def output(self, t, x, u):
            return np.stack([np.where(t > 0.0105, 0.25, 0.75), 0.52 + 0.0 * t]), np.stack([0.0 * t, 0.0 * t])

    error = stopped(Jump(), path)
    assert error.t == pytest.approx(0.011)
    np.testing.assert_allclose(error.position, [0.25, 0.52])


def test_a_start_outside_of_the_domain_is_refused_at_the_first_tick():
    path = PATHS["line"]
    source = Constant(value=(0.9, 0.64), unit="m", name="place")
    still = Constant(value=(0.0, 0.0), unit="m/s", name="still")

    @subsystem(sample_time=1e-3)
    def measuring(position, velocity):
        return TransverseTransform(path)(PathProjection(path)(position), position, velocity)

    with pytest.raises(PathDomainError, match="beyond the end of the open path") as caught:
        Diagram("outside", *measuring(source, still)).simulate(0.1, progress=False)
    assert caught.value.t == 0.0
    assert caught.value.theta == 1.0
    assert len(caught.value.run.t) == 0


# --- forces -----------------------------------------------------------------------------------------------------------


def axes(kind, theta):
    """Tangent and normal from the definition."""
    s1 = exact(PATHS[kind]).sigma(mp.mpf(theta), 1)
    t = np.array([float(v / mp.hypot(*s1)) for v in s1])
    return t, np.array([-t[1], t[0]])


@EVERY
def test_forces_are_projected_on_tangent_and_normal(kind):
    rng = np.random.default_rng(6)
    for theta, _, _ in states(PATHS[kind], rng, 5):
        force = rng.uniform(-9, 9, 2)
        tangent, normal = axes(kind, theta)
        got = evaluate(ForceProjection(PATHS[kind]), theta=theta, force=force)
        assert got["f_par"] == pytest.approx(tangent @ force, abs=1e-12)
        assert got["f_perp"] == pytest.approx(normal @ force, abs=1e-12)


@pytest.mark.drawn(3)
@EVERY
def test_a_hand_pushes_along_tangent_and_normal(kind):
    rng = np.random.default_rng(7)
    for theta, xi, (f_par, f_perp) in states(PATHS[kind], rng, 5):
        tangent, normal = axes(kind, theta)
        y = on_plane(PATHS[kind], theta, xi)
        hand = HandForce(PATHS[kind])
        got = evaluate(hand, [theta], **all_inputs(hand, position=y, f_par=f_par, f_perp=f_perp))["force"]
        np.testing.assert_allclose(got, f_par * tangent + f_perp * normal, rtol=0, atol=1e-12)


@pytest.mark.drawn(3)
@EVERY
def test_a_spring_presses_back_on_its_side_only(kind):
    rng = np.random.default_rng(9)
    for theta, xi, _ in states(PATHS[kind], rng, 8):
        _, normal = axes(kind, theta)
        y = on_plane(PATHS[kind], theta, xi)
        got = evaluate(PathSpring(PATHS[kind], stiffness=1000.0, cubic_stiffness=4e7), [theta], position=y)["force"]
        depth = max(xi, 0.0)
        np.testing.assert_allclose(got, -(1000.0 * depth + 4e7 * depth**3) * normal, rtol=1e-9, atol=1e-9)


# --- admittance -------------------------------------------------------------------------------------------------------


def filtered(block, forces, T, method="exact", reference=(0.0, 0.0, 0.0), **inputs):
    """The path reference at every tick."""
    given = all_inputs(block, force=0.0, reference=np.array(reference), **inputs)
    made = trace(block, {name: np.shape(v) for name, v in given.items()}, sampled=True, method=method)
    p, state, out = ca.DM(made.pack(block, T)), ca.DM.zeros(2), []
    for force in forces:
        columns = [float(force) if name == "force" else v for name, v in given.items()]
        path_reference, state, _ = made.function.call([0.0, state, *columns, p])
        out.append(np.array(path_reference).ravel())
    return np.array(out)


@pytest.mark.parametrize("free", [False, True], ids=["with stiffness", "without stiffness"])
def test_the_admittance_is_discretized_exactly(free):
    # exp of the system with the held force as a third state
    rng = np.random.default_rng(11 + free)
    for _ in range(8):
        m, d, k, T = (*rng.uniform([0.2, 0.5, 5.0], [5.0, 30.0, 500.0]), 10 ** rng.uniform(-3.5, -1.5))
        k = 0.0 if free else k
        desired, forces, reference = rng.uniform(-5, 5), rng.uniform(-5, 5, 60), rng.uniform(-1, 1, 3)
        offset = 0.0 if free else rng.uniform(-0.1, 0.1)
        block = AdmittanceFilter(mass=m, damping=d, stiffness=k)
        got = filtered(block, forces, T, reference=reference, desired_force=desired, offset=offset)
        phi = expm(np.array([[0, 1, 0], [-k / m, -d / m, 1 / m], [0, 0, 0]]) * T)
        e = np.zeros(2)
        for force, row in zip(forces, got, strict=True):
            drive = force - desired + k * offset
            acceleration = (drive - d * e[1] - k * e[0]) / m
            np.testing.assert_allclose(row, np.add(reference, [*e, acceleration]), rtol=1e-12, atol=1e-12)
            e = (phi @ [*e, drive])[:2]


def test_the_semi_implicit_admittance_moves_with_the_new_velocity():
    rng = np.random.default_rng(13)
    m, d, k, T = 0.5, 2.7, 10.0, 4e-3
    forces = rng.uniform(-5, 5, 80)
    got = filtered(AdmittanceFilter(mass=m, damping=d, stiffness=k), forces, T, "semi_implicit")
    e = v = 0.0
    for force, row in zip(forces, got, strict=True):
        a = (force - d * v - k * e) / m
        np.testing.assert_allclose(row, [e, v, a], rtol=1e-12, atol=1e-12)
        v += T * a
        e += T * v


@pytest.mark.parametrize(("m", "zeta", "k"), [(0.5, 0.6, 10.0), (2.0, 0.3, 200.0)], ids=["along", "across"])
def test_an_admittance_overshoots_by_its_damping_ratio(m, zeta, k):
    # exact at the samples; the peak lies within half a sample of one: (omega_d T)^2/8 of the overshoot at most
    T, omega = 1e-3, np.sqrt(k / m * (1 - zeta**2))
    n = round(1.5 * np.pi / omega / T)
    e = filtered(AdmittanceFilter(mass=m, damping_ratio=zeta, stiffness=k), np.full(n, 3.0), T)[:, 0] / (3.0 / k)
    overshoot = np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2))
    assert overshoot - (omega * T) ** 2 <= e.max() - 1 <= overshoot + 1e-12
    assert np.argmax(e) * T == pytest.approx(np.pi / omega, abs=T)


def test_an_admittance_without_stiffness_needs_its_damping():
    with pytest.raises(ParameterError) as caught:
        AdmittanceFilter(mass=0.5, stiffness=0.0, damping_ratio=0.6)
    assert "found stiffness=0 with damping_ratio=0.6; 2 ζ √(m k) would be zero." in str(caught.value)
    assert "Give damping=… in N.s/m, such as the value with the former stiffness." in str(caught.value)
    for both in ({}, {"damping": 1.0, "damping_ratio": 0.5}):
        with pytest.raises(ParameterError, match="found .*damping_ratio .* damping; expected one of them"):
            AdmittanceFilter(mass=0.5, stiffness=1.0, **both)
    assert AdmittanceFilter(mass=0.5, stiffness=0.0, damping=2.683).effective_damping == 2.683


# --- error dynamics ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("poles", [(-20, -20, -20), (-40, -40, -40), (-3, -7, -11), (-5, -3 + 4j, -3 - 4j)])
def test_error_dynamics_have_the_given_poles(poles):
    a, b, c = poles
    block = ErrorDynamics.from_poles(poles)
    want = [-(a + b + c), a * b + b * c + c * a, -a * b * c]
    np.testing.assert_allclose([block.a2, block.a1, block.a0], np.real(want), rtol=1e-14)
    np.testing.assert_allclose([1, block.a2, block.a1, block.a0], np.real(np.poly(poles)), rtol=1e-14)
    # a triple root is found to the third root of the rounding error
    np.testing.assert_allclose(np.sort_complex(block.poles), np.sort_complex(np.array(poles, complex)), rtol=1e-4)


@pytest.mark.parametrize("poles", [(-1, -2), (-1, -2, 3), (-1, -2, 0), (-1, -2 + 1j, -3), (-1, -2 + 1j, -2 + 1j)])
def test_poles_that_are_none_are_refused(poles):
    with pytest.raises(ParameterError, match="expected three poles in the left half plane"):
        ErrorDynamics.from_poles(poles)


def controlled(integral, excess, coordinate=(0.3, -0.4), reference=(0.1, 0.2, 7.0), T=2e-3):
    block = ErrorDynamics(a2=60.0, a1=1200.0, a0=8000.0)
    inputs = {"coordinate": np.array(coordinate), "reference": np.array(reference), "excess": np.array(excess)}
    made = evaluate(block, [integral], T=T, **{name: inputs[name] for name in block.inputs})
    return float(made["v"]), float(made[NEXT][0])


def test_the_command_is_that_of_the_error_equation():
    # (12) with E5: v = r'' - a2 e' - a1 e - a0 int e
    v, _ = controlled(0.02, 0.0)
    assert v == pytest.approx(7.0 - 60.0 * (-0.6) - 1200.0 * 0.2 - 8000.0 * 0.02, rel=1e-13)


@pytest.mark.parametrize("excess", [0.0, (0.0, 0.0), 5.0, (3.0, 0.0), (0.0, -1e-9), (1.0, -1.0)], ids=str)
def test_the_integral_holds_while_any_axis_saturates(excess):
    _, after = controlled(0.02, excess)
    assert after == (0.02 if np.any(np.asarray(excess)) else pytest.approx(0.02 + 2e-3 * 0.2, rel=1e-13))
