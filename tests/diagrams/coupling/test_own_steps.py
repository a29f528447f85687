"""FMUs that state a fixed step of their own solver, and communication steps that are no multiples of it."""

import numpy as np
import pytest

from loopwright.blocks import Gain
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu
from support.closed_form import closed_form_fmu

TRUNCATES = "{ double n = floor(20.0 * h / 0.01 + 1e-9); h = n * 0.01 / 20.0; }"
"""Its solver takes whole steps of 0.01 s alone, and does not say that it stops short."""


@pytest.mark.parametrize(("T", "fits"), [(0.01, True), (0.03, True), (0.015, False), (0.004, False)])
@pytest.mark.parametrize("step", [None, "T"])
@pytest.mark.drawn(3)
def test_steps_that_are_no_multiples_of_the_fmus_own_are_told(tmp_path, T, fits, step):
    file = closed_form_fmu(
        tmp_path,
        3,
        "dx[0] = -3*x[0] + 2*u[0]; y[0] = 4*x[0];",
        attributes=' fixedInternalStepSize="0.01"',
        check=TRUNCATES,
        dependencies={"y1": "x1", "dx1": "x1 u1"},
    )

    @subsystem(sample_time=T)
    def controller(y):
        return Gain(gain=-1.0, name="k")(y)

    plant = Fmu(file, name="plant", interface="co_simulation")
    diagram = Diagram("d", plant(u1=controller(plant.y1) + 1.0))
    run = diagram.simulate(0.3, step=T if step else None, progress=False)
    told = [m for m in run.messages if m.startswith("plant:") and "fixedInternalStepSize" in m]
    assert len(told) == (not fits)
    A, x = np.exp(-3.0 * T), 0.0
    for _ in range(round(0.3 / T)):
        x = A * x + (1.0 - A) / 3.0 * 2.0 * (1.0 - 4.0 * x)
    assert (abs(run["plant.y1"][-1] - 4.0 * x) < 1e-6) == fits
