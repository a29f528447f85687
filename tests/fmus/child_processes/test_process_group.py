"""Child processes end with their host, in whatever way it ends, and leave no folder."""

import os
import signal
import subprocess
import sys

import pytest

from loopwright.fmus.child_processes import ProcessGroup, run_in_group
from support.marked import GONE, ON_LINUX, Host
from support.waiting import is_there, wait_for

pytestmark = ON_LINUX
SIGNALS = pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])

COMPILER = """
import os, subprocess, sys, time
if ("--version" in sys.argv) != (sys.argv[1] == "version"):
    sys.exit()
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1e4)"])
open(sys.argv[2], "w").close()
time.sleep(1e4)
"""
BUILD = """
import sys
from pathlib import Path
from loopwright.fmus.export.compiler import compile_shared
compile_shared({{"a.c": ""}}, Path({!r}))
"""


@SIGNALS
@pytest.mark.parametrize("when", ["version", "compile"])
def test_a_compiler_ends_with_its_host(tmp_path, number, when):
    """It and the process that it has started, and the folder in which it works is removed."""
    (tmp_path / "sleep.py").write_text(COMPILER)
    command = f"{sys.executable} {tmp_path / 'sleep.py'} {when} {tmp_path / 'begun'}"
    out = tmp_path / "out" / "a.so"
    with Host(BUILD.format(str(out)), LOOPWRIGHT_CC=command) as host:
        assert wait_for((tmp_path / "begun").exists, seconds=60.0)
        assert len([line for line in host.others().values() if "sleep" in line]) == 2
        assert host.kill(number) == {}
        assert wait_for(lambda: [*out.parent.glob("*")], [], GONE) == []


FORKED = """
import os, sys, time
from loopwright.fmus.child_processes import ProcessGroup
with ProcessGroup() as group:
    member = group.start([sys.executable, "-c", "import time; time.sleep(1e4)"])
    held, (end, begin) = os.dup(group._leader.stdin.fileno()), os.pipe()
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
    """The fork holds the host's end of the pipe to the leader."""
    with Host(FORKED) as host:
        member, other, status = host.process.stdout.readline().split()
        assert status == "None"
        assert is_there(member)
        host.process.kill()
        host.process.wait()
        assert wait_for(lambda: [*host.others()], [int(other)], GONE) == [int(other)]


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


LED_AGAIN = """
import os, signal, sys, time
from loopwright.fmus.child_processes import ProcessGroup
sleep = [sys.executable, "-c", "import time; time.sleep(1e4)"]
with ProcessGroup() as group:
    first = group.start(sleep)
    os.kill(os.getpgid(first.pid), signal.SIGKILL)
    os.waitid(os.P_PID, os.getpgid(first.pid), os.WEXITED | os.WNOWAIT)
    second = group.start(sleep)
    assert os.getpgid(second.pid) != os.getpgid(first.pid)
    if sys.argv[1:] == ["end"]:
        group.end()
        print(first.wait(), second.wait())
        sys.exit()
    first.kill()  # the group of the killed leader protects nothing
    open(sys.argv[1], "w").close()
    time.sleep(1e4)
"""


@SIGNALS
def test_a_group_whose_leader_was_killed_gets_another(tmp_path, number):
    with Host(LED_AGAIN, str(tmp_path / "begun")) as host:
        assert wait_for((tmp_path / "begun").exists, seconds=60.0)
        assert host.kill(number) == {}
    done = subprocess.run([sys.executable, "-c", LED_AGAIN, "end"], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["-9", "-9"]


def test_a_command_is_run_to_its_end(tmp_path):
    script = "import os, sys; print(os.getcwd(), os.environ['X']); print('no', file=sys.stderr); sys.exit(3)"
    command = [sys.executable, "-c", script]
    done = run_in_group(command, folders=[tmp_path], cwd=tmp_path, environment={**os.environ, "X": "7"})
    assert (done.args, done.returncode, done.stdout, done.stderr) == (command, 3, f"{tmp_path} 7\n", "no\n")
    assert tmp_path.exists()  # the host lives
    with pytest.raises(subprocess.TimeoutExpired):
        run_in_group([sys.executable, "-c", SPAWN], seconds=1.0)
    with pytest.raises(FileNotFoundError):
        run_in_group([str(tmp_path / "none")])
    assert not [pid for pid in children() if "leader.py" in command_line(pid)]


def children():
    with open(f"/proc/self/task/{os.getpid()}/children") as file:
        return file.read().split()


def command_line(pid):
    with open(f"/proc/{pid}/cmdline") as file:
        return file.read()
