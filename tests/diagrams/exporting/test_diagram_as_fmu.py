"""A diagram, or its controller, as an FMU: built, checked by FMPy, run in FMPy and here again."""

import fmpy
import fmpy.validation
import numpy as np
import pytest

from loopwright import Fmu, build
from loopwright.blocks import PID, PT1, OptionError, Step, TransferFunction
from loopwright.diagrams import Diagram, subsystem
from support.instances import open_instance

PLANT = {"numerator": [1.0], "denominator": [1.0, 1.0]}


@subsystem(sample_time=1e-2)
def controller(reference, level):
    """PI with a filtered derivative."""
    return PID(kp=2.0, ki=3.0, kd=0.1, filter_time=0.02, name="pid")(reference, level).named("effort")


@pytest.fixture(scope="module")
def diagram():
    plant = TransferFunction(**PLANT, name="plant")
    return Diagram("level", plant(controller(Step(times=0.05, values=1.0, name="wanted"), plant.y)))


@pytest.fixture(scope="module")
def file(diagram, tmp_path_factory):
    return build(diagram, tmp_path_factory.mktemp("fmu"), subsystem="controller")


def test_fmpy_finds_nothing_wrong(file):
    assert fmpy.validation.validate_fmu(str(file)) == []
    description = fmpy.read_model_description(str(file))
    assert description.modelExchange is None
    ports = [v for v in description.modelVariables if v.causality in ("input", "output") and v.type != "Clock"]
    assert {v.name: v.causality for v in ports} == {
        "reference": "input",
        "level": "input",
        "effort": "output",
    }
    assert "at the start of a communication step" in description.description


def test_a_controller_in_fmpy_has_the_bits_of_the_run(file, diagram, tmp_path):
    """The master steps the controller before the plant, of which the run has the values."""
    run = diagram.simulate(1.0, progress=False)
    item = open_instance(file, tmp_path)
    item.initialize(level=float(run["plant.y"][0]))
    assert item["effort"] == run["effort"][0]
    for k in range(100):
        item.step(float(run.t[k]), 0.01, reference=float(run["wanted.y"][k]), level=float(run["plant.y"][k]))
        assert item["effort"] == run["effort"][k]
    item.free()


def test_here_it_acts_one_sample_later(file, diagram):
    """FMUs step together here, so that the plant gets an effort that was computed from values of a sample before."""
    plant = TransferFunction(**PLANT, name="plant")
    late = Diagram("late", plant(controller.replace(delay=1)(Step(times=0.05, values=1.0, name="wanted"), plant.y)))
    again = TransferFunction(**PLANT, name="plant")
    fmu = Fmu(file, name="fmu")
    effort = fmu(reference=Step(times=0.05, values=1.0, name="wanted"), level=again.y).effort
    found = Diagram("again", again(effort)).simulate(1.0, step=1e-2, solver="rk4", progress=False)
    expected = late.simulate(1.0, step=1e-2, solver="rk4", progress=False)
    np.testing.assert_allclose(found["plant.y"], expected["plant.y"], rtol=0, atol=1e-12)
    assert not np.allclose(found["plant.y"], diagram.simulate(1.0, progress=False)["plant.y"], rtol=0, atol=1e-4)


def test_what_another_kind_of_model_has_is_refused(diagram):
    with pytest.raises(OptionError, match="a diagram has none"):
        build(diagram, integrator="rodas")
    with pytest.raises(OptionError, match="are options of diagrams"):
        build(TransferFunction(**PLANT), subsystem="controller")
    with pytest.raises(OptionError, match="expected 'any' or 'ticks'"):
        build(diagram, communication="never")


def test_a_state_that_nothing_reads_and_its_output_have_two_names(uncompiled, tmp_path):
    """Of one name, no importer took them: `PT1` puts out its state, by the path of both."""
    file = build(Diagram("plain", PT1(time_constant=1.0, name="lag")(1.0)), tmp_path / "plain.fmu")
    names = [v.name for v in fmpy.read_model_description(str(file), validate=False).modelVariables]
    assert len(names) == len({*names})
    assert {"lag.y", "lag.y_state"} <= {*names}
