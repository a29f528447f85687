"""A folder whose system calls fail with an error number, for whoever runs the tests: root is refused nothing."""

import builtins
import errno
import io
import os

WRITES = ("mkdir", "replace", "rename", "link", "symlink", "chmod", "unlink", "rmdir")
READS = ("stat", "lstat", "listdir", "scandir", "access")


def fail_below(monkeypatch, folder, code):
    """Let every call that writes below a folder fail; with EACCES those that look into it, too.

    The folder itself can be seen, as that of another user in a folder of one's own.
    """
    root = os.path.realpath(folder)
    denied = code == errno.EACCES

    def check(path, *, itself=True):
        if not isinstance(path, str | bytes | os.PathLike):
            return
        name = os.path.join(OWN_FOLDER, os.fsdecode(path))
        if name.startswith(root + os.sep) or (itself and name == root):
            raise OSError(code, os.strerror(code), os.fsdecode(path))

    def wrap(name, *, itself):
        call = getattr(os, name)

        def failing(path, *arguments, **options):
            if options.get("dir_fd") is None:
                check(path, itself=itself)
                if arguments:
                    check(arguments[0], itself=itself)
            return call(path, *arguments, **options)

        monkeypatch.setattr(os, name, failing)

    for name in WRITES:
        wrap(name, itself=False)
    if denied:
        for name in READS:
            wrap(name, itself=name in ("listdir", "scandir"))
    real_open, real_file = os.open, io.open

    def failing_open(path, flags, *arguments, **options):
        if denied or flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            check(path)
        return real_open(path, flags, *arguments, **options)

    def failing_file(file, mode="r", *arguments, **options):
        if denied or set(mode) & set("wax+"):
            check(file)
        return real_file(file, mode, *arguments, **options)

    monkeypatch.setattr(os, "open", failing_open)
    monkeypatch.setattr(io, "open", failing_file)
    monkeypatch.setattr(builtins, "open", failing_file)


OWN_FOLDER = os.getcwd()
"""Folder that relative paths begin at."""
