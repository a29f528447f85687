"""Compiled libraries that stay from session to session, for all checkouts, and are shared by a session's workers.

The compiler would take a third of the quick set's time for a thousand small libraries, nearly all of which are the same
in every session. An entry counts only for the very same sources, headers, command and version of zig, so that a change
of any of them compiles again. Other compilers run as ever, and so does zig in a test that gives it a cache of its own.
"""

import hashlib
import importlib.metadata
import os
import shutil
from contextlib import suppress
from pathlib import Path

from loopwright.fmus.export import compiler

MOST = 5000
"""Libraries that are kept, those used last: several versions of each, some 250 MB."""


def install(patch, folder, zig_cache):
    """Let zig's runs with caches in ``zig_cache`` take their libraries from ``folder``, and leave new ones there."""
    with suppress(FileNotFoundError):  # another worker does the same
        _trim(folder)
    compile_here = compiler._wait
    version = importlib.metadata.version("ziglang")

    def find(command, place, environment):
        caches = {os.environ.get(name) for name in ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR")}
        if Path(command[0]).parent.name != "ziglang" or caches != {str(zig_cache)}:
            return compile_here(command, place, environment)
        library, kept = place / command[command.index("-o") + 1], folder / _key(version, command, place)
        try:
            shutil.copy(kept, library)
            os.utime(kept)
        except FileNotFoundError:
            done = compile_here(command, place, environment)
            if done == (0, "", "") and library.is_file():  # one with warnings is compiled again, for its warnings
                fresh = kept.with_suffix(f".{os.getpid()}")
                shutil.copy(library, fresh)
                fresh.replace(kept)
            return done
        return 0, "", ""

    patch.setattr(compiler, "_wait", find)


def _trim(folder):
    """Remove the libraries beyond `MOST`, those first that were used longest ago."""
    files = list(folder.iterdir())
    if len(files) > MOST:
        for file in sorted(files, key=lambda file: file.stat().st_mtime)[:-MOST]:
            file.unlink()


def _key(version, command, place):
    includes = [argument for argument in command if argument.startswith("-I") and argument != "-I."]
    headers = [file for argument in includes for file in sorted(Path(argument[2:]).glob("*.h"))]
    sources = sorted(file for file in place.iterdir() if file.is_file())
    named = [(file.name.encode(), file.read_bytes()) for file in (*headers, *sources)]
    given = [
        argument for argument in command[1:] if argument not in includes
    ]  # folders differ from checkout to checkout
    digest = hashlib.sha256()
    for part in (version.encode(), *map(os.fsencode, given), *(part for pair in named for part in pair)):
        digest.update(f"{len(part)}:".encode() + part)
    return digest.hexdigest()
