"""Files and folders: written whole or not at all, and their errors said in words.

An error says what was found, what was expected, and one next step.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from .errors import DiskError, LoopwrightError, OptionError

_NOT_ALLOWED = (errno.EACCES, errno.EPERM)
_NO_FOLDER = (errno.ENOTDIR, errno.EEXIST)
_TOO_MANY = (errno.EMFILE, errno.ENFILE)
_QUOTA = getattr(errno, "EDQUOT", None)  # not on Windows

OTHER_TEMPORARY = "Set TMPDIR to your own folder."
"""Step where the folder of temporary files can't be used."""

_PROBE = 2**24
"""Bytes of a trial file: more than a library of ours takes, and than is left where one did not fit."""

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


def describe_disk_error(error: OSError, place: str | os.PathLike[str], instead: str) -> str:
    """Return what the system found wrong with a file or folder, what was expected, and one next step.

    The step is ``instead``, such as "Name another folder.", wherever nothing can be mended in this place.
    """
    # where one of our errors was made of the system's before, the cause counts
    while isinstance(error, DiskError) and isinstance(error.__cause__, OSError):
        error = error.__cause__
    named = _name_in(error)  # an error that names another path than the place is about that one
    path = named or os.fspath(place)
    there, code = _nearest(path), error.errno
    # A relative path says nothing where the working folder is gone, so this comes before all other causes.
    if code == errno.ENOENT and (not named or not os.path.isabs(path)) and not _has_working_folder():
        return (
            "the working folder of this process has been removed; expected one that is there. Change to another one "
            "first, by cd in a shell or os.chdir in Python."
        )
    if code in _NOT_ALLOWED:
        return f"there is no permission to use {there!r}{_owner(there)}; expected that this user has it. {instead}"
    if code == errno.ENOSPC:
        if _has_no_inodes(there):
            return f"the disk at {_disk(there)!r} holds no more files; expected that one more fits. Delete some there."
        return f"no space is left on the disk at {_disk(there)!r} for {path!r}; expected some. Make room there."
    if code is not None and code == _QUOTA:
        return f"this user's quota on the disk at {_disk(there)!r} is used up; expected some left. Make room there."
    if code == errno.EFBIG:
        if (limit := _largest_file()) is None:
            return f"{path!r} grows larger than its file system allows; expected one that can hold it. {instead}"
        return (
            f"{path!r} grows beyond {limit} bytes, the largest file that this process may write (RLIMIT_FSIZE); "
            "expected no such limit. Lift it with 'ulimit -f unlimited' in the shell that starts Python."
        )
    if code == errno.EROFS:
        return f"{there!r} is on a file system that can only be read; expected one that can be written. {instead}"
    if code == errno.ENOENT:
        return _describe_missing(path, instead)
    # The system names the whole path; the file in the way is the nearest part of it that exists.
    if code in _NO_FOLDER and not os.path.isdir(there):
        return f"{there!r} is a file; expected a folder. {instead}"
    if code == errno.EISDIR:
        return f"{there!r} is a folder; expected a file, or nothing. {instead}"
    if code == errno.ENAMETOOLONG:
        return f"the path {path!r} is longer than its file system allows; expected a shorter one. {instead}"
    if code in _TOO_MANY:
        return (
            "this process has as many files open as it may (RLIMIT_NOFILE); expected that one more can be opened. "
            "Raise the limit with 'ulimit -n' in the shell that starts Python."
        )
    said = error.strerror or str(error) or type(error).__name__
    return f"the system says {said!r} of {path!r}; expected that it can be used. {instead}"


@contextmanager
def explain_disk_errors(
    failed: str,
    place: str | os.PathLike[str],
    instead: str,
    raised: type[LoopwrightError] = DiskError,
    **where: Any,
) -> Iterator[None]:
    """Turn an error of the system, within a block that uses a file or folder, into ``raised``, at ``where``.

    It begins with what has ``failed``, such as "the FMU can't be built"; see `describe_disk_error` for the rest.
    """
    try:
        yield
    except OSError as error:
        if raised is DiskError and isinstance(error, DiskError):
            raise  # explained already
        if isinstance(error, ConnectionError):  # a pipe whose reader has had enough
            raise
        raise raised(f"{failed}: {describe_disk_error(error, place, instead)}", **where) from error


def find_disk_error(folder: str | os.PathLike[str]) -> OSError | None:
    """Return the error of a trial file of 16 MiB in a folder; None where it can be written."""
    # another program, such as a compiler, says in its own words alone that it could not write
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_PROBE))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return error
    return None


def _name_in(error: OSError) -> str:
    """Return the path that an error is about; empty where it names none."""
    names = [os.fsdecode(n) for n in (error.filename, error.filename2) if isinstance(n, str | bytes) and n]
    if error.errno == errno.ENOENT:  # of a file that takes another one's place: whichever is missing
        names.sort(key=os.path.lexists)
        return names[0] if names else ""
    return names[-1] if names else ""


def _nearest(path: str) -> str:
    """Return the path, or the nearest folder above it that this user can see."""
    while True:
        with suppress(OSError):
            os.stat(path)
            return path
        above = os.path.dirname(path) or os.curdir
        if above == path:
            return path
        path = above


def _has_working_folder() -> bool:
    try:
        os.getcwd()
    except FileNotFoundError:
        return False
    return True


def _disk(path: str) -> str:
    """Return the folder at which the disk of a file is mounted: a temporary folder is gone when the error is read."""
    path = os.path.realpath(path)
    while not os.path.ismount(path):
        path = os.path.dirname(path)
    return path


def _owner(path: str) -> str:
    """Return, in brackets, whose a file is and what may be done with it, where the system knows users by number."""
    if os.name != "posix":
        return ""
    with suppress(OSError):
        found = os.stat(path)
        mode = stat.S_IMODE(found.st_mode)
        return f" (of user {_user(found.st_uid)}, permissions {mode:o}; this process is of user {_user(os.geteuid())})"
    return ""


def _user(number: int) -> str:
    with suppress(ImportError, KeyError):
        import pwd

        return pwd.getpwuid(number).pw_name
    return str(number)


def _has_no_inodes(path: str) -> bool:
    with suppress(OSError, AttributeError):  # not on Windows
        found = os.statvfs(path)
        return found.f_files > 0 and found.f_ffree == 0
    return False


def _largest_file() -> int | None:
    """Return the size in bytes of the largest file that this process may write; None without a limit."""
    with suppress(ImportError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
        return None if limit == resource.RLIM_INFINITY else limit
    return None


def _describe_missing(path: str, instead: str) -> str:
    folder = os.path.dirname(path) or os.curdir
    if os.path.isdir(folder):
        return f"there is no {path!r}; expected that it is there. {instead}"
    return f"there is no folder {folder!r}; expected one. Make it."
