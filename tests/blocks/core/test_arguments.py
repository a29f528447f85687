"""Kinds of values that stand at a signature: what they refuse, and with which words."""

import inspect
import pickle
from dataclasses import dataclass, replace

import numpy as np
import pytest

from loopwright.blocks import OptionError, ParameterError, Value, parameter
from loopwright.blocks.core import Kind, accepts, kinds


@accepts("Diagram.listen", windows=kinds.integer(2), kind=kinds.choice("sine", "noise"), at=kinds.positive)
def listen(windows: int = 0, *, kind: str = "sine", at: float | None = None) -> tuple[int, str]:
    """Return its arguments."""
    return windows, kind


@accepts("settings", ParameterError, retries=kinds.integer(0, 50))
@dataclass(frozen=True)
class Settings:
    """A dataclass with a checked field."""

    retries: int = 3
    other: object = None


class Table(Value):
    """A value with a checked parameter."""

    points: np.ndarray | None = parameter(default=None, kind=kinds.rising)
    way: str = parameter(default="hold", kind=kinds.choice("hold", "stop"))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: listen(1), "Diagram.listen.windows: found 1; expected an integer from 2 on. Give windows= as that."),
        (lambda: listen(True), "Diagram.listen.windows: found True; expected an integer from 2 on."),
        (lambda: listen(2.0), "Diagram.listen.windows: found 2; expected an integer from 2 on."),
        (lambda: listen(2, kind="sinus"), "kind: found 'sinus'; expected 'sine' or 'noise'. Did you mean 'sine'?"),
        (lambda: listen(2, kind=3), "kind: found 3; expected 'sine' or 'noise'. Give one of them."),
        (lambda: listen(2, at=float("inf")), "at: found inf; expected a positive number. Give at= as that."),
        (lambda: Settings(51), "settings.retries: found 51; expected an integer from 0 to 50."),
        (lambda: replace(Settings(), retries=-1), "settings.retries: found -1; expected an integer from 0 to 50."),
        (lambda: Table(points=[1, 1]), "Table.points: found [1.0, 1.0]; expected at least two numbers that rise."),
        (lambda: Table().replace(points=[1]), "Table.points: found [1.0]; expected at least two numbers that rise."),
        (lambda: Table(way="stopp"), "way: found 'stopp'; expected 'hold' or 'stop'. Did you mean 'stop'?"),
        (lambda: Table(way=None), "way: found None; expected 'hold' or 'stop'. Give one of them."),
    ],
)
def test_a_value_of_another_kind_is_refused(call, message):
    with pytest.raises((OptionError, ParameterError)) as caught:
        call()
    assert message in str(caught.value)


def test_the_error_has_the_class_that_is_declared():
    with pytest.raises(ParameterError):
        Settings(51)
    with pytest.raises(OptionError):
        listen(1)
    with pytest.raises(ParameterError):
        Table(way="x")


def test_values_of_the_kind_and_defaults_are_taken():
    assert listen() == (0, "sine")  # a default is always right
    assert listen(np.int64(2), kind="noise") == (2, "noise")
    assert listen(2, at=None) == (2, "sine")
    assert Settings(50) == Settings(retries=50)
    assert Table().points is None
    assert Table(points=[0, 1]).points.tolist() == [0.0, 1.0]


@accepts("{owner.name}", values=kinds.integer(0), limits=kinds.positive)
def collect(owner: object, *values: int, **limits: float) -> int:
    """Return the number of its arguments."""
    return len(values) + len(limits)


def test_each_of_several_arguments_is_checked_and_the_owner_is_named():
    class Owner:
        name = "robot"

    assert collect(Owner(), 1, 2, low=1.0) == 3
    with pytest.raises(OptionError, match="^robot.values: found -1; expected an integer from 0 on"):
        collect(Owner(), 1, -1)
    with pytest.raises(OptionError, match="^robot.low: found 0; expected a positive number"):
        collect(Owner(), 1, low=0.0)


def test_a_kind_of_no_argument_is_refused_at_the_definition():
    with pytest.raises(TypeError, match="has no argument windwos"):
        accepts(windwos=kinds.flag)(collect)


def test_signatures_and_pickles_stay():
    assert list(inspect.signature(listen).parameters) == ["windows", "kind", "at"]
    assert str(inspect.signature(Settings)) == "(retries: int = 3, other: object = None) -> None"
    assert pickle.loads(pickle.dumps(Settings(4))) == Settings(4)


def test_words_of_a_kind_can_be_others():
    even = kinds.integer(0).where(lambda value: value % 2 == 0).worded("an even number", "Add 1.", kinds.by_name)
    assert even.holds(2)
    assert not even.holds(3)
    assert not even.holds("2")
    assert even.complaint("n", 3) == "found n=3; expected an even number. Add 1."
    hinted = Kind("a text", lambda value: isinstance(value, str), lambda value: f"Write '{value}'.")
    assert hinted.complaint("n", 3) == "found 3; expected a text. Write '3'."
