"""Limits confirmed by runs with the environment inside the plant, for every plant of the library with a force port."""

from dataclasses import replace

import numpy as np
import pytest

from loopwright.blocks import AdmittanceFilter, Line, OptionError, Reference
from loopwright.diagrams import Channel, ConfirmationError, Rig, experiments, fig3
from loopwright.diagrams.contact.confirmed_limits import measure_growth
from loopwright.diagrams.contact.moored_plant import LIBRARY, library_class
from loopwright.diagrams.paper.fig3_wires import IMPEDANCE_PAR, IMPEDANCE_PERP
from loopwright.fmus import Fmu, gantry, gantry_elastic, gantry_stiction

PATH = Line(start=(-1.0, 0.0), end=(1.0, 0.0))
PLANTS = {"gantry": gantry, "elastic": gantry_elastic, "stiction": gantry_stiction}
PUSH = {"stiction": 1e-9}
"""So little that the bristles hold."""


def contact(name, side, delay=0):
    start = {"position": (0.0, 0.0), "gravity": 0.0} | ({"deflection": (0.0, 0.0)} if name == "elastic" else {})
    plant = Fmu(PLANTS[name].build(), name="plant", start=start)
    model = gantry.nominal.replace(gravity=0.0)
    par = Channel(Reference(1.0, unit="m", name="eta_d"), AdmittanceFilter(**IMPEDANCE_PAR))
    perp = Channel(Reference(0.0, unit="m", name="xi_d"), AdmittanceFilter(**IMPEDANCE_PERP))
    return fig3(plant, PATH, par, perp, model=model, rig=Rig(delay=delay)).contact(direction=side)


CASES = [
    ("gantry", "perp", 0, "stiffness", {"damping": 10.0}),
    ("gantry", "par", 1, "stiffness", {}),
    ("gantry", "perp", 0, "mass", {"stiffness": 100.0}),
    ("gantry", "par", 1, "tool_mass", {"stiffness": 100.0}),
    ("elastic", "perp", 0, "stiffness", {"damping": 10.0}),
    ("elastic", "par", 1, "mass", {"stiffness": 100.0}),
    ("stiction", "perp", 0, "stiffness", {"damping": 10.0}),
]


@pytest.mark.parametrize(
    ("name", "side", "delay", "vary", "held"),
    [pytest.param(*case, marks=[pytest.mark.slow]) for case in CASES],
)
def test_a_limit_holds_in_the_nonlinear_run(name, side, delay, vary, held):
    here = contact(name, side, delay)
    limit = here.stability_limit(vary, **held)
    found = here.confirm(limit, push=PUSH.get(name, 1e-6))
    for trial, factor in zip(found.trials, (0.97, 1.03), strict=True):
        assert trial.value == factor * limit.value
        assert trial.measured == pytest.approx(trial.predicted, abs=0.02 * abs(trial.predicted) + 2e-3)
        assert (trial.measured > 0) is (factor > 1)
    assert found.below.predicted <= limit.growth_below + 1e-9  # other modes may decay more slowly there
    assert found.above.predicted == pytest.approx(limit.growth_above, rel=1e-6)
    assert "inside the plant" in str(found)


def moved(here, limit, factor):
    """A wrong limit with the growth rates that the contact's model has there, as if it were its own."""
    value = factor * limit.value
    below, above = (here.loop(limit.vary, **limit.environment).growth_at(f * value) for f in (0.97, 1.03))
    return replace(limit, value=value, growth_below=below, growth_above=above)


@pytest.mark.slow
def test_a_limit_that_is_none_is_refuted():
    here = contact("gantry", "perp")
    limit = here.stability_limit("stiffness", damping=10.0)
    with pytest.raises(ConfirmationError, match=r"stiffness .* is refuted: growth rates in 1/s .* expected"):
        here.confirm(moved(here, limit, 1.2))


@pytest.mark.slow
def test_sources_stand_still_in_the_runs():
    here = experiments.compliance().diagram.contact(direction="perp")  # its set point steps at 1 s
    limit = here.stability_limit("stiffness", damping=10.0)
    assert here.confirm(limit).above.fastest < 1e-5


def test_what_cannot_be_confirmed_says_why():
    here = contact("gantry", "perp")
    limit = here.stability_limit("stiffness", damping=10.0)
    with pytest.raises(OptionError, match="found a limit of inf N/m; expected a finite one"):
        here.confirm(replace(limit, value=np.inf))
    with pytest.raises(OptionError, match="push: found 0"):
        here.confirm(limit, push=0)


@pytest.mark.slow
def test_a_plant_of_the_library_in_model_exchange_is_tried_with_the_environment_in_the_solver():
    made = experiments.compliance(plant=gantry.build()).diagram
    here = made.replace(plant=made["plant"].replace(interface="model_exchange")).contact()
    found = here.confirm(here.stability_limit())
    assert "in the solver" in found.method.value
    for trial in found.trials:
        assert trial.measured == pytest.approx(trial.predicted, abs=0.01 * abs(trial.predicted))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["inside", "held"])
@pytest.mark.parametrize("side", ["par", "perp"])
def test_a_limit_under_a_static_force_on_a_curved_path_holds(side, method):
    made = experiments.compliance().diagram.replace({"free_space.value": (3.0, 1.5)})
    here = made.contact(direction=side, at=made.operating_point(30.0))  # the steps are over, and the robot rests
    started = experiments.compliance().diagram.contact(direction=side)
    moved = here.point.values["plant.position"] - started.point.values["plant.position"]
    assert np.linalg.norm(moved) > 0.05
    limit = here.stability_limit(damping=10.0)
    assert abs(limit.value / started.stability_limit(damping=10.0).value - 1.0) > 0.01
    found = here.confirm(limit, method=method)
    for trial in found.trials:
        assert trial.measured == pytest.approx(trial.predicted, abs=0.01 * abs(trial.predicted) + 1e-3)
        assert trial.fastest < 1e-5  # it was at rest: the runs begin at the point


@pytest.mark.slow
def test_plants_of_the_library_are_known_by_their_models_and_parameters():
    assert set(LIBRARY) == {"gantry", "gantry_elastic", "gantry_stiction", "scara"}
    assert library_class(Fmu(gantry_elastic.build(), name="plant")) is LIBRARY["gantry_elastic"]
    assert library_class(gantry.nominal) is LIBRARY["gantry"]


@pytest.mark.parametrize("sigma", [-0.3, 0.0, 0.2, 25.0])
@pytest.mark.parametrize("omega", [0.0, 80.0, np.pi / 1e-3])
def test_growth_is_measured_beside_slow_motion(sigma, omega):
    t = np.arange(0.0, 3.0, 1e-3)
    signal = np.exp(sigma * t) * np.cos(omega * t) + (0.01 * np.cos(2.0 * t) if omega else 0.0)
    assert measure_growth(t, signal, omega, 0.5, 1.0) == pytest.approx(sigma, abs=2e-4, rel=1e-3)
