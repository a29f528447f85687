"""Temporary folders: they go in any case, and the reason why one can't be made is named."""

import errno
import tempfile

import pytest

from loopwright.fmus import FmuError
from loopwright.fmus.child_processes import temporary_folder
from support.failing_disk import fail_below


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES])
def test_no_folder_for_temporary_files(code, tmp_path, monkeypatch):
    """Python says which ones it has tried, and not why."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: [str(tmp_path)])
    fail_below(monkeypatch, tmp_path, code)
    with pytest.raises(FmuError) as caught, temporary_folder("the FMU can't be built", FmuError, block="plant"):
        pass
    said = str(caught.value)
    if code == errno.ENOSPC:
        assert said.startswith("plant: the FMU can't be built: no space is left on the disk at ")
        assert said.endswith("; expected some. Make room there.")
    else:
        assert said.startswith(f"plant: the FMU can't be built: there is no permission to use '{tmp_path}'")
        assert said.endswith(". Set TMPDIR to your own folder.")


def test_a_temporary_folder_goes_whatever_happens():
    seen = []

    def interrupt():
        with temporary_folder("nothing") as folder:
            (folder / "a").write_text("a")
            seen.append(folder)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupt()
    assert [folder.exists() for folder in seen] == [False]
