"""The place at which a worst case and sensitivities cut a loop: at the plant's input, where the wire also feeds the controller's model."""

import numpy as np
import pytest

from loopwright.blocks import OptionError, UnknownNameError
from loopwright.diagrams import Requirements
from support.predictors import T, observed, smith, smith_by_hand

Z = np.exp(1j * T * np.linspace(1e-3, np.pi / T, 20001))
FEW = {"count": 2, "starts": 0}


def peak(values):
    return float(np.max(1.0 / np.abs(1.0 + values)))


@pytest.mark.slow
def test_without_a_place_it_is_the_plants_input_as_in_a_report():
    at_plant, everywhere = (peak(system(Z)) for system in smith_by_hand())
    found = smith().worst_case({"controller.pi.kp": (1.999, 2.0)}, "u", quantity="ms", **FEW)
    assert found.nominal[0].value == pytest.approx(at_plant, rel=1e-3)
    assert found.worst.loop == ("u → plant.u",)
    named = smith().worst_case({"controller.pi.kp": (1.999, 2.0)}, "u", to="plant.u", quantity="ms", **FEW)
    assert named.nominal[0].value == found.nominal[0].value
    every = smith().worst_case({"controller.pi.kp": (1.999, 2.0)}, "u", to=[], quantity="ms", **FEW)
    assert every.nominal[0].value == pytest.approx(everywhere, rel=1e-3)
    assert every.worst.loop == ("u",)


def test_requirements_without_a_place_have_the_plants_input_too():
    at_plant = peak(smith_by_hand()[0](Z))
    found = smith().worst_case({"controller.pi.kp": (1.999, 2.0)}, "u", requirements=Requirements(ms=1.7), **FEW)
    assert found.nominal[0].value == pytest.approx(at_plant, rel=1e-3)
    assert found.nominal[0].goodness < 0.0


@pytest.mark.slow
def test_an_operating_point_serves_the_diagram_with_the_cut():
    diagram = smith()
    at = diagram.operating_point(0.0)
    found = diagram.worst_case({"controller.pi.kp": (1.999, 2.0)}, "u", quantity="ms", at=at, **FEW)
    assert found.nominal[0].value == pytest.approx(peak(smith_by_hand()[0](Z)), rel=1e-3)
    assert found.confirm().agrees


@pytest.mark.slow
def test_sensitivities_are_those_at_the_plants_input_too():
    """The slope by the plant's gain is that of differences by hand."""
    ms = [[peak(system(Z)) for system in smith_by_hand(gain)] for gain in (1.299, 1.3, 1.301)]
    at_plant, everywhere = zip(*ms, strict=True)
    for to, (low, here, high) in ((None, at_plant), ("plant", at_plant), ([], everywhere)):
        row = smith().sensitivities("u", ["plant.numerator[1]"], to=to)["plant.numerator[1]", "ms"]
        assert row.number.value == pytest.approx(here, rel=1e-6)
        assert row.slope.value == pytest.approx((high - low) / 0.002, rel=1e-3)


def test_what_can_not_be_cut_is_refused_by_name():
    box = {"law.gain": (0.9, 1.1)}
    with pytest.raises(OptionError, match="to: found it with 2 wires; expected it for one wire. Give one, loop='u'"):
        observed(boxed=False).worst_case(box, ["u", "plant.y"], to="plant.u", **FEW)
    with pytest.raises(OptionError, match="to: found it with requirements; expected it for one wire"):
        observed(boxed=False).worst_case(box, "u", to="plant.u", requirements=Requirements(ms=2.0), **FEW)
    with pytest.raises(UnknownNameError, match="there is no input 'plant.v'"):
        observed(boxed=False).worst_case(box, "u", to="plant.v", **FEW)
