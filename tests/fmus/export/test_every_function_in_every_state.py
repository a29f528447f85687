"""Exported FMUs under a C program that calls every function in every state, with right and wrong arguments."""

import pytest

from loopwright import build
from loopwright.blocks import Gain
from loopwright.diagrams import subsystem
from loopwright.fmus import build_fmu
from support import exported_diagrams
from support.exported import bouncing_ball, mass_spring_damper
from support.walked import walk

pytestmark = pytest.mark.slow


@subsystem
def late(u):
    """Two rates, one of which begins later."""
    first = subsystem(sample_time=0.02, offset=0.01, name="first")(lambda v: Gain(gain=2.0)(v))
    return subsystem(sample_time=0.01, name="second")(lambda v: Gain(gain=3.0)(v))(first(u)).named("y")


MODELS = {
    "controller": lambda fmi: build(exported_diagrams.controller, fmi=fmi, clocks=True),
    "two rates": lambda fmi: build(late, fmi=fmi, clocks=True),
    "rates without inputs": lambda fmi: build(exported_diagrams.sampled(), fmi=fmi),
    "thermostat": lambda fmi: build(exported_diagrams.continuous(), fmi=fmi),
    "plant": lambda fmi: build_fmu(mass_spring_damper(), fmi=fmi),
    "plant with events": lambda fmi: build_fmu(bouncing_ball(), fmi=fmi),
}


@pytest.mark.parametrize("fmi", [3, 2])
@pytest.mark.parametrize("model", MODELS)
def test_every_function_in_every_state(model, fmi, tmp_path):
    found = walk(MODELS[model](fmi), tmp_path / "fmu")
    checks, messages, failures = (int(text.split()[0]) for text in found.split(", "))
    assert failures == 0
    assert checks > 500
    assert messages > 200
