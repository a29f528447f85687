"""Child processes end with their host, in whatever way it ends, and leave no folder."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from loopwright.fmus import CompilerError
from loopwright.fmus.child_processes import ProcessGroup, run_in_group
from loopwright.fmus.export.compiler import compile_shared
from support.marked import GONE, ON_LINUX, Host
from support.waiting import is_there, wait_for

pytestmark = [ON_LINUX, pytest.mark.usefixtures("processes_of_earlier_tests_ended")]
SIGNALS = pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])

COMPILER = """
import os, subprocess, sys, time
if ("--version" in sys.argv) != (sys.argv[1] == "version"):
    sys.exit()
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1e4)"])
open(sys.argv[2], "w").close()
time.sleep(1e4)
"""
COMPILED = """
from pathlib import Path
from loopwright.fmus.export.compiler import compile_shared
compile_shared({{"a.c": ""}}, Path({!r}))
"""
PLANT = """
from loopwright.fmus import mass_spring_damper
mass_spring_damper.build(out={!r})
"""
PYTHON = """
import loopwright.fmus.export.python_fmu as python_fmu
from loopwright.fmus.models.mass_spring_damper import MassSpringDamper
python_fmu._MAKE = "import sys, time; open(r'BEGUN', 'w').close(); time.sleep(1e4)"
python_fmu.build_python(MassSpringDamper(), {!r})
"""


@SIGNALS
@pytest.mark.parametrize(
    ("script", "when"), [(COMPILED, "version"), (COMPILED, "compile"), (PLANT, "compile"), (PYTHON, "pack")]
)
@pytest.mark.drawn(2)
def test_a_build_ends_with_its_host(tmp_path, number, script, when):
    """The compiler and the process that it has started, and all folders in which they work are removed."""
    (tmp_path / "sleep.py").write_text(COMPILER)
    (temporary := tmp_path / "temporary").mkdir()
    begun, out = tmp_path / "begun", tmp_path / "out" / "a.so"
    command = f"{sys.executable} {tmp_path / 'sleep.py'} {when} {begun}"
    script = script.format(str(out)).replace("BEGUN", str(begun))
    with Host(script, LOOPWRIGHT_CC=command, TMPDIR=str(temporary)) as host:
        assert wait_for(begun.exists, seconds=60.0)
        assert len([line for line in host.others().values() if "sleep" in line]) == (1 if when == "pack" else 2)
        assert when != "compile" or [*temporary.iterdir(), *out.parent.glob(".building-*")] != []
        assert host.kill(number) == {}
        assert wait_for(lambda: [*out.parent.glob("*"), *temporary.iterdir()], [], GONE) == []


FORKED = """
import os, sys, time
from loopwright.fmus.child_processes import ProcessGroup, keeper
with ProcessGroup() as group:
    member = group.start([sys.executable, "-c", "import time; time.sleep(1e4)"])
    held, (end, begin) = os.dup(keeper._KEEPERS[0]._process.stdin.fileno()), os.pipe()
    other = os.fork()
    if other == 0:
        group.end()
        os.write(begin, b"x")
        time.sleep(1e4)
    os.read(end, 1)
    print(member.pid, other, member.poll(), flush=True)
    time.sleep(1e4)
"""


def test_a_fork_of_the_host_neither_ends_its_children_nor_keeps_them():
    """The fork holds the host's end of the pipe to the keeper."""
    with Host(FORKED) as host:
        member, other, status = host.process.stdout.readline().split()
        assert status == "None"
        assert is_there(member)
        host.process.kill()
        host.process.wait()
        assert wait_for(lambda: [*host.others()], [int(other)], GONE) == [int(other)]


def test_nothing_of_a_group_is_left_when_it_has_ended(tmp_path):
    """Not even a zombie: the process that keeps it, here for another group, too, says when it is gone."""
    with ProcessGroup():
        for _ in range(5):
            with ProcessGroup() as group:
                run_in_group([sys.executable, "-c", ""], seconds=60)
                (number,) = [one for _, one in group._groups]
                assert Path(f"/proc/{number}").exists()
            assert not Path(f"/proc/{number}").exists()


def test_the_end_of_a_group_is_that_of_all_its_processes():
    with ProcessGroup() as group:
        child = group.start([sys.executable, "-c", SPAWN], stdout=subprocess.PIPE)
        grandchild = int(child.stdout.readline())
        assert os.getpgid(grandchild) == os.getpgid(child.pid) != os.getpgid(0)
    assert child.wait() == -signal.SIGKILL
    child.stdout.close()
    assert wait_for(lambda: is_there(grandchild), False, GONE) is False
    with pytest.raises(ProcessLookupError):
        group.start([sys.executable, "-c", ""])


SPAWN = """
import subprocess, sys, time
print(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1e4)"]).pid, flush=True)
time.sleep(1e4)
"""


KEPT_AGAIN = """
import os, signal, sys, time
from loopwright.fmus.child_processes import ProcessGroup, keeper, make_temporary_folder
sleep = [sys.executable, "-c", "import time; time.sleep(1e4)"]
folder = make_temporary_folder("")
with ProcessGroup() as group:
    first = group.start(sleep)
    lost = keeper._KEEPERS[0]._process if sys.argv[1] == "keeper" else None
    os.kill(os.getpgid(first.pid) if lost is None else lost.pid, signal.SIGKILL)
    if lost is not None:
        lost.wait()
        first.wait()
    second = group.start(sleep)
    if sys.argv[2:] == ["end"]:
        group.end()
        print(first.wait(), second.wait())
        sys.exit()
    if lost is None:
        first.kill()
    open(sys.argv[2], "w").close()
    time.sleep(1e4)
"""


@SIGNALS
@pytest.mark.parametrize("killed", ["first", "keeper"])
@pytest.mark.drawn
def test_a_group_goes_on_where_its_first_process_or_the_keeper_was_killed(tmp_path, number, killed):
    (temporary := tmp_path / "temporary").mkdir()
    with Host(KEPT_AGAIN, killed, str(tmp_path / "begun"), TMPDIR=str(temporary)) as host:
        assert wait_for((tmp_path / "begun").exists, seconds=60.0)
        assert host.kill(number) == {}
        assert wait_for(lambda: [*temporary.iterdir()], [], GONE) == []
    command = [sys.executable, "-c", KEPT_AGAIN, killed, "end"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["-9", "-9"]


def test_a_python_that_does_not_know_its_program_is_named(tmp_path, monkeypatch):
    """It was reported as a missing compiler."""
    monkeypatch.setattr(sys, "executable", "")
    with pytest.raises(CompilerError, match=r"sys.executable is ''.*Set it, such as sys.executable = '/usr/bin") as no:
        compile_shared({"a.c": ""}, tmp_path / "a.so")
    assert "Install" not in str(no.value)


def test_a_command_is_run_to_its_end(tmp_path):
    script = "import os, sys; print(os.getcwd(), os.environ['X']); print('no', file=sys.stderr); sys.exit(3)"
    command = [sys.executable, "-c", script]
    done = run_in_group(command, cwd=tmp_path, environment={**os.environ, "X": "7"})
    assert (done.args, done.returncode, done.stdout, done.stderr) == (command, 3, f"{tmp_path} 7\n", "no\n")
    with pytest.raises(subprocess.TimeoutExpired):
        run_in_group([sys.executable, "-c", SPAWN], seconds=1.0)
    with pytest.raises(FileNotFoundError):
        run_in_group([str(tmp_path / "none")])
    assert not [pid for pid in children() if "keeper_process" in command_line(pid)]


def children():
    with open(f"/proc/self/task/{os.getpid()}/children") as file:
        return file.read().split()


def command_line(pid):
    with open(f"/proc/{pid}/cmdline") as file:
        return file.read()
