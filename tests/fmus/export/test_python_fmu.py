"""FMUs that carry Python: numbers against closed forms, what they say about themselves, what is refused."""

import gc
import importlib.util
import json
import subprocess
import sys
import zipfile
from pathlib import Path

import fmpy
import fmpy.fmi2
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from lxml import etree

from loopwright.blocks import Block, DefinitionError, Input, Output, State, parameter
from loopwright.blocks.core import Layout
from loopwright.fmus import Fmu, FmuError, bouncing_ball, build_python
from loopwright.fmus.checks.summary import summarize
from loopwright.fmus.checks.validation import validate

# Slow: they load PythonFMU's library into this process, and its memory faults (see _python_slave.py) would take the
# whole quick set with them.
pytestmark = pytest.mark.slow

MODELS = '''
"""Models of mine."""
import math

import numpy as np

import rates
from loopwright.blocks import Block, Input, Output, State, parameter


class Inner(Block):
    """A rate in a block of its own."""

    rate: float = parameter(default=2.0, unit="1/s", above=0.0, description="decay rate")


class Decay(Block):
    """Two decays and an oscillator <with & without> a trace."""

    inner: Inner = parameter(default=Inner())
    amplitude: float = parameter(default=1.0, unit="V", minimum=0.0, tunable=False, description="of the sine")
    start: float = parameter(default=1.0, unit="V", structural=True)

    u = Input(shape=(2,), unit="V", description="voltages")
    s = State(unit="V", description="decays", start=lambda block: (block.start, 2.0), output=True)
    q = State(unit="V", start=0.5)
    w = Output(unit="V", description="sum of all")
    z = Output(shape=(1, 2), unit="V")

    def derivative(self, t, x, u):
        if t < 0.0:  # no trace gets past this
            return None
        decay = [-self.inner.rate * s + v for s, v in zip(x.s, u.u)]
        return np.array(decay), self.amplitude * math.cos(rates.OMEGA * t)

    def output(self, t, x, u):
        return float(x.s[0]) + float(x.s[1]) + x.q + sum(u.u), [[x.q, 2 * x.q]]


class Counter(Block):
    """Adds up its input, and forgets."""

    u = Input()
    n = State(output=True)

    def update(self, t, x, u, T):
        return 0.5 * x.n + T * u.u if u.u > -1 else 0.0


class Fails(Block):
    """Fails after a while."""

    k: float = parameter(default=1.0, above=0.0)
    y = State(output=True)

    def derivative(self, t, x, u):
        if t > 0.5:
            raise RuntimeError("past one half")
        return self.k if t < 0.25 else float("nan")


class FailsAtOnce(Block):
    """Fails at once."""

    y = State(output=True)

    def derivative(self, t, x, u):
        values = {}
        return values["nothing"]


class Odd(Block):
    """No number at the start, and an input with a default."""

    u = Input(shape=(2,), default=1.5, minimum=-2.0, maximum=3.0, nominal=10.0)
    y = Output()

    def output(self, t, x, u):
        return float("nan") if t <= 0.1 else u.u[1]


def local():
    class Local(Decay):
        """Out of a function."""

    return Local()
'''


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """The file above, imported, with what it imports."""
    folder = tmp_path_factory.mktemp("models")
    (folder / "my_models.py").write_text(MODELS)
    (folder / "rates.py").write_text("OMEGA = 3.0\n")
    sys.path.insert(0, str(folder))
    try:
        import my_models

        yield my_models
    finally:
        sys.path.remove(str(folder))
        sys.modules.pop("my_models", None)
        sys.modules.pop("rates", None)


@pytest.fixture(scope="module")
def beside(models):
    return [Path(models.__file__).with_name("rates.py")]


@pytest.fixture(scope="module")
def built(models, beside, tmp_path_factory):
    block = models.Decay(inner=models.Inner(rate=4.0), start=3.0)
    return build_python(
        block, tmp_path_factory.mktemp("out"), name="decay", files=beside, internal_step=1e-3, stop_time=2.0
    )


@pytest.fixture
def slave(tmp_path):
    """slave(path) -> FMU, references by name."""
    made = []

    def make(path, **start):
        folder = tmp_path / str(len(made))
        description = fmpy.read_model_description(str(path))
        fmpy.extract(str(path), str(folder))
        fmu = fmpy.fmi2.FMU2Slave(
            guid=description.guid,
            unzipDirectory=str(folder),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName=f"i{len(made)}",
        )
        fmu.instantiate(loggingOn=False)
        made.append(fmu)
        references = {v.name: v.valueReference for v in description.modelVariables}
        fmu.setupExperiment(startTime=0.0)
        for name, value in start.items():
            fmu.setReal([references[name]], [value])
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        return fmu, references

    yield make
    for fmu in made:
        fmu.freeInstance()


def closed_form(t, rate=4.0, start=3.0, amplitude=1.0, u=(0.0, 0.0)):
    """s' = −rate s + u, q' = amplitude cos 3 t."""
    s = [u[i] / rate + (s0 - u[i] / rate) * np.exp(-rate * t) for i, s0 in enumerate((start, 2.0))]
    q = 0.5 + amplitude * np.sin(3 * t) / 3
    return [*s, q, s[0] + s[1] + q + sum(u), q, 2 * q]


NAMES = ["s[1]", "s[2]", "q", "w", "z[1,1]", "z[1,2]"]


def test_numbers_are_those_of_the_closed_form(built):
    result = fmpy.simulate_fmu(str(built), stop_time=2.0, output_interval=0.125, output=NAMES)
    for row in result:  # error of the method: (4e-3)⁵ / 120 a step, 2000 steps
        assert list(row)[1:] == pytest.approx(closed_form(row[0]), abs=2e-11)


def test_it_runs_as_a_block_with_its_scalars_as_arrays(built):
    plant = Fmu(built, name="plant")
    assert (plant.outputs["s"].shape, plant.outputs["z"].shape) == ((2,), (1, 2))
    y = np.zeros(sum(int(np.prod(p.shape)) for p in plant.outputs.values()))
    with plant.instantiate([], None) as one:
        one.bind(np.zeros(0), y)
        one.begin()
        for k in range(50):
            one.step(k * 0.02, 0.02)
    places = Layout.of({name: p.shape for name, p in plant.outputs.items()}).slices
    s1, s2, q, w, z1, z2 = closed_form(1.0)
    want = {"s": [s1, s2], "q": [q], "w": [w], "z": [z1, z2]}
    for name in want.keys() & places.keys():
        assert y[places[name]] == pytest.approx(want[name], abs=1e-10)
    assert {"s", "z"} <= places.keys()


def test_parameters_start_values_and_inputs(built):
    start = {"inner.rate": 0.5, "amplitude": 2.0, "s[1]": 7.0, "u[1]": 1.0, "u[2]": -3.0}
    result = fmpy.simulate_fmu(str(built), stop_time=1.0, output_interval=0.25, output=NAMES, start_values=start)
    for row in result:
        expected = closed_form(row[0], rate=0.5, start=7.0, amplitude=2.0, u=(1.0, -3.0))
        assert list(row)[1:] == pytest.approx(expected, abs=1e-12)


def test_it_runs_where_nothing_of_it_is_imported(built, tmp_path):
    code = (
        "import fmpy, json, sys\n"
        f"r = fmpy.simulate_fmu({str(built)!r}, stop_time=1.0, output_interval=1.0, output={NAMES!r})\n"
        "print(json.dumps(list(map(float, r[-1]))))\n"
    )
    for _ in range(3):  # the end of the process counts too: PythonFMU's own has aborted one run in two
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
        row = json.loads(done.stdout.splitlines()[-1])
        assert row[1:] == pytest.approx(closed_form(1.0), abs=2e-11)


def test_it_says_that_it_needs_python(built):
    description = fmpy.read_model_description(str(built), validate=True)
    assert description.coSimulation.needsExecutionTool is True
    assert "Needs Python where it runs" in description.description
    assert description.description.startswith("Two decays and an oscillator <with & without> a trace.")
    assert any("needs Python" in note for note in summarize(built)["notes"])
    with zipfile.ZipFile(built) as archive:
        page = archive.read("documentation/index.html").decode()
        assert {"resources/my_models.py", "resources/rates.py"} <= set(archive.namelist())
    assert "Needs Python" in page
    assert "&lt;with &amp; without&gt;" in page


def test_description_is_complete(built):
    assert validate_fmu(str(built)) == []
    assert validate(built).problems == ()
    variables = {v.name: v for v in fmpy.read_model_description(str(built)).modelVariables}
    table = {name: (v.causality, v.variability, v.initial, v.unit, v.start) for name, v in variables.items()}
    assert table == {
        "u[1]": ("input", "continuous", "exact", "V", "0"),
        "u[2]": ("input", "continuous", "exact", "V", "0"),
        "inner.rate": ("parameter", "tunable", "exact", "1/s", "4"),
        "amplitude": ("parameter", "fixed", "exact", "V", "1"),
        "s[1]": ("output", "continuous", "exact", "V", "3"),
        "s[2]": ("output", "continuous", "exact", "V", "2"),
        "q": ("local", "continuous", "exact", "V", "0.5"),
        "w": ("output", "continuous", "calculated", "V", None),
        "z[1,1]": ("output", "continuous", "calculated", "V", None),
        "z[1,2]": ("output", "continuous", "calculated", "V", None),
    }
    assert variables["amplitude"].min == "0.0"
    with zipfile.ZipFile(built) as archive:
        root = etree.fromstring(archive.read("modelDescription.xml"))
    unknowns = [int(u.get("index")) - 1 for u in root.findall("ModelStructure/InitialUnknowns/Unknown")]
    assert [list(variables)[i] for i in unknowns] == ["w", "z[1,1]", "z[1,2]"]
    assert root.find("UnitDefinitions/Unit[@name='V']/BaseUnit").attrib == {"kg": "1", "m": "2", "s": "-3", "A": "-1"}


def test_sampled_block_against_its_recursion(models, beside, tmp_path, slave):
    file = build_python(models.Counter(), tmp_path, step_size=0.25, files=beside)
    assert validate(file).problems == ()
    fmu, vr = slave(file)
    expected = 0.0
    for k in range(8):  # all of it is exact in binary
        fmu.setReal([vr["u"]], [float(k)])
        fmu.doStep(k * 0.25, 0.25)
        expected = 0.5 * expected + 0.25 * k
        assert fmu.getReal([vr["n"]]) == [expected]
    fmu.setReal([vr["u"]], [-2.0])
    fmu.doStep(2.0, 0.5)
    assert fmu.getReal([vr["n"]]) == [0.0]
    assert fmpy.read_model_description(str(file)).coSimulation.canHandleVariableCommunicationStepSize is False
    with pytest.raises(fmpy.fmi1.FMICallException, match="fmi2DoStep failed"):
        fmu.doStep(2.5, 0.3)
    fmu.doStep(2.5, 0.25)  # the step refused has changed nothing
    assert fmu.getReal([vr["n"]]) == [0.0]


def test_a_run_cut_and_restored_elsewhere_is_the_same(built, slave):
    def run(fmu, vr, first, last):
        for k in range(first, last):
            fmu.setReal([vr["u[1]"], vr["u[2]"]], [np.sin(k), np.cos(k)])
            fmu.doStep(k * 0.1, 0.1)
        return fmu.getReal([vr[name] for name in NAMES])

    whole = run(*slave(built, **{"inner.rate": 0.7}), 0, 10)
    one, vr = slave(built, **{"inner.rate": 0.7})
    run(one, vr, 0, 4)
    state = one.getFMUstate()
    data = one.serializeFMUstate(state)
    run(one, vr, 4, 7)
    one.setFMUstate(state)
    assert run(one, vr, 4, 10) == whole
    two, vr = slave(built)
    two.setFMUstate(two.deSerializeFMUstate(data))
    assert run(two, vr, 4, 10) == whole
    one.freeFMUstate(state)


def test_fmus_of_two_files_of_one_name_share_a_process(models, tmp_path, slave):
    files = []
    for i in (1, 2):
        folder = tmp_path / f"m{i}"
        folder.mkdir()
        (folder / "clash.py").write_text(
            "from loopwright.blocks import Block, State\n"
            f'class Ramp(Block):\n    """A ramp."""\n    y = State(output=True)\n'
            f"    def derivative(self, t, x, u):\n        return {i}.0 if t >= 0 else None\n"
        )
        spec = importlib.util.spec_from_file_location("clash", folder / "clash.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules["clash"] = module
        try:
            spec.loader.exec_module(module)
            files.append(build_python(module.Ramp(), folder))
        finally:
            del sys.modules["clash"]
    both = [slave(file) for file in files]
    for fmu, _ in both:
        fmu.doStep(0.0, 1.0)
    assert [fmu.getReal([vr["y"]])[0] for fmu, vr in both] == pytest.approx([1.0, 2.0], abs=1e-12)


def test_same_input_same_bytes_and_nothing_is_left(models, beside, tmp_path):
    before, path = set(sys.modules), list(sys.path)
    first = build_python(models.Counter(), tmp_path / "a.fmu", files=beside).read_bytes()
    assert build_python(models.Counter(), tmp_path / "b.fmu", files=beside).read_bytes() == first
    assert build_python(models.Counter(), tmp_path / "c.fmu", files=beside, stop_time=3.0).read_bytes() != first
    assert {name for name in set(sys.modules) - before if "loopwright_" in name or "pythonfmu" in name} == set()
    assert sys.path == path
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.fmu", "b.fmu", "c.fmu"]


def test_errors_while_it_runs_are_quoted(models, beside, tmp_path):
    file = build_python(models.Fails(), tmp_path, files=beside)
    log = []

    def run(**options):
        log.clear()
        gc.collect()  # what PythonFMU might have freed twice shows here
        with pytest.raises(fmpy.fmi1.FMICallException, match="fmi2DoStep failed with status 4"):
            fmpy.simulate_fmu(str(file), logger=lambda *a: log.append(a[-1].decode()), debug_logging=True, **options)
        return " ".join(log)

    line = next(i for i, text in enumerate(MODELS.splitlines(), 1) if "past one half" in text)
    for _ in range(5):
        assert "'ValueError: y is nan; expected finite numbers'" in run(stop_time=1.0, output_interval=0.125)
        assert f"'RuntimeError in line {line} of my_models.py: past one half'" in run(
            stop_time=1.0, output_interval=1.0
        )
    assert "found -1; expected a value above 0" in run(start_values={"k": -1.0}, stop_time=0.1, output_interval=0.1)


def test_what_goes_wrong_in_the_first_step_is_told(models, beside, tmp_path):
    file = build_python(models.Odd(), tmp_path, files=beside, step_size=0.1)
    assert [problem.found for problem in validate(file).problems] == [
        "co-simulation: after one step from its start values, y is no finite number."
    ]
    assert validate(build_python(models.Odd(), tmp_path, files=beside, step_size=0.2)).problems == ()
    problems = validate(build_python(models.Fails(), tmp_path, files=beside, step_size=0.5, stop_time=2.0)).problems
    assert len(problems) == 1
    assert problems[0].found.startswith("co-simulation at t = 0 s: ")
    assert "failed with fmi2Fatal" in problems[0].found
    assert "y is nan; expected finite numbers" in problems[0].found


def test_limits_and_defaults_of_ports(models, beside, tmp_path):
    file = build_python(models.Odd(), tmp_path, files=beside)
    variables = {v.name: v for v in fmpy.read_model_description(str(file)).modelVariables}
    found = [(v.start, v.min, v.max, v.nominal) for name, v in variables.items() if name.startswith("u[")]
    assert found == 2 * [("1.5", "-2.0", "3.0", "10.0")]


# --- what is refused ------------------------------------------------------------------------------------------------


def test_without_pythonfmu(models, tmp_path, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "pythonfmu" else find(name, *a))
    with pytest.raises(FmuError, match=r'pip install "loopwright\[python-fmu\]"'):
        build_python(models.Counter(), tmp_path)
    assert list(tmp_path.iterdir()) == []


class Prompted(Block):
    """As if typed at a prompt."""

    y = State(output=True)

    def derivative(self, t, x, u):
        return 1.0


def test_refused(models, tmp_path, monkeypatch):
    def refuse(text, block, **options):
        with pytest.raises(DefinitionError, match=text):
            build_python(block, tmp_path, **options)
        assert list(tmp_path.iterdir()) == []

    refuse("expected letters, digits and _", models.Counter(), name="a-b")
    refuse(r"bouncingball: it has events \(impact\)", bouncing_ball.nominal)
    refuse(
        r"its derivative fails at the start values in line \d+ of .*my_models.py: KeyError: 'nothing'",
        models.FailsAtOnce(),
    )
    refuse("found a class that is defined inside a function; define it at the top", models.local())
    refuse("found no file '.*nothing.py' to include", models.Counter(), files=[tmp_path / "nothing.py"])
    monkeypatch.setattr(Prompted, "__module__", "nowhere")
    refuse("found a class that is not defined in a file", Prompted())


def test_a_module_that_was_not_taken_along(models, tmp_path):
    with pytest.raises(FmuError, match=r"(?s)No module named 'rates'.*include it with files="):
        build_python(models.Decay(), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_equations_are_checked_when_it_is_built(tmp_path):
    class Base(Block):
        u = Input()
        v: float = parameter(default=1.0)

    class Two(Base):
        y, z = Output(), Output()

        def output(self, t, x, u):
            return 1.0, 2.0, 3.0

    class Wrong(Base):
        y = State(output=True)

        def derivative(self, t, x, u):
            return np.zeros(2)

    class Neither(Base):
        y = State(output=True)

    class Without(Base):
        y = Output()

    for block, text in (
        (Two(), "its output returned 3 values; expected 2"),
        (Wrong(), r"its derivative gives shape \(2,\); expected \(\)"),
        (Neither(), "neither derivative"),
        (Without(), r"has no output\(t, x, u\)"),
    ):
        with pytest.raises(DefinitionError, match=text):
            build_python(block, tmp_path)
