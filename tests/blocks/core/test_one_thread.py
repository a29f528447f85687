"""BLAS runs on one thread inside an analysis, and as before afterwards."""

import subprocess
import sys
from threading import Barrier, Thread

import pytest
import scipy.linalg  # noqa: F401 - its BLAS must be loaded to be seen
from threadpoolctl import threadpool_info, threadpool_limits

from loopwright.blocks.core import on_one_thread, one_thread
from loopwright.diagrams.frequency import loop_margins as _margins
from loopwright.frequency import margins


def threads():
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


@pytest.fixture(autouse=True)
def two_threads():
    with threadpool_limits(2, user_api="blas"):
        yield


def test_one_thread_inside_and_as_before_afterwards_nested_or_not():
    before = threads()
    assert set(before) == {2}
    with one_thread():
        with one_thread():
            assert set(threads()) == {1}
        assert set(threads()) == {1}
    assert threads() == before


def test_an_error_inside_gives_the_threads_back():
    @on_one_thread
    def fails():
        assert set(threads()) == {1}
        raise ValueError("inside")

    with pytest.raises(ValueError, match="inside"):
        fails()
    assert set(threads()) == {2}


def test_another_thread_that_leaves_last_does_not_leave_the_limit_behind():
    entered, left = Barrier(2), Barrier(2)

    def other():
        with one_thread():
            entered.wait()
            left.wait()

    thread = Thread(target=other)
    with one_thread():
        thread.start()
        entered.wait()
        assert set(threads()) == {1}
    left.wait()
    thread.join()
    assert set(threads()) == {2}


def test_margins_are_computed_on_one_thread(monkeypatch):
    import control

    seen = []
    judge = _margins._LoopMarginFinder
    monkeypatch.setattr(_margins, "_LoopMarginFinder", lambda *args: seen.append(set(threads())) or judge(*args))
    margins(control.ss(control.tf([1.0], [1.0, 1.0, 0.0])))
    assert seen == [{1}]
    assert set(threads()) == {2}


@pytest.mark.slow
def test_an_import_limits_nothing():
    code = (
        "import scipy.linalg; from threadpoolctl import threadpool_info as info, threadpool_limits as limit\n"
        "limit(2); before = [p['num_threads'] for p in info()]; import loopwright.diagrams\n"
        "print(*before, *(p['num_threads'] for p in info()[:len(before)]))"
    )
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert len(found) >= 2
    assert set(found) == {"2"}
