"""Public names: the front door, errors where they are raised, and hints for names that are elsewhere."""

import abc
import ast
import importlib
import inspect
import pickle
import pydoc
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import loopwright
from loopwright.blocks import PID, Gain
from loopwright.blocks.core import errors
from loopwright.blocks.core.shown import documented
from loopwright.blocks.names_of_other_tools import WAYS
from loopwright.diagrams import OptionError, UnknownNameError
from loopwright.diagrams.diagram import PLUMBING
from loopwright.diagrams.solvers import SOLVERS
from loopwright.diagrams.solvers.base import OTHER_NAMES
from loopwright.fmus import mass_spring_damper

ROOT = Path(__file__).parent.parent
PACKAGES = [
    name for name in loopwright.__all__ if inspect.ismodule(getattr(loopwright, name)) and name != "experiments"
]


def test_the_front_door_has_the_names_that_programs_begin_with():
    assert PACKAGES == ["blocks", "diagrams", "fmus", "frequency", "sweeps", "types"]
    names = set(loopwright.__all__) - set(PACKAGES)
    assert 25 <= len(names) <= 32
    for name in names - {"__version__"}:
        places = [package for package in PACKAGES if name in getattr(loopwright, package).__all__]
        assert places, f"{name} is in no package"
        assert getattr(loopwright, name) is getattr(getattr(loopwright, places[0]), name)


def test_a_name_has_one_place_but_for_errors_which_are_where_they_are_raised():
    places = {}
    for package in PACKAGES:
        for name in getattr(loopwright, package).__all__:
            places.setdefault(name, []).append(package)
    twice = {name for name, found in places.items() if len(found) > 1}
    assert all(issubclass(getattr(errors, name), loopwright.LoopwrightError) for name in twice)


def test_what_only_annotates_is_in_types():
    """No example of a page or a notebook calls one of them, and none is an error."""
    for name in loopwright.types.__all__:
        value = getattr(loopwright.types, name)
        assert not (inspect.isclass(value) and issubclass(value, BaseException))
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md"))]
    called = {
        node.func.id
        for text in texts
        for code in text.split("```python\n")[1:]
        for node in ast.walk(ast.parse(code.partition("```")[0]))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert len(called) > 40
    assert not called & set(loopwright.types.__all__)


@pytest.mark.parametrize(
    ("statement", "hint"),
    [
        ("from loopwright.diagrams import Margins", "from loopwright.frequency import Margins"),
        ("from loopwright.diagrams import margins", "from loopwright import margins"),
        ("from loopwright.diagrams import Box", "from loopwright.sweeps import Box"),
        ("from loopwright.diagrams import OperatingPoint", "from loopwright.types import OperatingPoint"),
        ("from loopwright.blocks import FmuError", "from loopwright.fmus import FmuError"),
        ("from loopwright.blocks import Diagram", "from loopwright import Diagram"),
        ("from loopwright import Gain", "from loopwright.blocks import Gain"),
        ("from loopwright.types import Margins", "from loopwright.frequency import Margins"),
        ("from loopwright.blocks import Satturation", "Did you mean Saturation"),
        ("import loopwright.diagrams.Margins", "from loopwright.frequency import Margins"),
        ("from loopwright import TransferFunction", "from loopwright.blocks import TransferFunction"),
        ("from loopwright import PID", "from loopwright.blocks import PID"),
        ("from loopwright import Diagramm", "Did you mean Diagram"),
        ("from loopwright.fmus import Diagram", "from loopwright import Diagram"),
        ("from loopwright.blocks import Scope", 'run.plot("speed")'),
        ("from loopwright import Scope", 'run.plot("speed")'),
        ("from loopwright import Simulation", "diagram.simulate(2.0)"),
        ("from loopwright import simulate_fmu", 'Diagram("name", Fmu("plant.fmu")())'),
        ("from loopwright import tf", "TransferFunction(numerator=…, denominator=…)"),
        ("from loopwright import ss", "StateSpace(A=…, B=…, C=…, D=…)"),
        ("from loopwright import bode", 'control.bode(diagram.linearize().loop("wire"))'),
        ("from loopwright.blocks import Adder", "the block is Sum"),
        ("from loopwright import linearize", "a method of a diagram"),
    ],
)
def test_a_name_that_is_elsewhere_is_an_error_that_says_where(statement, hint):
    with pytest.raises(ImportError) as caught:
        exec(statement, {})
    assert hint in str(caught.value)
    module, _, name = statement.replace(" import ", ".").removeprefix("from ").removeprefix("import ").rpartition(".")
    assert f"{module} has no '{name}'" in str(caught.value)
    with pytest.raises(AttributeError) as caught:
        getattr(importlib.import_module(module), name)
    assert hint in str(caught.value)


def test_names_of_other_tools_lead_to_names_that_exist():
    control = importlib.import_module("control")
    public = {name for package in PACKAGES for name in getattr(loopwright, package).__all__}
    classes = re.compile(r"\b(?:[A-Z]\w*[a-z]\w*|PID|PT1)(?=[(,. ;])")
    words = {"Here", "The", "It", "Among", "None", "An", "A", "At", "What", "Give", "Make", "Each", "Every", "Python"}
    for name, text in WAYS.items():
        assert name not in loopwright.blocks.__all__ + loopwright.fmus.__all__ + loopwright.diagrams.__all__, name
        found = set(classes.findall(re.sub(r"\w+-control|plant\.fmu", "", text))) - words
        assert found <= public, f"{name}: {found - public}"
        methods = re.findall(r"diagram\.(\w+)\(", text)
        assert all(hasattr(loopwright.Diagram, method) for method in methods)
        assert all(hasattr(loopwright.Run, method) for method in re.findall(r"run\.(\w+)\(", text))
        assert all(hasattr(control, function) for function in re.findall(r"control\.(\w+)\(", text))


def test_an_unknown_name_is_plainly_unknown():
    with pytest.raises(ImportError, match="cannot import name 'qqqq'"):
        exec("from loopwright import qqqq", {})
    assert not hasattr(loopwright, "qqqq")
    assert importlib.util.find_spec("loopwright.qqqq") is None


def test_the_package_runs_as_a_module():
    command = (sys.executable, "-m", "loopwright", "--version")
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["loopwright", loopwright.__version__]


# --- completion and help ---------------------------------------------------------------------------------------------------


def test_completion_of_a_block_shows_its_ports_and_parameters_and_little_else():
    common = {"events", "inputs", "name", "named", "outputs", "parameters", "replace", "states"}
    assert set(dir(Gain(gain=2.0))) == common | {"gain", "y"}
    assert {"kp", "excess", "u"} <= set(dir(PID(kp=1.0)))
    assert "drawn_as" not in dir(PID(kp=1.0))
    assert PID(kp=1.0).drawn_as == "PID"  # it is there all the same


def test_completion_shows_what_a_users_own_block_declares():
    class Lag(loopwright.Block):
        """First-order lag."""

        time_constant: float = loopwright.parameter(unit="s")
        u = loopwright.Input()
        y = loopwright.State(output=True)

        def derivative(self, t, x, u):
            return (u.u - x.y) / self.time_constant

        @property
        def corner(self):
            """Corner frequency in rad/s."""
            return 1.0 / self.time_constant

    assert {"time_constant", "y", "derivative", "corner", "replace"} <= set(dir(Lag(time_constant=2.0)))


def test_completion_of_a_plant_and_a_diagram_shows_what_a_person_types():
    plant = loopwright.Fmu(mass_spring_damper.build())
    shown = set(dir(plant))
    assert {"file", "start", "position", "description", "left_out", "linear_model", "replace"} <= shown
    assert len(shown) < 40
    assert not shown & {"instantiate", "check_place", "exchange", "start_of", "held_inputs"}
    diagram = loopwright.Diagram("small", Gain(gain=2.0)(loopwright.blocks.Constant(value=1.0)))
    assert {"simulate", "linearize", "draw", "report", "sweep", "blocks", "replace"} <= set(dir(diagram))
    assert not set(dir(diagram)) & PLUMBING
    assert all(hasattr(diagram, name) for name in PLUMBING)


def test_completion_of_the_experiments_and_of_a_plants_module_shows_what_they_define_and_no_import():
    assert {"path_following", "compliance", "DEFAULTS"} <= set(dir(loopwright.experiments))
    assert not {"np", "Any", "fig3", "Diagram"} & set(dir(loopwright.experiments))
    assert dir(loopwright.fmus.dc_motor) == ["DcMotor", "build", "nominal"]


@pytest.mark.parametrize("cls", [Gain, PID, loopwright.Block, loopwright.Fmu])
def test_help_shows_no_special_methods(cls):
    text = pydoc.render_doc(cls, renderer=pydoc.plaintext)
    assert "__add__" not in text
    assert "replace" in text
    assert "Methods defined here" in text


def test_help_of_the_base_has_what_an_author_of_blocks_overrides():
    text = pydoc.render_doc(loopwright.Block, renderer=pydoc.plaintext)
    assert all(name in text for name in ("input_breaks", "time_scale", "guard_error", "same_units"))


def test_what_a_docstring_lists_for_completion_exists():
    for package in PACKAGES:
        for name in getattr(loopwright, package).__all__:
            value = getattr(getattr(loopwright, package), name)
            if inspect.isclass(value) and issubclass(value, loopwright.Block):
                listed = documented(value) - {"inputs", "outputs", "states", "events"}
                assert not [member for member in listed if not hasattr(value, member)], name


def test_an_abstract_class_may_be_a_second_base_of_a_block():
    class Plant(loopwright.Block, abc.ABC):
        """A plant."""

        y = loopwright.Output()

        @abc.abstractmethod
        def output(self, t, x, u): ...

    class Still(Plant):
        """A plant that rests."""

        def output(self, t, x, u):
            return 0.0

    with pytest.raises(TypeError, match="abstract"):
        Plant()
    assert isinstance(Still(), Plant)
    assert not isinstance(Gain(gain=1.0), Plant)
    assert issubclass(Still, loopwright.Block)


# --- words of other tools --------------------------------------------------------------------------------------------------


@cache
def small():
    return loopwright.Diagram(
        "small", loopwright.blocks.Integrator()(loopwright.blocks.Constant(value=1.0)).named("speed")
    )


@cache
def small_run():
    return small().simulate(0.1, step=0.01, progress=False)


@pytest.mark.parametrize(
    ("call", "hint"),
    [
        (lambda: small().simulate(1.0, solver="ode45"), "solver='RK45'"),
        (lambda: small().simulate(1.0, solver="ode15s"), "solver='BDF'"),
        (lambda: small().simulate(1.0, solver="ode4"), "solver='rk4'"),
        (lambda: small().simulate(1.0, solver="RK54"), "or 'RK45'"),
        (lambda: small().simulate(1.0, dt=0.1), "Did you mean step=… (seconds)?"),
        (lambda: small().simulate(1.0, Ts=0.1), "Did you mean step=… (seconds)?"),
        (lambda: small().simulate(1.0, method="RK45"), 'Did you mean solver="RK45"'),
        (lambda: small().simulate(1.0, stop_time=2.0), "simulate(2.0)"),
        (lambda: small().simulate(t_final=2.0), "Did you mean the duration in s, the first argument: simulate(2.0)?"),
        (lambda: small().simulate(1.0, t_end_=2.0), "'t_end_'. Did you mean the duration in s, the first argument"),
        (lambda: small().linearize(point=1.0), "Did you mean at=…, a time in s, run.at(t) or a point?"),
        (lambda: small().linearize(t=1.0), "Did you mean at=…"),
        (lambda: small().simulate(1.0, reltol=1e-3), "Did you mean rtol=…?"),
        (lambda: loopwright.subsystem(dt=0.1), "Did you mean sample_time=… (seconds)?"),
        (lambda: small().report("a.html", requirements={"phase_margin_deg": 40}), "Requirements(phase_margin_deg=40)"),
        (lambda: loopwright.analyse(small(), requirements=[45]), "Requirements(phase_margin_deg=45)"),
        (
            lambda: small().worst_case({"integrator.initial_value": (0.0, 1.0)}, "speed", requirements={"ms": 1.6}),
            "Requirements(ms=1.6)",
        ),
        (lambda: small_run().plot("speeed"), "Did you mean 'speed'?"),
        (lambda: small().linearise, "Did you mean 'linearize'"),
        (lambda: small().run, "Write diagram.simulate(2.0)."),
        (lambda: small().bode, 'Write diagram.linearize().loop("wire").bode().'),
        (lambda: small().root_locus, 'Write diagram.linearize().loop("wire").root_locus().'),
        (lambda: small_run().scope, 'Write run.plot("wire").'),
        (lambda: small_run().to_dataframe, "Write run.to_pandas()."),
        (lambda: small_run().speed, "a run has no 'speed'. Write run[\"speed\"]."),
        (lambda: small_run().qqqq, "Completion lists its"),
        (lambda: small().step, 'Write diagram.linearize().loop("wire").step()'),
        (lambda: small_run().final_stat, "Did you mean 'final_state'"),
    ],
)
def test_a_word_of_another_tool_or_a_misspelt_one_is_an_error_that_says_what_to_write(call, hint):
    with pytest.raises((OptionError, UnknownNameError)) as caught:
        call()
    assert hint in str(caught.value)


def test_solvers_of_other_tools_lead_to_solvers():
    assert set(OTHER_NAMES.values()) <= set(SOLVERS)
    assert not {name.lower() for name in SOLVERS} & OTHER_NAMES.keys()


def test_a_missing_attribute_is_an_attribute_error_and_a_failing_property_keeps_its_own():
    assert not hasattr(small(), "scope")
    assert not hasattr(small_run(), "_repr_nothing_")

    class Failing(loopwright.Diagram):
        @property
        def total(self):
            return self.blocks.no_such_attribute

    with pytest.raises(AttributeError, match="no_such_attribute"):
        _ = Failing("failing", loopwright.blocks.Constant(value=1.0)).total
    copied = pickle.loads(pickle.dumps(small()))
    assert copied.blocks == small().blocks


# --- one word for one thing ------------------------------------------------------------------------------------------------


def test_progress_is_true_false_or_a_function_everywhere(capsys):
    diagram, seen = small(), {}

    def note(key):
        return lambda said: seen.setdefault(key, []).append(said)

    diagram.simulate(1.0, step=0.5, progress=note("simulate"))
    diagram.sweep(
        {"constant.value": (1.0, 2.0)},
        0.1,
        step=0.05,
        signals="speed",
        workers=1,
        compile=False,
        progress=note("sweep"),
    )
    loopwright.analyse(diagram, only=("subject",), progress=note("analyse"))
    with diagram.simulation(step=0.5) as simulation:
        simulation.advance(1.0, progress=note("advance"))
        simulation.advance(1.0, progress=False)
        simulation.advance(1.0)
    assert seen["simulate"][-1] == seen["advance"][-1] == pytest.approx(1.0)
    assert seen["sweep"][-1] == 2
    assert seen["analyse"][-1] == "subject"
    diagram.simulate(1.0, step=0.5, progress=False)
    loopwright.analyse(diagram, only=("subject",), progress=False)
    assert capsys.readouterr().err == ""
    diagram.simulate(1.0, step=0.5, progress=True)  # drawn, and taken away again at the end


@pytest.mark.parametrize(
    "call",
    [
        lambda: small().simulate(1.0, progress="yes"),
        lambda: small().sweep({"constant.value": (1.0, 2.0)}, 0.1, progress=1),
        lambda: small().worst_case({"constant.value": (1.0, 2.0)}, "speed", progress="loud"),
        lambda: small().report("a.html", progress="yes"),
        lambda: loopwright.analyse(small(), progress="yes"),
        lambda: loopwright.doctor("none.fmu", progress=2),
    ],
)
def test_another_progress_is_refused_in_one_way(call):
    with pytest.raises(OptionError, match="expected True, False or a function"):
        call()


def test_the_steps_of_blocks_that_round_have_one_name():
    for name in loopwright.blocks.__all__:
        value = getattr(loopwright.blocks, name)
        if inspect.isclass(value) and issubclass(value, loopwright.Block) and value.quanta:
            assert set(value.quanta.values()) == {"quantum"}, name


def test_derivatives_by_parameters_are_sensitivities_and_s_is_the_sensitivity():
    assert not hasattr(loopwright.Diagram, "sensitivity")
    assert callable(loopwright.Diagram.sensitivities)
    assert callable(loopwright.types.Linearization.sensitivity)
    with pytest.raises(UnknownNameError, match=r"diagram\.sensitivities\(…\)"):
        _ = small().sensitivity
