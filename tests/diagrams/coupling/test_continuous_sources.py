"""FMUs behind blocks in continuous time: the inputs of a communication step."""

from __future__ import annotations

import numpy as np
import pytest

from loopwright.blocks import Constant, Integrator, StateSpace
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, build

STEP = 0.1


@pytest.fixture(scope="module")
def lag():
    block = StateSpace(A=[[-1.0]], B=[[1.0]], C=[[1.0]], D=[[0.0]])
    return build(block, name="held_lag", internal_step=1e-3)


def stepped(inputs):
    """Return the outputs of y' = u - y with u held over each step."""
    a, y = np.exp(-STEP), [0.0]
    for u in inputs:
        y.append(a * y[-1] + (1.0 - a) * u)
    return y


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.drawn(1)
def test_a_ramp_is_held_from_the_beginning_of_a_step_or_from_its_end(lag, compiled):
    ramp = Integrator(name="ramp")(Constant(value=(1.0,)))
    diagram = Diagram("d", Fmu(lag, name="plant")(ramp))
    times = STEP * np.arange(11)
    for coupling, held in (("jacobi", times[:-1]), ("gauss_seidel", times[1:])):
        run = diagram.simulate(1.0, step=STEP, coupling=coupling, compile=compiled, progress=False)
        np.testing.assert_allclose(run["plant.y"][:, 0], stepped(held), atol=1e-10)
        assert compiled == (run.tier == "compiled") or coupling != "jacobi"


@pytest.mark.parametrize("compiled", [False, True])
def test_a_run_is_that_of_the_linear_model_and_goes_on_from_what_was_saved(lag, compiled):
    plant = Fmu(lag, name="plant")
    diagram = Diagram("d", plant(Integrator(name="c")(Constant(value=(1.0,)) - plant.y)))
    model = diagram.linearize(step=STEP)
    x, expected = np.zeros(2), [0.0]
    offset = np.array([STEP, 0.0])  # the constant, integrated over a step
    for _ in range(20):
        x = model.A @ x + offset
        expected.append(x[1])
    run = diagram.simulate(2.0, step=STEP, compile=compiled, progress=False)
    np.testing.assert_allclose(run["plant.y"][:, 0], expected, atol=1e-9)
    half = diagram.simulate(1.0, step=STEP, compile=compiled, progress=False)
    rest = diagram.simulate(1.0, step=STEP, compile=compiled, progress=False, start=half.final_state)
    np.testing.assert_allclose(rest["plant.y"][:, 0], expected[10:], atol=1e-9)
