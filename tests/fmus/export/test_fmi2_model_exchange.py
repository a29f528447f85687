"""Model Exchange, events and the adaptive integrators in FMI 2.0; importers that aren't ours."""

import ctypes
import math
import xml.etree.ElementTree as ET
import zipfile

import casadi as ca
import fmpy
import fmpy.fmi2
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from loopwright.fmus.export.model import ModelSpec, Variable
from loopwright.fmus.export.package import build_fmu
from support.exported import D, Instance, K, M, bouncing_ball, mass_spring_damper, pendulums, thermostat
from support.exported2 import E, G, Model, ball, fails2, flight, stiff


@pytest.fixture(scope="module")
def files(cache):
    makes = {"msd": mass_spring_damper, "pendulums": pendulums, "ball": ball, "stiff": stiff}
    return {name: build_fmu(make(), fmi=2) for name, make in makes.items()}


@pytest.fixture
def model(files, instance2, tmp_path):
    made = []

    def make(name, n, n_events=0, fmi=2):
        if fmi == 2:
            return Model(instance2(files[name], kind=fmpy.fmi2.FMU2Model), n, n_events)
        makes = {"msd": mass_spring_damper, "pendulums": pendulums, "ball": ball}
        item = Instance(build_fmu(makes[name]()), tmp_path / f"v3-{len(made)}", model_exchange=True)
        made.append(item)
        return Model(item, n, n_events)

    yield make
    for item in made:
        item.fmu.freeInstance()


# ---- the file ----


@pytest.mark.parametrize("name", ["ball", "stiff"])
def test_valid(files, name):
    assert validate_fmu(str(files[name])) == []
    description = fmpy.read_model_description(str(files[name]), validate=True)
    assert description.modelExchange.modelIdentifier == description.coSimulation.modelIdentifier == name
    assert description.numberOfEventIndicators == {"ball": 2, "stiff": 0}[name]


def test_variables_of_a_model_with_events(files):
    with zipfile.ZipFile(files["ball"]) as archive:
        root = ET.fromstring(archive.read("modelDescription.xml"))
    about = {v.get("name"): v.attrib | v.find("Real").attrib for v in root.find("ModelVariables")}
    assert (about["bounces"]["variability"], about["bounces"]["initial"]) == ("discrete", "exact")
    assert [name for name, a in about.items() if "reinit" in a] == ["velocity"]  # the jump leaves the height alone
    assert about["velocity"]["nominal"] == "4.0"
    assert [name for name, a in about.items() if "derivative" in a] == ["der(height)", "der(velocity)"]
    assert [about[name]["start"] for name in ("integrator", "tolerance")] == ["1.0", "1e-08"]


def test_knowns_of_outputs_are_continuous_states_inputs_and_time_alone(files):
    description = fmpy.read_model_description(str(files["ball"]))
    found = {
        u.variable.name: [v.name for v in u.dependencies] for u in (*description.outputs, *description.derivatives)
    }
    assert found == {
        "height": ["height"],
        "bounces": [],
        "energy": ["height", "velocity"],
        "der(height)": ["velocity"],
        "der(velocity)": [],
    }


def test_discrete_states_are_no_knowns():
    """The power is heating * on + ambient: `on` changes at events alone, `heating` is a parameter."""
    description = fmpy.read_model_description(str(build_fmu(thermostat(), fmi=2)))
    found = {u.variable.name: [v.name for v in u.dependencies] for u in description.outputs}
    assert found == {"temperature": ["temperature"], "on": [], "power": ["ambient"]}


# ---- Model Exchange, the equations ----


def test_fmpy_integrates_it(files):
    options = {"stop_time": 2.0, "output_interval": 0.01, "output": ["position", "velocity"]}
    result = fmpy.simulate_fmu(str(files["msd"]), fmi_type="ModelExchange", relative_tolerance=1e-8, **options)
    A = np.array([[0, 1], [-K / M, -D / M]])
    exact = np.array([expm(A * t) @ [0.1, 0.0] for t in result["time"]])
    assert np.abs(result["position"] - exact[:, 0]).max() < 1e-6  # a hundred times the tolerance of each step
    assert np.abs(result["velocity"] - exact[:, 1]).max() < 1e-6


def test_scipy_integrates_it(model):
    item = model("pendulums", 5).start(torque=[0.2, -0.1])
    got = solve_ivp(item.f, (0, 1), item.x, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]

    def right(t, x):
        torque = np.array([[1.0, 2.0], [3.0, 4.0]]) @ [0.2, -0.1]
        return [*x[2:4], *(torque - 9.81 * np.sin(x[:2]) - 0.1 * x[2:4] + 0.5 * np.sin(3 * t)), 0.0]

    truth = solve_ivp(right, (0, 1), [0.3, -0.2, 0, 0, 7], "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(got, truth, rtol=0, atol=1e-12)


def test_the_same_steps_give_the_same_bits_in_both_interfaces_and_versions(files, model, instance2):
    h = 2.0**-7
    runs = [model("msd", 2, fmi=fmi).start(force=1.5) for fmi in (2, 3)]
    stepped = instance2(files["msd"]).initialize(internal_step=h, force=1.5)
    for k in range(100):
        for item in runs:
            item.runge_kutta(k * h, h)
        stepped.step(k * h, h)
        expected = [stepped["position"], stepped["velocity"]]
        assert all(item.x.tolist() == expected for item in runs)
        assert all(item.item["acceleration"] == stepped["acceleration"] for item in runs)


def test_directional_derivatives_are_the_jacobian_of_the_rates(model):
    item = model("pendulums", 5).start(torque=[0.2, -0.1])
    item.move(0.3, [0.4, -0.3, 0.2, 0.1, 7.0])
    names = ["angle[1]", "angle[2]", "rate[1]", "rate[2]", "clock"]
    J = np.transpose([[item.item.directional(f"der({row})", column, [1.0])[0] for row in names] for column in names])
    expected = np.zeros((5, 5))
    expected[:2, 2:4] = np.eye(2)
    expected[2:4, :2] = np.diag(-9.81 * np.cos([0.4, -0.3]))
    expected[2:4, 2:4] = -0.1 * np.eye(2)
    np.testing.assert_allclose(J, expected, rtol=1e-12, atol=0)


def test_casadi_imports_it(files, tmp_path):
    """CasADi's own import: rates and, by our directional derivatives, their Jacobian."""
    fmpy.extract(str(files["pendulums"]), str(tmp_path))
    f = ca.DaeBuilder("pendulums", str(tmp_path)).create("f", ["x", "u"], ["ode"])
    x, u = np.array([0.3, -0.2, 0.1, 0.2, 7.0]), np.array([0.2, -0.1])
    trace = pendulums().derivative.expand()
    args = (0.0, x, u, [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(f(x, u).full(), trace(*args).full(), rtol=1e-14, atol=1e-14)
    by_x, by_u = (J.full() for J in f.jacobian()(x, u, 0))
    exact = [J.full() for J in trace.jacobian()(*args, 0)]
    np.testing.assert_allclose(by_x, exact[1], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(by_u, exact[2], rtol=1e-12, atol=1e-14)


# ---- events ----


def test_the_ball_bounces_in_fmpy(files):
    result = fmpy.simulate_fmu(
        str(files["ball"]),
        fmi_type="ModelExchange",
        stop_time=2.0,
        output_interval=0.01,
        relative_tolerance=1e-9,
        record_events=False,
        output=["height", "bounces"],
    )
    exact = np.array([flight(t) for t in result["time"]])
    assert exact[-1, 2] == 4
    assert result["bounces"].tolist() == exact[:, 2].tolist()
    assert np.abs(result["height"] - exact[:, 0]).max() < 1e-6


@pytest.mark.parametrize(("integrator", "bound"), [(1, 1e-12), (2, 1e-12), (3, 1e-12)])
def test_the_ball_bounces_inside_a_step(files, instance2, integrator, bound):
    """Parabolas are exact for each method, so only rounding is left."""
    item = instance2(files["ball"]).initialize(integrator=integrator)
    for k in range(10):
        item.step(0.25 * k, 0.25)
        height, velocity, n = flight(0.25 * (k + 1))
        assert (item["bounces"], item["echoes"]) == (n, n)
        assert item["height"] == pytest.approx(height, abs=bound)
        assert item["velocity"] == pytest.approx(velocity, abs=10 * bound)


def test_the_ball_falls_alike_in_both_versions(files, instance, instance2):
    two, three = instance2(files["ball"]).initialize(), instance(build_fmu(ball())).initialize()
    for k in range(20):
        two.step(0.125 * k, 0.125)
        three.step(0.125 * k, 0.125)
        assert [two[n] for n in ("height", "velocity", "bounces")] == [
            three[n] for n in ("height", "velocity", "bounces")
        ]


def test_event_iteration(model):
    """The bounce reverses the velocity; the echo fires at the same instant, in one more iteration."""
    item = model("ball", 2, 2).start()
    assert item.flags == [(False, False)]
    assert item.event() == [(False, False)]  # nothing fires without a crossing
    fall = math.sqrt(2 / G)
    item.move(fall, [0.0, -G * fall])  # on the floor: z <= 0
    before = item.indicators
    assert item.event() == [(True, True), (False, False)]
    assert (item.item["bounces"], item.item["echoes"]) == (1.0, 1.0)
    np.testing.assert_allclose(item.x, [0.0, E * G * fall], rtol=1e-15)
    assert before[0] > 0 > item.indicators[0]  # never 0: what the importer sees has a hysteresis
    item.move(fall + 1e-3, [1e-3, 4.0])
    assert item.event() == [(False, False)]  # rising through the floor is not declared
    assert item.item["bounces"] == 1.0


def test_an_event_says_whether_it_has_moved_a_continuous_state(instance2):
    item = Model(instance2(build_fmu(bouncing_ball(), fmi=2), kind=fmpy.fmi2.FMU2Model), 2, 1).start()
    item.move(0.5, [-1e-3, -4.0])
    assert item.event() == [(False, True)]
    item = Model(instance2(build_fmu(thermostat(), fmi=2), kind=fmpy.fmi2.FMU2Model), 1, 2).start()
    item.move(1.0, [21.5])
    assert item.event() == [(False, False)]
    assert item.item["on"] == 0.0  # it has switched the heating off


def test_a_saved_state_resumes_bit_identically_with_its_domains(files, model):
    item = model("ball", 2, 2).start()
    item.move(0.3, [-1e-12, -2.0])
    item.event()
    state = item.fmu.getFMUstate()
    data = item.fmu.serializeFMUstate(state)
    item.fmu.freeFMUstate(state)
    fresh = model("ball", 2, 2)
    restored = fresh.fmu.deSerializeFMUstate(data)
    fresh.fmu.setFMUstate(restored)
    fresh.fmu.freeFMUstate(restored)
    for run in (item, fresh):
        run.runge_kutta(0.3, 0.01)
    assert item.x.tolist() == fresh.x.tolist()
    assert item.indicators.tolist() == fresh.indicators.tolist()
    assert (item.item["bounces"], fresh.item["bounces"]) == (1.0, 1.0)


@pytest.mark.parametrize("integrator", [1, 2, 3])
def test_a_run_cut_between_steps_continues_bit_identically(files, instance2, integrator):
    """The integrator's step size and the domains are part of the state."""
    item = instance2(files["ball"]).initialize(integrator=integrator)
    for k in range(8):
        item.step(0.1 * k, 0.1)
    state = item.fmu.getFMUstate()
    data = item.fmu.serializeFMUstate(state)
    item.fmu.freeFMUstate(state)
    fresh = instance2(files["ball"])
    restored = fresh.fmu.deSerializeFMUstate(data)
    fresh.fmu.setFMUstate(restored)
    fresh.fmu.freeFMUstate(restored)
    for k in range(8, 24):
        for run in (item, fresh):
            run.step(0.1 * k, 0.1)
        assert [item[n] for n in ("height", "velocity", "energy")] == [
            fresh[n] for n in ("height", "velocity", "energy")
        ]


def test_a_stiff_model_in_steps_a_thousand_times_its_time_constant(files, instance2):
    item = instance2(files["stiff"]).initialize()
    for k in range(100):
        item.step(0.01 * k, 0.01)
    assert abs(item["error"]) < 1e-8  # the tolerance
    assert item["x"] == pytest.approx(math.cos(1.0), abs=1e-8)
    item = instance2(files["stiff"])
    fails2(item, lambda: item.initialize(integrator=4.0), "integrator", "was set to 4")


def test_the_importers_tolerance_counts_unless_the_parameter_is_set(files, instance2):
    item = instance2(files["stiff"])
    item.fmu.setupExperiment(tolerance=1e-5)
    assert item["tolerance"] == 1e-5
    item.fmu.reset()
    item["tolerance"] = 1e-6
    item.fmu.setupExperiment(tolerance=1e-5)
    assert item["tolerance"] == 1e-6


# ---- errors ----


def test_outside_of_its_domain_the_importer_may_try_again(instance2):
    """sqrt(x) at x < 0: fmi2Discard asks for a shorter step (FMI 2.0, 2.1.3)."""
    t, x, u, p = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("u", 0), ca.SX.sym("p", 0)
    f, g = ca.Function("f", [t, x, u, p], [-ca.sqrt(x)]), ca.Function("g", [t, x, u, p], [x])
    spec = ModelSpec("tank", "", (), (Variable("y", "output"),), (), (Variable("x", start=4.0, state=True),), f, g)
    item = Model(instance2(build_fmu(spec, fmi=2), kind=fmpy.fmi2.FMU2Model), 1).start()
    with pytest.raises(fmpy.fmi1.FMICallException) as caught:
        item.f(0.1, [-1.0])
    assert caught.value.status == fmpy.fmi2.fmi2Discard
    assert "der(x) (element 0) became" in item.item.log[-1][2]
    assert item.f(0.1, [9.0]) == [-3.0]


def test_calls_out_of_order(files, model, instance2):
    item = model("ball", 2, 2)
    fails2(item.item, lambda: item.rates, "fmi2GetDerivatives was called in state Instantiated")
    item.start()
    fails2(
        item.item, item.iterate, "fmi2NewDiscreteStates was called in state Continuous-Time Mode, expected Event Mode"
    )
    item.start()
    fails2(item.item, lambda: item._vector(item.fmu.getContinuousStates, 3), "found room for 3 values, expected 2")
    item.start()
    fails2(item.item, lambda: item.move(0.1, [np.nan, 0.0]), "height", "became nan", "finite")
    item.start()
    fails2(item.item, lambda: item.fmu.setTime(np.inf), "time was set to inf")
    item.start()
    fails2(item.item, lambda: item.item.__setitem__("restitution", 0.5), "restitution", "set it in Event Mode")
    item.item.initialize(height=2.0)
    item.item["restitution"] = 0.5  # Event Mode
    assert item.item["restitution"] == 0.5
    stepped = instance2(files["ball"]).initialize()
    set_time = stepped.fmu.dll["fmi2SetTime"]
    set_time.argtypes = [ctypes.c_void_p, ctypes.c_double]
    assert set_time(stepped.fmu.component, 1.0) == fmpy.fmi2.fmi2Error
    assert "fmi2SetTime: this is a Co-Simulation instance" in stepped.log[-1][2]


def test_a_state_of_the_other_interface_is_refused(files, model, instance2):
    stepped, item = instance2(files["ball"]).initialize(), model("ball", 2, 2).start()
    state = stepped.fmu.getFMUstate()
    data = stepped.fmu.serializeFMUstate(state)
    stepped.fmu.freeFMUstate(state)
    restored = item.fmu.deSerializeFMUstate(data)
    fails2(item.item, lambda: item.fmu.setFMUstate(restored), "this is the state of a Co-Simulation instance")
    item.fmu.freeFMUstate(restored)
