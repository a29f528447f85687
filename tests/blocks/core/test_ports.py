"""Declarations of ports: shapes of states, arguments that don't exist, inputs that may stay unwired."""

import numpy as np
import pytest

from loopwright.blocks import (
    PID,
    Block,
    Constant,
    DefinitionError,
    Input,
    Output,
    ShapeError,
    State,
    UnknownNameError,
    UnwiredInputError,
    parameter,
)
from loopwright.diagrams import Diagram
from loopwright.types import Array

RATES = np.arange(3.0)


def integrator(**declared):
    """Return a class whose state takes up its input."""

    class Integrates(Block):
        begin: Array = parameter(default=0.0, description="start value")
        u = Input(shape=(3,))
        y = State(output=True, **declared)

        def derivative(self, t, x, u):
            return u.u

    return Integrates


def end_of(block):
    return Diagram("d", block(Constant(value=RATES))).simulate(0.5)[f"{block.name}.y"][-1]


@pytest.mark.parametrize(
    ("declared", "given", "start"),
    [
        ({}, {}, 0.0),
        ({"start": 2.0}, {}, 2.0),
        ({"start": [1.0, 2.0, 3.0]}, {}, [1.0, 2.0, 3.0]),
        ({"start": "begin"}, {"begin": 4.0}, 4.0),
        ({"start": lambda block: block.begin}, {"begin": [4.0, 5.0, 6.0]}, [4.0, 5.0, 6.0]),
    ],
)
@pytest.mark.parametrize("shape", [(3,), 3, [3]])
def test_a_state_may_be_declared_with_its_shape(declared, given, start, shape):
    assert end_of(integrator(shape=shape, **declared)(name="s", **given)) == pytest.approx(0.5 * RATES + start)


def test_a_start_value_that_does_not_fit_the_shape_is_refused():
    with pytest.raises(ShapeError, match=r"s\.y: found a start value of shape \(2,\); .* \(3,\) as it is declared"):
        end_of(integrator(shape=(3,), start=[1.0, 2.0])(name="s"))


@pytest.mark.parametrize(
    ("declare", "text"),
    [
        (lambda: State(shape=(3,), like="u"), r"shape=\(3,\) and like='u'; expected one of them"),
        (lambda: State((3,)), r"found unit \(3,\); expected a text.* shape=\(3,\)"),
        (lambda: Input("m"), r"found shape 'm'; expected whole numbers.* unit='m'"),
        (lambda: Input(shape=(-1,)), r"found shape \(-1,\)"),
        (lambda: Output(shpae=(3,)), "Output has no argument 'shpae'. Did you mean 'shape'"),
        (lambda: State(initial=1.0), "State has no argument 'initial'"),
        (lambda: Input(minium=1.0), "Input has no argument 'minium'. Did you mean 'minimum'"),
    ],
)
def test_a_declaration_that_is_none_says_what_to_write(declare, text):
    with pytest.raises(DefinitionError, match=text):
        declare()


class Adds(Block):
    """y = a + b; b may stay unwired, and stands first."""

    b = Input(default=2.0)
    a = Input()
    y = Output()

    def output(self, t, x, u):
        return u.a + u.b


def test_as_many_signals_as_inputs_need_are_theirs_wherever_a_default_stands():
    one = Constant(value=1.0)

    def run(*args, **kwargs):
        return Diagram("d", Adds(name="adds")(*args, **kwargs).named("y")).simulate(0.1, step=0.1)["y"][-1]

    assert run(one) == run(a=one) == 3.0
    assert run(Constant(value=5.0), one) == run(Constant(value=5.0), a=one) == 6.0


def test_an_input_that_is_missing_is_named_and_one_with_a_default_is_not_asked_for():
    with pytest.raises(UnwiredInputError, match=r"nothing is wired to 'a'; expected adds\(a=…\)\."):
        Adds(name="adds")()


def test_a_default_is_no_place_for_an_injection():
    with pytest.raises(UnknownNameError, match=r"there is no signal 'adds\.b' .* Wire a Constant to it"):
        Diagram("d", Adds(name="adds")(Constant(value=1.0))).linearize(inputs="adds.b", step=0.1)


class Leaks(Block):
    """ẏ = u − k y, with the rate as an output where it is asked for, and a flow out where there is a hole."""

    hole: bool = parameter(default=False)
    with_rate: bool = parameter(default=False)
    u = Input()
    k = Input(only_if="hole")
    y = State(output=True)
    rate = Output(secondary=True, only_if=lambda block: block.with_rate)

    def slope(self, x, u):
        return u.u - u.k * x.y if self.hole else u.u

    def output(self, t, x, u):
        return self.slope(x, u)

    def derivative(self, t, x, u):
        return self.slope(x, u)


class Drains(Leaks):
    """The same with a further input."""

    v = Input()

    def slope(self, x, u):
        return super().slope(x, u) - u.v


def test_a_port_with_a_condition_is_one_of_those_blocks_alone_that_fulfil_it():
    one = Constant(value=1.0)
    run = Diagram("d", Leaks(hole=True, with_rate=True, name="tank")(one, one)).simulate(1.0, step=0.5)
    assert run["tank.y"] == pytest.approx(1.0 - np.exp(-run.t), abs=1e-6)
    assert run["tank.rate"] == pytest.approx(np.exp(-run.t), abs=1e-6)
    plain = Leaks(name="tank")
    assert list(plain.inputs) == ["u"]
    assert list(plain.outputs) == ["y"]
    assert Diagram("d", plain(one)).simulate(1.0, step=0.5)["tank.y"] == pytest.approx([0.0, 0.5, 1.0])
    with pytest.raises(AttributeError, match="tank: with these parameters it has no output 'rate'"):
        plain.rate.named("rate")


def test_a_class_below_has_the_conditional_ports_and_its_own():
    assert list(Drains(hole=True, name="d").inputs) == ["u", "k", "v"]
    assert list(Drains(name="d").inputs) == ["u", "v"]
    one = Constant(value=1.0)
    run = Diagram("d", Drains(name="tank")(one, Constant(value=3.0))).simulate(1.0, step=0.5)
    assert run["tank.y"] == pytest.approx([0.0, -1.0, -2.0])


def test_a_subclass_of_a_block_with_conditional_ports_has_its_own_input():
    class Biased(PID):
        bias = Input()

    assert list(Biased(kp=1.0, tracking=True).inputs) == ["r", "y", "actual", "bias"]


def test_a_condition_that_is_no_parameter_is_refused_where_it_is_declared():
    with pytest.raises(DefinitionError, match=r"Tank\.k: found only_if='hol'; .* Did you mean 'hole'"):

        class Tank(Block):
            hole: bool = parameter(default=False)
            k = Input(only_if="hol")
