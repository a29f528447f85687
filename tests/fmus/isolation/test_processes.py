"""FMUs in processes of their own: equal numbers, and faults that end the run alone. The FMU of the zoo is y' = u."""

import os
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from loopwright.blocks import ParameterError
from loopwright.blocks.core import Wanted
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, FmuProcessError, FmuRuntimeError, Isolation
from loopwright.fmus.fmu_block import setup_of
from loopwright.fmus.isolation import count_processes, end_idle
from loopwright.types import FmuEnd
from support.exported import mass_spring_damper
from support.waiting import Interruption, wait_for
from support.zoo import zoo_fmu

SHORT = Isolation(step_time=1.0)
"""For calls that never end; no other test has a limit that a busy machine reaches."""
pytestmark = pytest.mark.usefixtures("no_process_left")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("zoo")


def simulate(file, isolate=True, duration=0.1, **options):
    return Diagram("d", Fmu(file, name="plant", isolate=isolate)(u=1.0)).simulate(
        duration, step=0.01, progress=False, **options
    )


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_sound_fmu_gives_the_integral_of_its_input(folder, fmi):
    run = simulate(zoo_fmu(folder, fmi))
    assert np.allclose(run["plant.y"], run.t, atol=1e-12)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.drawn(1)
def test_numbers_are_bit_for_bit_those_in_process(msd, fmi):
    from loopwright.fmus import build_fmu

    file = msd if fmi == 3 else build_fmu(mass_spring_damper(), fmi=2)
    one, two = (
        Diagram("d", Fmu(file, name="plant", isolate=isolate)(force=1.0)).simulate(0.05, step=0.001, progress=False)
        for isolate in (True, False)
    )
    for port in Fmu(file).outputs:
        assert np.array_equal(one[f"plant.{port}"], two[f"plant.{port}"]), port


def test_it_works_where_memory_is_not_written_in_order(folder, monkeypatch):
    """There every request and reply is announced by a byte in a pipe, as on ARM."""
    end_idle()
    monkeypatch.setattr("loopwright.fmus.isolation.shared_memory.ORDERED", False)
    run = simulate(zoo_fmu(folder, 3), duration=1.0)
    assert np.allclose(run["plant.y"], run.t, atol=1e-12)
    with pytest.raises(FmuProcessError, match="SIGSEGV"):
        simulate(zoo_fmu(folder, 3, "step segfault 0.05"))


FAULTS = [
    ("load segfault", FmuEnd.CRASH, "loading its library", "SIGSEGV"),
    ("instantiate abort", FmuEnd.CRASH, "nstantiate", "SIGABRT"),
    ("enter exit", FmuEnd.EXIT, "EnterInitializationMode", "exit status 3"),
    ("step segfault 0.05", FmuEnd.CRASH, "DoStep", "SIGSEGV"),
    ("step divide_trapped 0.05", FmuEnd.CRASH, "DoStep", "SIGFPE"),
    ("step kill 0.05", FmuEnd.KILLED, "DoStep", "was killed (SIGKILL"),
    ("step exit0 0.05", FmuEnd.EXIT, "DoStep", "exit status 0"),
    ("step deaf_hang 0.05", FmuEnd.TIMEOUT, "DoStep", "has not ended after 1 s"),
    ("get segfault 0.05", FmuEnd.CRASH, "Get", "SIGSEGV"),
]


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize(("fault", "cause", "call", "text"), FAULTS, ids=[f[0].replace(" ", "_") for f in FAULTS])
@pytest.mark.drawn(5)
def test_a_fault_ends_the_run_and_says_where_when_and_why(folder, fmi, fault, cause, call, text):
    with pytest.raises(FmuProcessError) as caught:
        simulate(zoo_fmu(folder, fmi, fault), SHORT if cause is FmuEnd.TIMEOUT else True)
    error = caught.value
    assert error.cause is cause
    assert call in error.call
    assert text in str(error)
    assert error.call in str(error)
    assert error.block == "plant"
    late = "0.05" in fault
    assert error.t == pytest.approx((0.04 if call == "Get" else 0.05) if late else 0.0, abs=1e-9)
    if late:  # the samples until then are kept, and right
        assert len(error.run.t) >= 4
        assert np.allclose(error.run["plant.y"], error.run.t, atol=1e-12)


def test_too_much_memory_ends_the_run(folder):
    limits = Isolation(memory=200e6, step_time=30.0)
    with pytest.raises(FmuProcessError) as caught:
        simulate(zoo_fmu(folder, 3, "step memory 0.05"), limits)
    assert caught.value.cause is FmuEnd.MEMORY
    assert "200 MB" in str(caught.value)


@pytest.mark.skipif(sys.platform != "linux", reason="the system enforces the limit on Linux")
def test_a_limit_in_which_no_process_starts_is_said(folder):
    with pytest.raises(
        FmuProcessError, match=r"can't start within the limit of 0.001 MB .*isolate=Isolation"
    ) as caught:
        simulate(zoo_fmu(folder, 3, ""), Isolation(memory=1e3))
    assert caught.value.cause is FmuEnd.MEMORY
    assert "It wrote" not in str(caught.value)


@pytest.mark.skipif(sys.platform != "linux", reason="the system enforces the limit on Linux")
@pytest.mark.parametrize(("fault", "said"), [("no_memory", True), ("discard", False)])
def test_a_step_that_fails_for_want_of_memory_names_the_limit(folder, fault, said):
    file = zoo_fmu(folder, 3, f"step {fault} 0.05")
    with pytest.raises(FmuRuntimeError) as caught:
        simulate(file, Isolation(memory=200e6, step_time=30.0))
    assert ("of 200 MB of memory" in str(caught.value)) == said
    assert ("isolate=Isolation(memory=…)" in str(caught.value)) == said


def test_a_flood_of_output_ends_the_run(folder):
    limits = Isolation(output=1e6, step_time=30.0)
    with pytest.raises(FmuProcessError, match="wrote more than 1 MB") as caught:
        simulate(zoo_fmu(folder, 3, "step flood_stdout 0.05"), limits)
    assert caught.value.cause is FmuEnd.OUTPUT
    assert "out out out" in str(caught.value)  # its last lines


def test_the_log_before_the_end_is_quoted(folder):
    with pytest.raises(FmuProcessError, match="The FMU says: plant: warning: from a thread") as caught:
        simulate(zoo_fmu(folder, 3, "step log_hang 0.05"), SHORT)
    assert caught.value.cause is FmuEnd.TIMEOUT


@pytest.mark.parametrize("fault", ["chdir", "rounding", "traps", "sigmask", "sigint", "umask", "environment", "limits"])
@pytest.mark.drawn(3)
def test_what_an_fmu_changes_stays_in_its_process(folder, fault):
    here, mask = Path.cwd(), os.umask(0o022)
    os.umask(mask)
    environment = dict(os.environ)
    third = 1.0 / 3.0 + 1e-17
    run = simulate(zoo_fmu(folder, 3, f"step {fault}"))
    assert np.allclose(run["plant.y"], run.t, atol=1e-12)
    assert Path.cwd() == here
    assert dict(os.environ) == environment
    assert third == 1.0 / 3.0 + 1e-17
    assert os.umask(mask) == mask
    assert count_processes() == (0, 0)  # such a process is not used again


def processes_of(folder):
    """Return the numbers of processes whose command line names a folder."""
    found = []
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if str(folder).encode() in file.read_bytes():
                found.append(int(file.parent.name))
        except OSError:  # it has ended
            continue
    return found


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="looks at /proc")
def test_what_an_fmu_forks_ends_with_its_process(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    plant = Fmu(zoo_fmu(folder, 3, "step fork"), name="plant", isolate=True)
    with plant.instantiate(["u"], None) as one:
        one.bind(np.ones(1), np.zeros(1))
        one.begin()
        one.step(0.0, 0.01)
        assert len(processes_of(tmp_path)) == 2
    end_idle()
    assert wait_for(lambda: processes_of(tmp_path), []) == []  # killed, it ends when it gets its next turn
    assert [*tmp_path.iterdir()] == []


def test_a_fork_that_comes_back_is_no_second_fmu(folder):
    run = simulate(zoo_fmu(folder, 3, "step fork_on 0.05"))
    assert np.allclose(run["plant.y"], run.t, atol=1e-12)


def test_the_process_is_kept_for_the_next_run_with_a_fresh_instance(folder):
    file = zoo_fmu(folder, 3)
    first = simulate(file)
    assert count_processes() == (1, 1)
    second = simulate(file)
    assert count_processes() == (1, 1)
    assert np.array_equal(first["plant.y"], second["plant.y"])


@pytest.mark.parametrize(("fault", "kept"), [("chance", (1, 1)), ("stays", (0, 0))])
def test_a_run_does_not_follow_from_the_one_before(folder, fault, kept):
    """Random numbers of the C library begin again; a library that stays when it is unloaded has its memory still."""
    file = zoo_fmu(folder, 3, f"step {fault}")
    first, second = simulate(file), simulate(file)
    assert first["plant.y"][-1] > 1.0
    assert first["plant.y"].tobytes() == second["plant.y"].tobytes()
    assert count_processes() == kept


def test_an_fmu_that_a_process_can_have_once_may_be_there_twice(folder, tmp_path):
    import zipfile

    once = tmp_path / "once.fmu"
    with zipfile.ZipFile(zoo_fmu(folder, 3)) as old, zipfile.ZipFile(once, "w") as new:
        for item in old.infolist():
            data = old.read(item)
            if item.filename == "modelDescription.xml":
                flag = b'canBeInstantiatedOnlyOncePerProcess="true" canGetAndSetFMUState'
                data = data.replace(b"canGetAndSetFMUState", flag)
            new.writestr(item, data)
    a, b = (Fmu(once, name=name, isolate=True) for name in "ab")
    run = Diagram("d", a(u=1.0), b(u=2.0)).simulate(0.1, step=0.01, progress=False)
    assert np.allclose(run["b.y"], 2.0 * run.t, atol=1e-12)


def test_two_fmus_step_at_the_same_time(folder, meeting):
    """Each step waits until the other FMU is in its own."""
    file = zoo_fmu(folder, 3, "step meet")
    blocks = [Fmu(file, name=name, isolate=True) for name in "ab"]
    with blocks[0].instantiate(["u"], None) as a, blocks[1].instantiate(["u"], None) as b:
        for one in (a, b):
            one.bind(np.ones(1), np.zeros(1))
            one.begin()
        for k in range(5):
            a.start_step(0.01 * k, 0.01)
            b.start_step(0.01 * k, 0.01)
            a.finish_step()
            b.finish_step()
    assert meeting.count == 10


def test_saved_states_go_across_the_process(folder):
    plant = Fmu(zoo_fmu(folder, 3), name="plant", isolate=True)
    with plant.instantiate(["u"], None) as one:
        u, y = np.ones(1), np.zeros(1)
        one.bind(u, y)
        one.begin()
        one.step(0.0, 0.5)
        state = one.save()
        one.step(0.5, 0.5)
        assert y[0] == pytest.approx(1.0)
        one.restore(state)
        assert y[0] == pytest.approx(0.5)
        assert one.t == 0.5
        del state  # its memory is freed with the next one that is saved
        one.save()


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.drawn(1)
def test_model_exchange_and_linear_models_are_bit_for_bit_those_in_process(cache, fmi):
    from loopwright.fmus import build_fmu

    file = build_fmu(mass_spring_damper(), fmi=fmi)
    one, two = (Fmu(file, name="plant", isolate=isolate) for isolate in (True, False))
    for interface in ("model_exchange", "co_simulation"):
        for exact in (True, False):
            a, b = (plant.linear_model(interface=interface, exact=exact) for plant in (one, two))
            assert all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("A", "B", "C", "D", "y0"))
            assert a.derivation == b.derivation
    a, b = (plant.step_difference(0.01) for plant in (one, two))
    assert np.array_equal(a.A, b.A)
    x, y = (
        Diagram("d", plant.replace(interface="model_exchange")(force=1.0)).simulate(0.5, step=0.01, progress=False)
        for plant in (one, two)
    )
    for port in one.outputs:
        assert np.array_equal(x[f"plant.{port}"], y[f"plant.{port}"]), port


@pytest.mark.parametrize("wait", [0.0, 0.05])
def test_a_crash_in_model_exchange_names_the_time(msd, wait):
    """The library's process is ended between two evaluations, as by a system that is out of memory."""
    file = msd
    plant = Fmu(file, name="plant", interface="model_exchange", isolate=True)
    with plant.exchange([*plant.inputs]) as one:
        one.begin_exchange()
        evaluate = one.evaluation(Wanted((*plant.outputs,), rates=True))
        evaluate(0.25, np.zeros(2), np.ones(1))
        os.kill(one.fmi.process.pid, signal.SIGKILL)
        time.sleep(wait)  # its pipe is closed, or it has ended
        with pytest.raises(FmuProcessError, match="SIGKILL") as caught:
            evaluate(0.5, np.zeros(2), np.ones(1))
    assert caught.value.block == "plant"
    assert caught.value.t == 0.5
    assert caught.value.cause is FmuEnd.KILLED


def test_foreign_fmus_are_isolated_and_own_builds_are_not(folder, msd, tmp_path):
    assert setup_of(Fmu(zoo_fmu(folder, 3))).process_limits == Isolation()
    assert setup_of(Fmu(msd)).process_limits is None
    copy = tmp_path / "copy.fmu"
    copy.write_bytes(msd.read_bytes())
    assert setup_of(Fmu(copy)).process_limits is None  # its content counts
    assert setup_of(Fmu(msd, isolate=True)).process_limits == Isolation()
    assert setup_of(Fmu(zoo_fmu(folder, 3), isolate=False)).process_limits is None


def test_a_cache_that_others_can_write_proves_nothing(msd, cache):
    noted = cache / "built"
    mode = noted.stat().st_mode
    noted.chmod(0o777)
    try:
        assert setup_of(Fmu(msd)).process_limits is not None
    finally:
        noted.chmod(mode)
    assert setup_of(Fmu(msd)).process_limits is None


def test_a_wrong_limit_is_refused(msd):
    with pytest.raises(ParameterError, match=r"isolate.step_time: found -1; expected a positive number"):
        Isolation(step_time=-1)
    with pytest.raises(ParameterError, match="found 'yes'; expected True, False, None or an Isolation"):
        Fmu(msd, isolate="yes")


def test_what_an_fmu_prints_is_told_at_the_end(folder):
    plant = Fmu(zoo_fmu(folder, 3, "step print"), name="plant", isolate=True)
    for _ in range(2):  # the second one in the same process
        with plant.instantiate(["u"], None) as one:
            one.bind(np.ones(1), np.zeros(1))
            one.begin()
            one.step(0.0, 0.01)
        assert [m for m in one.messages if "printed" in m] == ["plant: it printed, in its own process: step by 0.01"]
    with Fmu(zoo_fmu(folder, 3), isolate=True).instantiate(["u"], None) as one:
        one.begin()
    assert one.messages == []


def test_the_child_imports_the_standard_library_only():
    """It is a second of NumPy, CasADi and FMPy faster so."""
    from loopwright.fmus.isolation import fmu_process

    begin = fmu_process._START.replace("; main()", "; print(*sys.modules)")
    here = [str(Path(fmu_process.__file__).parent)]
    done = subprocess.run([sys.executable, "-c", begin, *here], capture_output=True, text=True, check=True)
    assert "loopwright_child.child" in done.stdout.split()
    assert not {"numpy", "casadi", "fmpy", "loopwright", "scipy"} & set(done.stdout.split())
    assert len(done.stdout.split()) < 250


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_fork_of_this_process_leaves_its_fmus_alone(folder):
    with Fmu(zoo_fmu(folder, 3), name="plant", isolate=True).instantiate(["u"], None) as one:
        y = np.zeros(1)
        one.bind(np.ones(1), y)
        one.begin()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of threads of other tests
            pid = os.fork()
        if pid == 0:
            with suppress(BaseException):
                one.close()
                end_idle()
            os._exit(0)
        os.waitpid(pid, 0)
        one.step(0.0, 0.01)
        assert y[0] == pytest.approx(0.01)


def test_an_interrupt_ends_the_process_of_a_step(folder, meeting):
    """Ctrl-C while the FMU works: the run ends at once, long before the limit of a step, and the process with it."""
    limits = Isolation(step_time=1e4)
    plant = Fmu(zoo_fmu(folder, 3, "step deaf_hang 0.02"), name="plant", isolate=limits)
    with plant.instantiate(["u"], None) as one:
        one.bind(np.ones(1), np.zeros(1))
        one.begin()
        for k in range(2):
            one.step(0.01 * k, 0.01)
        with Interruption(lambda: meeting.count == 1), pytest.raises(KeyboardInterrupt):
            one.step(0.02, 0.01)
    assert count_processes() == (0, 0)
