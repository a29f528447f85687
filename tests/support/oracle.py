"""An independent, high-accuracy solution of the sampled loop of experiments A, B, C, D.

Nothing of the project is imported. The plant is integrated from sample to sample by a method of order 4 in short steps,
motor and external force held; the controller is written out in plain floats from the paper's formulas with the readings of
its notes (E.. = erratum, paragraph 2 = derivation), in the order of a tick that experiments.md fixes.
F is the force on the robot; xi > 0 is inside the ellipse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.special import ellipe, ellipeinc

Pair = tuple[float, float]
Motion = tuple[float, float, float]  # position, velocity, acceleration

MASS: Pair = (36.87, 21.20)  # m_t + m_J (E10)
COULOMB: Pair = (65.42, 37.69)
VISCOUS: Pair = (175.93, 62.83)
WEIGHT: Pair = (0.0, 9.81 * 4.41)  # the rotary equivalent mass has no weight (E10)
A, B, CENTRE = 0.3, 0.15, (0.5, 0.5)  # semi-axes (E12) and centre of (16)
POLE: Pair = (20.0, 40.0)  # triple poles at -p, channels (parallel, perpendicular)
IMPEDANCE_MASS: Pair = (0.5, 2.0)  # Table III
IMPEDANCE_STIFFNESS: Pair = (10.0, 200.0)
IMPEDANCE_DAMPING: Pair = (2 * 0.6 * math.sqrt(0.5 * 10.0), 2 * 0.3 * math.sqrt(2.0 * 200.0))  # 2 zeta sqrt(m k) (E7)
K_E, K_3 = 1000.0, 5.0 / 0.005**3  # springs of D and D': both 5 N at 5 mm
_PARAMETER = 1 - (B / A) ** 2  # m = k^2 of the elliptic integrals
_QUARTER = float(ellipe(_PARAMETER))
LENGTH = 4 * A * _QUARTER  # 1.4532672330821512 m
DURATION = {"A": 11.0, "B": 15.0, "C": 12.0, "D": 9.0}
START: dict[str, Pair] = {"A": (0.10, 0.01), "B": (0.0, 0.0), "C": (0.2, 0.0), "D": (0.2, 0.0)}  # eta_1, xi_1; at rest
RATE, MIN_STEPS = 0.02, 4  # `test_oracle.py` compares with SciPy at 1e-12


@dataclass(frozen=True)
class Options:
    """What a rig adds to an experiment; all off by default."""

    coulomb_scale: float = 1.0  # plant's friction only
    viscous_scale: float = 1.0  # plant's friction only
    friction_width: float = 0.01  # plant and model
    tool_mass: float = 0.0
    encoder: float = 0.0  # quantum in m, 0: off
    delay: int = 0  # 0 or 1 samples
    motor_force_limit: float | Pair | None = None  # (y, z)
    velocity_limit: float | Pair | None = None  # of the path reference (par, perp)
    acceleration_limit: float | Pair | None = None  # of the path reference (par, perp)
    sample_time: float = 1e-3
    admittance_method: str = "exact"  # or "semi_implicit"
    cubic: bool = False  # variant D'


# Geometry of the ellipse (paragraph 2 of the notes)


class Frame(NamedTuple):
    """The path at one parameter: foot point, unit tangent and normal, curvature, d kappa/ds, |sigma'|."""

    point: Pair
    tangent: Pair
    normal: Pair
    kappa: float
    kappa_s: float
    speed: float


class PathState(NamedTuple):
    """The transformed state of one position and velocity, with the frame at the foot point."""

    theta: float
    eta: Pair
    xi: Pair
    q: float
    frame: Frame


def frame(theta: float) -> Frame:
    c, s = math.cos(theta), math.sin(theta)
    x1, y1, x2, y2, x3, y3 = -A * s, B * c, -A * c, -B * s, A * s, -B * c  # sigma', sigma'', sigma'''
    w2 = x1 * x1 + y1 * y1
    w = math.sqrt(w2)
    area = x1 * y2 - y1 * x2
    kappa_s = ((x1 * y3 - y1 * x3) * w2 - 3 * area * (x1 * x2 + y1 * y2)) / w2**3
    tangent = (x1 / w, y1 / w)
    return Frame((A * c + CENTRE[0], B * s + CENTRE[1]), tangent, (-tangent[1], tangent[0]), area / w**3, kappa_s, w)


def arc_length(theta: float) -> float:
    """eta_1 of theta, lifted: |sigma'| = a sqrt(1 - m cos^2 theta), so s = a (E(theta - pi/2 | m) + E(m))."""
    laps = round(theta / (2 * math.pi))
    rest = theta - laps * 2 * math.pi
    return laps * LENGTH + A * (float(ellipeinc(rest - math.pi / 2, _PARAMETER)) + _QUARTER)


def parameter(eta: float) -> float:
    """The inverse of `arc_length`, by Newton."""
    theta = 2 * math.pi * eta / LENGTH
    for _ in range(50):
        step = (eta - arc_length(theta)) / frame(theta).speed
        theta += step
        if abs(step) <= 1e-15 * max(1.0, abs(theta)):
            break
    return theta


def project(position: Pair, start: float | None = None) -> float:
    """Newton on (6) from `start`, lifted; without a start the global arg min of (4), with theta in [-pi, pi)."""
    y, z = position[0] - CENTRE[0], position[1] - CENTRE[1]
    if start is None:
        grid = np.linspace(-math.pi, math.pi, 1440, endpoint=False)
        start = float(grid[np.argmin((y - A * np.cos(grid)) ** 2 + (z - B * np.sin(grid)) ** 2)])
    theta = start
    for _ in range(50):
        c, s = math.cos(theta), math.sin(theta)
        dy, dz = y - A * c, z - B * s
        slope = A * A * s * s + B * B * c * c + dy * A * c + dz * B * s  # |sigma'|^2 q
        if slope <= 0.0:
            raise ValueError(f"the projection of {position} left the tube around the path (q <= 0)")
        step = (-dy * A * s + dz * B * c) / slope
        theta += step
        if abs(step) < 1e-9:  # quadratic: the error left is far below rounding
            return theta
    raise ValueError(f"no convergence of the projection of {position}")


def transform(position: Pair, velocity: Pair, start: float | None = None) -> PathState:
    """T: the state in path coordinates, eta_2 = t'v/q and xi_2 = n'v."""
    theta = project(position, start)
    f = frame(theta)
    (ty, tz), (ny, nz) = f.tangent, f.normal
    xi = ny * (position[0] - f.point[0]) + nz * (position[1] - f.point[1])
    q = 1 - f.kappa * xi
    eta_2 = (ty * velocity[0] + tz * velocity[1]) / q
    return PathState(theta, (arc_length(theta), eta_2), (xi, ny * velocity[0] + nz * velocity[1]), q, f)


def inverse_transform(eta: Pair, xi: Pair) -> tuple[Pair, Pair]:
    """T^-1: position and velocity, y = sigma + n xi_1 and y' = q eta_2 t + xi_2 n."""
    f = frame(parameter(eta[0]))
    along = (1 - f.kappa * xi[0]) * eta[1]
    position = (f.point[0] + f.normal[0] * xi[0], f.point[1] + f.normal[1] * xi[0])
    return position, (along * f.tangent[0] + xi[1] * f.normal[0], along * f.tangent[1] + xi[1] * f.normal[1])


# Profiles and closed forms


def smooth(t: float, t0: float, duration: float, r0: float, r1: float) -> Motion:
    z, h = min(max((t - t0) / duration, 0.0), 1.0), r1 - r0
    return (
        r0 + h * z**4 * (35 - 84 * z + 70 * z**2 - 20 * z**3),
        h * 140 * z**3 * (1 - z) ** 3 / duration,
        h * 420 * z**2 * (1 - z) ** 2 * (1 - 2 * z) / duration**2,
    )


def pulse(t: float, t0: float, t1: float, height: float) -> float:
    return height * (smooth(t, t0, 0.2, 0.0, 1.0)[0] - smooth(t, t1 - 0.2, 0.2, 0.0, 1.0)[0])


def error_response(p: float, e0: float, t: np.ndarray) -> np.ndarray:
    """The continuous PID loop's error after an initial error e0 at rest with zero integral, triple pole at -p."""
    return e0 * (1 + p * t - p**2 * t**2) * np.exp(-p * t)


def impedance_response(m: float, d: float, k: float, force: float, t: np.ndarray) -> np.ndarray:
    """e of m e'' + d e' + k e = force from rest, underdamped: the steady state is force/k."""
    sigma, omega = d / (2 * m), math.sqrt(k / m - (d / (2 * m)) ** 2)
    return force / k * (1 - np.exp(-sigma * t) * (np.cos(omega * t) + sigma / omega * np.sin(omega * t)))


def overshoot(zeta: float) -> float:
    return math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2))


def references(letter: str, t: float) -> tuple[Motion, Motion]:
    """The references eta, xi that come with their derivatives: of the path (A) or of the admittance (B, C, D)."""
    if letter == "A":
        eta = (smooth(t, 1.0, 2.0, 0.12, 0.75), smooth(t, 5.5, 2.0, 0.0, 0.85))
        xi = (smooth(t, 4.0, 0.5, 0.0, -0.03), smooth(t, 8.5, 0.5, 0.0, 0.06), smooth(t, 9.5, 0.5, 0.0, -0.03))
        return _sum(*eta), _sum(*xi)
    if letter == "D":
        return smooth(t, 3.0, 3.0, 0.2, 1.0), (0.0, 0.0, 0.0)
    return (START[letter][0], 0.0, 0.0), (0.0, 0.0, 0.0)


def desired_force(letter: str, t: float) -> Pair:
    """F^d (par, perp)."""
    if letter == "B":
        return (-2.0 if _from(t, 11.0) else 2.0 * _from(t, 7.0), -5.0 if _from(t, 11.0) else 5.0 * _from(t, 4.0))
    return (0.0, -5.0 * _from(t, 0.5)) if letter == "D" else (0.0, 0.0)


def set_point(letter: str, t: float) -> float | None:
    """B's tangential set-point, which comes without derivatives (E27)."""
    return 0.3 * _from(t, 1.0) if letter == "B" else None


def environment_force(letter: str, t: float, xi: float, cubic: bool = False) -> Pair:
    """The external force (par, perp) in the frame at the foot point of the true position: C's hand, D's spring."""
    if letter == "C":
        par = pulse(t, 0.5, 1.5, 1.5) + pulse(t, 2.5, 3.5, -1.5) + pulse(t, 8.5, 9.7, 1.5)
        perp = pulse(t, 0.5, 4.5, 0.3) * math.sin(2 * math.pi * t)
        return par, perp + pulse(t, 5.0, 6.0, 6.0) + pulse(t, 6.5, 7.5, -6.0) + pulse(t, 8.5, 9.7, -6.0)
    if letter == "D":
        return 0.0, -K_3 * max(xi, 0.0) ** 3 if cubic else -K_E * max(xi, 0.0)
    return 0.0, 0.0


def _sum(*motions: Motion) -> Motion:
    return sum(m[0] for m in motions), sum(m[1] for m in motions), sum(m[2] for m in motions)


def _from(t: float, t0: float) -> bool:
    return t >= t0 - 1e-9  # the first tick with t_k >= t0, whatever the rounding of k T


def _pair(value: float | Pair | None) -> Pair:
    if value is None:
        return math.inf, math.inf
    return (float(value), float(value)) if isinstance(value, (int, float)) else (float(value[0]), float(value[1]))


# The plant


class Plant:
    """M s'' = u - F_c tanh(s'/w) - c_v s' - F_G + F (E1, E6), state (y, z, y', z').

    Each axis is integrated by itself, by Runge and Kutta's classical method in plain floats. A sub-step h is so short
    that the fastest motion, which friction at rest makes, has rate h <= `RATE`.
    """

    def __init__(self, options: Options) -> None:
        coulomb = [options.coulomb_scale * c for c in COULOMB]
        viscous = [options.viscous_scale * c for c in VISCOUS]
        self.width, self.force = options.friction_width, (0.0, 0.0)
        self.axes = tuple(zip(MASS, coulomb, viscous, WEIGHT, strict=True))

    def acceleration(self, state: np.ndarray) -> Pair:
        """The acceleration of a state under the motor and external force last held."""
        y, z = (
            (f - weight - c * math.tanh(v / self.width) - d * v) / m
            for f, v, (m, c, d, weight) in zip(self.force, state[2:].tolist(), self.axes, strict=True)
        )
        return y, z

    def advance(self, state: np.ndarray, motor: Pair, external: Pair, T: float) -> np.ndarray:
        self.force = (motor[0] + external[0], motor[1] + external[1])
        x = state.tolist()
        for i in (0, 1):
            x[i], x[i + 2] = self._axis(i, x[i], x[i + 2], T)
        return np.array(x)

    def _axis(self, i: int, s: float, v: float, T: float) -> Pair:
        m, c, d, weight = self.axes[i]
        tanh, w, free, c, d = math.tanh, self.width, (self.force[i] - weight) / m, c / m, d / m
        n = max(MIN_STEPS, math.ceil((c / w + d) * T / RATE))
        h = T / n
        for _ in range(n):
            a1 = free - c * tanh(v / w) - d * v
            v2 = v + h / 2 * a1
            a2 = free - c * tanh(v2 / w) - d * v2
            v3 = v + h / 2 * a2
            a3 = free - c * tanh(v3 / w) - d * v3
            v4 = v + h * a3
            a4 = free - c * tanh(v4 / w) - d * v4
            s += h / 6 * (v + 2 * v2 + 2 * v3 + v4)
            v += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        return s, v


# The controller


class Admittance:
    """One channel of (14), (15): m e'' + d e' + k e = F - F^d, e = path reference - reference, zero at 0 (E13)."""

    def __init__(self, m: float, d: float, k: float, options: Options, v_max: float, a_max: float) -> None:
        self.m, self.d, self.k, self.T = m, d, k, options.sample_time
        self.v_max, self.a_max, self.exact = v_max, a_max, options.admittance_method == "exact"
        self.e = self.e1 = 0.0
        self.cut: Pair | None = None  # position and velocity of the path reference after a tick in which a limit acted
        generator = np.array([[0.0, 1.0, 0.0], [-k / m, -d / m, 1 / m], [0.0, 0.0, 0.0]])
        self.phi = expm(generator * self.T)[:2].tolist()  # (e, e')_{k+1} = phi (e, e', F)_k, force held

    def step(self, reference: Motion, force: float) -> Motion:
        """The path reference at t_k; the state advances to t_{k+1}.

        While no limit acts, e advances exactly. After a tick in which one acted, the path reference itself is known:
        position and velocity as they advanced under the cut acceleration, whatever the reference did meanwhile.
        """
        r, r1, r2 = reference
        T = self.T
        if self.cut is not None:
            self.e, self.e1 = self.cut[0] - r, self.cut[1] - r1
        e, e1 = self.e, self.e1
        if abs(r1 + e1) > self.v_max:  # foreseen with r' + r'' T, which a jerk misses by T^2 times it
            e1 = math.copysign(self.v_max, r1 + e1) - r1
        e2 = (force - self.d * e1 - self.k * e) / self.m
        position, v, a = r + e, r1 + e1, r2 + e2
        if self.exact:
            self.e, self.e1 = (row[0] * e + row[1] * e1 + row[2] * force for row in self.phi)
        else:
            self.e1 = e1 + T * e2
            self.e = e + T * self.e1
        self.cut = None
        if abs(a) > self.a_max or abs(r1 + r2 * T + self.e1) > self.v_max:
            a = min(max(a, (-self.v_max - v) / T), (self.v_max - v) / T)
            a = min(max(a, -self.a_max), self.a_max)
            self.cut = (position + v * T + a * T * T / 2, v + a * T)
        return position, v, a


def impedances(letter: str, options: Options) -> tuple[Admittance, Admittance] | None:
    """The channels (par, perp); one stiffness is zero in C and D, the damping keeps its value (E8)."""
    if letter == "A":
        return None
    stiffness = {"B": IMPEDANCE_STIFFNESS, "C": (0.0, 200.0), "D": (10.0, 0.0)}[letter]
    v_max, a_max = _pair(options.velocity_limit), _pair(options.acceleration_limit)
    par, perp = (
        Admittance(IMPEDANCE_MASS[i], IMPEDANCE_DAMPING[i], stiffness[i], options, v_max[i], a_max[i]) for i in (0, 1)
    )
    return par, perp


def pid(p: float, e: float, e1: float, integral: float, feed_forward: float) -> float:
    """(12) with the reading of E5, triple pole at -p."""
    return feed_forward - 3 * p * e1 - 3 * p**2 * e - p**3 * integral


def linearizing_force(s: PathState, velocity: Pair, v_par: float, v_perp: float, force: Pair, width: float) -> Pair:
    """The boxed law: u = G_v^-1 {n (v_perp + kappa q eta_2^2) + t (q v_par - 2 kappa eta_2 xi_2 - ...) - f_v} - F."""
    eta_2, (xi_1, xi_2), f = s.eta[1], s.xi, s.frame
    along_n = v_perp + f.kappa * s.q * eta_2**2
    along_t = s.q * v_par - 2 * f.kappa * eta_2 * xi_2 - f.kappa_s * xi_1 * eta_2**2
    u = [
        MASS[i] * (f.normal[i] * along_n + f.tangent[i] * along_t)
        + (COULOMB[i] * math.tanh(velocity[i] / width) + VISCOUS[i] * velocity[i] + WEIGHT[i])  # -G_v^-1 f_v
        - force[i]
        for i in (0, 1)
    ]
    return u[0], u[1]


# The loop


def simulate(
    letter: str,
    options: Options | None = None,
    duration: float | None = None,
) -> dict[str, np.ndarray]:
    """One experiment, sampled at t_k = k T, k = 0..N.

    `position`, `velocity`, `acceleration` are the plant's, `position_measured`, `velocity_measured` what the controller
    gets (the same without an encoder); `eta`, `xi`, `theta`, `q` are the controller's, of the measured position.
    `force` is the measured force, `external_force` the one that acts; `motor_force[k]` acts from t_k on,
    `command[k]` is computed (and limited) at t_k.
    """
    options = options or Options()
    if options.delay not in (0, 1) or options.admittance_method not in ("exact", "semi_implicit"):
        raise ValueError(f"delay is 0 or 1, admittance_method 'exact' or 'semi_implicit': {options}")
    if letter == "A" and (options.velocity_limit is not None or options.acceleration_limit is not None):
        raise ValueError("experiment A has no admittance, its path reference is given: nothing to limit")
    T, quantum, width = options.sample_time, options.encoder, options.friction_width
    ticks = round((DURATION[letter] if duration is None else duration) / T)
    plant, channels = Plant(options), impedances(letter, options)
    tool, limit = options.tool_mass, _pair(options.motor_force_limit)
    start = inverse_transform((START[letter][0], 0.0), (START[letter][1], 0.0))[0]
    state = np.array([*start, 0.0, 0.0])
    acceleration: Pair = (0.0, 0.0)
    integral_par = integral_perp = 0.0
    theta = theta_true = previous = last_command = None
    rows: list[list[float]] = []

    for k in range(ticks + 1):
        t = k * T
        # 1. Measure. The hand and the spring act at the true position, the controller sees the encoder's.
        y, z, vy, vz = state.tolist()
        position, velocity = (y, z), (vy, vz)
        true = transform(position, velocity, theta_true)
        theta_true = true.theta
        par, perp = environment_force(letter, t, true.xi[0], options.cubic)
        (ty, tz), (ny, nz) = true.frame.tangent, true.frame.normal
        external = (par * ty + perp * ny, par * tz + perp * nz)
        force = (external[0] - tool * acceleration[0], external[1] - tool * acceleration[1])  # E25
        if quantum > 0.0:
            position = (quantum * round(y / quantum), quantum * round(z / quantum))
            if previous is not None:
                velocity = ((position[0] - previous[0]) / T, (position[1] - previous[1]) / T)
            previous = position
            seen = transform(position, velocity, theta)
            theta = seen.theta
        else:
            seen = true
        # 2. Admittance, driven by the projected force (13) minus the desired one (E16).
        eta_p, xi_p = references(letter, t)
        if channels is not None:
            f, (desired_par, desired_perp), aim = seen.frame, desired_force(letter, t), set_point(letter, t)
            f_par = f.tangent[0] * force[0] + f.tangent[1] * force[1] - desired_par
            f_perp = f.normal[0] * force[0] + f.normal[1] * force[1] - desired_perp
            if aim is not None:
                f_par += channels[0].k * (aim - eta_p[0])
            eta_p, xi_p = channels[0].step(eta_p, f_par), channels[1].step(xi_p, f_perp)
        # 3. PID with the integral so far.
        e_par, e_perp = seen.eta[0] - eta_p[0], seen.xi[0] - xi_p[0]  # eta lifted (E17)
        v_par = pid(POLE[0], e_par, seen.eta[1] - eta_p[1], integral_par, eta_p[2])
        v_perp = pid(POLE[1], e_perp, seen.xi[1] - xi_p[1], integral_perp, xi_p[2])
        # 4. Feedback linearization, saturation, delay.
        wanted = linearizing_force(seen, velocity, v_par, v_perp, force, width)
        command = (min(max(wanted[0], -limit[0]), limit[0]), min(max(wanted[1], -limit[1]), limit[1]))
        motor = command if last_command is None else last_command  # u_0 acts in the first two ticks
        if options.delay:
            last_command = command
        row = [(t,), seen.eta, seen.xi, (y, z), (vy, vz), force, motor, (v_par, v_perp, seen.theta, seen.q)]
        row += [eta_p, xi_p, acceleration, position, velocity, external, command]
        rows.append([value for part in row for value in part])
        # 5. Update.
        if command == wanted:
            integral_par += T * e_par
            integral_perp += T * e_perp
        if k < ticks:
            state = plant.advance(state, motor, external, T)
            acceleration = plant.acceleration(state)

    columns = "t eta:2 xi:2 position:2 velocity:2 force:2 motor_force:2 v_par v_perp theta q eta_p:3 xi_p:3 "
    columns += "acceleration:2 position_measured:2 velocity_measured:2 external_force:2 command:2"
    table, result, at = np.array(rows), {}, 0
    for column in columns.split():
        name, _, width_of = column.partition(":")
        n = int(width_of or 1)
        result[name] = table[:, at].copy() if n == 1 else table[:, at : at + n].copy()
        at += n
    return result
