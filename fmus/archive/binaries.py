"""Libraries of an FMU for this platform: found by name, and checked before they are loaded."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from ...blocks.core import FmuFileError
from ..platform import native_platform
from .faults import FmuFault, FmuFinding
from .library_headers import SharedLibrary, read_library
from .zip_file import FmuArchive

_FOLDERS2 = {"x86_64-linux": "linux64", "x86_64-windows": "win64", "x86_64-darwin": "darwin64"}
"""Folders of binaries in FMI 2.0 (2.3.1), where they differ from FMI 3.0's platform tuples."""
_SUFFIXES = (".so", ".dll", ".dylib")
_COMMON = ("GetVersion", "FreeInstance", "EnterInitializationMode", "ExitInitializationMode", "Terminate")
_REQUIRED = {
    ("2", False): ("Instantiate", "SetupExperiment", *_COMMON, "DoStep"),
    ("2", True): ("Instantiate", "SetupExperiment", *_COMMON, "SetContinuousStates", "GetDerivatives"),
    ("3", False): ("InstantiateCoSimulation", *_COMMON, "DoStep"),
    ("3", True): ("InstantiateModelExchange", *_COMMON, "SetContinuousStates", "GetContinuousStateDerivatives"),
}
"""Functions without which an FMU can't run, by the major version and whether it is for model exchange."""


def find_binary(path: Path, entries: Collection[str], version: str, identifier: str) -> str:
    """Return the library for this platform: that of the model identifier, else the only one in the folder."""
    platform = native_platform()
    folder = platform if version.startswith("3.") else _FOLDERS2.get(platform, platform)
    with_abi = {e.split("/")[1] for e in entries if e.startswith(f"binaries/{platform}-")}  # FMI 3.0, 2.5.1.4
    if with_abi and not any(e.startswith(f"binaries/{folder}/") for e in entries):
        folder = min(with_abi)
    here = sorted(e for e in entries if e.startswith(f"binaries/{folder}/") and e.endswith(_SUFFIXES))
    named = [e for e in here if e.rpartition("/")[2].rpartition(".")[0] == identifier]
    direct = named or [e for e in here if e.count("/") == 2]
    if len(direct) == 1 or named:
        return direct[0]
    found = sorted(
        {e.split("/")[1] for e in entries if e.startswith("binaries/") and e.count("/") > 1 and e[-1] != "/"}
    )
    if direct:
        names = ", ".join(e.rpartition("/")[2] for e in direct)
        raise FmuFileError(
            f"{str(path)!r} has several libraries in binaries/{folder}, none with its model identifier: found {names}; "
            f"expected {identifier}. Export it again.",
            fault=FmuFault.AMBIGUOUS,
            subject=folder,
        )
    raise FmuFileError(
        f"{str(path)!r} has no binary for this platform, {folder} (it has: {', '.join(found) or 'none'}). Export "
        f"or build it for this platform; 'loopwright doctor {path}' says what would run it.",
        fault=FmuFault.NO_BINARY,
        subject=folder,
    )


def judge_name(binary: str, identifier: str) -> tuple[FmuFinding, ...]:
    """Return the finding that a library's name is not the model identifier's (FMI 2.0, 2.3.1; FMI 3.0, 2.5.1.4)."""
    name = binary.rpartition("/")[2]
    if name.rpartition(".")[0] == identifier:
        return ()
    found = f"its library is called {name}, as the only one in its folder; expected the model identifier, {identifier}."
    return (
        FmuFinding(
            FmuFault.OTHER_NAME, binary, found, "It runs here; other tools may not find it. Report it to its maker."
        ),
    )


def missing_functions(library: SharedLibrary, version: str, *, model_exchange: bool) -> tuple[str, ...]:
    """Return the functions that a library must export and does not; empty if its symbols are not known.

    None is known as missing in FMI 1.0, where names have the model's prefix.
    """
    if library.symbols is None or library.damage:
        return ()
    required = _REQUIRED.get((version[0], model_exchange), ())
    return tuple(name for end in required if (name := f"fmi{version[0]}{end}") not in library.symbols)


def check_binary(archive: FmuArchive, binary: str, version: str, *, model_exchange: bool = False) -> SharedLibrary:
    """Return the header of an FMU's library, after holding it against this platform and the file's size."""
    library, native, file = read_library(archive.read(binary)), native_platform(), str(archive.path)
    if library.platforms and native not in library.platforms:
        raise FmuFileError(
            f"the library {binary} of {file!r} is for {' and '.join(library.platforms)}; expected {native}, as its "
            f"folder says. Export it again; 'loopwright doctor {file}' says what would run it.",
            fault=FmuFault.OTHER_PLATFORM,
            subject=binary,
        )
    if library.damage:
        raise FmuFileError(
            f"the library {binary} of {file!r} can't be loaded safely: {library.damage}. Copy or download the FMU "
            "again, or export it again.",
            fault=FmuFault.TRUNCATED,
            subject=binary,
        )
    missing = missing_functions(library, version, model_exchange=model_exchange)
    beside = {name.rpartition("/")[2] for name in archive.files if name.startswith(f"{binary.rpartition('/')[0]}/")}
    if missing and not beside & set(library.needed):  # a wrapper may take them from its own library
        others = sorted({name[:4] for name in library.symbols or () if name[:4] in ("fmi2", "fmi3")} - {missing[0][:4]})
        instead = f" It has functions of FMI {others[0][3]}." if others else ""
        raise FmuFileError(
            f"the library {binary} of {file!r} lacks {', '.join(missing)}, without which an FMU of FMI {version} can't "
            f"run.{instead} Export it again.",
            fault=FmuFault.MISSING_SYMBOL,
            subject=binary,
        )
    return library
