"""Parts of a result from two processes are those of one, in their order, whatever happens to the second one."""

import os
import signal
from dataclasses import dataclass, field
from itertools import repeat
from pathlib import Path

import pytest

from loopwright.blocks import Constant, LoopwrightError, OptionError
from loopwright.diagrams import Diagram, analyse
from loopwright.diagrams.second_process import SecondProcess
from support.marked import ON_LINUX, Host
from support.waiting import wait_for

KEYS = ("a", "b", "c", "d")


@dataclass
class Parts:
    """Makes letters; in another process some of them go wrong."""

    wrong: dict = field(default_factory=dict)
    home: int = 0

    def make(self, key, tell):
        tell(f"making {key}")
        if os.getpid() != self.home and key in self.wrong:
            if self.wrong[key] == "ends":
                os._exit(3)
            if self.wrong[key] == "fails":
                raise LoopwrightError("not here")
            return lambda: None  # can't be sent
        return key.upper(), os.getpid()


@pytest.fixture
def parts(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(os.path.dirname(__file__))
    module = __import__("test_second_process")
    return lambda wrong: module.Parts(wrong, os.getpid())


def share(task, told):
    def make(key):
        if key == "a" and second._child is not None:  # the second process gets its turn
            assert wait_for(lambda: bool(second._made) or not second._thread.is_alive())
        return task.make(key, told.append)

    with SecondProcess(task.make, "letters") as second:
        return second.share(KEYS, make, told.append), second


@pytest.mark.slow
def test_both_processes_make_parts_and_tell_of_them(parts):
    told = []
    found, _ = share(parts({}), told)
    assert [letter for letter, _ in found] == ["A", "B", "C", "D"]
    assert found[0][1] == os.getpid()
    assert found[3][1] != os.getpid()
    assert sorted(told) == [f"making {key}" for key in KEYS]


@pytest.mark.slow
@pytest.mark.parametrize(
    "way", ["ends", *(pytest.param(way, marks=pytest.mark.slow) for way in ("fails", "can't be sent"))]
)
def test_parts_that_the_second_process_does_not_make_are_made_here(parts, way):
    found, _ = share(parts(dict.fromkeys(KEYS, way)), [])
    assert found == [(key.upper(), os.getpid()) for key in KEYS]


def test_an_error_here_ends_the_second_process(parts):
    task = parts({})
    with pytest.raises(KeyboardInterrupt), SecondProcess(task.make, "letters") as second:
        second.share(KEYS, lambda key: (_ for _ in ()).throw(KeyboardInterrupt), print)
    assert second._child.has_ended()


def test_a_task_that_can_not_be_sent_is_done_here():
    class Local(Parts):
        def __reduce__(self):
            raise TypeError("never")

    found, second = share(Local({}, os.getpid()), [])
    assert second._child is None
    assert {place for _, place in found} == {os.getpid()}


def test_the_number_of_processes_is_checked():
    for wrong in (0, True, 1.5):
        with pytest.raises(OptionError, match="expected 1, or 2"):
            analyse(Diagram("held", Constant(value=1.0)), workers=wrong)


@pytest.mark.slow
def test_a_report_is_the_same_from_one_process_and_from_two(tmp_path):
    from loopwright.diagrams import experiments

    diagram = experiments.path_following().diagram
    pages = []
    for workers in (1, 2):
        told = []
        diagram.report(tmp_path / "page.html", json=True, workers=workers, about={"made": "now"}, progress=told.append)
        page = (tmp_path / "page.html").read_text() + (tmp_path / "page.json").read_text()
        pages.append(page)
        assert {"poles", "inner", "injection"} <= set(told)
    one, two = ([line for line in page.splitlines() if "UTC" not in line] for page in pages)
    assert one == two


@dataclass
class Holds:
    """Runs in C for hours in the second process, and holds the interpreter lock there."""

    folder: Path

    def make(self, key, tell):
        (self.folder / str(os.getpid())).touch()
        sum(repeat(1, 10**13))


HOST = f"""
import sys, time
from pathlib import Path
sys.path[:0] = {[os.path.dirname(__file__), str(Path(__file__).parents[2])]!r}
from loopwright.diagrams import Diagram, analyse
from loopwright.diagrams.second_process import SecondProcess
from test_second_process import Holds
with SecondProcess(Holds(Path(sys.argv[1])).make, "letters") as second:
    second.share(["a", "b"], lambda key: time.sleep(1e4), print)
"""


@ON_LINUX
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
@pytest.mark.drawn(1)
def test_the_second_process_ends_with_its_host(tmp_path, number):
    with Host(HOST, str(tmp_path)) as host:
        assert wait_for(lambda: [int(path.name) in host.others() for path in tmp_path.iterdir()], [True], 60.0) == [
            True
        ]
        assert host.kill(number) == {}
