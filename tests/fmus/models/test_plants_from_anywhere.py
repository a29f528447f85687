"""Fig. 3 with its plant from elsewhere: one changed argument.

Builds of both versions of FMI give the numbers of one model; the gantry that another tool has exported from its own
equations gives those of the gantry.
"""

import importlib.metadata
import importlib.util
import shutil
import sys
import zipfile

import numpy as np
import pytest

from loopwright.diagrams import experiments
from loopwright.fmus import Fmu, gantry, gantry_contact, gantry_elastic, gantry_stiction, scara
from support.followed import PATH, follow
from support.foreign_gantry import by_casadi, by_pythonfmu, by_pythonfmu3

PLANTS = (gantry, gantry_elastic, gantry_stiction, gantry_contact)


def run_experiment(plant, duration=None, letter="A", **options):
    experiment = experiments.EXPERIMENTS[letter](plant=plant)
    return experiment.diagram.simulate(duration or experiment.duration, progress=False, **options)


def largest_differences(run, other, names):
    """Return the largest difference of each signal, relative to its size."""
    return {name: float(np.abs(run[name] - other[name]).max() / np.abs(other[name]).max()) for name in names}


SIGNALS = ("eta", "xi", "motor_force", "plant.position", "plant.velocity", "plant.acceleration")


@pytest.mark.slow  # the quick set has tests/fmus/fmu_block/test_fmi2.py
@pytest.mark.parametrize("plant", PLANTS, ids=lambda p: p.__name__.rpartition(".")[2])
def test_builds_of_both_versions_give_the_same_numbers(plant):
    """The C of a plant is one, whatever its version: not a bit may differ, events and stiff friction included."""
    runs = [run_experiment(plant.build(fmi=fmi), 1.0) for fmi in (2, 3)]
    for name in SIGNALS:
        assert np.array_equal(runs[0][name], runs[1][name]), name
    assert np.abs(runs[0]["plant.position"] - runs[0]["plant.position"][0]).max() > 0.01  # m: it moves


@pytest.mark.slow
@pytest.mark.parametrize("letter", "ABCD")
@pytest.mark.parametrize("plant", PLANTS, ids=lambda p: p.__name__.rpartition(".")[2])
def test_whole_experiments_with_builds_of_both_versions(plant, letter):
    runs = [run_experiment(plant.build(fmi=fmi), letter=letter) for fmi in (2, 3)]
    for name in SIGNALS:
        assert np.array_equal(runs[0][name], runs[1][name]), name


@pytest.mark.slow
def test_arms_of_both_versions_follow_alike():
    start = {"joint_angle": scara.nominal.joint_angles(PATH.to_plane(0.10, 0.01))}
    runs = []
    for fmi in (2, 3):
        arm = Fmu(scara.build(fmi=fmi), name="plant", start=start)
        runs.append(follow(arm, scara.nominal, "motor_torque", arm.joint_angle, arm.joint_velocity))
    for name in ("eta", "xi", "command", "plant.joint_angle"):
        assert np.array_equal(runs[0][name], runs[1][name]), name


@pytest.mark.slow
@pytest.mark.parametrize("plant", PLANTS, ids=lambda p: p.__name__.rpartition(".")[2])
def test_model_exchange_of_both_versions_gives_the_same_numbers(plant):
    runs = [run_experiment(Fmu(plant.build(fmi=fmi), interface="model_exchange"), 0.3) for fmi in (2, 3)]
    for name in SIGNALS:
        assert np.array_equal(runs[0][name], runs[1][name]), name


@pytest.mark.slow
def test_in_model_exchange_the_acceleration_answers_the_motor_force_at_once():
    """The plant's difference: co-simulation shows the force of before the step, and steps with its own integrator."""
    exchanged = run_experiment(Fmu(gantry.build(), interface="model_exchange"), 0.3)
    stepped = run_experiment(gantry.build(), 0.3)
    smooth = largest_differences(exchanged, stepped, SIGNALS[:5])
    assert max(smooth.values()) < 2e-6  # of the Runge-Kutta steps of 0.2 ms
    jump = np.diff(stepped["motor_force"], axis=0) / [36.87, 21.20]  # m/s2, by Table II
    ahead = exchanged["plant.acceleration"][1:] - stepped["plant.acceleration"][1:]
    assert np.abs(jump).max() > 1.0
    np.testing.assert_allclose(ahead, jump, rtol=0, atol=1e-4 * np.abs(jump).max())


# --- the gantry of other tools --------------------------------------------------------------------------------------

TOOLS = {"pythonfmu": by_pythonfmu, "pythonfmu3": by_pythonfmu3}


@pytest.mark.slow  # an interpreter within this one: what it breaks shall not take the quick set with it
@pytest.mark.parametrize("letter", "AC")
@pytest.mark.parametrize("tool", TOOLS)
def test_a_gantry_that_another_tool_has_exported(tmp_path, tool, letter):
    """Another text of the equations, in Python, with the steps of the plant's own integrator: rounding remains."""
    if importlib.util.find_spec(tool) is None:
        pytest.skip(f"{tool} is not installed (extra: test)")
    run, own = run_experiment(TOOLS[tool](tmp_path), letter=letter), run_experiment(gantry.build(), letter=letter)
    assert max(largest_differences(run, own, SIGNALS).values()) < 1e-12  # tanh of two libraries: 1 ulp, in a loop


@pytest.mark.parametrize("tool", TOOLS)
def test_such_an_export_has_its_binaries_whatever_was_loaded_here(tmp_path, monkeypatch, tool):
    """As an FMU of the tool leaves it that was loaded into this process: its own package, without binaries, is first."""
    if importlib.util.find_spec(tool) is None:
        pytest.skip(f"{tool} is not installed (extra: test)")
    package = importlib.metadata.distribution(tool).locate_file(
        tool
    )  # an FMU that an earlier test has loaded may be first
    carried = tmp_path / "resources"
    shutil.copytree(package, carried / tool, ignore=shutil.ignore_patterns("binaries", "__pycache__"))
    monkeypatch.syspath_prepend(str(carried))
    for name in [name for name in sys.modules if name.partition(".")[0] == tool]:
        monkeypatch.delitem(sys.modules, name)
    with zipfile.ZipFile(TOOLS[tool](tmp_path)) as archive:
        assert [name for name in archive.namelist() if name.startswith("binaries/") and name.endswith(".so")]


@pytest.mark.slow
def test_a_gantry_for_model_exchange_that_casadi_has_exported(tmp_path):
    """The one solver takes the one right-hand side from two libraries: rounding remains."""
    plants = Fmu(by_casadi(tmp_path)), Fmu(gantry.build(), interface="model_exchange")
    run, own = (run_experiment(plant, 0.3) for plant in plants)
    assert max(largest_differences(run, own, SIGNALS).values()) < 1e-12
