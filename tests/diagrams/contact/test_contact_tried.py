"""Limits of plants that the reduced loop refuses, tried in the nonlinear co-simulation with the environment inside."""

from functools import cache

import numpy as np
import pytest

from loopwright.diagrams import experiments
from loopwright.fmus import build, gantry_elastic, gantry_stiction
from support.contact import ROUGH, deviation, diagram, loop, measured_growth, moor, moored_start, parameters

PLANTS = {
    "elastic": (gantry_elastic, {"deflection": (0.0, 0.0)}, 1e-6),
    "stiction": (gantry_stiction, {}, 1e-9),  # so little that the bristles hold
}
TIMES = {"stiffness": (3.5, 1.0, 1.0), "mass": (0.2, 0.2, 0.2)}
"""Time of the first window, distance to the second, and length of a window, in s."""
STEP = 1e-4
"""Internal step of the FMUs in s: at 1 ms, that of the bristles alone shifts growth rates by 0.03 1/s."""


@cache
def moored_file(name):
    model = PLANTS[name][0]
    return build(moor(type(model.nominal))(), name=f"moored_{name}", internal_step=STEP)


def own_parameters(model, made):
    """Start values that the plant has in common with the gantry of the reduced model."""
    known = parameters(made.true_plant)
    return {n: v for n, v in known.items() if n in model.nominal.parameters}


@cache
def contact(name, side, delay):
    model, start, _ = PLANTS[name]
    made = loop(side, ROUGH, delay=delay)
    at = made.path.to_plane(made.eta, made.xi)
    start = {**start, "position": at, **own_parameters(model, made)}
    return diagram(made, start, file=model.build()).contact(direction=side)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.97, 1.03])
@pytest.mark.parametrize(
    ("name", "side", "delay", "vary", "held"),
    [
        ("elastic", "perp", 0, "stiffness", {"damping": 10.0}),
        ("elastic", "perp", 1, "stiffness", {}),
        ("elastic", "par", 0, "stiffness", {"damping": 10.0}),
        ("elastic", "perp", 1, "mass", {"stiffness": 100.0}),
        ("elastic", "par", 1, "mass", {"stiffness": 100.0}),
        ("stiction", "perp", 0, "stiffness", {"damping": 10.0}),
    ],
)
def test_the_co_simulation_grows_as_the_contact_predicts(name, side, delay, vary, held, factor):
    here = contact(name, side, delay)
    limit = here.stability_limit(vary, **held)
    value = factor * limit.value
    A = here.loop(vary, **held).close(value).A
    rates = np.log(np.linalg.eigvals(A).astype(complex) + 1e-300) / 1e-3
    predicted = rates[np.argmin(np.abs(rates.imag - limit.frequency))].real  # of the mode that breaks
    made = loop(side, ROUGH, delay=delay)
    model, start, push = PLANTS[name]
    gantry_only = set(parameters(made.true_plant)) - set(own_parameters(model, made))
    start = {**start, **moored_start(made, push, **held, **{vary: value})}
    start = {n: v for n, v in start.items() if n not in gantry_only}
    first, span, window = TIMES[vary]
    run = diagram(made, start, file=moored_file(name)).simulate(
        first + span + window + 0.01, progress=False, record=["plant.velocity"], states=False
    )
    signal = deviation(made, run, "velocity")
    if vary == "mass":
        signal = np.diff(signal, 2)  # the mode is fast, and hardly moves the robot
    fastest = np.max(np.abs(deviation(made, run, "velocity")))
    assert fastest < 1e-5  # far below the friction's width, 1e-2 m/s; at 500 rad/s that is 20 nm, and the bristles hold
    measured = measured_growth(signal, 1e-3, first, span, window)
    assert measured == pytest.approx(predicted, abs=2e-3)
    assert (measured > 0.0) == (factor > 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("side", "yields"), [("par", 0.0678180), ("perp", 0.005)])
def test_a_static_force_turns_with_the_frame_of_a_curved_path(side, yields):
    made = experiments.compliance().diagram.replace({"free_space.value": (3.0, 1.5)})
    point = made.operating_point(30.0)  # the steps are over, and the robot rests under the force
    here = made.contact(direction=side, at=point)

    def rest(change):
        force = np.array([3.0, 1.5]) + change * here.direction
        return made.replace({"free_space.value": tuple(force)}).trim(at=point).values["plant.position"]

    moved = here.direction @ (rest(1e-3) - rest(-1e-3)) / 2e-3
    assert moved == pytest.approx(yields, rel=1e-5)
    found = here.admittance(1e-3)
    assert (found.rendered / 1e-3j).real == pytest.approx(moved, rel=1e-6)  # m/N
    assert (found.target / 1e-3j).real == pytest.approx({"par": 0.0970664, "perp": 0.005}[side], rel=1e-5)
