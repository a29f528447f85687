"""FMUs in a sweep: their messages, and their files."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from loopwright.blocks import Block, Gain, Input, Output, State, parameter
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, FmuRuntimeError, build
from support.waiting import FAR

T = 0.01


class Root(Block):
    """A growing state, whose output ends at 2."""

    rate: float = parameter(default=1.0)
    u = Input()
    x = State(start=0.5, output=True)
    y = Output()

    def derivative(self, t, x, u):
        return self.rate * x.x**2 + u.u

    def output(self, t, x, u):
        return np.sqrt(2.0 - x.x)


def rooted(file):
    @subsystem(sample_time=T, name="box")
    def box(x):
        return Gain(gain=0.0, name="gain")(x)

    plant = Fmu(file, name="plant")
    return Diagram("rooted", plant(u=box(plant.x)))


@pytest.mark.parametrize("lanes", [False, 2])
@pytest.mark.drawn(1)
def test_the_error_of_a_run_quotes_the_messages_of_no_run_before(tmp_path, lanes):
    diagram, rates = rooted(build(Root(), out=tmp_path / "root.fmu")), (2.0, 0.1, 1.5, 1.0)
    found = diagram.sweep({"plant.rate": rates}, 2.5, signals="plant.x", workers=1, progress=False, lanes=lanes)
    assert [failure.index for failure in found.failures] == [0, 2, 3]
    for failure in found.failures:
        with pytest.raises(FmuRuntimeError) as alone:
            diagram.replace({"plant.start.rate": rates[failure.index]}).simulate(2.5, compile=True)
        assert failure.message in str(alone.value)


def test_the_path_of_an_fmu_holds_while_another_thread_loads_one(tmp_path, monkeypatch):
    build(Root(), out=tmp_path / "root.fmu")
    monkeypatch.chdir(tmp_path)
    block, elsewhere, goes_on = Fmu("root.fmu"), threading.Event(), threading.Event()
    change = os.chdir

    def linger(folder):
        change(folder)
        if Path(folder) != tmp_path:
            elsewhere.set()
            goes_on.wait(0.2)

    monkeypatch.setattr(os, "chdir", linger)

    def load():
        with block.instantiate([*block.inputs], None):
            pass

    with ThreadPoolExecutor(1) as pool:
        loading = pool.submit(load)
        assert elsewhere.wait(FAR)
        assert block.description.file == tmp_path / "root.fmu"
        goes_on.set()
        loading.result()


@pytest.mark.slow
def test_an_fmu_in_the_home_folder_is_fused_and_runs_in_lanes(tmp_path, monkeypatch):
    build(Root(), out=tmp_path / "root.fmu")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    diagram = rooted("~/root.fmu")
    assert any("are in the loop" in text for text in diagram.simulate(0.1, fuse=True).messages)
    found = diagram.sweep({"plant.rate": (0.1, 0.2)}, 0.1, signals="plant.x", progress=False, lanes=True)
    assert any("Side by side" in text for text in found.messages)
