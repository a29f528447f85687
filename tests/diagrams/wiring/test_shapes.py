"""Shapes are compared at both ends of every wire, whatever the blocks are called and in which order they are looked at."""

import itertools

import numpy as np
import pytest

from loopwright.blocks import Block, Constant, Gain, Input, Output, Saturation, ShapeError, Sum, UnitDelay
from loopwright.diagrams import Diagram, subsystem


class Wants(Block):
    """Wants a pair."""

    u = Input(shape=(2,))
    y = Output()

    def output(self, t, x, u):
        return u.u[0] + u.u[1]


ORDERS = pytest.mark.parametrize("name", ["a_gain", "z_gain"])


@ORDERS
def test_a_number_wired_to_a_pair_is_refused_whatever_the_name(name):
    with pytest.raises(ShapeError, match=rf"^m\.u: {name}\.y is a scalar; expected \(2,\)"):
        Diagram("d", Wants(name="m")(Gain(gain=2.0, name=name)(Constant(value=1.0, name="n"))))


@ORDERS
def test_a_vector_of_another_length_is_refused_whatever_the_name(name):
    with pytest.raises(ShapeError, match=rf"^m\.u: {name}\.y has shape \(3,\); expected \(2,\)"):
        Diagram("d", Wants(name="m")(Gain(gain=2.0, name=name)(Constant(value=(1.0, 2.0, 3.0), name="n"))))


@ORDERS
def test_a_part_of_a_vector_is_compared_by_its_own_shape(name):
    def build(part):
        gain = Gain(gain=2.0, name=name)(Constant(value=(1.0, 2.0, 3.0), name="n"))
        return Diagram("d", Wants(name="m")(gain.y[part]).named("w"))

    run = build(slice(1, 3)).simulate(0.1, step=0.1, progress=False)
    assert run["w"].tolist() == [10.0, 10.0]
    with pytest.raises(ShapeError, match=rf"^m\.u: {name}\.y\[3\] is a scalar; expected \(2,\)"):
        build(2)


@ORDERS
def test_a_number_is_refused_across_a_border_too(name):
    @subsystem(sample_time=0.1)
    def box(u):
        return Wants(name="m")(u)

    with pytest.raises(ShapeError, match=rf"^box\.m\.u: {name}\.y is a scalar; expected \(2,\)"):
        Diagram("d", box(Gain(gain=2.0, name=name)(Constant(value=1.0, name="n"))))


@ORDERS
def test_a_number_is_refused_in_a_loop_too(name):
    @subsystem(sample_time=0.1)
    def box(r):
        wants = Wants(name="m")
        gain = Gain(gain=0.5, name=name)(UnitDelay(name="delay", initial_value=0.0)(Sum(name="s")(wants.y, r)))
        wants(gain)
        return gain

    with pytest.raises(ShapeError, match=rf"^box\.m\.u: box\.{name}\.y is a scalar; expected \(2,\)"):
        Diagram("d", box(Constant(value=1.0, name="n")))


# --- a loop's shape does not depend on names --------------------------------------------------------------------------


def accumulator(names, start, signal):
    """A loop without a declared shape but the delay's start: s = delay + signal, limited and scaled on the way."""
    total, limited, delayed = names

    @subsystem(sample_time=0.1)
    def box(u):
        delay = UnitDelay(initial_value=start, name=delayed)
        s = Sum(name=total)(delay.y, u)
        delay(Saturation(limit=3.5, name=limited)(s))
        return s

    return Diagram("d", box(Constant(value=signal, name="n")).named("w"))


@pytest.mark.parametrize("names", list(itertools.permutations("abz")), ids="".join)
@pytest.mark.parametrize(("start", "signal"), [(0.0, 1.0), ((0.0, 1.0), (1.0, 2.0))], ids=["number", "pair"])
def test_a_loop_has_one_shape_whatever_its_blocks_are_called(names, start, signal):
    run = accumulator(names, start, signal).simulate(0.3, progress=False)
    state, rows = np.array(start), []
    for _ in range(4):
        rows.append(state + signal)
        state = np.clip(state + signal, -3.5, 3.5)
    assert run["w"].shape == (4, *np.shape(start))
    np.testing.assert_array_equal(run["w"], rows)


@pytest.mark.parametrize("names", list(itertools.permutations("abz")), ids="".join)
def test_a_loop_whose_shapes_disagree_is_refused_whatever_its_blocks_are_called(names):
    total, widening, delayed = names

    @subsystem(sample_time=0.1)
    def box(u):
        delay = UnitDelay(initial_value=0.0, name=delayed)
        s = Sum(name=total)(delay.y, u)
        delay(Gain(gain=np.ones((3, 2)), name=widening)(s))  # three numbers, to be added to a pair in the next tick
        return s

    where = rf"^box\.{total}\.u1: box\.{delayed}\.y has shape \(3,\), where the loop that it closes asks for \(2,\)"
    with pytest.raises(ShapeError, match=where):
        Diagram("d", box(Constant(value=(1.0, 2.0), name="n")))
