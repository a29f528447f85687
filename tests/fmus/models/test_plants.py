"""The plants to swap: each FMU against SciPy or a closed form.

The equations are written here once more, with NumPy, from the docstrings; nothing of the plants' modules is used but
what builds the FMU.
"""

import fmpy
import mpmath as mp
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import loopwright.fmus
from loopwright.blocks import ParameterError
from loopwright.fmus import Fmu, FmuRuntimeError, gantry_elastic, gantry_stiction, scara
from support.plants import (
    C_V,
    F_C,
    F_S,
    FREE,
    M_J,
    M_T,
    S0,
    WEIGHT,
    D,
    K,
    M,
    elastic,
    friction,
    lugre,
    run,
    sticking,
    stribeck,
)

PLANTS = ("gantry_elastic", "gantry_stiction", "gantry_contact", "scara", "mass_spring_damper", "dc_motor")
PLANTS += ("bouncing_ball",)


@pytest.fixture(scope="module")
def build():
    return lambda name, **options: getattr(loopwright.fmus, name).build(**options)


def solve(rhs, x0, T, *inputs, method="DOP853", rtol=1e-12, atol=1e-14):
    """The same by SciPy: the states at the ticks."""
    x = [np.array(x0, dtype=float)]
    for row in zip(*inputs, strict=True):
        x.append(solve_ivp(lambda t, x, u=row: rhs(x, *u), (0, T), x[-1], method, rtol=rtol, atol=atol).y[:, -1])
    return np.array(x)


def pushes(n, T, amplitude):
    """Two inputs of shape (n, 2) that reverse the motion a few times."""
    t = T * np.arange(n)
    motor = np.stack([np.sin(13.0 * t) + 0.4, np.cos(17.0 * t) + 0.2], axis=1) * amplitude
    return motor, np.stack([np.cos(29.0 * t), np.sin(23.0 * t)], axis=1) * 0.1 * np.mean(amplitude)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("fmi", [3, 2])
@pytest.mark.parametrize("name", PLANTS)
def test_every_plant_passes_fmpys_validation_and_says_what_its_variables_are(uncompiled, build, name, fmi):
    file = build(name, fmi=fmi)
    assert file.name == f"{name}.fmu"
    assert validate_fmu(str(file)) == []
    for variable in fmpy.read_model_description(str(file)).modelVariables:
        if not variable.name.startswith("der(") and not variable.name.endswith(".indicator"):
            assert variable.description, variable.name
            assert variable.unit or variable.type not in ("Float64", "Real"), variable.name


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gantry_elastic", "gantry_stiction", "gantry_contact"])
def test_the_gantries_have_the_ports_of_the_experiments(build, name):
    plant = Fmu(build(name))
    assert {n: (p.shape, p.unit) for n, p in plant.inputs.items()} == {
        "motor_force": ((2,), "N"),
        "external_force": ((2,), "N"),
    }
    for port, unit in (("position", "m"), ("velocity", "m/s"), ("acceleration", "m/s2")):
        assert (plant.outputs[port].shape, plant.outputs[port].unit) == ((2,), unit)


# --- gantry_elastic ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_elastic_gantry_is_two_masses_on_each_axis(build):
    T, n = 1e-3, 400
    motor, external = pushes(n, T, np.array([250.0, 140.0]))
    given = {"slide_friction_share": 0.3}
    got = run(build("gantry_elastic"), T, given, motor_force=motor, external_force=external)
    start = [0.8, 0.5, 0, 0, 0.8, 0.5 + WEIGHT[1] / K[1], 0, 0]
    x = solve(lambda x, u, f: elastic(x, u, f, 0.3), start, T, motor, external)
    # RK4 at 0.1 ms on a resonance of 630 1/s: (0.063)^4/120 = 1e-7 of its part in the motion, some 50 um and 30 mm/s
    assert np.abs(got["position"] - x[:, :2]).max() < 3e-11
    assert np.abs(got["motor_position"] - x[:, 4:6]).max() < 3e-11
    assert np.abs(got["velocity"] - x[:, 2:4]).max() < 2e-8
    assert np.abs(x[:, 4:6] - x[:, :2]).max() > 5e-5  # the screws do deflect
    at_ticks = np.array([elastic(row, u, f, 0.3)[2:4] for row, u, f in zip(x[1:], motor, external, strict=True)])
    assert np.abs(got["acceleration"][1:] - at_ticks).max() < 1e-5  # m/s2, of 8


def test_the_resonance_of_a_screw_is_that_of_its_eigenvalues():
    frequency, damping = gantry_elastic.nominal.resonance
    for i in range(2):
        inverse = 1.0 / M_T[i] + 1.0 / M_J[i]
        pole = np.linalg.eigvals([[0.0, 1.0], [-K[i] * inverse, -D[i] * inverse]])[0]
        assert 2.0 * np.pi * frequency[i] == pytest.approx(abs(pole), rel=1e-12)
        assert damping[i] == pytest.approx(-pole.real / abs(pole), rel=1e-12)


@pytest.mark.slow
def test_a_deflected_screw_rings_at_its_resonance(build):
    # without friction, weight and forces: delta'' + (1/m_t + 1/m_J) (d delta' + k delta) = 0
    T, n, e0 = 1e-3, 60, np.array([1e-4, -2e-4])
    still = np.zeros((n, 2))
    start = {**FREE, "deflection": e0, "deflection_rate": 0.0, "internal_step": 2e-5}
    got = run(build("gantry_elastic"), T, start, motor_force=still, external_force=still)
    reduced = M_T * M_J / M
    omega, damping = np.sqrt(K / reduced), D / (2 * np.sqrt(K * reduced))
    assert omega / (2 * np.pi) == pytest.approx([100.0, 100.0], rel=0.01)  # what the docstring says
    assert damping == pytest.approx([0.12, 0.12], rel=0.02)
    t, root = T * np.arange(n + 1)[:, None], np.sqrt(1 - damping**2)
    swing = np.cos(omega * root * t) + damping / root * np.sin(omega * root * t)
    want = e0 * np.exp(-damping * omega * t) * swing
    assert np.abs(got["motor_position"] - got["position"] - want).max() < 1e-11
    assert np.abs(
        M_T * (got["position"] - [0.8, 0.5]) + M_J * (got["motor_position"] - [0.8, 0.5]) - M_J * e0
    ).max() < (
        1e-11  # momentum: the common centre of mass stays
    )


@pytest.mark.slow
def test_a_stiff_screw_is_the_gantry(build):
    T, n = 1e-3, 200
    motor, external = pushes(n, T, np.array([250.0, 140.0]))

    def rigid(x, u, f):
        return np.concatenate([x[2:], (u - friction(x[2:]) - WEIGHT + f) / M])

    x = solve(rigid, [0.8, 0.5, 0, 0], T, motor, external)

    def difference(factor):
        start = {"screw_stiffness": K * factor, "screw_damping": D * factor, "internal_step": 1e-5}
        start["deflection"] = WEIGHT / (K * factor)
        got = run(build("gantry_elastic"), T, start, motor_force=motor, external_force=external)
        return np.abs(got["position"] - x[:, :2]).max()

    soft, stiff = difference(10.0), difference(100.0)
    # the slide gives way by the force it is accelerated with, over the stiffness: some 10 um at ten times k
    assert 1e-6 < soft < 3e-5
    assert stiff == pytest.approx(soft / 10.0, rel=0.1)


# --- gantry_stiction --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize("scales", [(1.0, 1.0), (0.6, 2.0)])
def test_the_gantry_with_stiction_obeys_the_lugre_model(build, scales):
    T, n = 1e-3, 400
    motor, external = pushes(n, T, np.array([250.0, 140.0]))
    start = dict(zip(("coulomb_scale", "viscous_scale"), scales, strict=True))
    got = run(build("gantry_stiction"), T, start, motor_force=motor, external_force=external)
    x = solve(lambda x, u, f: sticking(x, u, f, *scales), [0.8, 0.5, 0, 0, 0, 0], T, motor, external)
    assert np.abs(got["velocity"]).max() > 0.3
    # implicit, relative error 1e-8 a step, and smaller ones at the kink of |v|
    assert np.abs(got["velocity"] - x[:, 2:4]).max() < 2e-9
    assert np.abs(got["position"] - x[:, :2]).max() < 1e-10
    forces = np.array([lugre(row[2:4], row[4:], *scales)[1] for row in x])
    assert np.abs(got["friction_force"] - forces).max() < 3e-5  # N, of 200


@pytest.mark.slow
def test_at_speed_the_bristles_are_stiff_and_the_implicit_integrator_holds(build):
    # at 20 m/s their rate is 6e5 1/s: the explicit method with steps of 50 us is far beyond its limit
    still = np.zeros((20, 2))
    start = {"velocity": 20.0, "equivalent_mass": 1e12}
    got = run(build("gantry_stiction"), 1e-3, start, motor_force=still, external_force=still)
    assert got["friction_force"][-1] == pytest.approx(F_C + 20.0 * C_V, rel=1e-6)
    explicit = {"integrator": 1, "internal_step": 5e-5}
    with pytest.raises(FmuRuntimeError, match="finite"):
        run(build("gantry_stiction"), 1e-3, start | explicit, motor_force=still, external_force=still)


@pytest.mark.parametrize("v", [-0.4, -0.02, -0.004, 0.0005, 0.002, 0.005, 0.01, 0.1, 1.0])
def test_steady_friction_is_the_stribeck_curve(build, v):
    # so heavy that no force changes its velocity: rising and falling part of the curve alike
    n = int(np.clip(20 * 40e-6 / abs(v) / 1e-3, 20, 2000))  # the bristles settle within 40 um
    still = np.zeros((n, 2))
    start = {"velocity": v, "equivalent_mass": 1e12}
    got = run(build("gantry_stiction"), 1e-3, start, motor_force=still, external_force=still)
    want = np.sign(v) * stribeck(v) + C_V * v
    assert got["friction_force"][-1] == pytest.approx(want, rel=3e-9)


def test_before_it_breaks_away_the_axis_yields_as_the_bristles_do(build):
    # pushed slowly, z' = v (1 - sigma_0 z/F_s), so that the force is F_s (1 - exp(-sigma_0 s/F_s))
    T, n = 1e-3, 4000
    push = np.outer(np.linspace(0.0, 0.95, n), F_S) + WEIGHT
    start = {"bristle": 0.0, "gravity": 9.81}
    got = run(build("gantry_stiction"), T, start, motor_force=push, external_force=np.zeros((n, 2)))
    moved = got["position"] - [0.8, 0.5]
    want = -F_S / S0 * np.log(1.0 - (push - WEIGHT) / F_S)
    # what inertia and dampers take: v is 0.15 mm/s at the end, sigma_1 v and c_v v some N
    assert moved[1000:-1] == pytest.approx(want[999:-1], rel=0.02)
    assert moved[-1] == pytest.approx([116e-6, 117e-6], rel=0.02)  # micrometres: it sticks


def test_the_breakaway_force_is_that_of_the_stribeck_curve(build):
    def after_a_second(share):
        n = 1000
        push = np.tile(share * F_S + WEIGHT, (n, 1)) * np.minimum(1.0, np.arange(n) / 500.0)[:, None]
        got = run(build("gantry_stiction"), 1e-3, motor_force=push, external_force=np.zeros((n, 2)))
        return np.abs(got["position"][-1] - got["position"][500])

    assert np.all(after_a_second(0.95) < 1e-4)
    assert np.all(after_a_second(1.02) > 1e-2)  # it slides, although F_c could hold it no less than F_s


def test_a_breakaway_friction_below_the_coulomb_friction_is_refused():
    with pytest.raises(ParameterError, match=r"breakaway_friction: found \[60.0, 49.0\].*65.42.*Raise it"):
        gantry_stiction.GantryStiction(breakaway_friction=(60.0, 49.0))


# --- scara ------------------------------------------------------------------------------------------------------------

L1, L2, C1, C2, M1, M2, I1, I2, J1, J2 = 0.6, 0.5, 0.3, 0.25, 6.0, 4.0, 0.2, 0.1, 1.0, 0.4


def energies(q, v, g, cos, sin):
    """Kinetic and potential energy, from the links' centres and their velocities."""
    a, b, w = q[0], q[0] + q[1], v[0] + v[1]
    elbow = (-L1 * sin(a) * v[0], L1 * cos(a) * v[0])
    second = (elbow[0] - C2 * sin(b) * w, elbow[1] + C2 * cos(b) * w)
    kinetic = M1 * (C1 * v[0]) ** 2 + M2 * (second[0] ** 2 + second[1] ** 2)
    kinetic += I1 * v[0] ** 2 + I2 * w**2 + J1 * v[0] ** 2 + J2 * v[1] ** 2
    return kinetic / 2, g * (M1 * C1 * sin(a) + M2 * (L1 * sin(a) + C2 * sin(b)))


def tip(q, cos=np.cos, sin=np.sin):
    return L1 * cos(q[0]) + L2 * cos(q[0] + q[1]), L1 * sin(q[0]) + L2 * sin(q[0] + q[1])


def arm(x, torque, force):
    """Joint velocities and accelerations, the matrices written out."""
    q, v = x[:2], x[2:]
    beta = M2 * L1 * C2
    outer = I2 + M2 * C2**2
    m12 = outer + beta * np.cos(q[1])
    inertia = np.array([[J1 + I1 + M1 * C1**2 + M2 * L1**2 + outer + 2 * beta * np.cos(q[1]), m12], [m12, J2 + outer]])
    coriolis = beta * np.sin(q[1]) * np.array([-2 * v[0] * v[1] - v[1] ** 2, v[0] ** 2])
    rub = np.array([4.0, 2.0]) * np.tanh(v / 0.02) + np.array([5.0, 3.0]) * v
    y, z = tip(q)
    reach = L2 * np.array([np.cos(q[0] + q[1]), np.sin(q[0] + q[1])])
    jacobian = np.array([[-z, -reach[1]], [y, reach[0]]])
    return np.concatenate([v, np.linalg.solve(inertia, torque + jacobian.T @ force - coriolis - rub)])


def test_the_scara_obeys_lagranges_equation():
    # tau + dh^T F - friction = d/dt dL/dq' - dL/dq, differentiated along the motion with 50 digits
    rng = np.random.default_rng(3)
    model = scara.nominal.replace(gravity=9.81)
    with mp.workdps(50):
        for _ in range(5):
            q, v, torque, force = rng.normal(size=(4, 2)) * [[1.5], [2.0], [20.0], [10.0]]
            a = model.coordinate_acceleration(q, v, torque, force)
            Q, V, A = ([mp.mpf(float(e)) for e in vector] for vector in (q, v, a))

            def lagrangian(angle, rate):
                kinetic, potential = energies(angle, rate, mp.mpf("9.81"), mp.cos, mp.sin)
                return kinetic - potential

            def momentum(t, i):
                angle = [Q[k] + t * V[k] + t**2 / 2 * A[k] for k in (0, 1)]  # noqa: B023 - called at once
                rate = [V[k] + t * A[k] for k in (0, 1)]  # noqa: B023
                return mp.diff(lambda w: lagrangian(angle, [w if k == i else rate[k] for k in (0, 1)]), rate[i])

            for i in (0, 1):
                slope = mp.diff(lambda e: lagrangian([e if k == i else Q[k] for k in (0, 1)], V), Q[i])  # noqa: B023
                work = mp.diff(
                    lambda e: np.dot(force, tip([e if k == i else Q[k] for k in (0, 1)], mp.cos, mp.sin)),  # noqa: B023
                    Q[i],
                )
                rub = (4.0, 2.0)[i] * mp.tanh(V[i] / mp.mpf("0.02")) + (5.0, 3.0)[i] * V[i]
                left = mp.diff(lambda t: momentum(t, i), 0) - slope  # noqa: B023
                assert float(left - (torque[i] + work - rub)) == pytest.approx(0.0, abs=1e-11)


@pytest.mark.slow
def test_the_scaras_fmu_agrees_with_scipy(build):
    T, n = 1e-3, 500
    torque, force = pushes(n, T, np.array([30.0, 15.0]))
    got = run(build("scara"), T, motor_torque=torque, external_force=force)
    x = solve(arm, [0.07072564, 1.0852782, 0, 0], T, torque, force)
    assert np.abs(np.ptp(x[:, :2], axis=0)).min() > 0.1
    assert np.abs(got["joint_angle"] - x[:, :2]).max() < 3e-9
    assert np.abs(got["joint_velocity"] - x[:, 2:]).max() < 3e-8
    assert np.abs(got["position"] - np.stack(tip(x[:, :2].T), axis=1)).max() < 3e-9


@pytest.mark.slow
def test_the_scaras_velocity_and_acceleration_are_the_derivatives_of_its_position(build):
    T, n = 1e-4, 60
    torque, force = np.tile([20.0, -12.0], (n, 1)), np.tile([5.0, 3.0], (n, 1))
    start = {"joint_angle": (0.4, 1.2), "joint_velocity": (1.5, -2.0)}
    got = run(build("scara"), T, start, motor_torque=torque, external_force=force)
    y, v = got["position"], got["velocity"]
    rate = (y[:-4] - 8 * y[1:-3] + 8 * y[3:-1] - y[4:]) / (12 * T)  # of order 4
    assert np.abs(rate - v[2:-2]).max() < 1e-9
    rate = (v[1:-4] - 8 * v[2:-3] + 8 * v[4:-1] - v[5:]) / (12 * T)  # the first row knows no inputs yet
    assert np.abs(rate - got["acceleration"][3:-2]).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("g", [0.0, 9.81])
def test_a_free_scara_keeps_its_energy(build, g):
    T, n = 1e-3, 2000
    start = {"coulomb_scale": 0.0, "viscous_scale": 0.0, "gravity": g, "joint_velocity": (2.0, -3.0)}
    still = np.zeros((n, 2))
    got = run(build("scara"), T, start, motor_torque=still, external_force=still)
    q, v = got["joint_angle"].T, got["joint_velocity"].T
    kinetic, potential = energies(q, v, g, np.cos, np.sin)
    assert np.ptp(v[0]) > 0.3  # the joints exchange it, and with weight the height does
    assert np.ptp(potential) == 0.0 if g == 0.0 else np.ptp(potential) > 10.0
    assert np.ptp(kinetic + potential) < 1e-11  # J, of 8


def test_the_scaras_start_angles_are_those_of_a_position():
    for position in ((0.8, 0.5), (0.2, 0.5), (-0.3, -0.7)):
        for elbow in (1, -1):
            q = scara.nominal.joint_angles(position, elbow=elbow)
            assert tip(q) == pytest.approx(position, abs=1e-15)
            assert np.sign(q[1]) == elbow
    with pytest.raises(ParameterError, match=r"1\.13137 m from the base; expected a distance between 0\.1 and 1\.1 m"):
        scara.nominal.joint_angles((0.8, 0.8))
    with pytest.raises(ParameterError, match=r"position: found the position \[0\.0, 0\.05\] m"):
        scara.nominal.joint_angles((0.0, 0.05))


# --- the small ones ---------------------------------------------------------------------------------------------------


def test_the_mass_on_a_spring_is_a_damped_oscillation(build):
    T, n, m, d, k, force = 0.01, 300, 2.0, 3.0, 50.0, 4.0
    start = {"mass": m, "damping": d, "stiffness": k, "position": 0.3, "velocity": -1.0}
    got = run(build("mass_spring_damper"), T, start, force=np.full(n, force))
    t = T * np.arange(n + 1)
    decay, omega = d / (2 * m), np.sqrt(k / m - (d / (2 * m)) ** 2)
    e0 = 0.3 - force / k
    swing = e0 * np.cos(omega * t) + (-1.0 + decay * e0) / omega * np.sin(omega * t)
    want = force / k + np.exp(-decay * t) * swing
    assert np.abs(got["position"] - want).max() < 1e-11  # RK4 at 1 ms, 5 rad/s: (5e-3)^4/120 of 0.3 m for each radian
    assert got["acceleration"][1:] == pytest.approx(
        (force - d * got["velocity"] - k * got["position"])[1:] / m, abs=1e-12
    )


@pytest.mark.slow
def test_the_dc_motor_follows_its_matrix_exponential(build):
    T, n = 1e-3, 100
    voltage, load = 12.0 * np.sign(np.sin(np.arange(n) / 7.0)), 0.05 * np.cos(np.arange(n) / 5.0)
    got = run(build("dc_motor"), T, {"friction": 2e-5}, voltage=voltage, load_torque=load)
    R, L, k, J, b = 1.2, 2e-3, 0.05, 2e-5, 2e-5
    A = np.zeros((5, 5))
    A[:3] = [[-R / L, -k / L, 0, 1 / L, 0], [k / J, -b / J, 0, 0, -1 / J], [0, 1, 0, 0, 0]]
    step, x = expm(A * T), np.zeros((n + 1, 3))
    for i in range(n):
        x[i + 1] = (step @ [*x[i], voltage[i], load[i]])[:3]
    # RK4 at 0.1 ms, a rate of 600 1/s: (0.06)^4/120 = 1e-7 of 10 A and 200 rad/s that change
    for name, column in (("current", 0), ("speed", 1), ("angle", 2)):
        assert np.abs(got[name] - x[:, column]).max() < 2e-6 * np.ptp(x[:, column]), name
    assert got["torque"] == pytest.approx(k * got["current"], rel=1e-15)
