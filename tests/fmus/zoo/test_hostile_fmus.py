"""Hostile and broken FMUs, a fault in each: this process lives on unchanged, and the run's error says what happened.

They run in a process that stands for the user's (`support/zoo_host.py`), one after the other. The block is y' = u with
u = 1, so that every sample that was kept is the time.
"""

import json
import os
import select
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu
from support import zoo_host
from support.waiting import FAR, wait_for
from support.zoo import zoo_fmu

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="its C source knows Linux")

T, H, N = 0.05, 0.01, 11  # time of the fault, step, samples of a whole run to 0.1 s
KEPT = 6  # samples up to the fault
SOON = 180.0  # s, of a run that takes some tenths; the limits of its calls are further
SHORT = {"step_time": 1.0, "start_time": 4.0}
"""For calls that never end; no other test has a limit that a busy machine reaches."""


class Host:
    """The process that runs the FMUs; a dead one is told, and replaced for the next test."""

    def __init__(self, folder):
        self.folder, self.process, self.count = Path(folder), None, 0

    def start(self):
        self.work = self.folder / f"work{self.count}"
        self.temporary = self.folder / f"temporary{self.count}"
        self.count += 1
        for place in (self.work, self.temporary):
            place.mkdir()
        self.process = subprocess.Popen(
            [sys.executable, zoo_host.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=self.work,
            env=os.environ | {"TMPDIR": str(self.temporary)},
        )

    def run(self, file, *, read=False, **options):
        """Run an FMU with options of its block; ``read`` wires a block to its output."""
        if self.process is None or self.process.poll() is not None:
            self.start()
        request = {"file": str(file), "options": options, "read": read, "duration": 0.1, "step": H}
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        if not select.select([self.process.stdout], [], [], SOON)[0]:
            self.process.kill()
            self.process.wait()
            raise AssertionError(f"the run of {file.name} has not ended after {SOON:g} s")
        line = self.process.stdout.readline()
        assert line, f"the process that ran {file.name} ended with {self.process.wait(FAR)}"
        answer = json.loads(line)
        assert "broken" not in answer, answer["broken"]
        return answer

    def end(self):
        """End the process, and return the processes and temporary files that it leaves."""
        if self.process is None:
            return [], []
        self.process.stdin.close()
        self.process.wait(FAR)
        self.process.stdout.close()
        return wait_for(lambda: users_of(self.folder), []), sorted(p.name for p in self.temporary.rglob("*"))


def users_of(folder):
    """Return the processes with a file below a folder as their working folder or in their memory."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if str(folder) in (entry / "maps").read_text() or str(folder) in os.readlink(entry / "cwd"):
                found.append(int(entry.name))
        except OSError:
            continue
    return [pid for pid in found if pid != os.getpid()]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("zoo")


@pytest.fixture(scope="module")
def host(place):
    """The process for all tests; at its end nothing is left of it, of its FMUs, or of what these have started."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LOOPWRIGHT_CACHE", str(place / "cache"))
        made = Host(place)
        yield made
        processes, files = made.end()
    assert processes == []
    assert files == []


def check_host(answer):
    """Check that nothing of this process has changed, and that no process hangs about as a zombie or stopped."""
    assert answer["changed"] == {}
    assert not set(answer["children"].values()) & {"Z", "T"}, answer["children"]
    assert answer["y"] == pytest.approx(answer["t"], abs=1e-12)


def quick(*values):
    return pytest.param(*values)


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


def limits(fault):
    """Return the limits of calls: those of a fault without end are reached, others never."""
    return SHORT if fault in ("hang", "spin", "deaf_hang", "stop") else {"step_time": 1e4, "start_time": 1e4}


def fail(answer, kind, kept, *words):
    """Check an error: its class, the samples until then, and words of its text, which names the block."""
    check_host(answer)
    assert kind in answer["kinds"], answer["text"]
    assert len(answer["t"]) == kept, answer["text"]
    for word in ("zoo", *words):
        assert word in answer["text"]


# --- faults that end the FMU's process -------------------------------------------------------------------------------

CRASHES = [
    quick("segfault", "crash", "SIGSEGV"),
    slow("bus", "crash", "SIGBUS"),
    slow("illegal", "crash", "SIGILL"),
    slow("divide", "crash", "SIGFPE"),
    slow("divide_trapped", "crash", "SIGFPE"),
    quick("abort", "crash", "SIGABRT"),
    slow("stack", "crash", "SIGSEGV"),
    slow("scribble", "crash", "SIGSEGV"),
    slow("thread_crash", "crash", "SIGSEGV"),
    slow("kill", "killed", "SIGKILL"),
    quick("exit", "exit", "status 3"),
    slow("exit0", "exit", "status 0"),
    slow("quick_exit", "exit", "status 0"),
    quick("hang", "timeout", "1 s"),
    slow("spin", "timeout", "1 s"),
    slow("deaf_hang", "timeout", "1 s"),
    slow("stop", "timeout", "1 s"),
]


@pytest.mark.parametrize("fmi", [3, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("fault", "cause", "word"), CRASHES)
def test_a_fault_in_a_step_ends_the_run_and_nothing_else(host, place, fmi, fault, cause, word):
    answer = host.run(zoo_fmu(place, fmi, f"step {fault} {T}"), isolate=limits(fault))
    fail(answer, "FmuProcessError", KEPT, f"fmi{fmi}DoStep", word, f"t = {T} s")
    assert (answer["cause"], answer["call"]) == (cause, f"fmi{fmi}DoStep")


BEFORE = {
    "load": "loading its library",
    "version": "GetVersion",
    "instantiate": "Instantiate",
    "set": "SetFloat64",
    "enter": "EnterInitializationMode",
    "exit": "ExitInitializationMode",
    "get": "GetFloat64",
}
AFTER = {"terminate": "Terminate", "free": "FreeInstance", "unload": "unloading"}


@pytest.mark.parametrize("fmi", [3, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("where", [quick("load"), *(slow(name) for name in list(BEFORE)[1:])])
@pytest.mark.parametrize(
    ("fault", "cause"), [quick("segfault", "crash"), slow("exit", "exit"), slow("hang", "timeout")]
)
def test_a_fault_before_the_first_step_names_the_call(host, place, fmi, where, fault, cause):
    answer = host.run(zoo_fmu(place, fmi, f"{where} {fault}"), isolate=limits(fault))
    fail(answer, "FmuProcessError", 0)
    assert answer["cause"] == cause
    assert BEFORE[where].replace("Float64", "Real" if fmi == 2 else "Float64") in answer["call"]


@pytest.mark.parametrize("fmi", [3, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("where", [quick("free"), slow("terminate"), slow("unload")])
@pytest.mark.parametrize("fault", [quick("segfault"), slow("exit"), slow("hang")])
def test_a_fault_after_the_last_step_leaves_the_run_whole_and_is_told(host, place, fmi, where, fault):
    answer = host.run(zoo_fmu(place, fmi, f"{where} {fault}"), isolate=limits(fault))
    check_host(answer)
    assert answer["kinds"] == []
    assert len(answer["t"]) == N
    assert any(AFTER[where] in text for text in answer["messages"]), answer["messages"]


# --- limits ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_memory_without_end_is_told_as_such(host, place):
    answer = host.run(zoo_fmu(place, 3, f"step memory {T}"), isolate={"memory": 400e6, "step_time": 30.0})
    fail(answer, "FmuProcessError", KEPT, "memory")
    assert answer["cause"] == "memory"


def test_output_without_end_is_told_as_such(host, place):
    answer = host.run(zoo_fmu(place, 3, f"step flood_stdout {T}"), isolate={"output": 1e6, "step_time": 30.0})
    fail(answer, "FmuProcessError", KEPT, "1 MB", "out out out")
    assert answer["cause"] == "output"


# --- faults that stay in the FMU's process ---------------------------------------------------------------------------

CONTAINED = [
    quick("chdir"),
    slow("rounding"),
    slow("traps"),
    slow("sigmask"),
    slow("sigint"),
    slow("umask"),
    slow("environment"),
    slow("limits"),
    slow("file"),
    slow("close_stdout"),
    slow("close_all"),
    quick("fork"),
    slow("fork_exit"),
    slow("thread"),
    slow("thread_on"),
    slow("leak"),
    slow("handles"),
    slow("slow"),
]


@pytest.mark.parametrize("fmi", [3, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("fault", CONTAINED)
def test_what_an_fmu_does_to_its_process_stays_there(host, place, fmi, fault):
    for _ in range(2):  # the second run finds nothing of the first
        answer = host.run(zoo_fmu(place, fmi, f"step {fault} {T}"))
        check_host(answer)
        assert answer["kinds"] == [], answer["text"]
        assert len(answer["t"]) == N


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_step_that_two_processes_return_from_counts_once(host, place, fmi):
    """A fork of which both sides go on: each would answer."""
    answer = host.run(zoo_fmu(place, fmi, f"step fork_on {T}"))
    check_host(answer)
    assert len(answer["t"]) == N or "FmuProcessError" in answer["kinds"]


# --- messages --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("fault", ["flood_log", "huge_log", "odd_log"])
def test_messages_are_kept_within_bounds_and_can_be_printed(host, place, fmi, fault):
    answer = host.run(zoo_fmu(place, fmi, f"step {fault} {T}"))
    check_host(answer)
    assert answer["kinds"] == []
    assert 1 <= len(answer["messages"]) <= 1001
    assert all(text.isprintable() for text in answer["messages"])
    assert sum(map(len, answer["messages"])) < 200_000


# --- wrong returns ---------------------------------------------------------------------------------------------------

RETURNS = [
    quick("error", "fmi{}Error", "this is an error"),
    slow("fatal", "fmi{}Fatal", "this is fatal"),
    slow("discard", "fmi{}Discard", "no solution here"),
    slow("status17", "status 17", "zoo"),
    slow("minus", "status -1", "zoo"),
]


@pytest.mark.parametrize("fmi", [3, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("fault", "status", "words"), RETURNS)
def test_a_step_that_fails_is_told_with_the_fmu_s_words(host, place, fmi, fault, status, words):
    answer = host.run(zoo_fmu(place, fmi, f"step {fault} {T}"))
    fail(answer, "FmuRuntimeError", KEPT, status.format(fmi), words)
    assert answer["at"] == pytest.approx(T)


@pytest.mark.slow
@pytest.mark.parametrize(("fmi", "word"), [(2, "pending after 1 s"), (3, "status 5")])
def test_a_step_that_is_pending_for_ever_ends(host, place, fmi, word):
    """In FMI 2.0 it is asked for its status as long as a step may take; FMI 3.0 has no such status."""
    answer = host.run(zoo_fmu(place, fmi, f"step pending {T}"), isolate=SHORT)
    fail(answer, "FmuRuntimeError", KEPT, word)
    assert ("pending" in answer["text"]) == (fmi == 2)


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("where", ["set", "enter", "exit", "get"])
@pytest.mark.parametrize("fault", ["error", "discard", "fatal"])
def test_an_initialization_that_fails_says_so(host, place, fmi, where, fault):
    answer = host.run(zoo_fmu(place, fmi, f"{where} {fault}"))
    fail(answer, "FmuRuntimeError", 0, "initialization failed", "no solution here" if fault == "discard" else "this is")


@pytest.mark.parametrize("fmi", [3, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("fault", "word"),
    [
        slow("null", "instantiate"),
        quick("licence", "Licence checkout failed: no seat is free"),
        slow("error", "this is an error"),
    ],
)
def test_an_instance_that_can_t_be_had_says_so(host, place, fmi, fault, word):
    answer = host.run(zoo_fmu(place, fmi, f"instantiate {fault}"))
    fail(answer, "FmuFileError", 0, word, "loopwright doctor")


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_an_output_that_is_no_number_and_is_read_names_the_port(host, place, fmi, value):
    answer = host.run(zoo_fmu(place, fmi, f"value {value} {T}"), read=True)
    fail(answer, "NonFiniteError", KEPT - 1, "zoo.y", f"t = {T} s", "FMU", "read by reader.u")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fmi", "flag", "words"),
    [
        (2, "terminate", "terminateSimulation"),
        (3, "terminate", "terminateSimulation"),
        (3, "early", "earlyReturn"),
        (3, "beyond", "lastSuccessfulTime"),
        (3, "negative", "lastSuccessfulTime"),
        (3, "nan", "lastSuccessfulTime"),
    ],
)
def test_a_step_that_does_not_end_where_it_should_is_told(host, place, fmi, flag, words):
    answer = host.run(zoo_fmu(place, fmi, f"flags {flag} {T}"))
    if flag in ("negative", "nan"):  # told, and no error: FMUs leave it as it is
        check_host(answer)
        assert len(answer["t"]) == N, answer["text"]
        assert any(words in text for text in answer["messages"]) == (flag == "negative"), answer["messages"]
    elif flag == "terminate":  # the run ends: before the step in FMI 2.0, which discards it, and after it in FMI 3.0
        check_host(answer)
        assert answer["text"] == ""
        assert len(answer["t"]) == KEPT + (fmi == 3)
        assert any(words in text for text in answer["messages"]), answer["messages"]
    else:
        fail(answer, "FmuRuntimeError", KEPT, words)


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("version", ["3.9", "3.0-beta.1", "2.0-beta", "1.0", "null"])
def test_a_library_of_another_version_is_refused(host, place, fmi, version):
    answer = host.run(zoo_fmu(place, fmi, f"version_is {version}"))
    fail(answer, "FmuFileError", 0, "GetVersion", repr(f"{fmi}.0"))


# --- libraries with parts missing ------------------------------------------------------------------------------------

INSTANTIATE = {2: "Instantiate", 3: "InstantiateCoSimulation"}


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("name", ["DoStep", "", "FreeInstance", "GetVersion", "ExitInitializationMode"])
def test_a_library_without_a_function_that_it_needs_is_refused(host, place, fmi, name):
    name = name or INSTANTIATE[fmi]
    fail(host.run(zoo_fmu(place, fmi, missing=name)), "FmuFileError", 0, f"fmi{fmi}{name}")


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("name", ["GetFMUState", "Reset", "SetDebugLogging"])
def test_a_library_without_a_function_that_a_run_does_not_call_runs(host, place, fmi, name):
    name = name.replace("State", "state") if fmi == 2 else name
    answer = host.run(zoo_fmu(place, fmi, missing=name))
    check_host(answer)
    assert len(answer["t"]) == N, answer["text"]


@pytest.mark.parametrize("fmi", [3, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("keep", [slow(0.005), slow(0.1), quick(0.5), slow(0.8)])
def test_a_library_that_is_cut_off_is_refused(host, place, fmi, keep):
    answer = host.run(zoo_fmu(place, fmi, keep=keep))
    fail(answer, "FmuFileError", 0, "cut off")


# --- model exchange --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("where", ["derivative", "states", "time", "indicators"])
@pytest.mark.parametrize(
    ("fault", "kind"), [("segfault", "FmuProcessError"), ("hang", "FmuProcessError"), ("error", "FmuRuntimeError")]
)
def test_a_fault_in_an_evaluation_ends_the_run_and_nothing_else(host, place, fmi, where, fault, kind):
    answer = host.run(zoo_fmu(place, fmi, f"{where} {fault} {T}"), isolate=limits(fault), interface="model_exchange")
    fail(answer, kind, len(answer["t"]))
    assert 1 <= len(answer["t"]) <= KEPT


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("fault", ["slope nan", "slope inf", "derivative discard"])
def test_a_rate_that_is_no_number_names_the_state(host, place, fmi, fault):
    answer = host.run(zoo_fmu(place, fmi, f"{fault} {T}"), interface="model_exchange")
    fail(answer, "SimulationError", KEPT - 1, "zoo.y", "not finite")


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("value", ["zero", "nan"])
def test_a_nominal_value_that_is_none_is_told_and_replaced(host, place, fmi, value):
    answer = host.run(zoo_fmu(place, fmi, f"nominal {value}"), interface="model_exchange")
    check_host(answer)
    assert len(answer["t"]) == N, answer["text"]
    assert any("nominal" in text for text in answer["messages"])


@pytest.mark.parametrize("fmi", [3, pytest.param(2, marks=pytest.mark.slow)])
def test_values_that_are_computed_with_the_derivatives_alone_are_not_stale(place, fmi):
    """An older OpenModelica's variables are those of the last derivatives, whatever states have been set since."""
    plant = Fmu(
        zoo_fmu(place, fmi, "lazy on"), name="zoo", start={"u": 1.0}, interface="model_exchange", ports=["y", "z"]
    )
    run = Diagram("d", plant()).simulate(0.1, step=H, progress=False)
    np.testing.assert_allclose(run["zoo.z"], run.t, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [2, 3])
def test_an_event_iteration_without_end_is_ended(host, place, fmi):
    answer = host.run(zoo_fmu(place, fmi, "update endless"), interface="model_exchange")
    fail(answer, "SimulationError", 0, "event iteration")
