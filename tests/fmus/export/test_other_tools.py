"""Our FMUs in tools of others, against SciPy and closed forms: pathsim-fmi and ecospy.

FMPy and CasADi's own import are in most tests of this folder. Both peers read scalars alone, so that vectors go to them as
FMI 2.0 or as scalars of FMI 3.0.
"""

import importlib

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright import build
from loopwright.fmus import bouncing_ball, gantry, mass_spring_damper
from support import exported_diagrams
from support.ecos import load_ecospy
from support.exported import ball, bounces

FMI = (2, 3)
DT = 0.01
ADAPTIVE = {"integrator": 2.0, "tolerance": 1e-12}


def oscillation(t, force=5.0):
    """Position and velocity of s'' + s' + 100 s = F from s = 0.1 at rest: the plant's start values."""
    rest, damping, omega = force / 100.0, 0.5, np.sqrt(99.75)
    a, decay = 0.1 - rest, np.exp(-damping * t)
    s = rest + a * decay * (np.cos(omega * t) + damping / omega * np.sin(omega * t))
    return s, -a * decay * 100.0 / omega * np.sin(omega * t)


def gantry_motion(times, force):
    """Positions and velocities of the gantry under a constant motor force, written out with Table II."""
    mass, coulomb, viscous = np.array([36.87, 21.20]), np.array([65.42, 37.69]), np.array([175.93, 62.83])
    weight = np.array([0.0, 9.81 * 4.41])

    def rhs(t, x):
        v = x[2:]
        return np.concatenate([v, (force - weight - coulomb * np.tanh(v / 0.01) - viscous * v) / mass])

    x0 = [0.8, 0.5, 0.0, 0.0]
    return solve_ivp(rhs, (0.0, times[-1]), x0, "DOP853", times, rtol=1e-12, atol=1e-14).y.T


# --- pathsim-fmi ----------------------------------------------------------------------------------------------------


def pathsim(kind, path, n_outputs, end, *, inputs=(), **options):
    """Simulate the FMU with constant inputs; return times and outputs."""
    need = "pathsim and pathsim-fmi are not installed (extra: test)"
    blocks = pytest.importorskip("pathsim.blocks", reason=need)
    fmi = pytest.importorskip("pathsim_fmi", reason=need)
    core, solvers = importlib.import_module("pathsim"), importlib.import_module("pathsim.solvers")
    fmu, scope = getattr(fmi, kind)(str(path), **options), blocks.Scope()
    sources = [blocks.Constant(value) for value in inputs]
    wires = [core.Connection(source, fmu[i]) for i, source in enumerate(sources)]
    wires += [core.Connection(fmu[i], scope[i]) for i in range(n_outputs)]
    tight = {"Solver": solvers.RKDP87, "tolerance_lte_rel": 1e-12, "tolerance_lte_abs": 1e-14}
    core.Simulation([*sources, fmu, scope], wires, dt=DT, log=False, **tight).run(end)
    t, y = scope.read()
    return np.array(t), np.array(y).T


@pytest.mark.slow
@pytest.mark.parametrize("fmi", FMI)
def test_cosimulation_in_pathsim(fmi):
    path = mass_spring_damper.build(fmi=fmi)
    t, y = pathsim("CoSimulationFMU", path, 2, 1.0, inputs=[5.0], dt=DT, start_values=ADAPTIVE)
    assert len(t) > 90
    exact = np.stack(oscillation(t + DT), axis=1)  # pathsim-fmi shows at t what the step from t has led to
    np.testing.assert_allclose(y, exact, rtol=0, atol=5e-11)


@pytest.mark.parametrize("fmi", FMI)
def test_model_exchange_in_pathsim(fmi):
    path = mass_spring_damper.build(fmi=fmi)
    t, y = pathsim("ModelExchangeFMU", path, 3, 1.0, inputs=[5.0])
    s, v = oscillation(t)
    np.testing.assert_allclose(y, np.stack([s, v, 5.0 - v - 100.0 * s], axis=1), rtol=0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize("fmi", FMI)
def test_vectors_in_pathsim_as_scalars(fmi):
    path, force = gantry.build(fmi=fmi, arrays=False), np.array([120.0, 90.0])
    t, y = pathsim("CoSimulationFMU", path, 4, 0.5, inputs=[*force, 0.0, 0.0], dt=DT, start_values=ADAPTIVE)
    np.testing.assert_allclose(y, gantry_motion(t + DT, force), rtol=0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("fmi", FMI)
@pytest.mark.parametrize(("kind", "ahead"), [("CoSimulationFMU", DT), ("ModelExchangeFMU", 0.0)])
def test_events_in_pathsim(fmi, kind, ahead):
    """Two bounces: located inside doStep, or by pathsim from the event indicators."""
    path = bouncing_ball.build(fmi=fmi)
    options = {"dt": DT, "start_values": ADAPTIVE} if ahead else {}
    t, y = pathsim(kind, path, 3, 1.5, **options)
    (t1, _), (t2, _), *_ = bounces(2)
    apart = np.min(np.abs(t + ahead - np.array([[t1], [t2]])), axis=0) > 1e-6
    exact = np.array([ball(at) for at in t + ahead])
    np.testing.assert_allclose(y[apart, :2], exact[apart], rtol=0, atol=1e-12 if ahead else 1e-8)
    count = np.searchsorted([t1, t2], t + ahead)
    assert np.array_equal(y[apart, 2], count[apart])
    assert y[-1, 2] == 2


# --- ecospy ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ecospy():
    return load_ecospy()


def ecos(ecospy, path, parameters, names, steps):
    """Run an FMU for some steps; return the time, and the values after each."""
    rows = []
    with ecospy.EcosSimulationStructure() as structure:
        structure.add_model("plant", str(path))
        structure.add_parameter_set("given", {f"plant::{name}": value for name, value in parameters.items()})
        with ecospy.EcosSimulation(structure=structure, step_size=DT) as simulation:
            assert simulation.init(parameter_set="given"), ecospy.EcosLib.get_last_error()
            for _ in range(steps):
                simulation.step()
                rows.append([simulation.get_time(), *(simulation.get_real(f"plant::{name}") for name in names)])
            simulation.terminate()
    table = np.array(rows)
    return table[:, 0], table[:, 1:]


@pytest.mark.parametrize("fmi", FMI)
def test_cosimulation_in_ecos(ecospy, fmi):
    path = mass_spring_damper.build(fmi=fmi)
    names = ("position", "velocity", "acceleration")
    t, y = ecos(ecospy, path, {"force": 5.0, **ADAPTIVE}, names, 100)
    s, v = oscillation(t)
    assert t[-1] == pytest.approx(1.0)
    np.testing.assert_allclose(y, np.stack([s, v, 5.0 - v - 100.0 * s], axis=1), rtol=0, atol=5e-10)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("fmi", FMI)
def test_vectors_in_ecos_as_scalars(ecospy, fmi):
    path, force = gantry.build(fmi=fmi, arrays=False), np.array([120.0, 90.0])
    given = {"motor_force[1]": 120.0, "motor_force[2]": 90.0, **ADAPTIVE}
    names = ("position[1]", "position[2]", "velocity[1]", "velocity[2]")
    t, y = ecos(ecospy, path, given, names, 50)
    np.testing.assert_allclose(y, gantry_motion(t, force), rtol=0, atol=1e-11)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("fmi", FMI)
def test_events_in_ecos(ecospy, fmi):
    t, y = ecos(ecospy, bouncing_ball.build(fmi=fmi), ADAPTIVE, ("height", "velocity", "bounces"), 200)
    np.testing.assert_allclose(y[:, :2], [ball(at) for at in t], rtol=0, atol=1e-12)
    assert np.array_equal(y[:, 2], np.searchsorted([at for at, _ in bounces(30)], t))


# --- diagrams -------------------------------------------------------------------------------------------------------


def warmth(t):
    """Temperature and heat of the thermostat of `exported_diagrams`: T' = 0.3 P - 0.1 T, P = 10 until T = 2, 0 until 1."""
    at, start, heats = 0.0, 0.0, True
    while True:
        rest, level = (30.0, 2.0) if heats else (0.0, 1.0)
        end = at + 10.0 * np.log((start - rest) / (level - rest))
        if t < end:
            return rest + (start - rest) * np.exp(-0.1 * (t - at)), 10.0 * heats
        at, start, heats = end, level, not heats


@pytest.fixture(scope="module", params=FMI)
def thermostat(request):
    return build(exported_diagrams.continuous(), fmi=request.param, step_size=DT, tolerance=1e-10)


@pytest.mark.slow
def test_a_diagram_with_events_in_pathsim(thermostat):
    t, y = pathsim("CoSimulationFMU", thermostat, 2, 20.0, dt=DT)
    exact = np.array([warmth(at) for at in t + DT])
    switched = np.abs(np.diff(exact[:, 1], prepend=exact[0, 1])) > 0
    assert switched.sum() > 3
    np.testing.assert_allclose(y[:, 0], exact[:, 0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(y[:, 1], exact[:, 1], rtol=0, atol=0)


@pytest.mark.slow
def test_a_diagram_with_events_in_ecos(ecospy, thermostat):
    t, y = ecos(ecospy, thermostat, {}, ("warmth", "heat"), 2000)
    np.testing.assert_allclose(y, [warmth(at) for at in t], rtol=0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("fmi", FMI)
def test_a_sampled_controller_in_both(ecospy, fmi):
    """A PI controller at 100 Hz under a constant error e: u = kp e + ki e T k at tick k, which acts as a step begins."""
    path = build(exported_diagrams.controller, fmi=fmi)
    t, y = pathsim("CoSimulationFMU", path, 1, 1.0, inputs=[1.5, 0.5], dt=DT)
    np.testing.assert_allclose(y[:, 0], 2.0 + 3.0 * 0.01 * np.round(t / DT), rtol=1e-12)
    path = build(exported_diagrams.controller, fmi=fmi, clocks=False)  # ecos 0.7.2 frees memory of clocks twice
    t, y = ecos(ecospy, path, {"wanted": 1.5, "level": 0.5}, ("effort",), 100)
    np.testing.assert_allclose(y[:, 0], 2.0 + 3.0 * 0.01 * np.arange(100), rtol=1e-12)
