"""The file of an FMU of both versions: valid, complete, true, and compiled again from its own sources."""

import ctypes
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import fmpy
import fmpy.build
import numpy as np
import pytest
from fmpy.validation import validate_fmu

from loopwright.fmus import build, build_fmu, gantry
from loopwright.fmus.export import fmu_package as _build
from loopwright.fmus.platform import native_platform
from support.exported import (
    bouncing_ball,
    driven,
    echoing_ball,
    explosive,
    mass_spring_damper,
    pendulums,
    stiff,
    thermostat,
    van_der_pol,
)
from support.instances import run

FORMS = {"fmi3": {"fmi": 3}, "scalars": {"fmi": 3, "arrays": False}, "fmi2": {"fmi": 2}}
MODELS = [mass_spring_damper, pendulums, explosive, bouncing_ball, thermostat, driven, echoing_ball, stiff]
form = pytest.mark.parametrize("options", FORMS.values(), ids=FORMS)
version = pytest.mark.parametrize("fmi", [3, 2])


def xml(path):
    with zipfile.ZipFile(path) as archive:
        return ET.fromstring(archive.read("modelDescription.xml"))


def library(path, folder):
    fmpy.extract(str(path), str(folder))
    return next(p for p in (folder / "binaries").rglob("*") if p.is_file())


# ---- the description ----


@pytest.mark.drawn(2)
@form
@pytest.mark.parametrize("make", MODELS)
def test_valid(uncompiled, make, options):
    path = build_fmu(make(), **options)
    assert validate_fmu(str(path)) == []
    description = fmpy.read_model_description(str(path), validate=True)
    assert description.modelExchange.modelIdentifier == description.coSimulation.modelIdentifier == make().name
    assert description.numberOfContinuousStates == sum(v.size for v in make().continuous)
    assert description.numberOfEventIndicators == len(make().events)


def structure(path):
    """The model structure by names; FMI 2.0 counts from 1 in the order of the variables (2.2.7), 3.0 has references."""
    root, found = xml(path), {}
    variables = list(root.find("ModelVariables"))
    if root.get("fmiVersion") == "2.0":
        names = {str(i): v.get("name") for i, v in enumerate(variables, 1)}
        items = [(group.tag, item, "index") for group in root.find("ModelStructure") for item in group]
    else:
        names = {v.get("valueReference"): v.get("name") for v in variables}
        items = [(item.tag, item, "valueReference") for item in root.find("ModelStructure")]
    for tag, item, key in items:
        numbers = item.get("dependencies").split()
        if key == "index":
            assert numbers == sorted(numbers, key=int)
        pairs = zip(numbers, item.get("dependenciesKind").split(), strict=True)
        found[tag, names[item.get(key)]] = {names[n]: kind for n, kind in pairs}
    return found


TAGS = {3: ("Output", "ContinuousStateDerivative", "InitialUnknown"), 2: ("Outputs", "Derivatives", "InitialUnknowns")}


@version
def test_structure_is_complete_and_traced(uncompiled, fmi):
    output, derivative, unknown = TAGS[fmi]
    everything = dict.fromkeys(("mass", "damping", "stiffness", "force", "position", "velocity"), "dependent")
    now = {"force": "fixed", "position": "fixed", "velocity": "tunable"}
    if fmi == 3:  # the knowns of FMI 2.0 are inputs, states and time
        now["damping"] = "dependent"
    assert structure(build_fmu(mass_spring_damper(), fmi=fmi)) == {
        (output, "position"): {"position": "constant"},
        (output, "acceleration"): now,
        (derivative, "der(position)"): {"velocity": "constant"},
        (derivative, "der(velocity)"): now,
        (unknown, "der(position)"): {"velocity": "constant"},
        (unknown, "der(velocity)"): everything,
        (unknown, "acceleration"): everything,
    }


def test_structure_of_arrays(uncompiled):
    found = structure(build_fmu(pendulums()))
    assert found["ContinuousStateDerivative", "der(clock)"] == {}
    assert found["Output", "deflection"] == {"angle": "dependent"}
    assert found["Output", "positive"] == {"torque": "dependent"}  # a step: no constant factor
    assert set(found["ContinuousStateDerivative", "der(rate)"]) == {"time", "gain", "torque", "angle", "rate"}


def test_structure_is_told_element_by_element_in_fmi_2(uncompiled):
    """In FMI 3.0 the arrays depend on each other as wholes; here each pendulum is alone with its own angle."""
    found = structure(build_fmu(pendulums(), fmi=2))
    assert found["Outputs", "deflection[2]"] == {"angle[2]": "dependent"}
    assert set(found["Derivatives", "der(angle[1])"]) == {"rate[1]"}
    assert found["Derivatives", "der(clock)"] == {}
    assert set(found["Derivatives", "der(rate[2])"]) == {"time", "torque[1]", "torque[2]", "angle[2]", "rate[2]"}
    assert {"gain[2,1]", "gain[2,2]"} < set(found["InitialUnknowns", "der(rate[2])"])


def test_structure_with_events(uncompiled):
    both = {"temperature": "constant", "set_point": "constant"}
    assert structure(build_fmu(thermostat())) == {
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


def test_knowns_of_fmi_2_are_continuous_states_inputs_and_time_alone(uncompiled):
    """The power is heating * on + ambient: `on` changes at events alone, `heating` is a parameter."""
    description = fmpy.read_model_description(str(build_fmu(echoing_ball(), fmi=2)))
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
    description = fmpy.read_model_description(str(build_fmu(thermostat(), fmi=2)))
    found = {u.variable.name: [v.name for v in u.dependencies] for u in description.outputs}
    assert found == {"temperature": ["temperature"], "on": [], "power": ["ambient"]}


def attributes(path):
    """The attributes of each variable; in FMI 2.0 with those of its Real."""
    found = {}
    for v in xml(path).find("ModelVariables"):
        real = v.find("Real")
        found[v.get("name")] = v.attrib | ({} if real is None else real.attrib)
    return found


@version
def test_variables_say_what_they_are(uncompiled, fmi):
    path = build_fmu(mass_spring_damper(), fmi=fmi)
    root, rows = xml(path), attributes(path)
    references = [int(about["valueReference"]) for about in rows.values()]
    assert len(set(references)) == len(references)
    about = rows["force"]
    assert about["description"] == 'Force "from outside"'
    assert (about["causality"], about["unit"], about["start"]) == ("input", "N", "0.0")
    assert about.get("variability", "continuous") == "continuous"  # by default in FMI 3.0
    about = rows["position"]
    assert (about["causality"], about["initial"], about["start"]) == ("output", "exact", "0.1")
    derivative = rows["der(velocity)"]
    state = list(rows)[int(derivative["derivative"]) - 1] if fmi == 2 else "velocity"
    assert state == "velocity"
    assert fmi == 2 or derivative["derivative"] == rows["velocity"]["valueReference"]
    assert (derivative["unit"], rows["mass"]["min"]) == ("m/s2", "1e-06")
    assert (rows["internal_step"]["unit"], rows["internal_step"]["start"]) == ("s", "0.001")
    units = {u.get("name"): u.find("BaseUnit").attrib for u in root.find("UnitDefinitions")}
    assert units["N.s/m"] == {"kg": "1", "s": "-1"}
    assert root.get("fmiVersion") == {2: "2.0", 3: "3.0"}[fmi]


@version
def test_variables_of_events_and_discrete_states(uncompiled, fmi):
    rows = attributes(build_fmu(thermostat(), fmi=fmi))
    about = rows["on"]
    assert (about["variability"], about["initial"], about["causality"]) == ("discrete", "exact", "output")
    assert "der(on)" not in rows
    assert rows["temperature"]["nominal"] == "20.0"
    assert rows["too_cold.indicator"]["nominal"] == "0.5"
    assert rows["set_point"]["variability"] == "discrete"
    assert "reinit" not in rows["temperature"]  # the jump leaves it alone
    rows = attributes(build_fmu(echoing_ball(), fmi=fmi))
    assert [name for name, about in rows.items() if "reinit" in about] == ["velocity"]  # the height stays
    assert rows["velocity"]["nominal"] == "4.0"
    assert [name for name, about in rows.items() if "derivative" in about] == ["der(height)", "der(velocity)"]
    assert [rows[name]["start"] for name in ("integrator", "tolerance")] == ["1.0", "1e-08"]


@pytest.mark.parametrize("options", [{"fmi": 2}, {"arrays": False}])
def test_arrays_become_elements(uncompiled, options):
    variables = {v.name: v for v in fmpy.read_model_description(str(build_fmu(pendulums(), **options))).modelVariables}
    assert not any(v.dimensions for v in variables.values())
    starts = {name: float(variables[name].start) for name in variables if name.startswith(("gain", "angle"))}
    assert starts == {"gain[1,1]": 1, "gain[1,2]": 2, "gain[2,1]": 3, "gain[2,2]": 4, "angle[1]": 0.3, "angle[2]": -0.2}
    assert {"der(rate[1])", "der(rate[2])", "torque[1]", "torque[2]", "clock", "positive"} < set(variables)


def test_capabilities_of_fmi_2_are_true(uncompiled):
    root = xml(build_fmu(mass_spring_damper(), fmi=2))
    both = {
        "modelIdentifier": "mass_spring_damper",
        "canNotUseMemoryManagementFunctions": "true",
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
        "providesDirectionalDerivative": "true",
    }
    assert root.find("ModelExchange").attrib == both | {"completedIntegratorStepNotNeeded": "true"}
    assert root.find("CoSimulation").attrib == both | {
        "canHandleVariableCommunicationStepSize": "true",
        "canInterpolateInputs": "true",
        "maxOutputDerivativeOrder": "0",
        "canRunAsynchronuously": "false",
    }


def test_capabilities_of_fmi_3_are_true(uncompiled):
    root, with_events = xml(build_fmu(mass_spring_damper())), xml(build_fmu(bouncing_ball()))
    for description, expected in ((root, "false"), (with_events, "true")):
        exchange = description.find("ModelExchange").attrib
        assert exchange["providesDirectionalDerivatives"] == exchange["providesAdjointDerivatives"] == "true"
        assert exchange["canGetAndSetFMUState"] == exchange["canSerializeFMUState"] == "true"
        assert exchange["needsCompletedIntegratorStep"] == "false"
        stepping = description.find("CoSimulation").attrib
        assert (stepping["hasEventMode"], stepping["mightReturnEarlyFromDoStep"]) == (expected, expected)
    assert root.find("DefaultExperiment").get("tolerance") == "1e-08"


# ---- binary and sources ----


@pytest.mark.slow
@version
def test_exports_every_function_of_the_standard(fmi, tmp_path):
    loaded = ctypes.CDLL(str(library(build_fmu(mass_spring_damper(), fmi=fmi), tmp_path)))
    header = (Path(fmpy.__file__).parent / "c-code" / f"fmi{fmi}Functions.h").read_text()
    names = re.findall(rf"^\s*FMI{fmi}_Export\s+fmi{fmi}\w+TYPE\s+(fmi{fmi}\w+);", header, re.MULTILINE)
    assert len(names) == {2: 44, 3: 75}[fmi]
    assert [name for name in sorted(names) if not hasattr(loaded, name)] == []
    assert not hasattr(loaded, f"fmi{5 - fmi}DoStep")


@version
def test_binaries_are_where_the_standard_wants_them(uncompiled, fmi):
    two = {"x86_64-linux": "linux64", "x86_64-windows": "win64", "x86_64-darwin": "darwin64"} if fmi == 2 else {}
    with zipfile.ZipFile(build_fmu(mass_spring_damper(), fmi=fmi)) as archive:
        found = [name for name in archive.namelist() if name.startswith("binaries/")]
    assert [name.split("/")[1] for name in found] == [two.get(native_platform(), native_platform())]


@pytest.mark.slow
@pytest.mark.drawn(1)
@version
def test_fmpy_compiles_it_from_its_sources(fmi, tmp_path, instance):
    """All that is needed is in `sources/`; FMPy brings FMI's headers, and asks CMake for a compiler."""
    if shutil.which("cmake") is None:
        pytest.skip("no CMake on this machine")
    path = build_fmu(mass_spring_damper(), fmi=fmi)
    binary = library(path, tmp_path / "unzipped")
    binary.unlink()
    (tmp_path / "build").mkdir()
    fmpy.build.build_platform_binary(tmp_path / "unzipped", tmp_path / "build")
    assert binary.is_file()
    again = tmp_path / "again.fmu"
    with zipfile.ZipFile(again, "w") as archive:
        for file in (tmp_path / "unzipped").rglob("*"):
            archive.write(file, file.relative_to(tmp_path / "unzipped"))
    assert run(instance(again).initialize(), 0.0, 100) == run(instance(path).initialize(), 0.0, 100)


@pytest.mark.slow
@version
def test_compiles_from_its_sources_without_warnings(uncompiled, fmi, tmp_path):
    if (gcc := shutil.which("gcc")) is None:
        pytest.skip("no gcc on this machine")
    with zipfile.ZipFile(build_fmu(mass_spring_damper(), fmi=fmi)) as archive:
        archive.extractall(tmp_path)
    flags = ["-std=c11", "-O1", "-Wall", "-Wextra", "-Wno-unused-parameter", "-Werror", "-fPIC", "-shared"]
    command = [gcc, *flags, f"-I{_build.fmi_headers()[0]}", "-o", tmp_path / "a.so", tmp_path / "sources" / "model.c"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


SLOW_LEVELS = [pytest.param(level, marks=pytest.mark.slow) for level in ("-O0", "-O2", "-O3", "-Os")]


@pytest.mark.slow
@pytest.mark.parametrize("level", ["-O1", *SLOW_LEVELS])
def test_equations_that_are_inlined_compile_at_every_level(uncompiled, level, tmp_path):
    if (gcc := shutil.which("gcc")) is None:
        pytest.skip("no gcc on this machine")
    with zipfile.ZipFile(build_fmu(van_der_pol())) as archive:
        archive.extractall(tmp_path)
    command = [gcc, "-std=c11", level, f"-I{_build.fmi_headers()[0]}", "-c", "-o", tmp_path / "a.o"]
    done = subprocess.run([*command, tmp_path / "sources" / "model.c"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_the_gantry_runs_alike_in_both_versions():
    two = build(gantry.nominal, fmi=2, internal_step=2e-4)
    assert validate_fmu(str(two)) == []
    three = build(gantry.nominal, internal_step=2e-4)
    options = {"stop_time": 0.2, "output_interval": 0.01}
    scalar = fmpy.simulate_fmu(str(two), start_values={"motor_force[1]": 150.0}, output=["position[1]"], **options)
    whole = fmpy.simulate_fmu(str(three), start_values={"motor_force": [150.0, 0.0]}, output=["position"], **options)
    assert np.array_equal(scalar["position[1]"], whole["position"][:, 0])
    assert abs(scalar["position[1]"][-1] - scalar["position[1]"][0]) > 1e-3


@pytest.mark.parametrize(
    ("given", "written"), [("pend", "pend.fmu"), ("pend.v2", "pend.v2.fmu"), ("pend.FMU", "pend.FMU")]
)
def test_a_file_without_the_ending_of_fmus_gets_it(tmp_path, given, written):
    assert _build.file_for(tmp_path / given, "gantry") == tmp_path / written
    assert gantry.build(out=tmp_path / given) == tmp_path / written
    assert [file.name for file in tmp_path.iterdir()] == [written]
    assert _build.file_for(tmp_path, "gantry") == tmp_path / "gantry.fmu"
