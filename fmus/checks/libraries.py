"""Libraries in an FMU, by platform: what they lack on this machine, and functions that they should export.

Those are the functions of the standard, and of the capabilities that the FMU declares.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from ...blocks.core import FmuError
from ..archive import FmuArchive, FmuFault, FmuFinding, SharedLibrary, read_library, write_files
from ..child_processes import find_python, run_in_group, temporary_folder
from ..toolchain import SUFFIXES

# Folders of binaries in FMI 1.0 and 2.0 (2.3.1) as platform tuples of FMI 3.0 (2.5.1.4).
_FOLDERS = {
    "linux32": "x86-linux",
    "linux64": "x86_64-linux",
    "win32": "x86-windows",
    "win64": "x86_64-windows",
    "darwin64": "x86_64-darwin",
}
_LOAD = "import ctypes, sys\ntry: ctypes.CDLL(sys.argv[1])\nexcept OSError as error: print(error)"
_FOUND = re.compile(r"^\s*(?:\S+ => )?(/\S+) \(0x[0-9a-f]+\)$", re.MULTILINE)
_MISSING = re.compile(r"^\s*(\S+) => not found", re.MULTILINE)


def tuple_of(folder: str) -> str | None:
    """Return the FMI 3.0 platform tuple of a folder of binaries; None for an unknown folder."""
    name = _FOLDERS.get(folder, folder)
    parts = name.split("-")
    known = len(parts) in (2, 3) and parts[1] in SUFFIXES  # a third part is the ABI
    return "-".join(parts[:2]) if known else None


def binaries_of(entries: Iterable[str]) -> dict[str, list[str]]:
    """Return the files directly in each folder of binaries."""
    found: dict[str, list[str]] = {}
    for name in sorted(entries):
        parts = PurePosixPath(name).parts
        if len(parts) == 3 and parts[0] == "binaries" and not name.endswith("/"):
            found.setdefault(parts[1], []).append(parts[2])
    return found


def library_name(identifier: str, platform: str) -> str:
    """Return the file name of an FMU's library on a platform."""
    return identifier + SUFFIXES[platform.split("-")[1]]


def native_libraries(
    native: str, binaries: Mapping[str, list[str]], identifiers: Iterable[str]
) -> tuple[str, list[str]] | None:
    """Return the folder of this machine's platform, and the libraries in it that are the FMU's; None without one.

    They are those of the model identifiers, else the only library in the folder.
    """
    suffix = SUFFIXES.get(native.split("-")[1])
    for folder, names in binaries.items():
        if tuple_of(folder) != native or suffix is None:
            continue
        libraries = [name for name in names if name.endswith(suffix)]
        named = sorted({library_name(i, native) for i in identifiers} & set(libraries))
        if named or len(libraries) == 1:
            return folder, named or libraries
    return None


def native_binary(
    archive: FmuArchive,
    native: str,
    binaries: Mapping[str, list[str]],
    interfaces: Mapping[str, Mapping[str, Any]],
    *,
    load: bool = True,
) -> dict[str, Any]:
    """Return whether there is a binary for this machine, and the libraries and symbols that it lacks here.

    With ``load`` false no code of the FMU's runs, and they are sought on Linux only.
    """
    identifiers = [str(attributes.get("modelIdentifier")) for attributes in interfaces.values()]
    found = native_libraries(native, binaries, identifiers)
    sought = found is not None and (load or native.endswith("-linux"))
    missing, undefined = find_missing(archive, native, *found) if found is not None and sought else ([], [])
    return {
        "platform": native,
        "available": found is not None,
        "missing_libraries": missing,
        "undefined_symbols": undefined,
    }


def find_missing(archive: FmuArchive, native: str, folder: str, names: Iterable[str]) -> tuple[list[str], list[str]]:
    """Return the shared libraries and symbols that are missing here, without running code of the FMU's on Linux.

    The system's loader is asked where it finds the libraries; the symbols are read from the files. On other systems the
    library is loaded by another process.
    """
    missing: set[str] = set()
    undefined: set[str] = set()
    ldd = shutil.which("ldd") if sys.platform.startswith("linux") else None
    with temporary_folder(f"the libraries of {str(archive.path)!r} can't be checked", FmuError) as made:
        # all files in the folder, since it may bring its own libraries
        write_files(archive, made, [name for name in archive.files if name.startswith(f"binaries/{folder}/")])
        for name in names:
            header = read_library(archive.read(f"binaries/{folder}/{name}"))
            if header.damage or native not in header.platforms:
                continue
            library = str(made / "binaries" / folder / name)
            command = [ldd, library] if ldd else [find_python(), "-c", _LOAD, library]
            try:
                done = run_in_group(command, cwd=made, seconds=60)
            except (OSError, subprocess.TimeoutExpired):
                continue
            if not ldd:
                missing |= {done.stdout.strip().replace(library, name)} if done.stdout.strip() else set()
                continue
            missing |= set(_MISSING.findall(done.stdout))
            there = [read_library(Path(path).read_bytes()).symbols for path in _FOUND.findall(done.stdout)]
            exported = [symbols for symbols in there if symbols is not None]
            undefined |= header.undefined.difference(*exported) if exported else set()
    return sorted(missing), sorted(undefined)


_PROMISES = {
    "2": {
        "canGetAndSetFMUstate": ("fmi2GetFMUstate", "fmi2SetFMUstate", "fmi2FreeFMUstate"),
        "canSerializeFMUstate": ("fmi2SerializedFMUstateSize", "fmi2SerializeFMUstate", "fmi2DeSerializeFMUstate"),
        "providesDirectionalDerivative": ("fmi2GetDirectionalDerivative",),
        "canInterpolateInputs": ("fmi2SetRealInputDerivatives",),
    },
    "3": {
        "canGetAndSetFMUState": ("fmi3GetFMUState", "fmi3SetFMUState", "fmi3FreeFMUState"),
        "canSerializeFMUState": ("fmi3SerializedFMUStateSize", "fmi3SerializeFMUState", "fmi3DeserializeFMUState"),
        "providesDirectionalDerivatives": ("fmi3GetDirectionalDerivative",),
        "providesAdjointDerivatives": ("fmi3GetAdjointDerivative",),
        "hasEventMode": ("fmi3EnterEventMode", "fmi3EnterStepMode", "fmi3UpdateDiscreteStates"),
    },
}
"""Functions by the capability flag that promises them (FMI 2.0, 3.3.1, 4.3.1; FMI 3.0, 3.4, 4.4)."""


def missing_promises(library: SharedLibrary, place: str, summary: Mapping[str, Any]) -> Iterator[FmuFinding]:
    """Yield functions that a library lacks: those of capabilities that it declares, and others of the standard."""
    major = summary["fmi_version"][0]
    if library.symbols is None or major not in _PROMISES:
        return
    promised: set[str] = set()
    for flag, names in _PROMISES[major].items():
        if not any(attributes.get(flag) in (True, 1) for attributes in summary["interfaces"].values()):
            continue
        lost = [name for name in names if name not in library.symbols]
        promised.update(lost)
        if lost:
            yield FmuFinding(
                FmuFault.MISSING_SYMBOL,
                lost[0],
                f"it declares {flag}, but {place} lacks {', '.join(lost)}; expected them.",
                "Don't rely on this capability. Report it to its makers.",
            )
    others = sorted(_standard(major, summary["interfaces"]) - library.symbols - promised)
    if others:
        shown = ", ".join(others[:4]) + (f" and {len(others) - 4} more" if len(others) > 4 else "")
        yield FmuFinding(
            FmuFault.MISSING_SYMBOL,
            others[0],
            f"{place} lacks {shown}, which the standard asks for; expected all functions of an interface.",
            "It runs here without them; other tools may refuse it.",
        )


def _standard(major: str, interfaces: Mapping[str, Any]) -> set[str]:
    """Return the functions that a library must export by the standard, as FMPy asks for them."""
    import fmpy.fmi2
    import fmpy.fmi3

    classes = {
        ("2", "CoSimulation"): fmpy.fmi2.FMU2Slave,
        ("2", "ModelExchange"): fmpy.fmi2.FMU2Model,
        ("3", "CoSimulation"): fmpy.fmi3.FMU3Slave,
        ("3", "ModelExchange"): fmpy.fmi3.FMU3Model,
    }
    chosen = [kind for (version, name), kind in classes.items() if version == major and name in interfaces]
    return {name for kind in chosen for name in dir(kind) if name.startswith(f"fmi{major}")}
