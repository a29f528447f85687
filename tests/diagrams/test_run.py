"""What a run recorded, reached by name: in the whole, at an instant, and as a picture."""

import ast
from pathlib import Path

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, Reference, UnknownNameError
from loopwright.diagrams import Diagram, _plots, subsystem


@subsystem(sample_time=0.5, name="a")
def first(u):
    return Gain(gain=1.0)(u).named("w")


@subsystem(sample_time=0.5, name="b")
def second(u):
    return Gain(gain=10.0)(u).named("w")


@pytest.fixture(scope="module")
def run():
    u = Constant(value=3.0)
    return Diagram("twins", first(u).named("left"), second(u).named("right")).simulate(1.0, progress=False)


def test_a_snapshot_refuses_a_name_that_stands_for_two_wires_as_the_run_does(run):
    for recorded in (run, run.at(0.5)):
        with pytest.raises(UnknownNameError, match=r"'w' stands for several signals: a\.w, b\.w\. Write more"):
            recorded["w"]


def test_a_snapshot_takes_the_names_that_the_run_takes(run):
    at = run.at(0.7)
    assert (at.t, at.tick) == (0.5, 1)
    assert [float(at[n]) for n in ("a.w", "b.w", "left", "right")] == [3.0, 30.0, 3.0, 30.0]
    assert all(np.array_equal(at[n], run[n][1]) for n in run.names)
    assert at.names == run.wires


def test_one_wire_under_one_name_in_two_frames_is_not_ambiguous():
    y = first(Constant(value=2.0)).named("w")  # inside and outside the name is on the same port
    run = Diagram("same", Gain(gain=1.0)(y)).simulate(0.5, progress=False)
    assert sorted(run.wires) == ["a.w", "w"]
    assert float(run.at(0.5)["w"]) == run["w"][-1] == 2.0


def test_a_part_of_a_vector_has_its_unit_and_its_row():
    r = Reference(2.0, unit="m", name="r")
    run = Diagram("parts", Gain(gain=1.0)(r.y[0].named("first")), Gain(gain=1.0)(r.y[1:].named("rates"))).simulate(
        1.0, step=0.5, progress=False
    )
    assert run.unit("first") == "m"
    assert run.unit("rates") == ("m/s", "m/s2")
    assert np.array_equal(run.at(1.0)["rates"], [0.0, 0.0])


def test_names_complete_in_a_notebook(run):
    assert {"a.w", "b.w", "constant.y"} <= set(run._ipython_key_completions_())


def test_plots_of_a_run_need_nothing_of_the_experiments():
    tree = ast.parse(Path(_plots.__file__).read_text(encoding="utf-8"))
    modules = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert "_run" in modules
    assert not any(word in module for word in ("experiments", "_figures", "fig3") for module in modules)
