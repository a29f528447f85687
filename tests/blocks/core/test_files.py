"""Files appear whole or not at all: on a full disk, and when they are interrupted."""

import os
import resource
import stat

import pytest

from loopwright.blocks.core import replace_file, write_text
from loopwright.diagrams import DiskError


@pytest.fixture
def full_disk():
    """Let no file grow beyond 1000 bytes, as long as the test writes: the error is that of a full disk but for its name."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    class Limit:
        def __enter__(self):
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))

        def __exit__(self, *error):
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    yield Limit()
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_file_is_written(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "ä\n")
    assert path.read_bytes() == "ä\n".encode()
    write_text(path, "b")
    assert path.read_text() == "b"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_full_disk_leaves_the_old_file_and_nothing_of_the_new_one(tmp_path, full_disk):
    path = tmp_path / "a.txt"
    write_text(path, "old")
    with pytest.raises(OSError, match=r"grows beyond 1000 bytes"), full_disk:
        write_text(path, 10_000 * "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_an_interrupt_leaves_the_old_file_and_nothing_of_the_new_one(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def write_half():
        with replace_file(path) as fresh:
            fresh.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_the_rights_of_a_file_and_a_link_to_it_stay(tmp_path):
    path, link = tmp_path / "a.txt", tmp_path / "link.txt"
    write_text(path, "old")
    path.chmod(0o640)
    link.symlink_to(path)
    write_text(link, "new")
    assert path.read_text() == "new"
    assert link.is_symlink()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def test_a_pipe_is_written_directly():
    read, write = os.pipe()
    write_text(f"/dev/fd/{write}", "through")
    assert os.read(read, 100) == b"through"
    os.close(read)
    os.close(write)


def test_a_folder_that_is_not_there_is_told(tmp_path):
    with pytest.raises(DiskError, match=r"there is no folder '.*none'"):
        write_text(tmp_path / "none" / "a.txt", "a")
