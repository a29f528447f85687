"""The cache of compiled code, under everything that may stand in its way."""

import errno
import os
import subprocess
import sys

import pytest

from loopwright.blocks import Constant, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.compiled import compiled_libraries
from loopwright.fmus import CompilerError

SOURCE = '__attribute__((visibility("default"))) int seven(void) { return 7; }'
posix = pytest.mark.skipif(os.name != "posix", reason="owners, modes and links are those of POSIX")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / "cache"))
    compiled_libraries.load_compiled.cache_clear()
    yield tmp_path / "cache"
    compiled_libraries.load_compiled.cache_clear()


@posix
def test_a_link_to_another_folder_is_refused_and_the_folder_stays_as_it_is(cache, tmp_path):
    (elsewhere := tmp_path / "elsewhere").mkdir()
    (mine := elsewhere / "mine").touch()
    elsewhere.chmod(0o777)
    cache.mkdir()
    (cache / "compiled").symlink_to(elsewhere)
    with pytest.raises(CompilerError, match=r"compiled' is a link to another one; expected a folder"):
        compiled_libraries.load_compiled(SOURCE)
    assert mine.exists()
    assert elsewhere.stat().st_mode & 0o777 == 0o777


@posix
def test_a_folder_that_was_open_loses_libraries_and_no_other_files(cache):
    """LOOPWRIGHT_CACHE may be a folder in which the user has one of this name."""
    folder = cache / "compiled"
    folder.mkdir(parents=True)
    names = [f"{'0' * 40}.so", f"{'a' * 40}.size", "notes.txt", "mine.so"]
    for name in names:
        (folder / name).touch()
    folder.chmod(0o775)
    library = compiled_libraries._library_of(SOURCE)
    assert sorted(file.name for file in folder.iterdir()) == ["mine.so", "notes.txt"]
    assert library.parent == folder
    assert folder.stat().st_mode & 0o777 == 0o700


@posix
def test_a_cache_is_its_users_own_whatever_the_umask(cache):
    before = os.umask(0)
    try:
        compiled_libraries._library_of(SOURCE)
    finally:
        os.umask(before)
    assert [folder.stat().st_mode & 0o777 for folder in (cache, cache / "compiled")] == [0o700, 0o700]


def test_a_length_is_noted_by_two_at_once(cache, monkeypatch):
    library = compiled_libraries._library_of(SOURCE)
    library.write_bytes(b"12345")
    replace, nested = os.replace, []

    def interrupted(source, target):
        if not nested:
            nested.append(True)
            compiled_libraries._note_size(library)  # another thread, which has just come here
        replace(source, target)

    monkeypatch.setattr(compiled_libraries.os, "replace", interrupted)
    compiled_libraries._note_size(library)
    assert nested
    assert compiled_libraries._is_whole(library)
    assert sorted(file.suffix for file in library.parent.iterdir()) == sorted([".size", library.suffix])


def test_a_run_without_room_for_its_code_is_interpreted_and_says_so(cache, monkeypatch):
    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(compiled_libraries, "_note_size", fail)

    @subsystem(sample_time=0.1, name="box")
    def box(u):
        return UnitDelay(initial_value=0.0, name="delay")(u)

    run = Diagram("full", box(Constant(value=1.0, name="u")).named("y")).simulate(0.3, compile=True, progress=False)
    assert run.tier == "interpreted"
    assert run["y"].tolist() == [0.0, 1.0, 1.0, 1.0]
    assert [m for m in run.messages if "no space is left on the disk at " in m and m.count("Make room there") == 1]


LIMITED = """
import resource, sys
from loopwright.fmus import CompilerError
from loopwright.diagrams.compiled import load_compiled
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY))
try:
    load_compiled(sys.argv[2])
except CompilerError as error:
    print("refused:", error)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
print(load_compiled(sys.argv[2])["seven"]())
"""


@pytest.mark.slow
@posix
@pytest.mark.parametrize("size", [10, 1000])
def test_files_that_can_not_be_written_whole_leave_nothing_that_is_loaded(cache, size):
    """The source does not fit, or the library does not; then there is room again."""
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(size), SOURCE], check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("refused: ")
    assert done.stdout.endswith("7\n")


@pytest.mark.slow
def test_processes_at_once_load_one_library(cache):
    script = "import sys; from loopwright.diagrams.compiled import load_compiled; print(load_compiled(sys.argv[1])['seven']())"
    started = [
        subprocess.Popen([sys.executable, "-c", script, SOURCE], stdout=subprocess.PIPE, text=True) for _ in range(3)
    ]
    assert [process.communicate()[0] for process in started] == ["7\n"] * 3
    assert len([*(cache / "compiled").iterdir()]) == 2
