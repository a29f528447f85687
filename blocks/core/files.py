"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile

from .disk import explain_disk_errors
from .errors import OptionError

OTHER_FILE = "Name a file in another folder."
"""Step where a file that a user has named can't be written."""


def check_file(path: str | os.PathLike[str]) -> Path:
    """Return the file of a path that a user gave; find out, before anything is computed, whether it can be written."""
    file = Path(path).expanduser()
    with explain_disk_errors(f"{str(path)!r} can't be written", file, OTHER_FILE, OptionError, port="path"):
        if file.is_dir():
            raise OptionError(f"{str(path)!r} is a folder. Name a file in it.", port="path")
        if not file.parent.is_dir():
            raise OptionError(f"there is no folder {str(file.parent)!r}. Make it, or name another one.", port="path")
        folder = Path(os.path.realpath(file)).parent
        if file.is_file() or not file.exists():
            with TemporaryFile(dir=folder):
                pass
    return file


@contextmanager
def replace_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield the name of a file to write; when the block ends, it takes the place of the file ``path``.

    If the block fails, or is interrupted, nothing is left of the new file, and an old one stays as it was: a full disk
    cuts no file. The name ends as ``path`` does. Whatever is no regular file, such as a pipe, is written directly.
    """
    given = Path(path).expanduser()
    with explain_disk_errors(f"{str(path)!r} can't be written", given, OTHER_FILE):
        if given.exists() and not given.is_file():
            yield given
            return
        target = Path(os.path.realpath(given))
        fresh = target.with_name(f".{target.stem}.{secrets.token_hex(4)}.part{target.suffix}")
        try:
            yield fresh
            with open(fresh, "rb+") as file:
                os.fsync(file.fileno())  # some systems report a full disk here only
            if target.exists():
                shutil.copymode(target, fresh)
            fresh.replace(target)
        except OSError as error:
            if error.filename == str(fresh):  # a name that its user has not given
                error.filename, error.filename2 = str(target), None
            raise
        finally:
            with suppress(OSError):
                fresh.unlink()


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text as UTF-8; the file appears whole or not at all."""
    with replace_file(path) as fresh:
        fresh.write_text(text, encoding="utf-8")
