"""An FMU of our own, compiled again for the processor of this machine."""

from __future__ import annotations

import hashlib
import os
import platform as system
import zipfile
from functools import lru_cache
from pathlib import Path

from ...blocks.core import FmuError, FmuFileError, accepts, kinds
from ..child_processes import folder_in
from ..platform import cache_folder, explain_cache_errors, is_built_here, native_platform, record_build
from .compiler import compile_shared, describe_compiler, find_compiler
from .fmu_package import FOLDERS2, fmi_headers, zip_files

_FLAGS = ("-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math")


def processor_flags() -> tuple[str, ...]:
    """Return the flags of a compiler for the processor of this machine, with products and sums fused.

    Raises `CompilerError` if there is no compiler.
    """
    zig_or_other = find_compiler().zig or not native_platform().startswith("x86")
    return (*_FLAGS, "-mcpu=native" if zig_or_other else "-march=native")


@accepts(path=kinds.path)
def tune(path: str | os.PathLike[str]) -> Path:
    """Return an FMU with its binary compiled again for the processor of this machine.

    It has the instructions of this processor and fuses products with sums (FMA), so that it is faster, and runs on such
    processors only. Its values differ from the FMU's by rounding. It is made once, and kept in the cache.

    Parameters
    ----------
    path : path
        An FMU that Loopwright has built on this machine: its own sources are compiled.

    Raises
    ------
    FmuError
        For any other FMU.
    CompilerError
        If there is no compiler, or it fails.
    """
    file = Path(path)
    if not file.is_file():
        raise FmuFileError(f"found no file {str(file)!r}; expected an FMU. Give its path.")
    content = file.read_bytes()
    if not is_built_here(hashlib.sha256(content).hexdigest()):
        raise FmuError(
            f"Loopwright has not built {str(file)!r} on this machine, and compiles no sources of others; expected an "
            "FMU of loopwright.build. Run it as it is, without fuse=True.",
        )
    compiler, target, flags = find_compiler(), native_platform(), processor_flags()
    parts = (*describe_compiler(target), *flags, describe_processor())
    key = hashlib.sha256(content + "\0".join(parts).encode()).hexdigest()
    out = cache_folder() / "tuned" / key[:32] / file.name
    with explain_cache_errors(f"the FMU {str(file)!r}, compiled for this processor, can't be kept in the cache"):
        if out.is_file() and is_built_here(hashlib.sha256(out.read_bytes()).hexdigest()):
            return out
        with zipfile.ZipFile(file) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
        binaries = [name for name in files if name.startswith("binaries/")]
        (own,) = (name for name in binaries if name.split("/")[1] in (target, FOLDERS2.get(target)))
        sources = {n.removeprefix("sources/"): t.decode() for n, t in files.items() if n.endswith((".c", ".h"))}
        out.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with folder_in(out.parent, ".tuning-") as folder:
            library = folder / Path(own).name
            headers = [fmi_headers()[0]]
            compile_shared(sources, library, compiled=["model.c"], include=headers, compiler=compiler, more_flags=flags)
            tuned = zip_files({n: t for n, t in files.items() if n not in binaries} | {own: library.read_bytes()})
            (made := folder / file.name).write_bytes(tuned)
            os.replace(made, out)
    record_build(hashlib.sha256(tuned).hexdigest())
    return out


@lru_cache(maxsize=1)
def describe_processor() -> str:
    """Return the processor's name and what it can do: a cache may be shared among machines."""
    try:
        first = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0]
    except OSError:
        return f"{system.processor()} {system.machine()}"
    return "\n".join(line for line in first.splitlines() if "." not in line)  # those with a point move, as its clock
