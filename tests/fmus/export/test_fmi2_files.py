"""Export to FMI 2.0: the file and its sources. Scalars in place of arrays in FMI 3.0 too."""

import ctypes
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import fmpy
import fmpy.build
import fmpy.fmi2
import numpy as np
import pytest
from fmpy.validation import validate_fmu

from loopwright.blocks.core.errors import DefinitionError, FmuError
from loopwright.fmus import gantry
from loopwright.fmus.export import package as _build
from loopwright.fmus.export.from_block import build
from loopwright.fmus.export.model import Variable
from loopwright.fmus.export.package import build_fmu
from loopwright.fmus.platform import native_platform
from support.exported import explosive, mass_spring_damper, pendulums, run


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
        "canInterpolateInputs": "true",
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


def test_binaries_are_where_fmi_2_wants_them(msd2):
    folder = {"x86_64-linux": "linux64", "x86_64-windows": "win64", "x86_64-darwin": "darwin64"}
    with zipfile.ZipFile(msd2) as archive:
        found = [name for name in archive.namelist() if name.startswith("binaries/")]
    assert [name.split("/")[1] for name in found] == [folder.get(native_platform(), native_platform())]
