"""The C compiler's command, platforms and flags. It imports nothing of the package: an installation reads it, too."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import shlex
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

#: FMI 3.0 platform tuples (2.5.1.4) of the platforms to build for, and zig's name of each with the oldest system:
#: glibc 2.17, macOS 11. On Windows the C library belongs to the system since version 10.
TARGETS = {
    "x86_64-linux": "x86_64-linux-gnu.2.17",
    "aarch64-linux": "aarch64-linux-gnu.2.17",
    "x86_64-windows": "x86_64-windows-gnu",
    "x86_64-darwin": "x86_64-macos.11.0",
    "aarch64-darwin": "aarch64-macos.11.0",
}
SUFFIXES = {"linux": ".so", "windows": ".dll", "darwin": ".dylib"}

# -ffp-contract=off: no fused multiply-add, so that every platform and every compiler rounds alike.
FLAGS = ("-O2", "-std=c11", "-shared", "-fvisibility=hidden", "-ffp-contract=off", "-g0", "-s")
# Only what is declared inline is inlined, the integrators and the equations: a fifth of the time of a build less.
_ZIG_FLAGS = ("-finline-hint-functions",)
# Models use double and int alone: nothing of zig's own runtime, which takes seconds to build on a machine's first use.
_ZIG_RUNTIME = ("-rtlib=none",)

# No C library: what it would do is in headers of fmus/export/webassembly.
WEBASSEMBLY = (
    *(
        "-target",
        "wasm32-freestanding",
        "-O2",
        "-std=c11",
        "-ffp-contract=off",
        "-fno-math-errno",
        "-fno-trapping-math",
    ),
    *("-mbulk-memory", "-g0", "-s", "-rtlib=none", "-nostdlib", "-Wl,--no-entry", "-Wl,--export-memory"),
)
"""Flags of WebAssembly modules."""

DIAGRAM_FLAGS = ("-fno-math-errno", "-fno-trapping-math", "-fno-builtin-pow")
"""Further flags of diagrams: nobody reads errno, so that sine and cosine of one angle are one call; a power of two
stays a power in every bit."""
RUNTIME_FLAGS = ("-fno-unroll-loops",)
"""Further flags of the runtime library: vectors are short; a sixth less for the compiler."""


def find_command(find_python: Callable[[], str]) -> tuple[tuple[str, ...], str] | None:
    """Return the command of a C compiler, and its source: "LOOPWRIGHT_CC", "ziglang" or "system"; None without any.

    ``find_python`` returns the interpreter that runs zig's package where its binary isn't found.
    """
    if given := os.environ.get("LOOPWRIGHT_CC"):
        return tuple(shlex.split(given, posix=os.name != "nt")), "LOOPWRIGHT_CC"
    if (spec := importlib.util.find_spec("ziglang")) is not None and spec.origin is not None:
        zig = Path(spec.origin).parent / ("zig.exe" if os.name == "nt" else "zig")
        return ((str(zig), "cc") if zig.is_file() else (find_python(), "-m", "ziglang", "cc")), "ziglang"
    found = next((path for name in ("cc", "gcc", "clang") if (path := shutil.which(name)) is not None), None)
    return None if found is None else ((found,), "system")


def native_platform() -> str:
    """Return this machine's platform as FMI 3.0 names it (2.5.1.4), such as ``x86_64-linux``."""
    machine = platform.machine().lower()
    arch = {"amd64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}.get(machine, machine)
    system = {"linux": "linux", "windows": "windows", "darwin": "darwin"}.get(platform.system().lower(), sys.platform)
    return f"{arch}-{system}"


def flags(platform: str, *, zig: bool) -> tuple[str, ...]:
    """Return the flags of every library for a platform, without sources, include folders and the output."""
    windows = platform.endswith("windows")
    target = ("-target", TARGETS[platform], *_ZIG_FLAGS, *(() if windows else _ZIG_RUNTIME)) if zig else ()
    return (*target, *FLAGS, *(() if windows else ("-fPIC",)))


def read_unit(folder: Path, name: str) -> str:
    """Return a C source of a folder with the files that it includes from there in their places."""
    own = '#include "'
    lines = (folder / name).read_text(encoding="utf-8").splitlines()
    return "\n".join(read_unit(folder, line[len(own) : -1]) if line.startswith(own) else line for line in lines)


def runtime_name(source: str, platform: str) -> str:
    """Return the file name of the runtime library of a source: one of another source or other flags has another."""
    text = "\0".join((platform, *FLAGS, *DIAGRAM_FLAGS, *RUNTIME_FLAGS, source))
    suffix = SUFFIXES.get(platform.rpartition("-")[2], ".so")
    return f"{platform}-{hashlib.sha256(text.encode()).hexdigest()[:32]}{suffix}"
