"""An FMU is linearized once at a point, for all loops that are looked at."""

import shutil

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain
from loopwright.diagrams import Diagram, experiments
from loopwright.fmus import Fmu, FmuError


@pytest.fixture
def counted(monkeypatch):
    calls = []
    for name in ("linear_model", "step_difference"):
        plain = getattr(Fmu, name)
        monkeypatch.setattr(Fmu, name, lambda self, *a, _plain=plain, **k: calls.append(k) or _plain(self, *a, **k))
    return calls


def test_loops_of_a_diagram_linearize_its_fmu_once(counted):
    diagram = experiments.path_following().diagram.replace({"plant.start.translational_mass": 31.0})
    model = diagram.linearize()
    count = len(counted)
    assert count > 0
    first = model.loop("controller.v_par").A
    assert model.loop("controller.v_perp").A.shape == first.shape
    assert np.array_equal(diagram.linearize().A, model.A)
    assert len(counted) == count
    other = diagram.replace({"plant.start.translational_mass": 62.0}).linearize()  # another value: another model
    assert len(counted) > count
    assert not np.array_equal(other.A, model.A)


def test_an_fmu_whose_file_has_changed_is_refused(tmp_path):
    plant = experiments.path_following().diagram["plant"]
    file = shutil.copy(plant.file, tmp_path / "plant.fmu")
    block = Fmu(file, name="plant")
    force = Constant(value=(0.0, 0.0), unit="N", name="force")
    diagram = Diagram("alone", Gain(gain=1.0, name="g")(block(motor_force=force.y, external_force=force.y).position))
    diagram.linearize(step=1e-3)
    with open(file, "ab") as stream:
        stream.write(b"\\0")
    with pytest.raises(FmuError, match="has changed"):
        diagram.linearize(step=1e-3)
