"""Inputs of an FMU that the user gives in ``start``: they need no wire, and a run says so once."""

import numpy as np
import pytest

from loopwright.blocks import Constant, UnwiredInputError
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, gantry
from support.scalar_ports import RATE, RENAME, levels, scalar_ports

PUMP, INFLOW = -1.0, 3.0
SAID = "plant: nothing is wired to its input pump, which keeps its value of start="
TIERS = pytest.mark.parametrize("compiled", [False, True], ids=["interpreted", "compiled"])


@pytest.fixture(scope="module")
def file(cache, tmp_path_factory):
    return scalar_ports(tmp_path_factory.mktemp("scalars"))


def held(file, **options):
    plant = Fmu(file, name="plant", start={"pump": PUMP}, **options)
    return Diagram("d", plant(inflow=Constant(value=INFLOW, name="inflow")))


@pytest.mark.parametrize("interface", ["co_simulation", "model_exchange"])
@pytest.mark.parametrize("isolate", [False, True], ids=["here", "isolated"])
@TIERS
@pytest.mark.drawn(3)
def test_it_keeps_its_value_and_the_run_says_so_once(file, interface, isolate, compiled):
    diagram = held(file, interface=interface, isolate=isolate)
    run = diagram.simulate(1.0, step=0.1, rtol=1e-9, atol=1e-11, progress=False, compile=compiled)
    want = levels(run.t, (INFLOW, PUMP))
    np.testing.assert_allclose(run["plant.low"], want[:, 0], rtol=0, atol=1e-7)
    np.testing.assert_allclose(run["plant.high"], want[:, 1], rtol=0, atol=1e-7)
    assert [m for m in run.messages if "nothing is wired" in m] == [SAID]


def test_what_is_wired_is_not_said(file):
    plant = Fmu(file, name="plant", start={"pump": PUMP})
    run = Diagram("d", plant(inflow=INFLOW, pump=0.5)).simulate(0.3, step=0.1, progress=False)
    np.testing.assert_allclose(run["plant.high"], levels(run.t, (INFLOW, 0.5))[:, 1], rtol=1e-13)
    assert not run.messages


def test_the_start_value_of_the_fmu_does_not_count(file):
    """The standard demands one of every input (FMI 2.0, 2.2.7)."""
    plant = Fmu(file, name="plant")
    assert plant.input_variables["pump"].start == 0.0
    with pytest.raises(UnwiredInputError) as e:
        Diagram("d", plant(inflow=INFLOW))
    assert str(e.value) == (
        "plant.pump: nothing is wired to 'pump'; expected plant(inflow=…, pump=…). An input that is to keep one value "
        "gets it by Fmu(…, start={'pump': …})."
    )
    with pytest.raises(
        UnwiredInputError, match=r"never called.* gets it by Fmu\(…, start=\{'inflow': …, 'pump': …\}\)\.$"
    ):
        Diagram("d", Constant(value=1.0)(), plant.low)
    with pytest.raises(UnwiredInputError, match=r"Fmu\(…, start=\{'inflow': …\}\)\.$"):
        Diagram("d", Fmu(file, name="plant", rename={"inflow": "supply"})(pump=1.0))  # by the FMU's name


def test_all_elements_of_an_array_must_be_given(file, cache):
    half = {"motor_force[1]": 1.0, "external_force": (0.0, 0.0)}
    with pytest.raises(UnwiredInputError, match=r"nothing is wired to 'motor_force'.*start=\{'motor_force': …\}"):
        Diagram("d", Fmu(gantry.build(fmi=2), name="plant", start=half)())
    plant = Fmu(gantry.build(fmi=2), name="plant", start={**half, "motor_force[2]": 43.2621})
    run = Diagram("d", plant()).simulate(0.1, step=0.01, progress=False)
    assert np.abs(run["plant.velocity"][:, 1]).max() < 1e-12  # the weight is carried
    joined = Fmu(file, name="plant", rename=RENAME, start={"inflow": INFLOW, "flow[2]": PUMP})
    run = Diagram("d", joined()).simulate(0.5, step=0.1, progress=False)
    np.testing.assert_allclose(run["plant.level"], levels(run.t, (INFLOW, PUMP)), rtol=1e-13)
    with pytest.raises(UnwiredInputError, match=r"start=\{'flow': …\}"):
        Diagram("d", Fmu(file, name="plant", rename=RENAME, start={"inflow": INFLOW})())


@pytest.mark.drawn(2)
@pytest.mark.parametrize("name", ["plant.start.pump", "plant.pump"])
@TIERS
def test_a_sweep_and_a_variant_change_it(file, name, compiled):
    found = held(file).sweep(
        {name: (1.0, 2.0)}, 0.5, step=0.1, signals=["plant.high"], progress=False, compile=compiled, workers=1
    )
    assert not found.failures
    for i, pump in enumerate((1.0, 2.0)):
        np.testing.assert_allclose(found["plant.high"][i], levels(found.t, (INFLOW, pump))[:, 1], rtol=1e-13)
    run = held(file).replace({name: 2.0}).simulate(0.5, step=0.1, progress=False)
    np.testing.assert_allclose(run["plant.high"], levels(run.t, (INFLOW, 2.0))[:, 1], rtol=1e-13)


def test_a_linear_model_and_a_drawing(file):
    diagram = held(file, isolate=False)
    np.testing.assert_allclose(diagram.linearize().A, -RATE * np.eye(2), atol=1e-8)
    svg = diagram.draw().svg
    assert "plant" in svg
    point = diagram.trim(targets={"plant.high": PUMP / RATE}, free={"plant.start.pump": (-9.0, 9.0)}, step=0.1)
    assert point.parameters["plant.start.pump"] == pytest.approx(PUMP, abs=1e-6)
