"""A diagram and the wired one that it holds: results hand out the user's own object, of the user's own class."""

import gc
import pickle

import pytest

from loopwright.blocks import Gain, Integrator
from loopwright.diagrams import Diagram


class Tank(Diagram):
    """A kind of diagram that a user has derived."""

    contact_port = "tank.u"


def make(kind=Tank):
    level = Integrator(name="level", initial_value=1.0)
    drain = Gain(gain=-2.0, name="drain")
    return kind("tank", level(drain(level.y).named("flow")))


def test_results_hand_out_the_very_diagram_that_they_were_made_of():
    diagram = make()
    with diagram.simulation(step=0.5) as simulation:
        assert simulation.diagram is diagram
    assert diagram.simulate(0.5, step=0.5, progress=False).diagram is diagram
    assert diagram.linearize().diagram is diagram


def test_a_diagram_that_was_let_go_is_shown_by_one_of_its_class():
    model = make().linearize()
    gc.collect()
    again = model.diagram
    assert type(again) is Tank
    assert model.diagram is again
    assert again["drain"].gain == -2.0
    assert again.linearize().A.tolist() == [[-2.0]]


@pytest.mark.parametrize("kind", [Diagram, Tank])
def test_variants_and_pickles_are_of_the_same_class(kind):
    diagram = make(kind)
    variants = (diagram.replace({"drain.gain": -3.0}), diagram.continuous(), diagram.sampled(0.1))
    for variant in (*variants, pickle.loads(pickle.dumps(diagram))):
        assert type(variant) is kind
        assert variant.wired.contact_port == kind.contact_port


def test_a_users_function_gets_the_users_diagram():
    seen = []

    def gain(diagram):
        seen.append(diagram)
        return abs(diagram["drain"].gain)

    found = make().worst_case({"drain.gain": (-3.0, -1.0)}, quantity=gain, count=3, starts=0)
    assert {type(diagram) for diagram in seen} == {Tank}
    assert type(found.diagram) is Tank
    assert found.base["drain"].gain == -2.0
    assert found.diagram["drain"].gain == found.parameters["drain.gain"]
