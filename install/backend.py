"""Builds the package by setuptools, with the runtime library of its runs compiled where there is a C compiler.

An installation never fails for want of one: without the library, the first run that needs it compiles it, and where
nothing can, its error says what to install.
"""

from __future__ import annotations

import os
import platform
import runpy
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403 - the hooks that stay as they are

ROOT = Path(__file__).resolve().parent.parent
RUNTIME = ROOT / "fmus" / "runtime"
BUILT = RUNTIME / "built"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
COMPILER = PROJECT["optional-dependencies"]["build"]
TOOLS = runpy.run_path(str(ROOT / "fmus" / "toolchain.py"))


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """Ask for zig where the machine has no compiler."""
    return [*build_meta.get_requires_for_build_wheel(config_settings), *_missing()]


def get_requires_for_build_editable(config_settings: Any = None) -> list[str]:
    """Ask for zig where the machine has no compiler."""
    return [*build_meta.get_requires_for_build_editable(config_settings), *_missing()]


def _missing() -> list[str]:
    return [] if TOOLS["find_command"](lambda: sys.executable) else COMPILER


def build_wheel(wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """Build a wheel: of this platform with the runtime library, a pure one where it can't be compiled."""
    tag = build_runtime()
    settings = dict(config_settings or {})
    if tag:
        options = settings.get("--build-option", [])
        settings["--build-option"] = [*([options] if isinstance(options, str) else options), f"--plat-name={tag}"]
    return str(build_meta.build_wheel(wheel_directory, settings, metadata_directory))


def build_editable(wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """Install the checkout itself, with the runtime library in it."""
    build_runtime()
    return str(build_meta.build_editable(wheel_directory, config_settings, metadata_directory))


def build_runtime() -> str:
    """Compile the runtime library into the package; return the wheel's platform, empty where there is none."""
    try:
        return _build()
    except (OSError, subprocess.SubprocessError, KeyError) as error:
        said = getattr(error, "stderr", None) or error
        print(f"loopwright: the runtime library was not compiled ({said}); the first run does so.", file=sys.stderr)
        return ""


def _build() -> str:
    found, native = TOOLS["find_command"](lambda: sys.executable), TOOLS["native_platform"]()
    shutil.rmtree(BUILT, ignore_errors=True)
    if found is None:
        return ""
    (command, of), source = found, TOOLS["read_unit"](RUNTIME, "runtime.c")
    zig = of == "ziglang"
    flags = (*TOOLS["flags"](native, zig=zig), *TOOLS["DIAGRAM_FLAGS"], *TOOLS["RUNTIME_FLAGS"])
    name = TOOLS["runtime_name"](source, native)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "code.c").write_text(source, encoding="utf-8", newline="\n")
        math = [] if native.endswith("windows") else ["-lm"]
        environment = {"ZIG_GLOBAL_CACHE_DIR": folder, "ZIG_LOCAL_CACHE_DIR": folder, **os.environ}
        subprocess.run(
            [*command, *flags, "-o", name, "code.c", *math],
            cwd=folder,
            env=environment,
            check=True,
            capture_output=True,
            text=True,
            timeout=600,
        )
        BUILT.mkdir()
        shutil.copyfile(Path(folder) / name, BUILT / name)
    return _tag(native, zig=zig)


def _tag(native: str, *, zig: bool) -> str:
    """Return the platform of a wheel with a library of this compiler."""
    arch, _, system = native.partition("-")
    if system == "windows":
        return "win_amd64" if arch == "x86_64" else f"win_{arch}"
    if system == "darwin":
        release = "11_0" if zig else "_".join(platform.mac_ver()[0].split(".")[:2])
        return f"macosx_{release}_{'arm64' if arch == 'aarch64' else arch}"
    return f"manylinux_2_17_{arch}" if zig and system == "linux" else f"{system}_{arch}"
