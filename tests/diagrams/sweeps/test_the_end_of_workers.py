"""Worker processes of a sweep and their FMUs end with the sweep, and with its host in whatever way that ends."""

import signal
from pathlib import Path

import pytest

from support.marked import ON_LINUX, Host, seconds_of
from support.waiting import wait_for
from support.zoo import zoo_fmu

pytestmark = ON_LINUX
SIGNALS = pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
TESTS = str(Path(__file__).parents[2])

HELD = f"""
import sys
sys.path.insert(0, {TESTS!r})
from support.swept import held
held().sweep({{"held.gain": [1.0, 2.0, 3.0]}}, 0.2, signals="y", workers=2, progress=False)
"""


@SIGNALS
def test_workers_that_hold_the_interpreter_lock_end_with_their_host(tmp_path, number):
    with Host(HELD, HELD_FOLDER=str(tmp_path)) as host:
        assert wait_for(lambda: len([*tmp_path.iterdir()]), 2, 60.0) == 2
        pids = [int(path.name) for path in tmp_path.iterdir()]
        assert set(pids) <= set(host.others())
        assert wait_for(lambda: min(map(seconds_of, pids)) > 0.5)  # in C
        assert host.kill(number) == {}


SWEEP = """
import os, sys
from pathlib import Path
from loopwright.blocks import Constant
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu
sys.path.insert(0, {tests!r})
from support.marked import marked
if __name__ == "__main__":
    plant = Fmu({file!r}, name="plant", isolate=True)
    diagram = Diagram("d", plant(u=Constant(value=1.0, name="one")))
    found = diagram.sweep({{"plant.p": [1.0, 2.0, 3.0, 4.0]}}, 0.05, step=0.01, signals="plant.y", workers=2, progress=False)
    mark = os.environ["LOOPWRIGHT_TEST_MARK"]
    print(len(found.failures), len(marked(mark)), [*Path({temporary!r}).iterdir()], flush=True)
"""


@pytest.mark.slow
@SIGNALS
def test_fmus_of_workers_end_with_the_host(tmp_path, number):
    (tmp_path / "temporary").mkdir()
    names = {
        "tests": TESTS,
        "file": str(zoo_fmu(tmp_path, 3, "step spin 0.01")),
        "temporary": str(tmp_path / "temporary"),
    }
    with Host(SWEEP.format(**names), TMPDIR=names["temporary"]) as host:

        def busy():
            return [pid for pid, line in host.others().items() if "loopwright_child" in line and seconds_of(pid) > 0.4]

        assert wait_for(lambda: len(busy()), 2, 60.0) == 2
        assert host.kill(number) == {}
        assert [*Path(names["temporary"]).iterdir()] == []


def test_the_end_of_a_sweep_leaves_no_process_and_no_folder(tmp_path):
    (tmp_path / "temporary").mkdir()
    names = {"tests": TESTS, "file": str(zoo_fmu(tmp_path, 3)), "temporary": str(tmp_path / "temporary")}
    with Host(SWEEP.format(**names), TMPDIR=names["temporary"]) as host:
        assert host.process.stdout.readline() == "0 1 []\n"
