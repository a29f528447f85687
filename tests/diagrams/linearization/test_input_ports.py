"""Input ports as places of a linear model: an injection reaches that input alone. Oracles: transfer functions by hand."""

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, StateSpace, TransferFunction, UnknownNameError
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, dc_motor

S = 0.7j


def lag(name, T):
    return TransferFunction(numerator=[1.0], denominator=[T, 1.0], name=name)


def two_consumers(k=4.0):
    """Return r → (e = r − both) → fast and slow lag, both = fast + slow: one signal with two consumers in a loop."""
    fast, slow = lag("fast", 1.0), lag("slow", 5.0)
    e = Gain(gain=k, name="k")(Constant(value=0.0) - fast.y - slow.y).named("e")
    return Diagram("two", fast(e), slow(e))


def value(model):
    return complex(np.ravel(model.system(S))[0])


def test_an_injection_at_an_input_reaches_that_input_alone():
    model = two_consumers().linearize(inputs="fast.u", outputs="slow.y")
    # fast = F (e + d), slow = G e, e = −k (fast + slow): slow/d = −k G F/(1 + k (F + G))
    F, G, k = 1 / (S + 1), 1 / (5 * S + 1), 4.0
    assert model.inputs == ("fast.u",)
    assert value(model) == pytest.approx(-k * G * F / (1 + k * (F + G)), rel=1e-12)
    whole = two_consumers().linearize(inputs="e", outputs="slow.y")
    assert value(whole) == pytest.approx(G * (1 - k * (F + G) / (1 + k * (F + G))), rel=1e-12)


def test_an_input_that_is_opened_is_cut_for_that_block_alone():
    model = two_consumers().linearize(inputs="fast.u", outputs="fast.y", openings="fast.u")
    assert value(model) == pytest.approx(1 / (S + 1), rel=1e-12)
    # with the fast lag cut off, e = −k slow at the input, and what arrives there is measured
    arrives = two_consumers().linearize(inputs="fast.u", outputs="fast.u", openings="fast.u")
    F, G, k = 1 / (S + 1), 1 / (5 * S + 1), 4.0
    assert value(arrives) == pytest.approx(-k * F / (1 + k * G), rel=1e-12)
    assert arrives.outputs == ("fast.u",)


def test_an_input_of_one_entry_of_a_vector_has_that_entry():
    system = StateSpace(A=-np.eye(2), B=np.eye(2), C=np.eye(2), name="pair")
    after = Gain(gain=3.0, name="after")
    model = Diagram("part", after(system(Constant(value=np.ones(2)))[1])).linearize(inputs="after.u", outputs="after.y")
    assert value(model) == pytest.approx(3.0)
    both = Diagram("vector", system(Gain(gain=2.0)(Constant(value=np.ones(2))))).linearize(
        inputs="pair.u", outputs="pair.y"
    )
    assert both.inputs == ("pair.u[1]", "pair.u[2]")
    assert np.asarray(both.system(S)) == pytest.approx(np.eye(2) / (S + 1), rel=1e-12)


def test_inputs_in_sampled_subsystems_and_of_fmus():
    plant = Fmu(dc_motor.build(), name="plant")

    @subsystem(sample_time=0.01)
    def controller(y):
        return Gain(gain=-0.1, name="k")(y)

    port = next(iter(plant.inputs))
    speed = plant[next(name for name in plant.outputs if "speed" in name or "velocity" in name)]
    others = {name: Constant(value=0.0) for name in list(plant.inputs)[1:]}
    diagram = Diagram("motor", plant(controller(speed).named("u"), **others))
    one = diagram.linearize(inputs=f"plant.{port}", outputs="k.y")
    other = diagram.linearize(inputs="u", outputs="k.y")
    z = np.exp(0.3j)
    assert np.asarray(one.system(z)) == pytest.approx(np.asarray(other.system(z)), rel=1e-9)
    inside = diagram.linearize(inputs="controller.k.u", outputs="k.y")
    assert abs(inside.D[0, 0]) == pytest.approx(0.1)


def test_a_name_that_is_neither_is_refused_with_near_ones():
    with pytest.raises(UnknownNameError, match=r"there is no signal 'fast.v'"):
        two_consumers().linearize(inputs="fast.v")
