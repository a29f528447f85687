"""Summary of a third-party FMU, of FMI 1.0 to 3.0, without running it.

A summary consists of dictionaries, lists, numbers and text only, so that it can be written as JSON.
"""

from __future__ import annotations

import hashlib
import math
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from ...blocks.core import FmuFileError
from ..export import SUFFIXES
from ..platform import native_platform

INTERFACES = {
    "CoSimulation": "co-simulation",
    "ModelExchange": "model exchange",
    "ScheduledExecution": "scheduled execution",
}
"""Names of the interfaces by their elements in ``modelDescription.xml``."""

# Folders of binaries in FMI 1.0 and 2.0 (2.3.1) as platform tuples of FMI 3.0 (2.5.1.4).
_FOLDERS = {
    "linux32": "x86-linux",
    "linux64": "x86_64-linux",
    "win32": "x86-windows",
    "win64": "x86_64-windows",
    "darwin64": "x86_64-darwin",
}
_MACHINES = {
    "linux": {0x03: "x86", 0x3E: "x86_64", 0xB7: "aarch64"},
    "windows": {0x14C: "x86", 0x8664: "x86_64", 0xAA64: "aarch64"},
    "darwin": {0x7: "x86", 0x1000007: "x86_64", 0x100000C: "aarch64"},
}
_LOAD = "import ctypes, sys\ntry: ctypes.CDLL(sys.argv[1])\nexcept OSError as error: print(error)"


def summarize(file: Path) -> dict[str, Any]:
    """Return a summary of an FMU's description and archive.

    Parameters
    ----------
    file : Path
        An FMU of FMI 1.0, 2.0 or 3.0.

    Returns
    -------
    dict
        JSON-like. ``variables`` is a list of dictionaries; ``shape`` of a scalar is an empty list.

    Raises
    ------
    FmuFileError
        If it can't be read.
    """
    entries, root = read_archive(file)
    model = _read_model(file)
    fmi = str(model.fmiVersion)
    binaries = binaries_of(entries)
    native = native_platform()
    states = {id(v.derivative) for v in model.modelVariables if v.derivative is not None}
    variables = [_variable(v, id(v) in states) for v in model.modelVariables]
    interfaces = _interfaces(root, model)
    experiment = model.defaultExperiment
    return {
        "file": str(file),
        "size": file.stat().st_size,
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "fmi_version": fmi,
        "model_name": model.modelName,
        "description": model.description or "",
        "version": model.version,
        "author": model.author,
        "license": model.license,
        "copyright": model.copyright,
        "generation_tool": model.generationTool,
        "generation_date_and_time": model.generationDateAndTime,
        "token": model.guid,
        "interfaces": interfaces,
        "default_experiment": {
            key: _value(getattr(experiment, attribute), "Float64")
            for key, attribute in (
                ("start_time", "startTime"),
                ("stop_time", "stopTime"),
                ("step_size", "stepSize"),
                ("tolerance", "tolerance"),
            )
            if getattr(experiment, attribute, None) is not None
        },
        "platforms": {folder: {"platform": tuple_of(folder), "files": names} for folder, names in binaries.items()},
        "native": _native_binary(file, native, binaries, interfaces),
        "sources": sorted(name for name in entries if name.startswith("sources/") and not name.endswith("/")),
        "documentation": any(name.startswith("documentation/") and not name.endswith("/") for name in entries),
        "log_categories": [category.name for category in model.logCategories],
        "continuous_states": _count(v for v in variables if v["state"]) or int(model.numberOfContinuousStates or 0),
        "event_indicators": _count(_variable(u.variable, False) for u in model.eventIndicators)
        or int(model.numberOfEventIndicators or 0),
        "variables": variables,
        "notes": _notes(fmi, entries, interfaces, model.generationTool or ""),
    }


def read_archive(file: Path) -> tuple[list[str], Any]:
    """Return the names in an FMU's archive and the root element of its ``modelDescription.xml``.

    Raises
    ------
    FmuFileError
        If it is no zip archive, or has no ``modelDescription.xml`` that can be read.
    """
    from lxml import etree

    try:
        with zipfile.ZipFile(file) as archive:
            entries = archive.namelist()
            if "modelDescription.xml" not in entries:
                nested = next((e for e in entries if e.endswith("/modelDescription.xml")), None)
                raise FmuFileError(
                    f"{str(file)!r} is a zip archive without modelDescription.xml, so it is no FMU. "
                    + (f"There is {nested}: pack the files in that folder, not the folder." if nested else "")
                )
            text = archive.read("modelDescription.xml")
    except zipfile.BadZipFile as error:
        with file.open("rb") as stream:
            found = stream.read(8)
        raise FmuFileError(
            f"{str(file)!r} is no FMU: it can't be read as a zip archive ({error}; it starts with {found!r}). Give the "
            ".fmu that the tool exported."
        ) from None
    except MemoryError:
        raise FmuFileError(
            f"{str(file)!r} can't be read: its modelDescription.xml does not fit into memory. Export the FMU again."
        ) from None
    except RuntimeError as error:  # of an archive that asks for a password, or is packed in an unknown way
        raise FmuFileError(
            f"{str(file)!r} can't be read: {error}. Pack it again without a password, by the usual compression."
        ) from None
    except (OSError, EOFError, zlib.error) as error:
        raise FmuFileError(f"{str(file)!r} can't be read: {error}. Check the path and its permissions.") from error
    try:
        root = etree.fromstring(text, etree.XMLParser(resolve_entities=False, no_network=True))
    except etree.XMLSyntaxError as error:
        raise FmuFileError(
            f"the modelDescription.xml of {str(file)!r} is no XML: {error}. Export the FMU again."
        ) from error
    return entries, root


def _read_model(file: Path) -> Any:
    import fmpy

    try:
        return fmpy.read_model_description(str(file), validate=False)
    except Exception as error:  # FMPy raises bare exceptions
        raise FmuFileError(
            f"the modelDescription.xml of {str(file)!r} can't be read: {error}. List its faults with "
            f"loopwright validate {file}"
        ) from error


# --- interfaces -----------------------------------------------------------------------------------------------------


def _interfaces(root: Any, model: Any) -> dict[str, dict[str, Any]]:
    """Return the attributes of each interface that the file gives; those left out are false or 0."""
    if model.fmiVersion == "1.0":  # the interface is no element there
        kind = "CoSimulation" if model.coSimulation is not None else "ModelExchange"
        return {kind: {"modelIdentifier": root.get("modelIdentifier")}}
    return {
        kind: {name: _flag(value) for name, value in element.attrib.items()}
        for kind in INTERFACES
        if (element := root.find(kind)) is not None
    }


def _flag(text: str) -> Any:
    if text in ("true", "false"):
        return text == "true"
    return _number(text) if text[:1].isdigit() else text


def _notes(fmi: str, entries: Iterable[str], interfaces: Mapping[str, Mapping[str, Any]], tool: str) -> list[str]:
    """Return notes on the limits of an FMU's use."""
    notes = []
    if fmi == "1.0":
        notes.append(
            "FMI 1.0 can be read here and nothing else: it can't become a block, and its validation does not run it. "
            "Export it with FMI 3.0."
        )
    python = tool.startswith("PythonFMU") or "resources/slavemodule.txt" in set(entries)
    if python:
        notes.append(
            "It needs Python: its equations are Python code that runs in an interpreter (PythonFMU), with the packages "
            "that they import. On Linux it loads only in a process that has libpython loaded, such as Python's own."
        )
    elif any(attributes.get("needsExecutionTool") in (True, 1) for attributes in interfaces.values()):
        notes.append("It needs another program to run (needsExecutionTool): it is a coupling, not a model.")
    if any(attributes.get("canBeInstantiatedOnlyOncePerProcess") in (True, 1) for attributes in interfaces.values()):
        notes.append("It can be instantiated only once in a process (canBeInstantiatedOnlyOncePerProcess).")
    return notes


# --- binaries -------------------------------------------------------------------------------------------------------


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


def platforms_of_binary(data: bytes) -> set[str]:
    """Return the platforms of a shared library, read from its header; none for an unknown format."""
    found: set[tuple[str, int]] = set()
    if data[:4] == b"\x7fELF" and len(data) >= 20:
        found.add(("linux", struct.unpack_from("<H" if data[5] == 1 else ">H", data, 18)[0]))
    elif data[:2] == b"MZ" and len(data) >= 64:
        (start,) = struct.unpack_from("<I", data, 0x3C)
        if data[start : start + 4] == b"PE\0\0" and len(data) >= start + 6:
            found.add(("windows", struct.unpack_from("<H", data, start + 4)[0]))
    elif data[:4] in (b"\xcf\xfa\xed\xfe", b"\xce\xfa\xed\xfe") and len(data) >= 8:
        found.add(("darwin", struct.unpack_from("<I", data, 4)[0]))
    elif data[:4] == b"\xca\xfe\xba\xbe" and len(data) >= 8:  # several architectures in one file
        (count,) = struct.unpack_from(">I", data, 4)
        for i in range(count if count < 16 and len(data) >= 8 + 20 * count else 0):
            found.add(("darwin", struct.unpack_from(">I", data, 8 + 20 * i)[0]))
    return {f"{_MACHINES[s][m]}-{s}" for s, m in found if m in _MACHINES[s]}


def _native_binary(
    file: Path, native: str, binaries: Mapping[str, list[str]], interfaces: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Return whether there is a binary for this machine, and the libraries and symbols that it lacks here."""
    system = native.split("-")[1]
    identifiers = {str(attributes.get("modelIdentifier")) for attributes in interfaces.values()}
    for folder, names in binaries.items():
        wanted = sorted({library_name(i, native) for i in identifiers} & set(names)) if system in SUFFIXES else []
        if tuple_of(folder) == native and wanted:
            missing, undefined = _find_missing(file, folder, wanted)
            return {
                "platform": native, "available": True, "missing_libraries": missing, "undefined_symbols": undefined,
            }  # fmt: skip
    return {"platform": native, "available": False, "missing_libraries": [], "undefined_symbols": []}


def _find_missing(file: Path, folder: str, names: Iterable[str]) -> tuple[list[str], list[str]]:
    """Return the shared libraries and symbols that are missing here, from ldd or from an attempt to load."""
    missing: set[str] = set()
    undefined: set[str] = set()
    ldd = shutil.which("ldd") if sys.platform.startswith("linux") else None
    with tempfile.TemporaryDirectory(prefix="loopwright-") as made, zipfile.ZipFile(file) as archive:
        for name in archive.namelist():
            if name.startswith(f"binaries/{folder}/"):  # all files, since it may bring its own libraries
                archive.extract(name, made)
        for name in names:
            library = str(Path(made) / "binaries" / folder / name)
            command = [ldd, "-r", library] if ldd else [sys.executable, "-c", _LOAD, library]
            try:
                done = subprocess.run(
                    command, cwd=made, capture_output=True, text=True, errors="replace", timeout=60, check=False
                )
            except (OSError, subprocess.TimeoutExpired):
                continue
            if ldd:
                missing |= set(re.findall(r"^\s*(\S+) => not found", done.stdout, re.MULTILINE))
                undefined |= set(re.findall(r"undefined symbol:\s*([^\s,]+)", done.stdout + done.stderr))
            elif done.stdout.strip():
                missing.add(done.stdout.strip().replace(library, name))
    return sorted(missing), sorted(undefined)


# --- variables ------------------------------------------------------------------------------------------------------


def _variable(v: Any, state: bool) -> dict[str, Any]:
    declared = v.declaredType
    numeric = v.type in ("Real", "Integer", "Enumeration") or re.match(r"Float|U?Int", v.type or "") is not None
    return {
        "name": v.name,
        "reference": v.valueReference,
        "type": v.type,
        "shape": _shape(v),
        "causality": v.causality or "local",
        "variability": v.variability,
        "initial": v.initial,
        "state": state,
        "derivative_of": None if v.derivative is None else v.derivative.name,
        "unit": v.unit or (None if declared is None else declared.unit),
        "start": _value(v.start, v.type),
        "min": _value(v.min, v.type) if numeric else None,
        "max": _value(v.max, v.type) if numeric else None,
        "nominal": _value(v.nominal, v.type) if numeric else None,
        "description": v.description or "",
    }


def _shape(variable: Any) -> list[Any]:
    """Return the sizes; a dimension by a structural parameter takes its start value."""
    sizes = [d.start if d.start is not None else getattr(d.variable, "start", None) for d in variable.dimensions or ()]
    return [int(size) if size is not None and str(size).strip().isdigit() else None for size in sizes]


def _count(variables: Iterable[Mapping[str, Any]]) -> int:
    """Return the number of elements of variables."""
    return sum(math.prod(size or 1 for size in v["shape"]) for v in variables)


def _value(text: Any, kind: str | None) -> Any:
    """Return a start value or limit for JSON; a value that is no number in JSON, or can't be read, stays text."""
    if text is None or kind in ("String", "Binary", "Clock"):
        return text
    if isinstance(text, bool | int | float):
        return text if math.isfinite(text) else str(text)
    if isinstance(text, list | tuple):
        return [_value(item, kind) for item in text]
    parts = str(text).split()
    if kind == "Boolean":
        values: list[Any] = [part in ("true", "1") for part in parts]
    else:
        values = [_number(part) for part in parts]
    return values[0] if len(values) == 1 else values


def _number(text: str) -> Any:
    try:
        value = int(text) if re.fullmatch(r"[+-]?\d+", text) else float(text)
    except ValueError:
        return text
    return value if math.isfinite(value) else text
