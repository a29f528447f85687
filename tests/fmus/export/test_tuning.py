"""FMUs that are compiled anew for the processor of this machine."""

from __future__ import annotations

import shutil
import zipfile

import numpy as np
import pytest

from loopwright.blocks import OptionError
from loopwright.diagrams import experiments
from loopwright.fmus import Fmu, FmuError, gantry, tune


@pytest.mark.drawn(1)
@pytest.mark.parametrize("fmi", [3, 2])
def test_it_is_the_same_fmu_with_another_binary(fmi):
    given = gantry.build(fmi=fmi)
    made = tune(given)
    with zipfile.ZipFile(given) as before, zipfile.ZipFile(made) as after:
        (binary,) = (name for name in after.namelist() if name.startswith("binaries/"))
        assert set(after.namelist()) <= set(before.namelist())
        for name in after.namelist():
            assert (after.read(name) == before.read(name)) is (name != binary), name


def test_it_is_made_once():
    first = tune(gantry.build())
    stamp = first.stat().st_mtime_ns
    assert tune(gantry.build()) == first
    assert first.stat().st_mtime_ns == stamp


def test_an_fmu_of_others_is_refused(tmp_path):
    other = tmp_path / "other.fmu"
    shutil.copy(gantry.build(), other)
    with zipfile.ZipFile(other, "a") as archive:
        archive.writestr("documentation/note.txt", "edited")
    with pytest.raises(FmuError, match="has not built"):
        tune(other)


@pytest.mark.parametrize("letter", ["C", pytest.param("A", marks=pytest.mark.slow)])
def test_a_fused_run_differs_by_rounding_and_says_so(letter):
    diagram = experiments.EXPERIMENTS[letter]().diagram
    plain = diagram.simulate(3.0, progress=False, compile=True)
    fused = diagram.simulate(3.0, progress=False, compile=True, fuse=True)
    size = np.maximum(1e-3, np.abs(plain.data).max(axis=0))
    rounding = 100 * np.finfo(float).eps * len(plain.data)  # of some hundred operations, tick by tick
    assert 0.0 < (np.abs(plain.data - fused.data) / size).max() < rounding
    assert [m for m in fused.messages if m.startswith("Fused: plant") and "differ by rounding" in m]
    assert not [m for m in plain.messages if "used" in m]


def test_a_foreign_fmu_runs_as_it_is_and_the_run_says_so(tmp_path):
    other = tmp_path / "other.fmu"
    shutil.copy(gantry.build(), other)
    with zipfile.ZipFile(other, "a") as archive:
        archive.writestr("documentation/note.txt", "edited")
    diagram = experiments.hand_guiding(plant=Fmu(other)).diagram
    run = diagram.simulate(0.01, progress=False, fuse=True)
    assert [m for m in run.messages if m.startswith("Not fused: plant")]


def test_fuse_is_true_or_false():
    with pytest.raises(OptionError, match="expected True or False"):
        experiments.hand_guiding().diagram.simulate(0.01, progress=False, fuse="no")
