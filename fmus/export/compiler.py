"""C compiler: it is found, and builds shared libraries.

The ``ziglang`` package comes first: it is the same compiler on every machine, and builds for all platforms from any of
them. Flags are fixed, so that one source gives one binary.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import shlex
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from pathlib import Path

from ...blocks.core import (
    OTHER_TEMPORARY,
    CompilerError,
    LoopwrightError,
    describe_disk_error,
    explain_disk_errors,
    find_disk_error,
    near,
)
from ..build_notes import announce_build
from ..child_processes import find_python, folder_in, run_in_group
from ..platform import OWN_CACHE, cache_folder, check_cache, native_platform
from ..toolchain import TARGETS, WEBASSEMBLY, find_command, flags

TIMEOUT = 600.0
"""Seconds after which a compilation is stopped. The first one on a machine takes seconds, on a slow one a minute."""

_INSTALL = 'Install one: pip install "loopwright[build]" (it brings ziglang), or set LOOPWRIGHT_CC to a command line.'


@dataclass(frozen=True)
class Compiler:
    """A compiler command.

    ``identity``: text that identifies the compiler and its version; part of cache keys.
    ``zig``: whether it takes zig's ``-target``.
    """

    command: tuple[str, ...]
    identity: str
    zig: bool = False


def find_compiler() -> Compiler:
    """Return the compiler to use: LOOPWRIGHT_CC, the ziglang package, else the system's cc, gcc or clang.

    Raises `CompilerError` if there is none; the text says how to install one.
    """
    found = find_command(find_python)
    if found is None:
        raise CompilerError(f"no C compiler was found: neither the ziglang package nor cc, gcc or clang. {_INSTALL}")
    command, source = found
    if source == "ziglang":
        return Compiler(command, f"ziglang {importlib.metadata.version('ziglang')}", zig=True)
    if source == "system":
        return Compiler(command, f"{command[0]}\n{_version(command)}")
    given = os.environ["LOOPWRIGHT_CC"]
    if not command or shutil.which(command[0]) is None:
        raise CompilerError(f"LOOPWRIGHT_CC is {given!r}, but there is no such command. Correct it, or unset it.")
    return Compiler(command, f"{given}\n{_version(command)}")


@lru_cache(maxsize=8)
def _version(command: tuple[str, ...]) -> str:
    try:
        done = run_in_group([*command, "--version"], seconds=60)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CompilerError(f"the C compiler {shlex.join(command)} can't be run: {error}. {_INSTALL}") from error
    except LoopwrightError as error:
        raise CompilerError(f"the C compiler can't be run: {error}") from error
    return done.stdout + done.stderr


def describe_compiler(platform: str) -> tuple[str, ...]:
    """Return the compiler's name, version and flags for a platform, for keys of caches.

    Raises `CompilerError` if there is none.
    """
    compiler = find_compiler()
    return (compiler.identity, *flags(platform, zig=compiler.zig))


def check_platform(compiler: Compiler, platform: str) -> None:
    """Refuse a platform for which this compiler can't build."""
    if platform not in TARGETS and (compiler.zig or platform != native_platform()):
        raise CompilerError(f"there is no platform {platform!r}. {near(platform, TARGETS)}")
    if not compiler.zig and platform != native_platform() and "LOOPWRIGHT_CC" not in os.environ:
        raise CompilerError(
            f"{compiler.command[0]} builds for {native_platform()} only, found platform {platform!r}. "
            'Install the compiler for all platforms: pip install "loopwright[build]".'
        )


def compile_shared(
    sources: Mapping[str, str],
    out: Path,
    *,
    platform: str | None = None,
    compiled: Sequence[str] | None = None,
    include: Sequence[Path] = (),
    compiler: Compiler | None = None,
    more_flags: Sequence[str] = (),
) -> None:
    """Compile C sources into a shared library.

    ``out``: the library to write; it appears complete or not at all.
    ``platform``: FMI 3.0 platform tuple; native if not given.
    ``compiled``: names of the sources to compile; if not given, all that end in ``.c``.
    ``compiler``: the compiler; `find_compiler`'s if not given.
    ``more_flags``: flags after those of every library.
    Raises `CompilerError` if there is no compiler, it does not end, or it fails; then its message is quoted. If the
    folder of ``out`` can't be written.
    Raises `FmuError` if the cache can't be written.
    """
    check_cache()  # zig retries for ever if it can't write there
    compiler = compiler or find_compiler()
    platform = platform or native_platform()
    check_platform(compiler, platform)
    names = [name for name in sources if name.endswith(".c")] if compiled is None else list(compiled)
    math = () if platform.endswith("windows") else ("-lm",)
    includes = [f"-I{path}" for path in include]
    given = [*flags(platform, zig=compiler.zig), *more_flags, "-I.", *includes]
    _compile(compiler, sources, Path(out), [*given], [*names, *math], platform)


def compile_webassembly(source: str, out: Path) -> None:
    """Compile a C source into a WebAssembly module, which imports nothing but functions of JavaScript's Math.

    ``source``: the C text; it finds the headers of ``webassembly/``, and no C library.
    ``out``: the module to write; it appears complete or not at all.
    Raises `CompilerError` if the package's compiler isn't there, or it fails.
    Raises `FmuError` if the cache can't be written.
    """
    check_cache()
    compiler = find_compiler()
    if not compiler.zig:
        raise CompilerError(
            f"found the compiler {compiler.command[0]!r}, which may not build WebAssembly; expected the package's. "
            'Install it: pip install "loopwright[build]"'
            + (", and unset LOOPWRIGHT_CC." if "LOOPWRIGHT_CC" in os.environ else ".")
        )
    folder = resources.files(__package__) / "webassembly"
    headers = {part.name: part.read_text(encoding="utf-8") for part in folder.iterdir() if part.name.endswith(".h")}
    _compile(
        compiler, {"module.c": source, **headers}, Path(out), [*WEBASSEMBLY, "-isystem", "."], ["module.c"], "the web"
    )


def _compile(
    compiler: Compiler,
    sources: Mapping[str, str],
    out: Path,
    given: Sequence[str],
    inputs: Sequence[str],
    platform: str,
) -> None:
    """Compile sources into a file, which appears complete or not at all."""
    with explain_disk_errors("the C code can't be compiled", out, OWN_CACHE, CompilerError):
        out.parent.mkdir(parents=True, exist_ok=True)
        with folder_in(out.parent, ".building-") as folder:
            for name, text in sources.items():
                (folder / name).write_text(text, encoding="utf-8", newline="\n")
            library = out.name  # a relative name, since some formats contain it
            command = [*compiler.command, *given, "-o", library, *inputs]
            with announce_build(_note(compiler)):
                _run(command, folder, platform)
            if not (folder / library).is_file():
                raise CompilerError(f"{shlex.join(command)} wrote no library. Check LOOPWRIGHT_CC.")
            os.replace(folder / library, out)


def run_compiler(
    sources: Mapping[str, str], commands: Sequence[Sequence[str]], results: Sequence[str], platform: str
) -> dict[str, bytes]:
    """Run a compiler's commands in a fresh folder with sources, and return the content of files that they write.

    ``sources``: text of each file, by name, with its folder.
    ``commands``: commands, one after the other.
    Raises `CompilerError` if a command can't be run, does not end, or fails; then its message is quoted.
    Raises `FmuError` if the cache can't be written.
    """
    check_cache()
    place = cache_folder()
    with (
        explain_disk_errors("the C code can't be compiled", place, OWN_CACHE, CompilerError),
        folder_in(place, ".building-") as folder,
        announce_build(_note(find_compiler())),
    ):
        for name, text in sources.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text, encoding="utf-8", newline="\n")
        for command in commands:
            _run(command, folder, platform)
        return {name: (folder / name).read_bytes() for name in results}


def _zig_caches() -> dict[str, str]:
    """Return the folders of zig's own caches, by the environment variable that names each."""
    own = str(cache_folder() / "zig")
    return {name: os.environ.get(name, own) for name in ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR")}


def _note(compiler: Compiler) -> str:
    first = compiler.zig and not os.path.isdir(_zig_caches()["ZIG_GLOBAL_CACHE_DIR"])
    return (
        "compiling C code; the compiler's first start on a machine takes some seconds" if first else "compiling C code"
    )


def _link_caches(folder: Path) -> dict[str, str]:
    """Return zig's caches under plain relative names, as links in the folder where it runs.

    zig hands the paths of its cache to tools that read some letters in another way: its linker fills each % of an
    output's path with a digit, and in lists of dependencies a colon ends a name. A relative path through a link has no
    letter of the user's.
    """
    found = {}
    for name, cache in _zig_caches().items():
        link = folder / f".{name.lower()}"
        found[name] = cache
        with suppress(OSError):  # Windows may allow no links
            link.symlink_to(os.path.abspath(cache), target_is_directory=True)
            Path(cache).mkdir(parents=True, exist_ok=True)
            found[name] = link.name
    return found


def _run(command: Sequence[str], folder: Path, platform: str) -> None:
    code, output, errors = _wait(command, folder, {**os.environ, **_link_caches(folder)})
    if code:
        lines = (errors.strip() or output.strip() or "(nothing)").splitlines()
        said = "\n".join(lines if len(lines) <= 40 else [*lines[:20], "...", *lines[-20:]])  # the first error matters
        failed = f"the C compiler failed for {platform} with exit code {code}"
        temporary = os.environ.get("TMPDIR", folder)
        for place, instead in ((folder, OWN_CACHE), (cache_folder(), OWN_CACHE), (temporary, OTHER_TEMPORARY)):
            if (error := find_disk_error(place)) is not None:  # the compiler has its own words for it
                found = describe_disk_error(error, place, instead)
                raise CompilerError(f"{failed}. Its message:\n{said}\nThe cause: {found}") from error
        raise CompilerError(
            f"{failed}. Its message:\n{said}\n"
            f"The command was: {shlex.join(command)}\n"
            "Check the model's equations, or try another compiler with LOOPWRIGHT_CC."
        )


def _wait(command: Sequence[str], folder: Path, environment: Mapping[str, str]) -> tuple[int, str, str]:
    """Run a compiler; it and all processes that it started end with this call and with this process."""
    try:
        done = run_in_group(command, cwd=folder, environment=environment, seconds=TIMEOUT)
    except OSError as error:
        raise CompilerError(f"the C compiler {command[0]} can't be run: {error}. {_INSTALL}") from error
    except LoopwrightError as error:
        raise CompilerError(f"the C compiler can't be run: {error}") from error
    except subprocess.TimeoutExpired as error:
        raise CompilerError(
            f"the C compiler did not end within {TIMEOUT:g} s and was stopped. The command was: "
            f"{shlex.join(command)}\nRun it by hand, or try another compiler with LOOPWRIGHT_CC."
        ) from error
    return done.returncode, done.stdout, done.stderr
