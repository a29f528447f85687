"""Parameters are what their annotations say, as written in a notebook: without ``from __future__ import annotations``."""

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    DefinitionError,
    Ellipse,
    ErrorDynamics,
    Input,
    Output,
    ParameterError,
    State,
    UnitError,
    parameter,
)
from loopwright.fmus import model_spec
from loopwright.types import Array


class Mass(Block):
    """A mass for each axis."""

    mass: Array = parameter(default=(1.0, 2.0), shape=(2,), unit="kg", above=0.0)
    drag: np.ndarray = parameter(default=(0.5, 0.5), unit="N.s/m")
    offset: Array | None = parameter(default=None, unit="N")
    flag: bool = parameter(default=False)
    word: str = parameter(default="a")
    force = Input(shape=(2,), unit="N")
    velocity = State(unit="m/s", start=(0.0, 0.0), output=True)

    def derivative(self, t, x, u):
        return (u.force - self.drag * x.velocity) / self.mass


def test_vectors_are_arrays_and_parameters_of_an_fmu():
    assert [v.name for v in model_spec(Mass()).parameters] == ["mass", "drag"]
    assert Mass(mass=3).mass.tolist() == [3.0, 3.0]
    assert Mass(offset=[1, 2]).offset.tolist() == [1.0, 2.0]
    assert Mass().offset is None


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"mass": (-1, 0)}, r"Mass\.mass: found \[-1\.0, 0\.0\]; expected a value above 0 in kg"),
        ({"mass": (1, 2, 3)}, r"Mass\.mass: found shape \(3,\); expected shape \(2,\) in kg"),
        ({"drag": "much"}, r"Mass\.drag: found 'much'; expected a number in N\.s/m"),
        ({"flag": "no"}, r"Mass\.flag: found 'no'; expected True or False"),
        ({"flag": 1}, r"Mass\.flag: found 1; expected True or False"),
        ({"word": 1}, r"Mass\.word: found 1; expected a text"),
    ],
)
def test_what_an_annotation_excludes_is_refused(given, text):
    with pytest.raises(ParameterError, match=text):
        Mass(**given)


def test_a_paths_direction_is_a_truth_value():
    with pytest.raises(ParameterError, match=r"Ellipse\.clockwise: found 'no'; expected True or False"):
        Ellipse(semi_axes=(0.3, 0.15), clockwise="no")


def test_a_mapping_of_numbers_is_no_number():
    class Table(Block):
        rows: dict[str, float] = parameter(default={})
        y = Output()

        def output(self, t, x, u):
            return 0.0 * t + len(self.rows)

    assert dict(Table(rows={"a": 1.0}).rows) == {"a": 1.0}


def test_a_parameter_without_an_annotation_is_told():
    with pytest.raises(DefinitionError, match=r"Bare\.k: the parameter has no annotation; write k: float = parameter"):
        type("Bare", (Block,), {"k": parameter(default=2.0)})


@pytest.mark.parametrize("declare", [lambda: Input(unit="Newton"), lambda: parameter(unit="Newton")])
def test_a_unit_that_can_not_be_read_is_told_where_it_is_written(declare):
    with pytest.raises(UnitError, match="unknown symbol 'Newton'"):
        declare()


@pytest.mark.parametrize("poles", [-20, None, "abc", [[-1, -2, -3]], [-1, -2], [-1, -2, 3]])
def test_what_are_no_three_stable_poles_is_refused(poles):
    with pytest.raises(ParameterError, match=r"ErrorDynamics\.poles: found .*; expected three poles in the left half"):
        ErrorDynamics.from_poles(poles)
