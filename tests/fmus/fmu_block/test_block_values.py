"""An FMU block as a value: its mappings are its own, and the file's content belongs to it."""

import pickle
import shutil

import numpy as np
import pytest

from loopwright.blocks import Constant, ParameterError
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, FmuFileError, gantry


@pytest.fixture(scope="module")
def built(cache):
    return gantry.build()


@pytest.fixture
def file(built, tmp_path):
    return shutil.copy(built, tmp_path / "plant.fmu")


@pytest.fixture
def other(file, tmp_path):
    """The same plant, as a file of another content."""
    import zipfile

    path = shutil.copy(file, tmp_path / "other.fmu")
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("documentation/edition.html", "<p>Another edition.</p>")
    return path


def loop(plant):
    return Diagram("d", plant(motor_force=Constant(value=(0.0, 0.0)), external_force=Constant(value=(0.0, 0.0))))


def test_renaming_the_port_of_one_leaves_the_others(file):
    a, b = Fmu(file), Fmu(file)
    with pytest.raises(ParameterError, match="can't be changed"):
        a.rename["position"] = "pos"
    assert "position" in b.outputs
    assert "position" in Fmu(file).outputs
    assert "pos" in Fmu(file, rename={"position": "pos"}).outputs
    assert a.rename == b.rename == {}


@pytest.mark.parametrize("pickled", [False, True])
def test_start_values_cannot_be_changed(file, pickled):
    plant = Fmu(file, start={"position": [0.1, 0.2]})
    if pickled:
        plant = pickle.loads(pickle.dumps(plant))
    with pytest.raises(ValueError, match="read-only"):
        plant.start["position"][0] = 9
    with pytest.raises(ParameterError, match="can't be changed"):
        plant.start["position"] = np.zeros(2)
    assert plant == Fmu(file, start={"position": (0.1, 0.2)})
    assert loop(plant).replace({"fmu.start.position": (0.3, 0.4)})["fmu"].start == {"position": [0.3, 0.4]}


def test_two_contents_under_one_path_are_two_values(file, other):
    before = Fmu(file)
    assert before == Fmu(file)
    assert pickle.loads(pickle.dumps(before)) == before
    shutil.copy(other, file)
    assert Fmu(file) != before
    assert Fmu(file) == before.replace()
    assert hash(Fmu(file)) != hash(before)


def test_a_file_that_changes_under_a_diagram_is_an_error_when_it_runs(file, other):
    plant = Fmu(file, name="plant")
    diagram = loop(plant)
    diagram.simulate(0.01, step=0.01, progress=False)
    old = plant.description.digest
    shutil.copy(other, file)
    new = Fmu(file).description.digest
    with pytest.raises(FmuFileError) as e:
        diagram.simulate(0.01, step=0.01, progress=False)
    text = str(e.value)
    assert text.startswith(f"plant.file: the file '{file}' has changed since this block was made")
    assert f"found SHA-256 {new[:12]}…, expected {old[:12]}…" in text
    assert ".replace()" in text
    with pytest.raises(FmuFileError, match="has changed"), plant.instantiate(["motor_force"], 1.0):
        pass
    diagram.replace(plant=plant.replace()).simulate(0.01, step=0.01, progress=False)


def test_a_file_that_is_looked_for_in_another_folder_is_an_error_that_names_the_folder(file, tmp_path, monkeypatch):
    monkeypatch.chdir(file.parent)
    plant = Fmu(file.name)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    with pytest.raises(FmuFileError) as e:
        loop(plant)
    assert str(e.value) == (
        f"fmu: there is no file {file.name!r}; expected an FMU. Check the path. It is relative to the working folder, "
        f"{str(tmp_path / 'elsewhere')!r}."
    )


def test_a_file_written_again_with_the_same_content_is_the_same(file, built):
    plant = Fmu(file)
    file.unlink()
    with pytest.raises(FmuFileError, match=r"^fmu: there is no file .*expected an FMU\. Check the path\.$"):
        loop(plant)
    shutil.copyfile(built, file)  # another time stamp
    loop(plant).simulate(0.01, step=0.01, progress=False)


def test_outputs_complete_also_where_the_file_is_gone(file):
    plant = Fmu(file, rename={"position": "axis.phi"})
    call = plant(motor_force=Constant(value=(0.0, 0.0)), external_force=Constant(value=(0.0, 0.0)))
    for item in (plant, call):
        assert {"velocity", "acceleration"} <= set(dir(item))
        assert "axis.phi" not in dir(item)
        assert "axis.phi" in item._ipython_key_completions_()
    file.unlink()
    assert "replace" in dir(plant)
    assert "velocity" not in dir(plant)
    assert repr(plant).startswith("Fmu(")
