"""Public names: the front door, errors where they are raised, and hints for names that are elsewhere."""

import abc
import ast
import importlib
import inspect
import pydoc
import subprocess
import sys
from pathlib import Path

import pytest

import loopwright
from loopwright.blocks import PID, Gain
from loopwright.blocks.core import errors
from loopwright.blocks.core.shown import documented
from loopwright.diagrams.diagram import PLUMBING
from loopwright.fmus import mass_spring_damper

ROOT = Path(__file__).parent.parent
PACKAGES = [
    name for name in loopwright.__all__ if inspect.ismodule(getattr(loopwright, name)) and name != "experiments"
]
FOLDERS = {"blocks": "blocks", "fmus": "fmus", "diagrams": "diagrams"}
FOLDERS |= {"frequency": "diagrams/frequency", "sweeps": "diagrams/sweeps"}


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


def raised_in(folder):
    """Return the errors that the sources of a folder make."""
    known = {name for name, value in vars(errors).items() if inspect.isclass(value)} - {"LoopwrightError"}
    return {
        node.func.id
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in known
    }


@pytest.mark.parametrize("package", FOLDERS)
def test_an_error_is_importable_where_it_is_raised(package):
    raised = raised_in(FOLDERS[package])
    assert raised
    assert raised <= set(getattr(loopwright, package).__all__)


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
