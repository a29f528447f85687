"""Frequency responses that are measured at some consumers of a wire alone, against loops by hand."""

import numpy as np
import pytest

from loopwright.blocks import UnknownNameError
from support.predictors import T, observed, observed_by_hand, smith, smith_by_hand


@pytest.mark.parametrize("at", [pytest.param(0.0, marks=pytest.mark.slow), "point"])
def test_the_loop_at_the_plants_input_of_a_smith_predictor(at):
    diagram = smith()
    at = diagram.operating_point(0.0) if at == "point" else at
    found = diagram.frequency_response("u", [0.3, 1.0], amplitude=1e-3, to="plant.u", at=at)
    exact = smith_by_hand()[0](np.exp(1j * T * found.omega))
    np.testing.assert_allclose(np.ravel(found.L.frdata), exact, rtol=1e-5)
    model = diagram.linearize()
    assert found.compare(model) < 1e-5
    assert found.compare(model, of="S") < 1e-5
    assert found.compare(model, of="T") < 1e-5
    assert (found.wire, found.to) == ("u", ("plant.u",))
    assert found.diagram is diagram
    every = diagram.frequency_response("u", [0.3, 1.0], amplitude=1e-3)
    np.testing.assert_allclose(np.ravel(every.L.frdata), smith_by_hand()[1](np.exp(1j * T * every.omega)), rtol=1e-5)


def test_the_loop_at_the_plants_input_of_an_observer_in_continuous_time():
    diagram = observed(boxed=False)
    found = diagram.frequency_response("u", [2.0], amplitude=1e-3, to=["plant.u"])
    assert found.L.frdata.item() == pytest.approx(observed_by_hand(1j * found.omega[0]), rel=1e-5)
    with pytest.raises(UnknownNameError, match="there is no input 'plant.v'"):
        diagram.frequency_response("u", [2.0], amplitude=1e-3, to="plant.v")
