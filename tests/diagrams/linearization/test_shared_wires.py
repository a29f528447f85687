"""Loops at wires that also feed a model of the controller's own: a Smith predictor, an observer; by hand."""

import numpy as np
import pytest

from loopwright.blocks import Gain, Integrator, TransferFunction, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.linearization import ParallelWays, SharedCut
from loopwright.frequency import margins
from support.predictors import DEAD, A, B, K, T, observed, observed_by_hand, smith, smith_by_hand


def at(system, w):
    return complex(system(np.exp(1j * w * T)))


def test_the_loop_of_a_smith_predictor_is_that_at_the_plants_input():
    """With a model that is right, the cut for all consumers shows C G₀: no dead time at all."""
    for gain, dead in ((1.0, DEAD), (1.3, DEAD), (1.0, DEAD + 2)):
        model = smith(gain, dead).linearize()
        at_plant, everywhere = smith_by_hand(gain, dead)
        one, whole = model.loop("u", to="plant.u"), model.loop("u")
        for w in (0.05, 0.3, 2.0):
            assert one(np.exp(1j * w * T)) == pytest.approx(at(at_plant, w), rel=1e-4)
            assert whole(np.exp(1j * w * T)) == pytest.approx(at(everywhere, w), rel=1e-4)
        assert one.findings == ()
        assert whole.findings == (SharedCut("controller.u", ("plant.u",), ("controller.model.u",)),)
        said = str(margins(whole))
        assert "the cut at 'controller.u' also takes controller.model.u, the controller's own way back" in said
        assert "loop('controller.u', to='plant.u')" in said


def test_the_loop_of_an_observer_is_that_at_the_plants_input():
    """Behind u the estimate is cut, too: there L = K (s I − A)⁻¹ B, that of the states themselves."""
    model = observed().linearize()
    one, whole = model.loop("u", to="plant.u"), model.loop("u")
    for w in (0.3, 2.0, 11.0):
        assert one(1j * w) == pytest.approx(observed_by_hand(1j * w), rel=1e-10)
        states = complex((K @ np.linalg.solve(1j * w * np.eye(2) - A, B)).item())
        assert whole(1j * w) == pytest.approx(states, rel=1e-10)
    assert [type(f) for f in whole.findings] == [SharedCut]
    assert whole.findings[0].to == ("plant.u",)
    assert one.findings == ()
    assert margins(whole).phase_margin_deg.findings == whole.findings


def test_blocks_side_by_side_are_equals_and_both_ways_are_named():
    """Nothing says which of two state spaces is the plant: the numbers count, and a line says what was cut."""
    whole = observed(boxed=False).linearize().loop("u")
    assert [type(f) for f in whole.findings] == [ParallelWays]
    found = margins(whole)
    assert found.phase_margin_deg.findings == ()
    assert "– 'u' is cut for plant.u, u_and_plant.u1, which all lead back to it" in str(found)


def test_the_parallel_parts_of_a_plant_are_no_way_of_the_controllers_own():
    """A sampled law drives two lags: both are the plant."""
    fast = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="fast")
    slow = TransferFunction(numerator=[1.0], denominator=[5.0, 1.0], name="slow")

    @subsystem(sample_time=T)
    def controller(y):
        return Gain(gain=-0.5, name="law")(y).named("u")

    u = controller(fast.y + slow.y)
    whole = Diagram("parts", fast(u), slow(u)).linearize().loop("u")
    assert [type(f) for f in whole.findings] == [ParallelWays]
    plain = [1.0 - np.exp(-T), 1.0 - np.exp(-T / 5.0)]
    z = np.exp(0.3j)
    by_hand = 0.5 * (plain[0] / (z - np.exp(-T)) + plain[1] / (z - np.exp(-T / 5.0)))
    assert whole(z) == pytest.approx(by_hand, rel=1e-10)


@pytest.mark.parametrize("kind", [Integrator, TransferFunction])
def test_a_measurement_that_several_loops_read_is_one_wire(kind):
    """The angle of a drive, in its loop of position and in that of speed: it was cut ahead of each, too."""
    given = {} if kind is Integrator else {"numerator": [1.0], "denominator": [1.0, 0.0]}
    angle = kind(name="angle", **given)
    outer = subsystem(sample_time=T, name="outer")(lambda y: Gain(gain=-0.4)(y).named("wish"))
    inner = subsystem(sample_time=T, name="inner")(lambda wish, y: (wish - 0.3 * y + 0.1 * UnitDelay()(y)).named("u"))
    u = inner(outer(angle.y), angle.y)
    whole = Diagram("drive", angle(u).named("angle")).linearize().loop("angle")
    assert whole.findings == ()
    z = np.exp(0.3j)
    assert whole(z) == pytest.approx((0.7 - 0.1 / z) * T / (z - 1.0), rel=1e-10)


def test_a_way_that_leaves_the_subsystem_is_no_way_of_its_own():
    """A reference of an inner loop also feeds a filter in its subsystem, whose way back is through the plant."""
    speed = Integrator(name="speed")

    @subsystem(sample_time=T)
    def controller(y):
        wish = Gain(gain=-0.4, name="outer")(y).named("wish")
        late = UnitDelay(initial_value=0.0, name="late")(wish)
        return wish, late

    wish, late = controller(speed.y)
    whole = Diagram("cascade", speed(0.5 * wish + 0.5 * late)).linearize().loop("wish")
    assert not [f for f in whole.findings if isinstance(f, SharedCut)]
    z = np.exp(0.3j)
    assert whole(z) == pytest.approx(0.4 * T * (0.5 + 0.5 / z) / (z - 1.0), rel=1e-10)
