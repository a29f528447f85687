"""FMI 3.0 Model Exchange: the file, the calls, and the numbers under solvers that are not ours."""

import ctypes
import xml.etree.ElementTree as ET
import zipfile

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp

from loopwright.fmus.export.package import build_fmu
from support.exported import (
    D,
    E,
    G,
    K,
    M,
    ball,
    bounces,
    bouncing_ball,
    driven,
    exact,
    fails,
    heating,
    mass_spring_damper,
    pendulums,
    thermostat,
    van_der_pol,
)


def vector(n, values=()):
    return (ctypes.c_double * n)(*values)


class Exchange:
    """A Model Exchange instance with vectors as lists."""

    def __init__(self, item):
        self.item, self.fmu = item, item.fmu

    def start(self, **start):
        for name, value in start.items():
            self.item[name] = value
        self.fmu.enterInitializationMode(startTime=self.item.start_time)
        self.fmu.exitInitializationMode()
        assert self.fmu.updateDiscreteStates() == (False, False, False, False, False, 0.0)
        self.fmu.enterContinuousTimeMode()
        return self

    def _get(self, function, n):
        found = vector(n)
        function(found, n)
        return list(found)

    @property
    def x(self):
        return self._get(self.fmu.getContinuousStates, self.item.n_states)

    @property
    def dx(self):
        return self._get(self.fmu.getContinuousStateDerivatives, self.item.n_states)

    @property
    def z(self):
        return self._get(self.fmu.getEventIndicators, self.item.n_events)

    @property
    def nominals(self):
        return self._get(self.fmu.getNominalsOfContinuousStates, self.item.n_states)

    def set(self, t, x):
        self.fmu.setTime(t)
        self.fmu.setContinuousStates(vector(len(x), x), len(x))

    def rhs(self, t, x):
        self.set(t, x)
        return self.dx


@pytest.fixture
def exchange(instance):
    return lambda path, **options: Exchange(instance(path, model_exchange=True, **options))


# ---- the file ----


def xml(path):
    with zipfile.ZipFile(path) as archive:
        return ET.fromstring(archive.read("modelDescription.xml"))


@pytest.mark.parametrize("make", [mass_spring_damper, pendulums, bouncing_ball, thermostat, driven])
def test_valid(make):
    path = build_fmu(make())
    assert validate_fmu(str(path)) == []
    description = fmpy.read_model_description(str(path))
    assert description.modelExchange.modelIdentifier == description.coSimulation.modelIdentifier
    assert description.numberOfContinuousStates == sum(v.size for v in make().continuous)
    assert description.numberOfEventIndicators == len(make().events)


def test_flags_are_true(msd):
    root, with_events = xml(msd), xml(build_fmu(bouncing_ball()))
    for description in (root, with_events):
        exchange = description.find("ModelExchange").attrib
        assert exchange["providesDirectionalDerivatives"] == exchange["providesAdjointDerivatives"] == "true"
        assert exchange["canGetAndSetFMUState"] == exchange["canSerializeFMUState"] == "true"
        assert exchange["needsCompletedIntegratorStep"] == "false"
    for description, expected in ((root, "false"), (with_events, "true")):
        stepping = description.find("CoSimulation").attrib
        assert (stepping["hasEventMode"], stepping["mightReturnEarlyFromDoStep"]) == (expected, expected)
    assert root.find("DefaultExperiment").get("tolerance") == "1e-08"


def test_structure_with_events():
    root = xml(build_fmu(thermostat()))
    names = {v.get("valueReference"): v.get("name") for v in root.find("ModelVariables")}
    found = {
        (u.tag, names[u.get("valueReference")]): {
            names[r]: kind
            for r, kind in zip(u.get("dependencies").split(), u.get("dependenciesKind").split(), strict=True)
        }
        for u in root.find("ModelStructure")
    }
    both = {"temperature": "constant", "set_point": "constant"}
    assert found == {
        ("Output", "temperature"): {"temperature": "constant"},
        ("Output", "on"): {},
        ("Output", "power"): {"heating": "discrete", "ambient": "constant"},
        ("ContinuousStateDerivative", "der(temperature)"): {
            "heating": "discrete",
            "ambient": "fixed",
            "temperature": "fixed",
        },
        ("InitialUnknown", "der(temperature)"): dict.fromkeys(
            ("a", "heating", "ambient", "temperature", "on"), "dependent"
        ),
        ("InitialUnknown", "power"): {"heating": "dependent", "on": "dependent", "ambient": "constant"},
        ("EventIndicator", "too_warm.indicator"): both,
        ("EventIndicator", "too_cold.indicator"): both,
    }


def test_variables_of_events_and_discrete_states():
    rows = {v.get("name"): v.attrib for v in xml(build_fmu(thermostat())).find("ModelVariables")}
    assert (rows["on"]["variability"], rows["on"]["initial"], rows["on"]["causality"]) == (
        "discrete",
        "exact",
        "output",
    )
    assert "der(on)" not in rows
    assert rows["temperature"]["nominal"] == "20.0"
    assert rows["too_cold.indicator"]["nominal"] == "0.5"
    assert rows["set_point"]["variability"] == "discrete"
    assert "reinit" not in rows["temperature"]  # the jump leaves it alone
    rows = {v.get("name"): v.attrib for v in xml(build_fmu(bouncing_ball())).find("ModelVariables")}
    assert rows["velocity"]["reinit"] == "true"
    assert "reinit" not in rows["height"]


# ---- the calls ----


def test_the_right_hand_side_is_the_models(exchange):
    spec = pendulums()
    me = exchange(build_fmu(spec), start_time=0.5).start(torque=[0.2, -0.1])
    assert me.x == [0.3, -0.2, 0.0, 0.0, 7.0]
    rng = np.random.default_rng(1)
    for t in (0.5, 0.7, 0.6):  # back in time too
        x = rng.normal(size=5)
        expected = np.array(spec.derivative(t, x, [0.2, -0.1], [1.0, 2.0, 3.0, 4.0])).ravel()
        np.testing.assert_allclose(me.rhs(t, x), expected, rtol=1e-14, atol=1e-15)
        assert me.item["time"] == t
        np.testing.assert_allclose(me.item["deflection"], np.sin(x[:2]), rtol=1e-15)
        np.testing.assert_allclose(me.item["der(rate)"], expected[2:4], rtol=1e-14)
    assert me.nominals == [1.0] * 5
    assert (me.fmu.getNumberOfContinuousStates(), me.fmu.getNumberOfEventIndicators()) == (5, 0)
    assert me.fmu.completedIntegratorStep() == (False, False)


def test_outputs_follow_the_inputs_at_once(msd, exchange):
    me = exchange(msd).start()
    for force in (1.0, -2.0):
        me.item["force"] = force
        assert me.item["acceleration"] == me.item["der(velocity)"] == me.dx[1] == (force - K * 0.1) / M
    me.set(0.3, [0.2, 0.5])
    assert me.item["acceleration"] == pytest.approx((-2.0 - D * 0.5 - K * 0.2) / M, rel=1e-15)


def test_derivatives_are_exact(exchange):
    spec = pendulums()
    me = exchange(build_fmu(spec)).start()
    me.item["torque"] = [0.5, 0.6]
    x = np.array([0.4, 1.1, -0.3, 0.2, 7.0])
    me.set(0.3, x)
    f = spec.derivative.expand()
    args = (0.3, x, [0.5, 0.6], [1.0, 2.0, 3.0, 4.0])
    J = [np.array(b)[2:4] for b in f.jacobian()(*args, f(*args))]
    for known, block in (("angle", J[1][:, :2]), ("rate", J[1][:, 2:4]), ("torque", J[2]), ("time", J[0])):
        forward = [me.item.directional("der(rate)", known, list(e)) for e in np.eye(block.shape[1])]
        np.testing.assert_allclose(np.transpose(forward), block, rtol=1e-12, atol=1e-13)
        reverse = [me.item.adjoint("der(rate)", known, list(e)) for e in np.eye(2)]
        np.testing.assert_allclose(reverse, block, rtol=1e-12, atol=1e-13)
    fails(me.item, lambda: me.item.directional("angle", "deflection", [1.0, 1.0]), "deflection is no known")


def test_derivatives_of_indicators(exchange):
    me = exchange(build_fmu(thermostat())).start()
    assert me.item.directional("too_warm.indicator", "temperature", [2.0]) == [2.0]
    assert me.item.directional("too_cold.indicator", "set_point", [1.0]) == [-1.0]
    assert me.item.directional("der(temperature)", "temperature", [1.0]) == [-0.1]


def test_indicators_have_a_hysteresis(exchange):
    """Away from 0 in its domain: at an event's restart none is 0; a stop just before the crossing fires the event."""
    me = exchange(build_fmu(bouncing_ball())).start()
    assert me.z == [pytest.approx(1.0)]
    me.set(0.4, [0.0, -1.0])
    assert me.z[0] == pytest.approx(1e-10) == me.item["bounce.indicator"]  # z = 0 is not yet past it
    me.set(0.4, [-0.999e-10, -1.0])
    assert me.z[0] > 0.0
    me.fmu.enterEventMode()
    assert me.fmu.updateDiscreteStates() == (False, False, False, True, False, 0.0)
    assert me.x == [-0.999e-10, 0.7]
    assert me.z[0] == pytest.approx(-1.999e-10)
    me.fmu.enterContinuousTimeMode()
    me.set(0.4 + 1e-9, [1e-11, 0.7])
    assert me.z[0] < 0.0  # seen only when it is well above
    me.fmu.enterEventMode()
    assert me.fmu.updateDiscreteStates() == (False, False, False, False, False, 0.0)
    assert me.z[0] == pytest.approx(1.1e-10)
    me.fmu.enterContinuousTimeMode()


def test_discrete_inputs_and_parameters_are_set_in_event_mode(exchange):
    me = exchange(build_fmu(thermostat())).start()
    fails(me.item, lambda: me.item.__setitem__("set_point", 1.0), "set_point is a discrete input; set it in Event Mode")
    me.start()
    fails(me.item, lambda: me.item.__setitem__("heating", 1.0), "heating is a tunable parameter; set it in Event Mode")
    me.start()
    fails(me.item, lambda: me.item.__setitem__("on", 1.0), "on is a state")
    me.start()
    fails(me.item, lambda: me.item.__setitem__("time", 1.0), "fmi3SetTime sets it")
    me.start()
    me.fmu.enterEventMode()
    me.item["set_point"], me.item["heating"] = 10.0, 2.0
    assert me.fmu.updateDiscreteStates()[:4] == (False, False, False, False)  # the switch is no continuous state
    assert me.item["on"] == 0.0
    assert me.item["power"] == 5.0
    me.fmu.enterContinuousTimeMode()


def test_calls_out_of_order(msd, exchange, instance):
    me = exchange(msd)
    fails(me.item, lambda: me.x, "fmi3GetContinuousStates was called in state Instantiated")
    me.fmu.enterInitializationMode()
    assert me.x == [0.1, 0.0]
    fails(me.item, me.fmu.enterContinuousTimeMode, "called in state Initialization Mode, expected Event Mode")
    me.start()
    fails(me.item, me.fmu.updateDiscreteStates, "called in state Continuous-Time Mode, expected Event Mode")
    me.start()
    fails(me.item, lambda: me.fmu.getContinuousStates(vector(1), 1), "found room for 1 values, expected 2")
    me.start()
    fails(me.item, lambda: me.set(np.nan, [0.0, 0.0]), "fmi3SetTime: time was set to nan s")
    me.start()
    fails(me.item, lambda: me.set(0.0, [0.0, np.inf]), "velocity (element 0) became inf")
    me.start()
    me.fmu.enterEventMode()
    fails(me.item, lambda: me.set(0.0, [0.0, 0.0]), "fmi3SetContinuousStates was called in state Event Mode")
    me.start()
    me.fmu.terminate()
    fails(me.item, lambda: me.dx, "called in state Terminated, expected Continuous-Time Mode")
    slave = instance(msd).initialize()
    count = ctypes.c_size_t()
    fails(
        slave,
        lambda: slave.fmu.fmi3GetNumberOfContinuousStates(slave.fmu.component, ctypes.byref(count)),
        "this is a Co-Simulation instance. Use fmi3InstantiateModelExchange",
    )


def test_states_belong_to_an_interface_type(msd, exchange, instance):
    me, slave = exchange(msd).start(), instance(msd).initialize()
    me.set(0.3, [0.2, 0.5])
    state = me.fmu.getFMUState()
    data = me.fmu.serializeFMUState(state)
    expected = me.dx
    me.rhs(1.0, [0.0, 0.0])
    me.fmu.setFMUState(state)
    me.fmu.freeFMUState(state)
    assert (me.item["time"], me.x, me.dx) == (0.3, [0.2, 0.5], expected)
    state = slave.fmu.deserializeFMUState(data)
    fails(slave, lambda: slave.fmu.setFMUState(state), "the state of a Model Exchange instance")
    slave.fmu.freeFMUState(state)


def test_reset_keeps_the_interface_type(msd, exchange):
    me = exchange(msd).start()
    me.fmu.reset()
    assert me.start().x == [0.1, 0.0]


# ---- the numbers ----


def test_scipy_integrates_it_to_the_matrix_exponential(msd, exchange):
    me = exchange(msd).start(force=5.0)
    x = solve_ivp(me.rhs, (0.0, 2.0), me.x, "DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    assert list(x) == pytest.approx(list(exact(2.0, (0.1, 0.0), 5.0)), abs=1e-11)


@pytest.mark.parametrize("interface", ["ModelExchange", "CoSimulation"])
def test_fmpy_agrees_with_scipy(interface):
    """Nonlinear, with time in it: CVode outside, or dopri5 inside, to their tolerances."""

    def rhs(t, x):
        return [-x[0] * x[1] + np.sin(3 * t) + 0.3, x[0] - x[1] ** 3 - 0.5 * x[1] * np.cos(t)]

    result = fmpy.simulate_fmu(
        str(build_fmu(driven(integrator="dopri5"))), fmi_type=interface, stop_time=5.0, output_interval=0.1,
        relative_tolerance=1e-10, start_values={"u": 0.3},
    )  # fmt: skip
    truth = solve_ivp(rhs, (0.0, 5.0), [1.0, 0.5], "DOP853", result["time"], rtol=1e-12, atol=1e-13).y
    bound = {"ModelExchange": 1e-7, "CoSimulation": 1e-9}[interface]  # CVode's error is some hundred tolerances
    assert np.abs(np.array([result["x"], result["y"]]) - truth).max() < bound


def test_a_stiff_model_under_cvode():
    result = fmpy.simulate_fmu(
        str(build_fmu(van_der_pol())), fmi_type="ModelExchange", stop_time=200.0, output_interval=10.0,
        relative_tolerance=1e-8,
    )  # fmt: skip
    truth = solve_ivp(
        lambda t, x: [x[1], 1000.0 * (1.0 - x[0] ** 2) * x[1] - x[0]], (0.0, 200.0), [2.0, 0.0], "Radau",
        result["time"], rtol=1e-10, atol=1e-12,
    ).y  # fmt: skip
    assert np.abs(result["x"] - truth[0]).max() < 300.0 * 1e-8


def test_bounces_under_cvode():
    """The event comes a hysteresis of 1e-10 m late: 1e-10 / 4 s at the first bounce, 1e-10 / 0.7 s at the sixth."""
    result = fmpy.simulate_fmu(
        str(build_fmu(bouncing_ball())), fmi_type="ModelExchange", stop_time=2.3, output_interval=0.01,
        relative_tolerance=1e-10, record_events=True,
    )  # fmt: skip
    times, heights, velocities = (result[name] for name in ("time", "height", "velocity"))
    up = np.flatnonzero((velocities[1:] - velocities[:-1] > 0.1) & (velocities[:-1] < 0.0)) + 1
    found = list(zip(times[up], velocities[up], strict=True))
    expected = [(t, v) for t, v in bounces(8) if t < 2.3]
    assert len(found) == len(expected) == 6
    for (t, v), (t0, v0) in zip(found, expected, strict=True):
        assert t == pytest.approx(t0, abs=1e-9)
        assert v == pytest.approx(v0, abs=1e-8)
    assert max(abs(h - ball(t)[0]) for t, h in zip(times, heights, strict=True)) < 5e-9
    assert E * np.sqrt(2.0 * G) == pytest.approx(expected[0][1])


def test_a_hysteresis_under_cvode():
    result = fmpy.simulate_fmu(
        str(build_fmu(thermostat())), fmi_type="ModelExchange", stop_time=20.0, output_interval=0.5,
        relative_tolerance=1e-10, record_events=False,
    )  # fmt: skip
    assert len(result) == 41
    for t, temperature, on, _ in result:
        assert (temperature, on) == (pytest.approx(heating(t)[0], abs=5e-7), heating(t)[1])
