"""Discrete inputs of FMUs: their slopes in co-simulation, and what a model says where it has none."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Constant, Gain
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu
from loopwright.types import StepsOnly
from support.closed_form import closed_form_fmu

DT = 0.1


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
@pytest.mark.parametrize("interface", ["model_exchange", "co_simulation"])
@pytest.mark.drawn(2)
def test_the_slope_by_a_discrete_input_is_right_or_said_to_be_missing(tmp_path, interface, kind):
    depends = {"y1": "x1 u1", "dx1": "x1 u1"}
    equations = "dx[0] = -3*x[0] + 2*u[0]; y[0] = 4*x[0] + 5*u[0];"
    file = closed_form_fmu(tmp_path, 3, equations, of_input=kind, dependencies=depends)
    plant = Fmu(file, interface=interface, name="plant")
    model = plant.linear_model(inputs={"u1": 0.3}, interface="model_exchange")
    np.testing.assert_allclose(np.block([[model.A, model.B], [model.C, model.D]]), [[-3, 2], [4, 5]], atol=1e-9)

    @subsystem(sample_time=DT)
    def controller(r):
        return Gain(gain=-1.0, name="law")(r)

    diagram = Diagram("d", plant(u1=controller(Constant(value=0.0, name="r")()).named("u")))
    linear = diagram.linearize(inputs="u", outputs="plant.y1")
    held = expm(np.array([[-3.0, 2.0], [0.0, 0.0]]) * DT)[0]
    assert linear.A[0, 0] == pytest.approx(held[0], rel=1e-9)
    if interface == "model_exchange" and kind == "discrete":
        assert linear.B[0, 0] == 0.0
        (finding,) = linear.carried
        assert isinstance(finding, StepsOnly)
        assert (finding.block, finding.port, finding.source) == ("plant", "y1", "u1")
        assert "co_simulation" in str(finding)
    else:
        assert linear.B[0, 0] == pytest.approx(held[1], rel=1e-8)
        assert linear.findings == ()
