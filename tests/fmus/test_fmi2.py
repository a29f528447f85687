"""Export to FMI 2.0: the file, and co-simulation. Scalars in place of arrays in FMI 3.0 too."""

import ctypes
import re
import shutil
import subprocess
import threading
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import fmpy
import fmpy.build
import fmpy.fmi2
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from exported import D, K, M, explosive, mass_spring_damper, pendulums, run
from exported2 import Instance2, fails2
from loopwright.blocks._errors import DefinitionError, FmuError
from loopwright.fmus import _build, gantry
from loopwright.fmus._build import build_fmu
from loopwright.fmus._compiler import native_platform
from loopwright.fmus._export import build
from loopwright.fmus._spec import Variable


@pytest.fixture(scope="module")
def msd2(cache):
    return build_fmu(mass_spring_damper(), fmi=2)


@pytest.fixture(scope="module")
def pendulums2(cache):
    return build_fmu(pendulums(), fmi=2)


@pytest.fixture
def instance2(tmp_path):
    made = []

    def make(path, **options):
        made.append(Instance2(path, tmp_path / f"v2-{len(made)}", **options))
        return made[-1]

    yield make
    for item in made:
        item.fmu.freeInstance()


def xml(path):
    with zipfile.ZipFile(path) as archive:
        return ET.fromstring(archive.read("modelDescription.xml"))


def library(path, folder):
    fmpy.extract(str(path), str(folder))
    return next(p for p in (folder / "binaries").rglob("*") if p.is_file())


# ---- the file ----


@pytest.mark.parametrize("make", [mass_spring_damper, pendulums, explosive])
@pytest.mark.parametrize("options", [{"fmi": 2}, {"arrays": False}])
def test_valid(make, options):
    path = build_fmu(make(), **options)
    assert validate_fmu(str(path)) == []
    assert fmpy.read_model_description(str(path), validate=True).coSimulation is not None


def test_the_gantry_is_valid_and_runs():
    path = build(gantry.nominal, fmi=2, internal_step=2e-4)
    assert validate_fmu(str(path)) == []
    three = build(gantry.nominal, internal_step=2e-4)
    options = {"stop_time": 0.2, "output_interval": 0.01}
    two = fmpy.simulate_fmu(str(path), start_values={"motor_force[1]": 150.0}, output=["position[1]"], **options)
    both = fmpy.simulate_fmu(str(three), start_values={"motor_force": [150.0, 0.0]}, output=["position"], **options)
    assert np.array_equal(two["position[1]"], both["position"][:, 0])
    assert abs(two["position[1]"][-1] - two["position[1]"][0]) > 1e-3


def structure(path):
    """The model structure by names; indices count from 1, in the order of the variables (FMI 2.0, 2.2.7)."""
    root = xml(path)
    names = {str(i): v.get("name") for i, v in enumerate(root.find("ModelVariables"), 1)}
    found = {}
    for group in root.find("ModelStructure"):
        for item in group:
            numbers = item.get("dependencies").split()
            assert numbers == sorted(numbers, key=int)
            pairs = zip(numbers, item.get("dependenciesKind").split(), strict=True)
            found[group.tag, names[item.get("index")]] = {names[n]: kind for n, kind in pairs}
    return found


def test_structure_is_complete_and_traced(msd2):
    everything = dict.fromkeys(("mass", "damping", "stiffness", "force", "position", "velocity"), "dependent")
    now = {"force": "fixed", "position": "fixed", "velocity": "tunable"}
    assert structure(msd2) == {
        ("Outputs", "position"): {"position": "constant"},
        ("Outputs", "acceleration"): now,
        ("Derivatives", "der(position)"): {"velocity": "constant"},
        ("Derivatives", "der(velocity)"): now,
        ("InitialUnknowns", "der(position)"): {"velocity": "constant"},
        ("InitialUnknowns", "der(velocity)"): everything,
        ("InitialUnknowns", "acceleration"): everything,
    }


def test_structure_is_told_element_by_element(pendulums2):
    """In FMI 3.0 the arrays depend on each other as wholes; here each pendulum is alone with its own angle."""
    found = structure(pendulums2)
    assert found["Outputs", "deflection[2]"] == {"angle[2]": "dependent"}
    assert set(found["Derivatives", "der(angle[1])"]) == {"rate[1]"}
    assert found["Derivatives", "der(clock)"] == {}
    assert set(found["Derivatives", "der(rate[2])"]) == {"time", "torque[1]", "torque[2]", "angle[2]", "rate[2]"}
    assert {"gain[2,1]", "gain[2,2]"} < set(found["InitialUnknowns", "der(rate[2])"])


def test_variables_say_what_they_are(msd2):
    root = xml(msd2)
    rows = {v.get("name"): (v.attrib, v.find("Real").attrib) for v in root.find("ModelVariables")}
    references = [int(about["valueReference"]) for about, _ in rows.values()]
    assert len(set(references)) == len(references)
    about, real = rows["force"]
    assert about["description"] == 'Force "from outside"'
    assert (about["causality"], about["variability"]) == ("input", "continuous")
    assert (real["unit"], real["start"]) == ("N", "0.0")
    about, real = rows["position"]
    assert (about["causality"], about["initial"], real["start"]) == ("output", "exact", "0.1")
    names = list(rows)
    assert names[int(rows["der(velocity)"][1]["derivative"]) - 1] == "velocity"
    assert (rows["der(velocity)"][1]["unit"], rows["mass"][1]["min"]) == ("m/s2", "1e-06")
    units = {u.get("name"): u.find("BaseUnit").attrib for u in root.find("UnitDefinitions")}
    assert units["N.s/m"] == {"kg": "1", "s": "-1"}
    assert root.attrib["fmiVersion"] == "2.0"


@pytest.mark.parametrize("options", [{"fmi": 2}, {"arrays": False}])
def test_arrays_become_elements(options):
    variables = {v.name: v for v in fmpy.read_model_description(str(build_fmu(pendulums(), **options))).modelVariables}
    assert not any(v.dimensions for v in variables.values())
    starts = {name: float(variables[name].start) for name in variables if name.startswith(("gain", "angle"))}
    assert starts == {"gain[1,1]": 1, "gain[1,2]": 2, "gain[2,1]": 3, "gain[2,2]": 4, "angle[1]": 0.3, "angle[2]": -0.2}
    assert {"der(rate[1])", "der(rate[2])", "torque[1]", "torque[2]", "clock", "positive"} < set(variables)


def test_capabilities_are_true(msd2):
    both = {
        "modelIdentifier": "mass_spring_damper",
        "canNotUseMemoryManagementFunctions": "true",
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
        "providesDirectionalDerivative": "true",
    }
    assert xml(msd2).find("ModelExchange").attrib == both | {"completedIntegratorStepNotNeeded": "true"}
    assert xml(msd2).find("CoSimulation").attrib == both | {
        "canHandleVariableCommunicationStepSize": "true",
        "canInterpolateInputs": "false",
        "maxOutputDerivativeOrder": "0",
        "canRunAsynchronuously": "false",
    }


def test_exports_every_function_of_the_standard(msd2, tmp_path):
    loaded = ctypes.CDLL(str(library(msd2, tmp_path)))
    header = (Path(fmpy.__file__).parent / "c-code" / "fmi2Functions.h").read_text()
    names = re.findall(r"^\s*FMI2_Export\s+fmi2\w+TYPE\s+(fmi2\w+);", header, re.MULTILINE)
    assert len(names) == 44
    assert [name for name in sorted(names) if not hasattr(loaded, name)] == []
    assert not hasattr(loaded, "fmi3DoStep")


@pytest.mark.parametrize("options", [{"fmi": 2}, {"fmi": 3}])
def test_fmpy_compiles_it_from_its_sources(options, tmp_path, instance, instance2):
    """All that is needed is in `sources/`; FMPy brings FMI's headers, and asks CMake for a compiler."""
    if shutil.which("cmake") is None:
        pytest.skip("no CMake on this machine")
    path = build_fmu(mass_spring_damper(), **options)
    binary = library(path, tmp_path / "unzipped")
    binary.unlink()
    (tmp_path / "build").mkdir()
    fmpy.build.build_platform_binary(tmp_path / "unzipped", tmp_path / "build")
    assert binary.is_file()
    again = tmp_path / "again.fmu"
    with zipfile.ZipFile(again, "w") as archive:
        for file in (tmp_path / "unzipped").rglob("*"):
            archive.write(file, file.relative_to(tmp_path / "unzipped"))
    make = instance2 if options["fmi"] == 2 else instance
    assert run(make(again).initialize(), 0.0, 100) == run(make(path).initialize(), 0.0, 100)


def test_compiles_from_its_sources_without_warnings(msd2, tmp_path):
    if (gcc := shutil.which("gcc")) is None:
        pytest.skip("no gcc on this machine")
    with zipfile.ZipFile(msd2) as archive:
        archive.extractall(tmp_path)
    flags = ["-std=c11", "-O1", "-Wall", "-Wextra", "-Wno-unused-parameter", "-Werror", "-fPIC", "-shared"]
    command = [gcc, *flags, f"-I{_build.fmi_headers()[0]}", "-o", tmp_path / "a.so", tmp_path / "sources" / "model.c"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_unknown_version():
    with pytest.raises(FmuError, match=r"found fmi=1, expected 3 \(FMI 3.0\) or 2"):
        build_fmu(mass_spring_damper(), fmi=1)


def test_elements_have_names_of_their_own():
    with pytest.raises(DefinitionError, match="not made of identifiers"):
        Variable("angle[1]")


# ---- the numbers ----


def test_free_motion_against_the_matrix_exponential(msd2):
    result = fmpy.simulate_fmu(str(msd2), stop_time=2.0, output_interval=0.01, output=["position", "velocity"])
    A = np.array([[0, 1], [-K / M, -D / M]])
    for t, position, velocity in result[::20]:
        assert (position, velocity) == pytest.approx(expm(A * t) @ [0.1, 0.0], abs=1e-12)


def test_arrays_and_time_against_dop853(pendulums2, instance2):
    def right(t, x):
        torque = np.array([[1.0, 2.0], [3.0, 4.0]]) @ [0.2, -0.1]
        return [*x[2:], *(torque - 9.81 * np.sin(x[:2]) - 0.1 * x[2:] + 0.5 * np.sin(3 * t))]

    item = instance2(pendulums2, start_time=0.25).initialize(internal_step=1e-3, torque=[0.2, -0.1])
    for k in range(20):
        item.step(0.25 + 0.05 * k, 0.05)
    truth = solve_ivp(right, (0.25, 1.25), [0.3, -0.2, 0, 0], "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    assert item["time"] == pytest.approx(1.25, abs=1e-15)
    np.testing.assert_allclose(np.concatenate([item["angle"], item["rate"]]), truth, rtol=0, atol=1e-10)
    np.testing.assert_allclose(item["deflection"], np.sin(truth[:2]), rtol=0, atol=1e-10)
    np.testing.assert_allclose(item["der(rate)"], right(1.25, truth)[2:], rtol=0, atol=1e-9)
    assert item["clock"] == 7.0


def test_the_same_bits_as_fmi_3(msd, msd2, pendulums2, instance, instance2):
    assert run(instance2(msd2).initialize(), 0.0, 300) == run(instance(msd).initialize(), 0.0, 300)
    vectors, scalars = instance(build_fmu(pendulums())), instance(build_fmu(pendulums(), arrays=False))
    two = instance2(pendulums2).initialize(torque=[0.2, -0.1])
    vectors.initialize(torque=[0.2, -0.1])
    scalars.initialize(**{"torque[1]": 0.2, "torque[2]": -0.1})
    for k in range(100):
        for item in (vectors, scalars, two):
            item.step(0.02 * k, 0.02)
    for name in ("angle", "rate", "deflection", "der(rate)"):
        first, bracket, rest = name.partition(")")
        elements = [f"{first}[{i}]{bracket}{rest}" for i in (1, 2)]
        assert vectors[name].tolist() == two[name].tolist() == [scalars[n] for n in elements]


def test_outputs_belong_to_the_last_communication_point(msd2, instance2):
    """FMI 2.0, 4.2.1: an input that is set counts from the next step on."""
    item = instance2(msd2).initialize(force=1.0)
    for k in range(3):
        before = [item[name] for name in ("position", "acceleration", "der(velocity)")]
        item["force"], item["damping"] = 1.0 + k, D + k
        assert [item[name] for name in ("position", "acceleration", "der(velocity)")] == before
        item.step(k * 0.1, 0.1)
        expected = (1.0 + k - (D + k) * item["velocity"] - K * item["position"]) / M
        assert item["acceleration"] == pytest.approx(expected, rel=1e-14)


def test_start_values_are_set_and_reset(msd2, instance2):
    item = instance2(msd2, start_time=2.0).initialize(mass=4.0, position=0.5)
    assert (item["acceleration"], item["time"]) == (-K * 0.5 / 4.0, 2.0)
    item.step(2.0, 0.1)
    item.fmu.reset()
    assert (item["mass"], item["position"], item["time"]) == (M, 0.1, 0.0)
    assert item.initialize()["acceleration"] == -K * 0.1 / M


# ---- states and derivatives ----


def test_a_saved_state_resumes_bit_identically(msd2, instance2):
    item = instance2(msd2).initialize(internal_step=3e-3, stiffness=20.0)
    run(item, 0.0, 50)
    state = item.fmu.getFMUstate()
    data = item.fmu.serializeFMUstate(state)
    expected = run(item, 0.5, 50)
    item.fmu.setFMUstate(state)
    assert run(item, 0.5, 50) == expected
    item.fmu.freeFMUstate(state)

    fresh = instance2(msd2)
    restored = fresh.fmu.deSerializeFMUstate(data)
    fresh.fmu.setFMUstate(restored)
    fresh.fmu.freeFMUstate(restored)
    assert fresh["stiffness"] == 20.0
    assert run(fresh, 0.5, 50) == expected


def test_states_of_others_are_refused(msd2, pendulums2, instance2):
    item, other = instance2(msd2), instance2(pendulums2)
    state = other.fmu.getFMUstate()
    data = other.fmu.serializeFMUstate(state)
    other.fmu.freeFMUstate(state)
    fails2(item, lambda: item.fmu.deSerializeFMUstate(data), "no state of this FMU")
    fails2(item, lambda: item.fmu.setFMUstate(None), "the state is NULL")


def test_directional_derivatives_equal_the_trace_and_finite_differences(pendulums2, instance2):
    spec = pendulums()
    f, g = spec.derivative.expand(), spec.output.expand()
    item = instance2(pendulums2).initialize(torque=[0.2, -0.1])
    item.step(0.0, 0.3)
    x = np.concatenate([item["angle"], item["rate"], [7.0]])
    knowns = {"time": 0, "angle": 1, "rate": 1, "torque": 2, "gain": 3}
    args = [item["time"], x, item["torque"], item["gain"]]
    columns = {"angle": slice(0, 2), "rate": slice(2, 4)}
    unknowns = ((g, "deflection", slice(0, 2)), (f, "der(rate)", slice(2, 4)), (f, "der(angle)", slice(0, 2)))
    for function, unknown, rows in unknowns:
        for known, i in knowns.items():
            J = np.array(function.jacobian()(*args, function(*args))[i])[rows, columns.get(known, slice(None))]
            got = np.transpose([item.directional(unknown, known, e) for e in np.eye(J.shape[1])])
            np.testing.assert_allclose(got, J, rtol=1e-12, atol=1e-13)
    for i in range(2):  # by the running FMU itself: only inputs act at a communication point, on the next step
        state, e = item.fmu.getFMUstate(), np.eye(2)[i]
        ends = []
        for sign in (-1, 1):
            item.step(0.3, 1e-6, torque=np.array([0.2, -0.1]) + sign * e)
            ends.append(item["der(rate)"])
            item.fmu.setFMUstate(state)
        item.fmu.freeFMUstate(state)
        np.testing.assert_allclose(item.directional("der(rate)", "torque", e), (ends[1] - ends[0]) / 2, rtol=1e-6)


def test_two_instances_in_two_threads_are_independent(msd2, instance2):
    expected = run(instance2(msd2).initialize(), 0.0, 500)
    pair, results = [instance2(msd2).initialize(), instance2(msd2).initialize(position=-0.7)], {}
    threads = [threading.Thread(target=lambda i=i: results.update({i: run(pair[i], 0.0, 500)})) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results[0] == expected
    assert results[1] != expected


@pytest.mark.slow
def test_many_instances_leave_nothing_behind(msd2, tmp_path):
    psutil = pytest.importorskip("psutil")
    item = Instance2(msd2, tmp_path)
    process = psutil.Process()

    def cycle(n):
        for _ in range(n):
            item.fmu.fmi2FreeInstance(item.fmu.component)
            item.fmu.instantiate(callbacks=item.callbacks, loggingOn=True)
            item.initialize()
            state = item.fmu.getFMUstate()
            item.step(0.0, 0.01)
            item.fmu.freeFMUstate(state)

    cycle(300)
    before = process.memory_info().rss, process.num_threads(), process.num_fds()
    cycle(2000)
    assert process.memory_info().rss - before[0] < 1_000_000  # 2000 instances of 1.5 kB each would be 3 MB
    assert (process.num_threads(), process.num_fds()) == before[1:]
    item.fmu.freeInstance()


# ---- errors ----


def test_values_that_are_refused(msd2, instance2):
    item = instance2(msd2).initialize()
    item.step(0.0, 0.5)
    fails2(item, lambda: item.step(0.5, 0.1, force=np.nan), "plant: fmi2SetReal: force", "nan at t = 0.5 s", "finite")
    fails2(item, lambda: item.initialize(mass=-1.0), "mass", "was set to -1", "from 1e-06 to inf")
    fails2(item, lambda: item.fmu.getReal([99]), "fmi2GetReal: there is no", "value reference 99")
    fails2(item, lambda: item.fmu.getInteger([0]), "fmi2GetInteger: all variables of this FMU are Real")
    fails2(item, lambda: item.fmu.setBoolean([0], [1]), "fmi2SetBoolean: all variables of this FMU are Real")


def test_what_may_be_set_when(msd2, instance2):
    item = instance2(msd2)
    fails2(item, lambda: item["acceleration"], "acceleration is calculated", "fmi2EnterInitializationMode first")
    fails2(item, lambda: item.initialize(time=1.0), "fmi2DoStep advances it")
    for name, why in (("mass", "fixed parameter"), ("position", "is a state"), ("integrator", "fixed parameter")):
        item.initialize()
        fails2(item, lambda name=name: item.step(0.0, 0.1, **{name: 1.0}), name, why, "fmi2ExitInitializationMode")


def test_calls_out_of_order(msd2, instance2):
    item = instance2(msd2, stop_time=0.3)
    fails2(item, lambda: item.step(0.0, 0.1), "fmi2DoStep was called in state Instantiated", "FMI 2.0")
    fails2(item, item.fmu.exitInitializationMode, "fmi2ExitInitializationMode was called in state Instantiated")
    fails2(item, item.fmu.terminate, "fmi2Terminate")
    item.initialize()
    fails2(item, lambda: item.fmu.setupExperiment(), "fmi2SetupExperiment was called in state Step Mode")
    item.initialize()
    fails2(item, lambda: item.step(0.5, 0.1), "currentCommunicationPoint is 0.5 s, but this FMU is at 0 s")
    item.initialize()
    fails2(item, lambda: item.step(0.0, -0.1), "communication step is -0.1 s")
    item.initialize()
    for k in range(3):
        item.step(k * 0.1, 0.1)  # 0.2 + 0.1 > 0.3: rounding doesn't count
    fails2(item, lambda: item.step(0.3, 0.1), "passes the stop time of 0.3 s", "fmi2SetupExperiment")
    fails2(item, lambda: item.fmu.setupExperiment(startTime=np.inf), "startTime is inf s")


def test_refused_functions_say_why(msd2, instance2):
    item = instance2(msd2).initialize()
    fails2(item, lambda: item.fmu.setRealInputDerivatives([4], [1], [1.0]), "canInterpolateInputs = false")
    fails2(item, lambda: item.fmu.getRealOutputDerivatives([5], [1]), "maxOutputDerivativeOrder is 0")
    fails2(item, item.fmu.cancelStep, "every step is complete when fmi2DoStep returns")


def test_status_of_a_step(msd2, instance2):
    item = instance2(msd2).initialize()
    item.step(0.0, 0.1)
    time, ended = ctypes.c_double(), ctypes.c_int(7)
    last, terminated = fmpy.fmi2.fmi2LastSuccessfulTime, fmpy.fmi2.fmi2Terminated
    assert item.fmu.fmi2GetRealStatus(item.fmu.component, last, ctypes.byref(time)) == fmpy.fmi2.fmi2OK
    assert item.fmu.fmi2GetBooleanStatus(item.fmu.component, terminated, ctypes.byref(ended)) == fmpy.fmi2.fmi2OK
    assert (time.value, ended.value) == (0.1, 0)
    with pytest.raises(fmpy.fmi1.FMICallException) as caught:
        item.fmu.fmi2GetStatus(item.fmu.component, fmpy.fmi2.fmi2DoStepStatus, ctypes.byref(ended))
    assert caught.value.status == fmpy.fmi2.fmi2Discard
    assert "fmi2GetStatus: every step is complete" in item.log[-1][2]
    item.step(0.1, 0.1)  # it has done no harm


def test_a_state_that_explodes_stops_the_step(instance2):
    item = instance2(build_fmu(explosive(), fmi=2)).initialize()
    item.step(0.0, 0.5)
    before = [item[name] for name in ("time", "calm", "x", "y")]
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.5, 2.0)
    assert [item[name] for name in ("time", "calm", "x", "y")] == before
    message = item.log[-1][2]
    assert "x (element 0) became" in message
    assert 1.0 < float(message.split("t = ")[1].split(" s")[0]) < 1.05  # the substep, not the end of the step


def test_logging_is_by_category_and_survives_percent_signs(msd2, instance2):
    item = instance2(msd2, name="100 %s #1")
    fails2(item, lambda: item.fmu.getReal([99]), "100 %s ##1: fmi2GetReal")  # '#' marks a reference
    item.fmu.setDebugLogging(True, ["logStatusWarning"])
    with pytest.raises(fmpy.fmi1.FMICallException):
        item["force"] = np.nan
    assert len(item.log) == 1
    item.fmu.reset()
    item.fmu.setDebugLogging(True, ["logAll"])
    fails2(item, lambda: item.fmu.getReal([99]), "fmi2GetReal")
    item.fmu.setDebugLogging(True, ["logEvents"])
    assert item.log[-1][0] == fmpy.fmi2.fmi2Warning
    assert "no log category logEvents" in item.log[-1][2]


def test_wrong_guid_is_refused(msd2, instance2):
    item = instance2(msd2)
    item.fmu.fmi2FreeInstance(item.fmu.component)
    right, item.fmu.guid = item.fmu.guid, "another"
    with pytest.raises(Exception, match="Failed to instantiate"):
        item.fmu.instantiate(callbacks=item.callbacks, loggingOn=True)
    assert f"the GUID is another, expected {right}" in item.log[-1][2]
    item.fmu.guid = right
    item.fmu.instantiate(callbacks=item.callbacks)


def test_binaries_are_where_fmi_2_wants_them(msd2):
    folder = {"x86_64-linux": "linux64", "x86_64-windows": "win64", "x86_64-darwin": "darwin64"}
    with zipfile.ZipFile(msd2) as archive:
        found = [name for name in archive.namelist() if name.startswith("binaries/")]
    assert [name.split("/")[1] for name in found] == [folder.get(native_platform(), native_platform())]
