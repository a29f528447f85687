"""Values: what they hold can't be changed, what tells them apart, and what a notebook shows of them."""

import copy
import inspect
import math
import pickle
import runpy
import types
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from loopwright.blocks import (
    PID,
    PT1,
    AdmittanceFilter,
    Block,
    Circle,
    Constant,
    ErrorDynamics,
    Gain,
    HandForce,
    Input,
    Output,
    ParameterError,
    Pulse,
    Reference,
    Sine,
    SmoothStep,
    State,
    StateSpace,
    Step,
    TraceError,
    UnitDelay,
    UnitError,
    Value,
    parameter,
)
from loopwright.diagrams import Diagram


class Branch(Block):
    """Its equation looks at the kind of its parameter."""

    k: Any = parameter(default=None, description="anything")
    y = Output()

    def output(self, t, x, u):
        return 0.0 * t + (10.0 if self.k is True else 20.0 if self.k is None else 30.0)


class Bag(Value):
    """Whatever."""

    table: Any = parameter(default={"a": [1, 2]}, description="a mapping")
    row: Any = parameter(default=[1, 2], description="a list")
    numbers: Any = parameter(default=np.zeros(2), description="an array of any kind")
    gain: float = parameter(default=2, description="a number, declared as an integer")


def result(block):
    return Diagram("d", block).simulate(1.0, step=0.5, progress=False)[f"{block.label}.y"][0]


# --- what tells values apart -----------------------------------------------------------------------------------------


def test_one_and_true_have_traces_of_their_own():
    assert [result(Branch(k=k)) for k in (1, True, 1, 1.0, None)] == [30.0, 10.0, 30.0, 30.0, 20.0]
    assert Branch(k=1) != Branch(k=True)
    assert Branch(k=(1, 0)) != Branch(k=(True, False))


def test_a_number_is_the_same_in_every_spelling_where_it_is_declared_a_float():
    assert Gain(gain=1) == Gain(gain=1.0) == Gain(gain=np.float32(1))
    assert hash(Gain(gain=1)) == hash(Gain(gain=1.0))
    assert Gain(gain=[1, 2]) == Gain(gain=np.array([1.0, 2.0]))
    assert len({Bag(), Bag(), Bag(gain=2.0), Bag(gain=3)}) == 2


def test_arrays_differ_by_shape_and_kind():
    kinds = [np.zeros(4), np.zeros((2, 2)), np.zeros(4, dtype=int), np.zeros(8, dtype=np.float32)]
    assert len({Branch(k=k) for k in kinds}) == 4
    objects = [np.array([{"a"}, 1], dtype=object)]
    with pytest.raises(ParameterError):
        Branch(k=objects)


class Settings:
    __hash__ = None

    def __repr__(self):
        return "<settings>"


@pytest.mark.parametrize("value", [Settings(), [Settings()], {"a": (Settings(),)}, bytearray(b"a")])
def test_what_cannot_be_hashed_is_refused_when_the_block_is_made(value):
    with pytest.raises(ParameterError, match=r"b\.k: found .*, which can't be hashed; expected a number, a text") as e:
        Branch(name="b", k=value)
    assert "@dataclass(frozen=True)" in str(e.value)


def test_what_can_be_hashed_is_taken_as_it_is():
    @dataclass(frozen=True)
    class Fixed:
        a: int = 1

    fixed = Fixed()
    assert Branch(k=fixed).k is fixed
    assert Branch(k=Fixed()) == Branch(k=fixed)
    assert Branch(k=np.sin) == Branch(k=np.sin)


# --- what they hold --------------------------------------------------------------------------------------------------


@pytest.fixture(params=["made", "pickled", "copied", "deeply copied"])
def bag(request):
    made = Bag(table={"x": np.array([1.0, 2.0]), "deep": {"y": [3, {4}]}}, numbers=np.arange(3))
    again = {"pickled": lambda b: pickle.loads(pickle.dumps(b)), "copied": copy.copy, "deeply copied": copy.deepcopy}
    return again.get(request.param, lambda b: b)(made)


def test_nothing_inside_can_be_changed(bag):
    assert bag == Bag(table={"x": np.array([1.0, 2.0]), "deep": {"y": [3, {4}]}}, numbers=np.arange(3))
    with pytest.raises(ParameterError, match=r"a mapping that is a parameter can't be changed; give replace"):
        bag.table["x"] = 1
    with pytest.raises(ParameterError, match=r"can't be changed"):
        bag.table["deep"]["z"] = 1
    with pytest.raises(ParameterError, match=r"can't be changed"):
        del bag.table["x"]
    for array in (bag.table["x"], bag.numbers):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 9
    assert bag.table["deep"] == {"y": (3, frozenset({4}))}
    assert bag.row == (1, 2)


def test_numeric_arrays_stay_read_only_in_a_pickle():
    gain = pickle.loads(pickle.dumps(Gain(gain=[1.0, 2.0])))
    with pytest.raises(ValueError, match="read-only"):
        gain.gain[0] = 9
    assert gain == Gain(gain=[1.0, 2.0])


def test_what_was_given_may_be_changed_afterwards():
    table, array = {"a": 1}, np.zeros(3)
    bag = Bag(table=table, numbers=array[:2])
    table["a"], array[0] = 2, 5.0
    assert bag.table == {"a": 1}
    assert bag.numbers.tolist() == [0.0, 0.0]


def test_defaults_are_shared_with_nobody():
    default = {"a": 1}

    class Other(Value):
        """Something."""

        table: Any = parameter(default=default, description="a mapping")

    default["a"] = 2
    assert Other().table == {"a": 1}


def test_a_frozen_mapping_compares_with_any_other():
    table = Bag(table={"a": 1.0, "x": np.zeros(2)}).table
    assert table == {"a": 1.0, "x": [0.0, 0.0]}
    assert table != {"a": 1.0, "x": [0.0, 1.0]}
    assert table != {"a": 1.0}
    assert table != 3
    assert hash(table) == hash(Bag(table={"x": np.zeros(2), "a": 1.0}).table)
    assert repr(Bag(table={"a": 1})) == "Bag(table={'a': 1})"
    assert repr(Bag()) == "Bag()"


# --- what a notebook shows -------------------------------------------------------------------------------------------


def test_the_signature_is_that_of_the_declarations():
    signature = inspect.signature(AdmittanceFilter)
    assert list(signature.parameters) == [*AdmittanceFilter.parameter_specs, "name"]
    assert {p.kind for p in signature.parameters.values()} == {inspect.Parameter.KEYWORD_ONLY}
    assert signature.parameters["mass"].default is inspect.Parameter.empty
    assert signature.parameters["damping"].default is None
    assert signature.parameters["mass"].annotation == "float"
    assert str(inspect.signature(HandForce)) == (
        "(path: 'Path', *, minimum_q: 'float' = 0.05, tolerance: 'float' = 1e-09, name: 'str | None' = None)"
    )
    assert "name" not in inspect.signature(Circle).parameters
    signature.bind(mass=1.0, stiffness=2.0)
    with pytest.raises(TypeError):
        signature.bind(1.0)


def test_help_gives_units_ranges_shapes_and_descriptions():
    text = inspect.getdoc(AdmittanceFilter)
    for line in (
        "mass : float, in kg, above 0\n    rendered mass m\n",
        "damping : float | None, in N.s/m, at least 0, optional\n",
        "Inputs\n------\nforce : scalar, in N\n    force on the robot in this direction\n",
        "desired_force : scalar, in N, default 0\n",
        "Outputs\n-------\npath_reference : shape (3,), in m, m/s, m/s2\n    r^p: value, rate, acceleration\n",
        "States\n------\nerror : scalar, start 0, in m\n    e\n",
    ):
        assert line in text, line
    assert text.index("Admittance control law (15)") == 0
    assert "u : any shape" in UnitDelay.__doc__
    assert "last : shape of u, start initial_value" in UnitDelay.__doc__
    assert "center : Array, shape (2,), in m" in Circle.__doc__
    assert "radius : float, in m, above 0" in Circle.__doc__


def test_a_section_that_is_written_is_not_made_again_and_none_is_inherited():
    class Written(Gain):
        """A gain.

        Parameters
        ----------
        gain : float
            In own words.
        """

        extra: float = parameter(default=0.0, description="made")

    class Bare(Written):
        v = Input(shape=(2,), unit="m", minimum=-1.0, maximum=1.0)
        z = State(start=lambda block: 0.0)

        def derivative(self, t, x, u):
            return 0.0

    assert Written.__doc__.count("Parameters\n") == 1
    assert "extra" not in Written.__doc__
    assert Bare.__doc__.startswith("Bare.\n\nParameters\n")
    assert "extra : float, default 0\n    made" in Bare.__doc__
    assert "v : shape (2,), in m, at least -1, at most 1" in Bare.__doc__
    assert "z : start from the parameters" in Bare.__doc__


# --- where an equation fails -----------------------------------------------------------------------------------------

SCRIPT = """from loopwright.blocks import Block, Input, Output
import math

def helper(v):
    return math.sqrt(v)  # fails deep in CasADi's own code

class Wrong(Block):
    u = Input()
    y = Output()

    def output(self, t, x, u):
        a = u.u
        return helper(a)
"""


@pytest.mark.parametrize("how", ["script", "notebook"])
def test_a_trace_error_names_the_users_own_line(how, tmp_path):
    file = str(tmp_path / "cell.py")
    if how == "script":
        (tmp_path / "cell.py").write_text(SCRIPT, encoding="utf-8")
        scope = runpy.run_path(file, run_name="__main__")
    else:  # a cell is compiled under a name of its own, and its classes live in __main__
        module = types.ModuleType("__main__")
        exec(compile(SCRIPT, file, "exec"), module.__dict__)
        scope = module.__dict__
    with pytest.raises(TraceError) as e:
        Diagram("d", scope["Wrong"]()(Constant(value=2.0)))
    assert f"in line 5 of {file}" in str(e.value)


# --- units of the sources --------------------------------------------------------------------------------------------

SOURCES = [
    Constant(value=1.0, unit="N"),
    Step(times=1.0, values=2.0, unit="N"),
    Pulse(start_time=0.0, end_time=1.0, amplitude=1.0, unit="N"),
    Sine(frequency=1.0, unit="N"),
]


@pytest.mark.parametrize("source", SOURCES, ids=lambda s: s.label)
def test_every_source_carries_a_unit_that_is_checked(source):
    hand = HandForce(Circle(radius=1.0))
    position = Constant(value=(1.0, 0.0))
    Diagram("d", hand(position, f_par=source))
    assert source.outputs["y"].unit == "N"
    with pytest.raises(UnitError, match=r"hand_force\.f_par: .*\.y is in m; expected in N"):
        Diagram("d", hand(position, f_par=source.replace(unit="m")))
    with pytest.raises(UnitError, match=r"hand_force\.f_perp: .*\.y is in m; expected in N"):
        Diagram("d", hand(position, f_perp=source.replace(unit="m")))


@pytest.mark.parametrize(
    "source", [Reference(0.0, unit="mm"), SmoothStep(levels=(0, 1), start_times=0, durations=1, unit="mm")]
)
def test_a_reference_carries_the_units_of_its_derivatives(source):
    assert source.outputs["y"].unit == ("mm", "mm/s", "mm/s2")
    assert source.outputs["y"].shape == (3,)
    law = ErrorDynamics.from_poles([-1, -1, -1], name="law")
    coordinate = Constant(value=(0.0, 0.0))
    with pytest.raises(UnitError, match=r"law\.reference: .*\.y is in mm, mm/s, mm/s2; expected in m, m/s, m/s2"):
        Diagram("d", law(coordinate, source))
    Diagram("d", law(coordinate, source.replace(unit="m")))
    Diagram("d", law(coordinate, source.replace(unit=None)))


@pytest.mark.parametrize("source", [*SOURCES, Reference(0.0), SmoothStep(levels=(0, 1), start_times=0, durations=1)])
def test_a_unit_that_cannot_be_read_is_refused_when_the_source_is_made(source):
    with pytest.raises(UnitError, match=r"^s\.unit: the unit 'meter/s' has an unknown symbol 'meter'"):
        source.replace(unit="meter/s", name="s")
    with pytest.raises(ParameterError, match=r"^s\.unit: found 3; expected a text"):
        source.replace(unit=3, name="s")


def test_an_error_of_a_users_check_names_the_block_by_itself():
    class Band(Block):
        lower: float = parameter(default=0.0)
        upper: float = parameter(default=1.0)

        def check(self):
            if not self.lower < self.upper:
                raise ParameterError("found lower above upper; expected it below. Exchange them.", port="lower")

    with pytest.raises(ParameterError, match=r"^narrow\.lower: found lower above upper"):
        Band(upper=-1.0, name="narrow")
    with pytest.raises(ParameterError, match=r"^band\.lower: found lower above upper"):
        Band().replace(upper=-1.0)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: PID(kp=math.nan), "PID.kp: found nan; expected finite numbers. Give kp= as that: proportional gain."),
        (lambda: PID(kp=True), "PID.kp: found True; expected a number. Give kp= as that: proportional gain."),
        (
            lambda: PT1(time_constant=-1.0),
            "PT1.time_constant: found -1; expected a value above 0 in s. Give time_constant= as that: time constant T.",
        ),
        (
            lambda: StateSpace(A=[[0, 1], [0, 0]], B=[0, 1], C=[1, 0], initial_state=(1, 2, 3)),
            "state_space.initial_state: found shape (3,); expected a number or 2 numbers. Give one for each state.",
        ),
    ],
)
def test_a_refused_value_has_a_next_step(make, text):
    with pytest.raises(ParameterError) as refused:
        make()
    assert str(refused.value) == text
