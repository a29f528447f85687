"""A state of an FMU that its initialization computes from another one moves with it where a step is tried.

A vendor's drivetrain starts one of its two inertias at rest: its relative speed follows from the other's speed.
"""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Gain
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu
from loopwright.frequency import margins
from support.misstated import A, B, misstated_fmu

T = 0.02
FOLLOWS = "int fmi{fmi}ExitInitializationMode(void *p) {{ instance *c = p; c->v = -3.0 * c->x; return 0; }}\n"
DESCRIBED = {
    2: (
        'name="v" valueReference="2" causality="output" variability="continuous" initial="exact"><Real start="0"/>',
        'name="v" valueReference="2" causality="output" variability="continuous" initial="calculated"><Real/>',
    ),
    3: (
        'name="v" valueReference="2" causality="output" variability="continuous" initial="exact" start="0"/>',
        'name="v" valueReference="2" causality="output" variability="continuous" initial="calculated"/>',
    ),
}
HELD = expm(T * np.block([[A, B], [np.zeros((1, 3))]]))
F, G = HELD[:2, :2], HELD[:2, 2:]


@pytest.fixture(scope="module", params=[2, 3])
def model(request, cache, tmp_path_factory):
    fmi = request.param
    changes = [("static double *at(", FOLLOWS.format(fmi=fmi) + "static double *at("), DESCRIBED[fmi]]
    plant = Fmu(misstated_fmu(tmp_path_factory.mktemp("follows"), fmi, changes), name="plant")

    @subsystem(sample_time=T)
    def control(v):
        return Gain(gain=-5.0, name="damper")(v).named("force")

    return Diagram("spring", plant(u=control(plant.v))).linearize()


def test_the_model_of_a_step_is_that_of_the_equations(model):
    assert model.states == ("plant.x", "plant.v")
    np.testing.assert_allclose(model.A, F + G @ np.array([[0.0, -5.0]]), atol=1e-9)
    assert model.uncertainty < 1e-6  # 0.4 of the largest entry where v was taken to stay as x was moved


def test_a_sound_loop_has_margins(model):
    """L = 5 (0 1) (z − F)⁻¹ G: its gain margin is that of the closed loop's eigenvalues."""
    found = margins(model.loop("force")).gain_margin_high.value
    for factor, stable in ((1.0 - 1e-6, True), (1.0 + 1e-6, False)):
        closed = F + G @ np.array([[0.0, -5.0 * found * factor]])
        assert bool(np.max(np.abs(np.linalg.eigvals(closed))) < 1.0) is stable
