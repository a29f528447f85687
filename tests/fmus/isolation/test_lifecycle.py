"""Load, run, close, again and again: memory, handles, threads, processes and files stay as they are."""

import gc
import os
import subprocess
import sys
import tempfile
import threading
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from loopwright.blocks import PID
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, FmuError, FmuRuntimeError, Isolation, StepOptions
from loopwright.fmus.calls import FmuInstance, LoadedFmu
from loopwright.fmus.fmu_block import setup_of
from loopwright.fmus.isolation import count_processes, end_idle
from loopwright.frequency import margins
from support.misstated import misstated_fmu
from support.waiting import FAR, is_there, wait_for
from support.zoo import zoo_fmu

ON_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
pytestmark = pytest.mark.usefixtures("no_process_left")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("zoo")


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """Folder of all temporary files."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def run_once(plant, steps=3):
    """Load, run, close; return the last output."""
    with plant.instantiate(["u"], None) as one:
        u, y = np.ones(1), np.zeros(1)
        one.bind(u, y)
        one.begin()
        for k in range(steps):
            one.step(0.01 * k, 0.01)
        return y[0]


def count_resources(temporary):
    """Return memory in MB, and counts of handles, threads, children and temporary files."""
    gc.collect()
    status = Path("/proc/self/status").read_text()
    memory = int(status.split("VmRSS:")[1].split()[0]) / 1e3
    children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    files = sum(1 for _ in temporary.rglob("*"))
    return memory, [len(os.listdir("/proc/self/fd")), threading.active_count(), len(children), files]


def settle():
    """End the idle processes; the thread of their timer, which is cancelled, ends when it gets its next turn."""
    end_idle()
    assert wait_for(lambda: any(isinstance(t, threading.Timer) for t in threading.enumerate()), False) is False


def check_flat(cycle, temporary, count, warm=3, growth=8.0):
    """Run a cycle many times; all counts stay, and memory grows by some MB at most."""
    for k in range(warm):
        cycle(k)
    settle()
    before, counts = count_resources(temporary)
    for k in range(count):
        cycle(k)
    settle()
    after, later = count_resources(temporary)
    assert later == counts
    assert after - before < growth, f"{after - before:.1f} MB in {count} cycles"
    assert count_processes() == (0, 0)


@ON_LINUX
@pytest.mark.parametrize(
    ("isolate", "count"),
    [
        (False, 5),
        (True, 5),
        pytest.param(False, 2000, marks=pytest.mark.slow),
        pytest.param(True, 2000, marks=pytest.mark.slow),
    ],
)
def test_cycles_of_one_fmu_leave_nothing_behind(folder, temporary, isolate, count):
    plant = Fmu(zoo_fmu(folder, 3), name="plant", isolate=isolate)

    def cycle(k):
        assert run_once(plant) == pytest.approx(0.03)

    check_flat(cycle, temporary, count)


@pytest.mark.slow
@ON_LINUX
@pytest.mark.parametrize("isolate", [False, True])
def test_cycles_of_fifty_fmus_leave_nothing_behind(folder, temporary, isolate, tmp_path_factory):
    """Fifty contents: the comment of each archive is another. Processes are kept for eight cycles, so that 250 start."""
    import shutil
    import zipfile

    others = tmp_path_factory.mktemp("others")
    plants = []
    for k in range(50):
        file = others / f"{k}.fmu"
        shutil.copy(zoo_fmu(folder, 3), file)
        with zipfile.ZipFile(file, "a") as archive:
            archive.comment = f"number {k}".encode()
        plants.append(Fmu(file, name="plant", isolate=isolate))

    def cycle(k):
        assert run_once(plants[k // (8 if isolate else 1) % 50]) == pytest.approx(0.03)

    check_flat(cycle, temporary, 2000, warm=400 if isolate else 50, growth=20.0)


@pytest.mark.slow
@ON_LINUX
@pytest.mark.parametrize(
    "fault", ["step segfault 0.01", "enter exit", "load abort", "free segfault", "step error 0.01"]
)
@pytest.mark.drawn(1)
def test_cycles_with_a_fault_leave_nothing_behind(folder, temporary, fault):
    plant = Fmu(zoo_fmu(folder, 3, fault), name="plant", isolate=True)

    def cycle(k):
        with nullcontext() if fault.startswith("free") else pytest.raises((FmuError, FmuRuntimeError)):
            run_once(plant)

    check_flat(cycle, temporary, 4, warm=2)


def test_two_versions_of_one_fmu_run_side_by_side(folder):
    one, two = (Fmu(zoo_fmu(folder, 3, fault), name="plant", isolate=True) for fault in ("", "step warning 1000.0"))
    with one.instantiate(["u"], None) as a, two.instantiate(["u"], None) as b:
        u, y, z = np.ones(1), np.zeros(1), np.zeros(1)
        a.bind(u, y)
        b.bind(2.0 * u, z)
        a.begin()
        b.begin()
        for k in range(5):
            a.step(0.01 * k, 0.01)
            b.step(0.01 * k, 0.01)
    assert y[0] == pytest.approx(0.05)
    assert z[0] == pytest.approx(0.10)
    end_idle()


def test_runs_in_threads_have_processes_of_their_own(folder):
    plant = Fmu(zoo_fmu(folder, 3), name="plant", isolate=True)
    found = []
    threads = [threading.Thread(target=lambda: found.append(run_once(plant, 200))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert np.allclose(found, 2.0)
    assert len(found) == 4
    end_idle()
    assert count_processes() == (0, 0)


SCRIPT = """
import sys, time, numpy as np
from loopwright.fmus import Fmu
from loopwright.fmus.isolation import count_processes
plant = Fmu(sys.argv[1], name="plant", isolate=True)
instance = plant.instantiate(["u"], None)
one = instance.__enter__()
one.bind(np.ones(1), np.zeros(1))
one.begin()
one.step(0.0, 0.01)
print(one.fmi.process.pid, one.fmi.process.folder, flush=True)
if sys.argv[2] == "hang":
    one.step(0.01, 0.01)
if sys.argv[2] == "wait":
    time.sleep(1e4)
"""


@ON_LINUX
@pytest.mark.parametrize(("how", "kill"), [("end", False), ("wait", True), ("hang", True)])
@pytest.mark.drawn(2)
def test_the_child_ends_with_its_parent_and_removes_its_folder(folder, tmp_path_factory, meeting, how, kill):
    """At the end of a script that closes nothing; and where the parent is killed, idle or in a call that hangs."""
    temporary = tmp_path_factory.mktemp("temporary")
    file = zoo_fmu(folder, 3, "step deaf_hang 0.01" if how == "hang" else "")
    environment = {**os.environ, "TMPDIR": str(temporary)}
    parent = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(file), how], stdout=subprocess.PIPE, text=True, env=environment
    )
    pid, place = parent.stdout.readline().split()
    assert how == "end" or is_there(pid)
    if kill:
        assert how != "hang" or wait_for(lambda: meeting.count, 1) == 1  # the call hangs
        parent.kill()
    parent.wait(FAR)
    parent.stdout.close()
    assert wait_for(lambda: is_there(pid) or Path(place).exists(), False) is False
    assert [*temporary.iterdir()] == []


@pytest.fixture
def uncollected():
    """Circles of references are not collected; the import of matplotlib leaves exceptions with all callers' frames."""
    import control  # noqa: F401  it imports matplotlib, and is imported when it is needed first

    gc.collect()
    gc.disable()
    yield
    gc.enable()


def test_a_loop_that_nobody_refers_to_any_more_has_no_process(tmp_path, uncollected):
    @subsystem(sample_time=0.01)
    def controller(v):
        return PID(kp=4.0, ki=20.0)(0.0, v)

    plant = Fmu(misstated_fmu(tmp_path, 3), interface="model_exchange", name="plant")
    diagram = Diagram("loop", plant(u=controller(plant["v"]).named("u")))
    loop = diagram.linearize().loop("u")
    found = margins(loop)
    assert count_processes()[0] >= 1
    del loop, found
    end_idle()
    assert count_processes() == (0, 0)


@pytest.mark.slow
def test_processes_that_only_garbage_holds_are_ended_before_many_are_there(folder, uncollected):
    plant = Fmu(zoo_fmu(folder, 3), name="plant", isolate=True)
    most = 0
    for _ in range(12):
        circle = [plant.instantiate(["u"], None)]
        circle[0].__enter__()
        circle.append(circle)
        most = max(most, count_processes()[0])
    assert most <= 9
    del circle
    gc.collect()


def test_an_idle_process_ends_after_a_while(folder, monkeypatch):
    from loopwright.fmus.isolation import pool

    monkeypatch.setattr(pool, "_IDLE_TIME", 0.2)
    end_idle()
    with pool._LOCKS[0]:  # its timer waits
        run_once(Fmu(zoo_fmu(folder, 3), name="plant", isolate=Isolation()))
        assert count_processes() == (1, 1)
    assert wait_for(count_processes, (0, 0)) == (0, 0)


def test_a_process_that_died_while_idle_is_replaced(folder):
    from loopwright.fmus.isolation import pool

    plant = Fmu(zoo_fmu(folder, 3), name="plant", isolate=True)
    end_idle()
    run_once(plant)
    ((_, process, _),) = pool._IDLE_ONES
    process._process.kill()
    assert wait_for(process.has_ended)
    assert run_once(plant) == pytest.approx(0.03)
    end_idle()
    assert count_processes() == (0, 0)


def test_what_it_writes_into_its_resources_is_not_there_in_the_next_run(folder):
    """It writes a file beside its working folder's others; the process with traces is not used again."""
    plant = Fmu(zoo_fmu(folder, 3, "step file"), name="plant", isolate=True)
    here = set(os.listdir())
    run_once(plant)
    assert set(os.listdir()) == here
    end_idle()


@pytest.mark.parametrize(("isolate", "fault"), [(False, "terminate error"), (True, "reset error")])
def test_a_foreign_fmu_is_not_reset_but_made_anew(folder, isolate, fault):
    """Its reset fails, or its termination; a fresh instance begins at y = 0 again."""
    plant = Fmu(zoo_fmu(folder, 3, fault), name="plant", isolate=isolate)
    one = FmuInstance(setup_of(plant), [])
    y = np.zeros(1)
    one.bind(np.zeros(0), y)
    try:
        for _ in range(3):
            one.initialize(None, values={"u": 1.0})
            one.begin()
            assert one.values(["y"]) == 0.0
            one.step(0.0, 0.5)
            assert one.values(["y"]) == y == 0.5
            one.reset()
    finally:
        one.close()
        end_idle()


@pytest.mark.parametrize(
    ("isolate", "rollback", "fault"),
    [
        (True, True, "states owned"),
        (True, False, "free_state error"),
        pytest.param(True, False, "states owned", marks=pytest.mark.slow),
        pytest.param(False, True, "states owned", marks=pytest.mark.slow),
        pytest.param(False, False, "states owned", marks=pytest.mark.slow),
    ],
)
def test_states_are_freed_before_their_instance(folder, isolate, rollback, fault):
    """A fault that ends the process for a state of another instance, or one that is left; an error is no end."""
    options = StepOptions(rollback=rollback)
    plant = Fmu(zoo_fmu(folder, 3, fault), name="plant", isolate=isolate, stepping=options)
    one = FmuInstance(setup_of(plant), [])
    one.bind(np.zeros(0), np.zeros(1))
    try:
        for _ in range(3):
            one.initialize(None, values={"u": 1.0})
            one.begin()
            start = one.save()
            one.step(0.0, 0.5)
            one.save()  # it has no name, so that it is freed
            one.step(0.5, 0.5)
            one.restore(start)
            one.step(0.0, 0.25)
            end = one.save()
            assert one.values(["y"]) == 0.25
            assert not start.is_free
            one.reset()
            assert start.is_free
            assert end.is_free
            with pytest.raises(FmuError, match="found a state that has been freed"):
                one.restore(end)
        one.initialize(None)
        one.begin()
        one.step(0.0, 0.5)
        kept = one.save()
    finally:
        one.close()
        end_idle()
    assert kept.is_free
    assert not [text for text in one.messages if "did not end well" in text]


def test_a_step_behind_a_linear_model_fails_without_words_on_a_run(folder):
    plant = Fmu(zoo_fmu(folder, 3, "step error"), name="plant", isolate=False)
    with pytest.raises(FmuRuntimeError) as error:
        plant.step_difference(0.1)
    assert str(error.value) == (
        "plant, t = 0 s: the step from t = 0 s by 0.1 s failed with fmi3Error. The FMU says: plant: error: this is an "
        "error. Take a smaller step, or check its start values."
    )


def test_an_own_build_is_reset(msd, monkeypatch):
    one = LoadedFmu(setup_of(Fmu(msd, name="plant")))
    calls = []
    try:
        monkeypatch.setattr(one.fmi, "renew", lambda log, running: calls.append("renew"))
        one.initialize(None)
        one.begin()
        one.reset()
        one.initialize(None)
        assert calls == []
    finally:
        one.close()


def test_an_instance_that_is_made_again_takes_no_more_memory(folder):
    """Calls that were bound are then those of the new instance; binding them again would fill the shared memory."""
    one = FmuInstance(setup_of(Fmu(zoo_fmu(folder, 3), name="plant", isolate=True)), [])
    y = np.zeros(1)
    one.bind(np.zeros(0), y)
    taken = []
    try:
        for k in range(5):
            one.initialize(None, values={"u": 1.0 + k})
            one.begin()
            for _ in range(3):  # bound when it is read for the second time
                assert one.values(["y", "u"]).tolist() == [0.0, 1.0 + k]
            one.step(0.0, 0.5)
            assert one.values(["y"]) == y == 0.5 * (1.0 + k)
            taken.append(one.fmi.process.place(0))
            one.reset()
    finally:
        one.close()
        end_idle()
    assert len({*taken[1:]}) == 1  # the second start binds what the first one has read
