"""Export to FMI 3.0: the file, the standard's rules, the numbers, the errors."""

import ctypes
import os
import re
import shutil
import subprocess
import sys
import threading
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import casadi as ca
import fmpy
import fmpy.fmi3
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from loopwright.blocks._errors import CompilerError, DefinitionError, ParameterError, UnitError
from loopwright.fmus import _build, _compiler
from loopwright.fmus._build import build_fmu
from loopwright.fmus._codegen import runtime
from loopwright.fmus._compiler import TARGETS, compile_shared, find_compiler, native_platform
from loopwright.fmus._spec import ModelSpec, Variable
from scipy.integrate import solve_ivp
from scipy.linalg import expm

M, D, K = 2.0, 0.5, 10.0


def mass_spring_damper(**changes):
    t, x, u, p = ca.SX.sym("t"), ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 3)
    acceleration = (u - p[1] * x[1] - p[2] * x[0]) / p[0]
    given = {
        "name": "mass_spring_damper",
        "description": "A mass on a spring & a damper, x < 1",
        "inputs": (Variable("force", "input", unit="N", description='Force "from outside"'),),
        "outputs": (Variable("acceleration", "output", unit="m/s2"),),
        "parameters": (
            Variable("mass", "parameter", "fixed", unit="kg", start=M, minimum=1e-6),
            Variable("damping", "parameter", "tunable", unit="N.s/m", start=D),
            Variable("stiffness", "parameter", "fixed", unit="N/m", start=K),
        ),
        "states": (
            Variable("position", "output", unit="m", start=0.1, state=True),
            Variable("velocity", "local", unit="m/s", start=0.0, state=True),
        ),
        "derivative": ca.Function("f", [t, x, u, p], [ca.vertcat(x[1], acceleration)]),
        "output": ca.Function("g", [t, x, u, p], [acceleration]),
    }
    return ModelSpec(**(given | changes))


def pendulums():
    """Array states, an MX model with a structural zero, time in it; two pendulums, one frozen clock."""
    t, x, u, p = ca.MX.sym("t"), ca.MX.sym("x", 5), ca.MX.sym("u", 2), ca.MX.sym("p", 4)
    angle, rate = x[:2], x[2:4]
    torque = ca.reshape(p, 2, 2).T @ u  # p is a 2 x 2 matrix, row by row
    acceleration = torque - 9.81 * ca.sin(angle) - 0.1 * rate + 0.5 * ca.sin(3 * t)
    derivative = ca.Function("f", [t, x, u, p], [ca.vertcat(rate, acceleration, ca.MX(1, 1))])
    output = ca.Function("g", [t, x, u, p], [ca.vertcat(ca.sin(angle), ca.if_else(u[0] > 0, 1.0, 0.0))])
    return ModelSpec(
        name="pendulums",
        description="",
        inputs=(Variable("torque", "input", shape=(2,)),),
        outputs=(Variable("deflection", "output", shape=(2,)), Variable("positive", "output")),
        parameters=(Variable("gain", "parameter", "tunable", (2, 2), start=[[1.0, 2.0], [3.0, 4.0]]),),
        states=(
            Variable("angle", "output", shape=(2,), start=[0.3, -0.2], state=True),
            Variable("rate", shape=(2,), start=0.0, state=True),
            Variable("clock", start=7.0, state=True),
        ),
        derivative=derivative,
        output=output,
        internal_step=1e-2,
    )


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LOOPWRIGHT_CACHE", str(folder))
        patch.delenv("LOOPWRIGHT_CC", raising=False)
        yield folder


@pytest.fixture(scope="module")
def msd(cache):
    return build_fmu(mass_spring_damper())


class Instance:
    """An FMU under FMPy's low-level interface, by names, with what it logs."""

    def __init__(self, path, folder, name="plant", token=None, start_time=0.0, stop_time=None):
        description = fmpy.read_model_description(str(path))
        self.references = {v.name: v.valueReference for v in description.modelVariables}
        self.sizes = {v.name: int(np.prod([d.start for d in v.dimensions] or [1])) for v in description.modelVariables}
        self.log = []
        self.folder, self.start_time, self.stop_time = folder, start_time, stop_time
        fmpy.extract(str(path), str(folder))
        self.fmu = fmpy.fmi3.FMU3Slave(
            guid=token or description.guid,
            unzipDirectory=str(folder),
            modelIdentifier=description.modelName,
            instanceName=name,
        )
        self.fmu.instantiate(loggingOn=True, logMessage=self._logged)

    def _logged(self, environment, status, category, message):
        self.log.append((status, category.decode(), message.decode()))

    def initialize(self, **start):
        for name, value in start.items():
            self[name] = value
        self.fmu.enterInitializationMode(startTime=self.start_time, stopTime=self.stop_time)
        self.fmu.exitInitializationMode()
        return self

    def __getitem__(self, name):
        values = self.fmu.getFloat64([self.references[name]], self.sizes[name])
        return values[0] if self.sizes[name] == 1 else np.array(values)

    def __setitem__(self, name, value):
        self.fmu.setFloat64([self.references[name]], np.ravel(value).tolist())

    def step(self, t, h, **inputs):
        for name, value in inputs.items():
            self[name] = value
        return self.fmu.doStep(t, h)

    def directional(self, unknown, known, seed):
        vr = self.references
        return self.fmu.getDirectionalDerivative([vr[unknown]], [vr[known]], seed, self.sizes[unknown])

    def adjoint(self, unknown, known, seed):
        vr = self.references
        return self.fmu.getAdjointDerivative([vr[unknown]], [vr[known]], seed, self.sizes[known])


@pytest.fixture
def instance(tmp_path):
    made = []

    def make(path, **options):
        made.append(Instance(path, tmp_path / str(len(made)), **options))
        return made[-1]

    yield make
    for item in made:
        item.fmu.freeInstance()


def fails(item, call, *parts):
    """The call fails, and the log says why; the FMU is reset."""
    before = len(item.log)
    with pytest.raises(fmpy.fmi1.FMICallException):
        call()
    assert len(item.log) == before + 1, item.log[before:]
    status, category, message = item.log[-1]
    assert (status, category) == (fmpy.fmi3.fmi3Error, "logStatusError")
    for part in parts:
        assert part in message
    item.fmu.reset()


def exact(t, x0, force=0.0):
    """State of the mass-spring-damper under a constant force: matrix exponential."""
    A = np.array([[0, 1, 0], [-K / M, -D / M, force / M], [0, 0, 0]])
    return (expm(A * t) @ np.array([*x0, 1.0]))[:2]


# ---- the file ----


@pytest.mark.parametrize("make", [mass_spring_damper, pendulums])
def test_valid(make):
    path = build_fmu(make())
    assert validate_fmu(str(path)) == []
    assert fmpy.read_model_description(str(path), validate=True).coSimulation is not None


def xml(path):
    with zipfile.ZipFile(path) as archive:
        return ET.fromstring(archive.read("modelDescription.xml"))


def structure(path):
    root = xml(path)
    names = {v.get("valueReference"): v.get("name") for v in root.find("ModelVariables")}
    found = {}
    for item in root.find("ModelStructure"):
        pairs = zip(item.get("dependencies").split(), item.get("dependenciesKind").split(), strict=True)
        found[item.tag, names[item.get("valueReference")]] = {names[r]: kind for r, kind in pairs}
    return found


def test_structure_is_complete_and_traced(msd):
    everything = dict.fromkeys(("mass", "damping", "stiffness", "force", "position", "velocity"), "dependent")
    now = {"force": "fixed", "position": "fixed", "velocity": "tunable", "damping": "dependent"}
    assert structure(msd) == {
        ("Output", "position"): {"position": "constant"},
        ("Output", "acceleration"): now,
        ("ContinuousStateDerivative", "der(position)"): {"velocity": "constant"},
        ("ContinuousStateDerivative", "der(velocity)"): now,
        ("InitialUnknown", "der(position)"): {"velocity": "constant"},
        ("InitialUnknown", "der(velocity)"): everything,
        ("InitialUnknown", "acceleration"): everything,
    }


def test_structure_of_arrays(cache):
    found = structure(build_fmu(pendulums()))
    assert found["ContinuousStateDerivative", "der(clock)"] == {}
    assert found["Output", "deflection"] == {"angle": "dependent"}
    assert found["Output", "positive"] == {"torque": "dependent"}  # a step: no constant factor
    assert set(found["ContinuousStateDerivative", "der(rate)"]) == {"time", "gain", "torque", "angle", "rate"}


def test_variables_say_what_they_are(msd):
    rows = {v.get("name"): v.attrib for v in xml(msd).find("ModelVariables")}
    assert rows["force"]["description"] == 'Force "from outside"'
    assert (rows["position"]["causality"], rows["position"]["initial"]) == ("output", "exact")
    assert rows["der(velocity)"]["derivative"] == rows["velocity"]["valueReference"]
    assert rows["der(velocity)"]["unit"] == "m/s2"
    assert rows["mass"]["min"] == "1e-06"
    assert (rows["internal_step"]["unit"], rows["internal_step"]["start"]) == ("s", "0.001")
    units = {u.get("name"): u.find("BaseUnit").attrib for u in xml(msd).find("UnitDefinitions")}
    assert units["N.s/m"] == {"kg": "1", "s": "-1"}


def test_exports_every_function_of_the_standard(msd, tmp_path):
    fmpy.extract(str(msd), str(tmp_path))
    library = ctypes.CDLL(str(next((tmp_path / "binaries" / native_platform()).iterdir())))
    header = (Path(fmpy.__file__).parent / "c-code" / "fmi3Functions.h").read_text()
    names = re.findall(r"^FMI3_Export\s+fmi3\w+TYPE\s+(fmi3\w+);", header, re.MULTILINE)
    assert len(names) == 75
    assert [name for name in sorted(names) if not hasattr(library, name)] == []


def test_compiles_from_its_sources_without_warnings(msd, tmp_path):
    if (gcc := shutil.which("gcc")) is None:
        pytest.skip("no gcc on this machine")
    with zipfile.ZipFile(msd) as archive:
        archive.extractall(tmp_path)
    flags = ["-std=c11", "-O1", "-Wall", "-Wextra", "-Wno-unused-parameter", "-Werror", "-fPIC", "-shared"]
    source = tmp_path / "sources" / "model.c"
    headers = f"-I{_build.fmi_headers()[0]}"
    done = subprocess.run(
        [gcc, *flags, headers, "-o", tmp_path / "a.so", source], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_same_input_same_bytes(tmp_path, monkeypatch, cache):
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(cache / "zig"))  # the libc; the model is compiled anew
    built = []
    for name in ("a", "b"):
        monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / name))
        monkeypatch.setenv("ZIG_LOCAL_CACHE_DIR", str(tmp_path / name / "local"))
        built.append(build_fmu(mass_spring_damper(), tmp_path / f"{name}.fmu"))
    assert built[0].read_bytes() == built[1].read_bytes()


@pytest.mark.slow
def test_same_bytes_from_cold_caches_in_other_processes(tmp_path, cache):
    code = "import sys, test_export as e; e.build_fmu(e.mass_spring_damper(), sys.argv[1])"
    for name in ("a", "b"):
        environment = {k: v for k, v in os.environ.items() if not k.startswith("ZIG_")}
        environment |= {"LOOPWRIGHT_CACHE": str(tmp_path / name)}
        environment["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), *sys.path])
        subprocess.run([sys.executable, "-c", code, tmp_path / f"{name}.fmu"], env=environment, check=True)
    assert (tmp_path / "a.fmu").read_bytes() == (tmp_path / "b.fmu").read_bytes()


def test_second_build_is_found(msd, monkeypatch, tmp_path):
    monkeypatch.setattr(_build, "_archive", lambda *args: pytest.fail("built again"))
    assert build_fmu(mass_spring_damper()) == msd
    copy = build_fmu(mass_spring_damper(), tmp_path)
    assert copy == tmp_path / "mass_spring_damper.fmu"
    assert copy.read_bytes() == msd.read_bytes()


def test_key_depends_on_everything(msd):
    compiler, platforms = find_compiler(), [native_platform()]

    def key(**changes):
        return _build.build_key(mass_spring_damper(**changes), platforms, compiler)

    spec = mass_spring_damper()
    faster = Variable("force", "input", unit="N", start=1.0)
    keys = {
        key(),
        key(internal_step=1e-4),
        key(description=""),
        key(inputs=(faster,)),
        key(output=ca.Function("g", spec.derivative.sx_in(), [spec.derivative(*spec.derivative.sx_in())[0]])),
        _build.build_key(spec, ["aarch64-linux"], compiler),
        _build.build_key(spec, platforms, _compiler.Compiler(compiler.command, "another", zig=True)),
    }
    assert len(keys) == 7
    assert key() == key()


def test_builds_at_once_in_threads(tmp_path, monkeypatch, cache):
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(cache / "zig"))
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path))
    built, spec = [], mass_spring_damper()
    threads = [threading.Thread(target=lambda: built.append(build_fmu(spec))) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(built) == 3
    assert len(set(built)) == 1
    assert validate_fmu(str(built[0])) == []
    assert [p.name for p in built[0].parent.iterdir()] == ["mass_spring_damper.fmu"]


# ---- the numbers ----


def test_free_motion_against_the_matrix_exponential(msd):
    result = fmpy.simulate_fmu(str(msd), stop_time=2.0, output_interval=0.01, output=["position", "velocity"])
    for t, position, velocity in result[::20]:
        assert (position, velocity) == pytest.approx(exact(t, (0.1, 0.0)), abs=1e-12)


def error_of(item, internal_step, t_end=1.6, h=0.4):
    item.fmu.reset()
    item.initialize(internal_step=internal_step, position=0.1, velocity=-0.3)
    for k in range(round(t_end / h)):
        item.step(k * h, h, force=5.0)
    return np.abs(np.array([item["position"], item["velocity"]]) - exact(t_end, (0.1, -0.3), 5.0)).max()


def test_order_of_the_integrator_is_4(msd, instance):
    item = instance(msd)
    steps = 0.1 / 2.0 ** np.arange(5)
    errors = [error_of(item, step) for step in steps]
    order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order == pytest.approx(4.0, abs=0.2)
    assert all(error < 2.0 * step**4 for error, step in zip(errors, steps, strict=True))


def test_substeps_are_the_ceiling_of_the_ratio(msd, instance):
    """0.4 / 0.1 is 4 pieces, 0.4 / 0.0999 is 5: the error shows it."""
    item = instance(msd)
    assert error_of(item, 0.1) == error_of(item, 0.1 * (1 - 1e-10))
    assert error_of(item, 0.0999) == error_of(item, 0.08)
    assert error_of(item, 0.0999) < error_of(item, 0.1)
    assert error_of(item, 0.4) == error_of(item, 10.0)


def test_arrays_and_time_against_dop853(instance):
    def right(t, x):
        torque = np.array([[1.0, 2.0], [3.0, 4.0]]) @ [0.2, -0.1]
        return [*x[2:], *(torque - 9.81 * np.sin(x[:2]) - 0.1 * x[2:] + 0.5 * np.sin(3 * t))]

    item = instance(build_fmu(pendulums()), start_time=0.25)
    item.initialize(internal_step=1e-3, torque=[0.2, -0.1])
    for k in range(20):
        item.step(0.25 + 0.05 * k, 0.05)
    truth = solve_ivp(right, (0.25, 1.25), [0.3, -0.2, 0, 0], "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    assert item["time"] == pytest.approx(1.25, abs=1e-15)
    np.testing.assert_allclose(np.concatenate([item["angle"], item["rate"]]), truth, rtol=0, atol=1e-10)
    np.testing.assert_allclose(item["deflection"], np.sin(truth[:2]), rtol=0, atol=1e-10)
    np.testing.assert_allclose(item["der(rate)"], right(1.25, truth)[2:], rtol=0, atol=1e-9)
    assert item["clock"] == 7.0


def test_variable_steps_end_where_the_master_says(msd, instance):
    item, t = instance(msd, start_time=3.0).initialize(), 3.0
    for h in (0.1, 0.013, 0.2, 1e-6, 0.087):
        assert item.step(t, h) == (False, False, False, t + h)
        t += h
        assert item["time"] == t
    assert item["position"] == pytest.approx(exact(t - 3.0, (0.1, 0.0))[0], abs=1e-12)


def test_start_values_are_set_and_reset(msd, instance):
    item = instance(msd)
    item.initialize(mass=4.0, position=0.5)
    assert item["acceleration"] == -K * 0.5 / 4.0
    item.step(0.0, 0.1)
    item.fmu.reset()
    assert (item["mass"], item["position"], item["time"]) == (M, 0.1, 0.0)
    assert item.initialize()["acceleration"] == -K * 0.1 / M


# ---- outputs belong to communication points (FMI 3.0, 4.2.1; FMI 2.0.5, 4.2.4) ----


def test_initialization_evaluates_what_is_set(msd, instance):
    item = instance(msd)
    item.fmu.enterInitializationMode()
    for force, position in ((0.0, 0.1), (3.0, 0.1), (3.0, -0.4)):
        item["force"], item["position"] = force, position
        assert item["acceleration"] == item["der(velocity)"] == (force - K * position) / M


def test_setting_an_input_changes_no_output_before_the_next_step(msd, instance):
    item = instance(msd).initialize(force=1.0)
    for k in range(3):
        before = [item[name] for name in ("position", "acceleration", "der(velocity)")]
        item["force"], item["damping"] = 1.0 + k, D + k
        assert [item[name] for name in ("position", "acceleration", "der(velocity)")] == before
        assert (item["force"], item["damping"]) == (1.0 + k, D + k)
        item.step(k * 0.1, 0.1)
        expected = (1.0 + k - (D + k) * item["velocity"] - K * item["position"]) / M
        assert item["acceleration"] == item["der(velocity)"] == pytest.approx(expected, rel=1e-14)


def test_derivatives_read_late_are_still_those_of_the_step(msd, instance):
    """Also when they are first read after the input and a tunable parameter have changed."""
    early, late = instance(msd).initialize(force=1.0), instance(msd).initialize(force=1.0)
    for item in (early, late):
        item.step(0.0, 0.1)
    expected = early["der(velocity)"]
    late["force"], late["damping"] = 100.0, 50.0
    assert late["der(velocity)"] == expected
    late.fmu.terminate()
    assert late["der(velocity)"] == expected


# ---- states ----


def run(item, t, n, h=0.01):
    for k in range(n):
        item.step(t + k * h, h, force=np.sin(t + k * h))
    return [item[name] for name in ("time", "position", "velocity", "acceleration", "der(velocity)")]


def test_a_saved_state_resumes_bit_identically(msd, instance):
    item = instance(msd).initialize(internal_step=3e-3, stiffness=20.0)
    run(item, 0.0, 50)
    state = item.fmu.getFMUState()
    data = item.fmu.serializeFMUState(state)
    expected = run(item, 0.5, 50)
    item.fmu.setFMUState(state)
    assert run(item, 0.5, 50) == expected
    item.fmu.freeFMUState(state)

    fresh = instance(msd)
    restored = fresh.fmu.deserializeFMUState(data)
    fresh.fmu.setFMUState(restored)
    fresh.fmu.freeFMUState(restored)
    assert fresh["stiffness"] == 20.0
    assert run(fresh, 0.5, 50) == expected


def test_states_of_others_are_refused(msd, instance):
    item, other = instance(msd), instance(build_fmu(pendulums()))
    state = other.fmu.getFMUState()
    data = other.fmu.serializeFMUState(state)
    other.fmu.freeFMUState(state)
    fails(item, lambda: item.fmu.deserializeFMUState(data), "no state of this FMU")
    fails(item, lambda: item.fmu.deserializeFMUState(b"nonsense"), "these 8 bytes are no state of this FMU")
    fails(item, lambda: item.fmu.setFMUState(None), "the state is NULL")


def test_a_state_brings_a_failed_fmu_back(msd, instance):
    item = instance(msd).initialize()
    state = item.fmu.getFMUState()
    with pytest.raises(fmpy.fmi1.FMICallException):
        item["force"] = np.nan
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.0, 0.1)
    assert "called in state Terminated, expected Step Mode" in item.log[-1][2]
    item.fmu.setFMUState(state)
    item.fmu.freeFMUState(state)
    item.step(0.0, 0.1, force=1.0)


def test_two_instances_in_two_threads_are_independent(msd, instance):
    alone = instance(msd).initialize()
    expected = run(alone, 0.0, 500)
    pair, results = [instance(msd).initialize() for _ in range(2)], {}
    pair[1].fmu.reset()
    pair[1].initialize(position=-0.7)
    threads = [threading.Thread(target=lambda i=i: results.update({i: run(pair[i], 0.0, 500)})) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results[0] == expected
    assert results[1] != expected


def test_many_instances_leave_no_memory_behind(msd, tmp_path):
    psutil = pytest.importorskip("psutil")
    item = Instance(msd, tmp_path)
    process = psutil.Process()

    def cycle(n):
        for _ in range(n):
            item.fmu.freeInstance = lambda: None  # FMPy's also unloads the library
            item.fmu.fmi3FreeInstance(item.fmu.component)
            item.fmu.instantiate(loggingOn=True, logMessage=item._logged)
            item.initialize()
            state = item.fmu.getFMUState()
            item.step(0.0, 0.01)
            item.fmu.freeFMUState(state)

    cycle(300)
    before = process.memory_info().rss
    cycle(2000)
    assert process.memory_info().rss - before < 1_000_000  # 2000 instances of 1.5 kB each would be 3 MB
    item.fmu.fmi3FreeInstance(item.fmu.component)


# ---- derivatives ----


def test_directional_and_adjoint_derivatives_equal_the_trace(instance):
    spec = pendulums()
    item = instance(build_fmu(spec)).initialize(torque=[0.2, -0.1])
    f, g = spec.derivative.expand(), spec.output.expand()  # 3.8.2: jacobian() of this MX function is wrong by time
    item.step(0.0, 0.3)
    item["torque"] = [0.5, 0.6]
    x = np.concatenate([item["angle"], item["rate"], [7.0]])
    args = (0.3, x, item["torque"], item["gain"])
    knowns = {"time": 0, "angle": 1, "rate": 1, "torque": 2, "gain": 3}
    columns = {"angle": slice(0, 2), "rate": slice(2, 4)}
    for function, unknown, rows in (
        (g, "deflection", slice(0, 2)),
        (f, "der(rate)", slice(2, 4)),
        (f, "der(angle)", slice(0, 2)),
    ):
        for known, i in knowns.items():
            J = np.array(function.jacobian()(*args, function(*args))[i])[rows, columns.get(known, slice(None))]
            forward = [item.directional(unknown, known, list(e)) for e in np.eye(J.shape[1])]
            np.testing.assert_allclose(np.transpose(forward), J, rtol=1e-12, atol=1e-13)
            reverse = [item.adjoint(unknown, known, list(e)) for e in np.eye(J.shape[0])]
            np.testing.assert_allclose(reverse, J, rtol=1e-12, atol=1e-13)
    assert item.directional("angle", "angle", [2.0, 3.0]) == [2.0, 3.0]  # a state that is an output
    assert item.adjoint("angle", "angle", [2.0, 3.0]) == [2.0, 3.0]
    assert item.directional("angle", "torque", [2.0, 3.0]) == [0.0, 0.0]


def test_directional_derivatives_during_initialization(msd, instance):
    item = instance(msd)
    item.fmu.enterInitializationMode()
    assert item.directional("acceleration", "mass", [1.0]) == [pytest.approx(K * 0.1 / M**2)]
    item.fmu.exitInitializationMode()
    fails(item, lambda: item.directional("acceleration", "mass", [1.0]), "mass is no known in Step Mode")
    item.initialize()
    fails(item, lambda: item.directional("velocity", "force", [1.0]), "velocity is no unknown")
    item.initialize()
    fails(item, lambda: item.directional("acceleration", "force", [1.0, 2.0]), "1 values are left over after force")


# ---- errors at run time ----


def test_wrong_references_and_sizes(msd, instance):
    item = instance(build_fmu(pendulums()))
    get, set_ = item.fmu.getFloat64, item.fmu.setFloat64
    fails(item, lambda: get([99]), "no Float64 variable with value reference 99", "lists 0 to 11")
    fails(item, lambda: set_([99], [1.0]), "fmi3SetFloat64", "value reference 99")
    angle = item.references["angle"]
    fails(item, lambda: get([angle], 1), "angle has 2 elements, but only 1 values are left")
    fails(item, lambda: get([angle], 3), "1 values are left over after angle")
    fails(item, lambda: set_([angle], [1.0]), "angle has 2 elements, but only 1 values")
    fails(item, lambda: item.fmu.getInt32([angle]), "fmi3GetInt32", "all variables of this FMU are Float64")


def test_values_that_are_refused(msd, instance):
    item = instance(msd).initialize()
    item.step(0.0, 0.5)
    fails(item, lambda: item.step(0.5, 0.1, force=np.nan), "plant: ", "force", "nan at t = 0.5 s", "finite")
    fails(item, lambda: item.initialize(mass=-1.0), "mass", "was set to -1", "from 1e-06 to inf")
    fails(item, lambda: item.initialize(internal_step=0.0), "internal_step was set to 0 s, expected a positive")
    fails(item, lambda: item.initialize(position=np.inf), "position", "inf")
    item.initialize(internal_step=1e-12)
    fails(item, lambda: item.step(0.0, 0.1), "more than 1e9 pieces")


def test_what_may_be_set_when(msd, instance):
    item = instance(msd)
    fails(item, lambda: item["acceleration"], "acceleration is calculated", "fmi3EnterInitializationMode first")
    fails(item, lambda: item.initialize(acceleration=1.0), "acceleration is calculated")
    fails(item, lambda: item.initialize(time=1.0), "time is the independent variable")
    for name, why in (("mass", "fixed parameter"), ("position", "is a state"), ("internal_step", "fixed parameter")):
        item.initialize()
        fails(item, lambda name=name: item.step(0.0, 0.1, **{name: 1.0}), name, why, "fmi3ExitInitializationMode")
    item.initialize()
    item.fmu.terminate()
    assert item["position"] == 0.1
    fails(item, lambda: item.step(0.0, 0.1, force=1.0), "force can't be set in state Terminated")


def test_calls_out_of_order(msd, instance):
    item = instance(msd)
    fails(item, lambda: item.step(0.0, 0.1), "fmi3DoStep was called in state Instantiated, expected Step Mode")
    fails(item, item.fmu.exitInitializationMode, "fmi3ExitInitializationMode was called in state Instantiated")
    fails(item, item.fmu.terminate, "fmi3Terminate")
    fails(item, item.fmu.enterEventMode, "hasEventMode = false")
    fails(item, item.fmu.enterConfigurationMode, "no structural parameters")
    fails(item, lambda: item.fmu.getOutputDerivatives([1], [1]), "maxOutputDerivativeOrder is 0")
    item.initialize()
    fails(item, item.fmu.enterInitializationMode, "called in state Step Mode, expected Instantiated")


def test_steps_that_are_refused(msd, instance):
    item = instance(msd, stop_time=1.0)
    item.initialize()
    fails(item, lambda: item.step(0.5, 0.1), "currentCommunicationPoint is 0.5 s, but this FMU is at 0 s")
    item.initialize()
    fails(item, lambda: item.step(0.0, 0.0), "communication step is 0 s")
    item.initialize()
    fails(item, lambda: item.step(0.0, -0.1), "communication step is -0.1 s")
    item.initialize()
    for k in range(10):
        item.step(k * 0.1, 0.1)  # up to the stop time, rounding and all
    fails(item, lambda: item.step(1.0, 0.1), "passes the stop time of 1 s")


def explosive():
    """x' = x^2 has no solution after t = 1 / x(0); the output is 1 / (2 - x)."""
    t, x, u, p = ca.SX.sym("t"), ca.SX.sym("x", 2), ca.SX.sym("u", 0), ca.SX.sym("p", 0)
    f = ca.Function("f", [t, x, u, p], [ca.vertcat(1.0, x[1] ** 2)])
    g = ca.Function("g", [t, x, u, p], [1 / (2 - x[1])])
    states = (Variable("calm", start=0.0, state=True), Variable("x", start=1.0, state=True))
    return ModelSpec("explosive", "", (), (Variable("y", "output"),), (), states, f, g, internal_step=1e-3)


def test_a_state_that_explodes_stops_the_step(instance):
    item = instance(build_fmu(explosive())).initialize()
    item.step(0.0, 0.5 + 1e-3)
    before = [item[name] for name in ("time", "calm", "x", "y")]
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.5 + 1e-3, 2.0)
    assert [item[name] for name in ("time", "calm", "x", "y")] == before
    message = item.log[-1][2]
    assert "x (element 0) became" in message
    when = float(message.split("t = ")[1].split(" s")[0])
    assert 1.0 < when < 1.05  # the substep, not the end of the step


def test_an_output_that_is_not_finite_stops_the_step(instance):
    item = instance(build_fmu(explosive()))
    fails(item, lambda: item.initialize(x=2.0), "y (element 0) became inf at t = 0 s")


def test_logging_is_quiet_unless_asked(msd, instance):
    item = instance(msd)
    item.fmu.setDebugLogging(False, [])
    with pytest.raises(fmpy.fmi1.FMICallException):
        item["force"] = np.nan
    assert item.log == []
    item.fmu.reset()
    item.fmu.setDebugLogging(True, ["logStatusWarning"])
    with pytest.raises(fmpy.fmi1.FMICallException):
        item["force"] = np.nan
    assert item.log == []
    item.fmu.reset()
    item.fmu.setDebugLogging(True, ["logAll"])
    assert item.log[-1][0] == fmpy.fmi3.fmi3Warning
    assert "no log category logAll" in item.log[-1][2]


def test_wrong_token_is_refused(msd, tmp_path, capfd):
    with pytest.raises(Exception, match="Failed to instantiate"):
        Instance(msd, tmp_path, token="another", name="x#1")


# ---- bad models, and compilers that fail ----


@pytest.mark.parametrize(
    ("make", "error", "parts"),
    [
        (lambda: Variable("a b"), DefinitionError, ["'a b'", "letters"]),
        (lambda: Variable("time"), DefinitionError, ["'time' is reserved"]),
        (lambda: Variable("u", "input", "fixed"), DefinitionError, ["u has causality 'input'"]),
        (lambda: Variable("u", "input", shape=(0,)), DefinitionError, ["shape (0,)"]),
        (lambda: Variable("u", "input", unit="Nm"), UnitError, ["Did you mean"]),
        (lambda: Variable("x", state=True), ParameterError, ["x is a state without a start value"]),
        (lambda: Variable("p", "parameter", "fixed"), ParameterError, ["p is a parameter without a start value"]),
        (lambda: Variable("y", "output", start=1.0), ParameterError, ["y is computed"]),
        (lambda: Variable("u", "input", start=np.nan), ParameterError, ["u has the start value nan", "finite"]),
        (lambda: Variable("u", "input", start=[1, 2]), ParameterError, ["shape ()"]),
        (lambda: Variable("u", "input", start=3.0, maximum=2.0), ParameterError, ["within [-inf, 2.0]"]),
        (lambda: mass_spring_damper(name="a-b"), DefinitionError, ["'a-b' is no C identifier"]),
        (lambda: mass_spring_damper(internal_step=0.0), ParameterError, ["internal_step", "positive"]),
        (lambda: mass_spring_damper(inputs=()), DefinitionError, ["derivative", "found u of", "column of 0"]),
        (lambda: mass_spring_damper(inputs=(Variable("force", "input"),)), DefinitionError, ["force without a unit"]),
        (
            lambda: mass_spring_damper(inputs=(Variable("mass", "input", unit="kg"),)),
            DefinitionError,
            ["'mass' names 2 variables"],
        ),
        (
            lambda: mass_spring_damper(derivative=mass_spring_damper().output),
            DefinitionError,
            ["mass_spring_damper.derivative", "found 1 x 1, expected a column of 2", "one derivative for each"],
        ),
        (lambda: mass_spring_damper(output=None), DefinitionError, ["expected a casadi.Function"]),
        (lambda: mass_spring_damper(states=(Variable("x"),)), DefinitionError, ["mass_spring_damper.x", "state=True"]),
    ],
)
def test_bad_models_are_refused(make, error, parts):
    with pytest.raises(error) as caught:
        make()
    for part in parts:
        assert part in str(caught.value)


def test_a_failing_compiler_is_quoted(tmp_path):
    with pytest.raises(CompilerError) as caught:
        compile_shared({"a.c": "int f(void) { return undeclared_thing; }"}, tmp_path / "a.so")
    message = str(caught.value)
    assert f"the C compiler failed for {native_platform()} with exit code" in message
    assert "undeclared_thing" in message
    assert "The command was: " in message
    assert list(tmp_path.iterdir()) == []


def test_a_failed_build_leaves_nothing(tmp_path, monkeypatch, cache):
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(cache / "zig"))
    monkeypatch.setenv("ZIG_LOCAL_CACHE_DIR", str(cache / "zig"))
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / "c"))
    monkeypatch.setattr(_build, "runtime", lambda: runtime() | {"core.c": "#error broken"})
    with pytest.raises(CompilerError, match="broken"):
        build_fmu(mass_spring_damper(), tmp_path / "out.fmu")
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


def test_no_compiler(monkeypatch, tmp_path):
    find = _compiler.importlib.util.find_spec
    monkeypatch.setattr(
        _compiler.importlib.util, "find_spec", lambda name, *a: None if name == "ziglang" else find(name, *a)
    )
    monkeypatch.setattr(_compiler.shutil, "which", lambda name: None)
    with pytest.raises(CompilerError) as caught:
        build_fmu(mass_spring_damper())
    assert str(caught.value) == (
        "no C compiler was found: neither the ziglang package nor cc, gcc or clang. "
        'Install one: pip install "loopwright[build]" (it brings ziglang), or set LOOPWRIGHT_CC to a command line.'
    )


def test_a_compiler_of_ones_own(monkeypatch, instance, msd):
    if (gcc := shutil.which("gcc")) is None:
        pytest.skip("no gcc on this machine")
    monkeypatch.setenv("LOOPWRIGHT_CC", f"{gcc} -pipe")
    path = build_fmu(mass_spring_damper())
    assert path != msd
    assert run(instance(path).initialize(), 0.0, 100) == run(instance(msd).initialize(), 0.0, 100)
    monkeypatch.setenv("LOOPWRIGHT_CC", "no-such-compiler -x")
    with pytest.raises(CompilerError, match="there is no such command"):
        build_fmu(mass_spring_damper())


def test_unknown_platform():
    with pytest.raises(CompilerError, match=r"no platform 'x86_64-macos'. Did you mean .*'x86_64-darwin'"):
        build_fmu(mass_spring_damper(), platform="x86_64-macos")


def test_the_system_compiler_builds_for_its_own_platform_only():
    other = next(p for p in TARGETS if p != native_platform())
    with pytest.raises(CompilerError, match="builds for"):
        _compiler.check_platform(_compiler.Compiler(("cc",), "cc"), other)


@pytest.mark.slow
def test_all_platforms(tmp_path, cache):
    notes = []
    path = build_fmu(mass_spring_damper(), tmp_path / "all.fmu", platform=TARGETS, notify=notes.append)
    assert len(notes) == len(TARGETS)
    magic = {"linux": b"\x7fELF", "windows": b"MZ", "darwin": b"\xcf\xfa\xed\xfe"}
    with zipfile.ZipFile(path) as archive:
        for name in TARGETS:
            suffix = _compiler.SUFFIXES[name.split("-")[1]]
            data = archive.read(f"binaries/{name}/mass_spring_damper{suffix}")
            assert data.startswith(magic[name.split("-")[1]])
            assert b"fmi3DoStep" in data
    assert validate_fmu(str(path)) == []
