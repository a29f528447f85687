"""Errors of files and folders say what was found, what was expected, and one next step."""

import errno
import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

from loopwright.blocks import OptionError
from loopwright.blocks.core import (
    check_file,
    describe_disk_error,
    explain_disk_errors,
    find_disk_error,
    write_text,
)
from loopwright.diagrams import DiskError
from support.failing_disk import fail_below

POSIX = pytest.mark.skipif(os.name != "posix", reason="limits and users of POSIX")
FOUND = {
    "EACCES": "there is no permission to use ",
    "EPERM": "there is no permission to use ",
    "ENOSPC": "no space is left on the disk at ",
    "EDQUOT": "this user's quota on the disk at ",
    "EROFS": " is on a file system that can only be read; ",
    "EFBIG": " grows larger than its file system allows; ",
    "EMFILE": "this process has as many files open as it may (RLIMIT_NOFILE); ",
    "ENAMETOOLONG": " is longer than its file system allows; ",
    "EIO": "the system says 'Input/output error' of ",
}
STEPS = {
    "ENOSPC": "Make room there.",
    "EDQUOT": "Make room there.",
    "EMFILE": "Raise the limit with 'ulimit -n' in the shell that starts Python.",
}


@POSIX
@pytest.mark.parametrize("name", FOUND)
def test_each_error_number_has_its_words_and_one_step(name, tmp_path):
    code = getattr(errno, name)
    place = tmp_path / "a.txt"
    said = describe_disk_error(OSError(code, os.strerror(code), str(place)), tmp_path, "Take another one.")
    found, _, rest = said.partition("; expected ")
    assert FOUND[name] in f"{found}; "
    assert rest.endswith(f". {STEPS.get(name, 'Take another one.')}")
    assert (" Take another one." in said) is (name not in STEPS)
    assert ("room" in said) is (name in ("ENOSPC", "EDQUOT"))


@POSIX
def test_a_folder_of_another_user_is_named_with_its_owner(tmp_path, monkeypatch):
    theirs = tmp_path / "theirs"
    theirs.mkdir(mode=0o750)
    theirs.chmod(0o750)
    fail_below(monkeypatch, theirs, errno.EACCES)
    with pytest.raises(DiskError) as caught:
        write_text(theirs / "a" / "b.txt", "b")
    import pwd

    me = pwd.getpwuid(os.geteuid()).pw_name
    assert str(caught.value) == (
        f"'{theirs}/a/b.txt' can't be written: there is no permission to use '{theirs}' (of user {me}, permissions "
        f"750; this process is of user {me}); expected that this user has it. Name a file in another folder."
    )
    assert isinstance(caught.value.__cause__, PermissionError)
    assert isinstance(caught.value, OSError)  # whoever caught those of earlier versions
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_missing_folders_and_files_in_place_of_folders(tmp_path):
    (tmp_path / "file").write_text("")
    for path, found, step in (
        (tmp_path / "none" / "a.txt", f"there is no folder '{tmp_path}/none'; expected one", "Make it."),
        (tmp_path / "file" / "a.txt", f"'{tmp_path}/file' is a file; expected a folder", "Continue."),
        (tmp_path, f"'{tmp_path}' is a folder; expected a file, or nothing", "Continue."),
    ):
        with pytest.raises(DiskError) as caught, explain_disk_errors("no", "x", "Continue."):
            path.write_text("")
        assert str(caught.value) == f"no: {found}. {step}"


GONE = """
import os, sys
from loopwright.blocks import LoopwrightError
from loopwright.blocks.core import check_file, write_text
os.chdir(sys.argv[1])
os.rmdir(sys.argv[1])
for write in (check_file, lambda path: write_text(path, "")):
    try:
        write("a.txt")
    except LoopwrightError as error:
        print(error)
"""


@POSIX
def test_a_working_folder_that_was_removed_is_named(tmp_path):
    done = subprocess.run([sys.executable, "-c", GONE, str(tmp_path)], capture_output=True, text=True, check=True)
    gone = (
        "'a.txt' can't be written: the working folder of this process has been removed; expected one that is there. "
        "Change to another one first, by cd in a shell or os.chdir in Python.\n"
    )
    assert done.stdout == f"path: {gone}{gone}"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device that is always full, of Linux")
def test_a_full_device(tmp_path):
    with pytest.raises(DiskError, match=r"^'/dev/full' can't be written: no space is left on the disk at '/.*'.*Make"):
        write_text("/dev/full", "text")


LIMITED = """
import resource, sys
from loopwright.diagrams import DiskError
from loopwright.blocks.core import write_text
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
try:
    write_text(sys.argv[1], 1001 * "x")
except DiskError as error:
    print(error)
"""


@POSIX
def test_a_limit_of_this_process_is_not_taken_for_a_full_disk(tmp_path):
    path = tmp_path / "a.txt"
    done = subprocess.run([sys.executable, "-c", LIMITED, str(path)], capture_output=True, text=True, check=True)
    assert done.stdout == (
        f"'{path}' can't be written: '{path}' grows beyond 1000 bytes, the largest file that this process may write "
        "(RLIMIT_FSIZE); expected no such limit. Lift it with 'ulimit -f unlimited' in the shell that starts Python.\n"
    )
    assert list(tmp_path.iterdir()) == []


def test_errors_that_are_explained_are_explained_once(tmp_path):
    with (
        pytest.raises(OptionError) as caught,
        explain_disk_errors("the sweep can't be kept", tmp_path, "Choose another folder.", OptionError, port="to"),
    ):
        write_text(tmp_path / "none" / "a.txt", "")
    assert str(caught.value) == (
        f"to: the sweep can't be kept: there is no folder '{tmp_path}/none'; expected one. Make it."
    )


def test_a_pipe_whose_reader_has_gone_is_no_error_of_a_disk(tmp_path):
    with pytest.raises(BrokenPipeError), explain_disk_errors("no", tmp_path, "no"):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")


def test_a_trial_file_finds_what_another_program_met(tmp_path, monkeypatch):
    assert find_disk_error(tmp_path) is None
    fail_below(monkeypatch, tmp_path, errno.EROFS)
    assert find_disk_error(tmp_path).errno == errno.EROFS


def test_a_file_is_tried_before_anything_is_computed(tmp_path, monkeypatch):
    fail_below(monkeypatch, tmp_path, errno.EROFS)
    with pytest.raises(OptionError, match=r"^path: .* is on a file system that can only be read; .* another folder\.$"):
        check_file(tmp_path / "a.csv")
