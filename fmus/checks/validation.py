"""Validation of a third-party FMU, by FMPy and by further checks.

The checks cover the archive, the description (against the standard's schemas, which FMPy ships), the model structure,
and the declared binaries and sources. Then each interface is tried in its own process.
"""

from __future__ import annotations

import posixpath
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...blocks.core import FmuFileError
from ..archive import (
    BUILD_DESCRIPTION,
    DESCRIPTION,
    ArchiveLimits,
    FmuArchive,
    FmuFault,
    FmuFinding,
    parse_xml,
    read_library,
    repair,
)
from ..platform import native_platform
from .libraries import binaries_of, library_name, native_libraries, tuple_of
from .summary import INTERFACES, open_fmu
from .trial import RUNS, experiment_of, try_out

_AGAIN = "Export it again with a newer version of its tool ({tool}), or report it to its makers."


@dataclass(frozen=True)
class ValidationReport:
    """Result of a validation."""

    problems: tuple[FmuFinding, ...]  # empty if the FMU is clean
    done: tuple[str, ...]  # checks and runs
    left: tuple[str, ...]  # checks that could not be done here, with the reason


def validate(file: Path, *, run: bool = True, limits: ArchiveLimits | None = None) -> ValidationReport:
    """Validate an FMU; ``run``: run it, too, in its own process."""
    try:
        archive, root = open_fmu(file, limits)
    except FmuFileError as error:
        problem = _breach(str(error), "Take another file: this one is not read any further.")
        return ValidationReport((problem,), (), ())
    entries = list(archive.files)
    tool = root.get("generationTool") or "not named"
    again = _AGAIN.format(tool=tool)
    fmi = root.get("fmiVersion") or "(none)"
    if not (fmi in ("1.0", "2.0") or fmi.startswith("3.")):
        problem = _breach(f"fmiVersion is {fmi!r}; expected 1.0, 2.0 or 3.0.", again)
        return ValidationReport((problem,), (), ("everything else: the version isn't known",))
    problems = [*_archive(archive), *_description(archive, root, again)]
    done = [f"description against FMI {fmi}'s schema and rules"]
    left: list[str] = []
    if fmi != "1.0":
        problems += [_breach(found, again) for found in (*_initial_unknowns(root), *_sources(archive, root))]
    problems += _binaries(archive, root, tool)
    folders = binaries_of(entries)
    if folders:
        done.append(f"binaries for {', '.join(folders)}")
    elements = {kind: element for kind in INTERFACES if (element := root.find(kind)) is not None}
    if fmi == "1.0":  # the interface is no element there
        elements = {"ModelExchange" if not root.xpath("Implementation") else "CoSimulation": root}
    for kind, element in elements.items() if run else ():
        name = INTERFACES[kind]
        reason = reason_not_to_run(kind, element, folders)
        if reason:
            left.append(f"{name} was not run: {reason}")
            continue
        given = root.find("DefaultExperiment")
        wrong = try_out(file, kind, {} if given is None else experiment_of(given.get), limits)
        done.append(f"{name} {RUNS[kind]}")
        if wrong is not None:
            problems.append(wrong)
    return ValidationReport(tuple(problems), tuple(done), tuple(left))


def _breach(found: str, step: str) -> FmuFinding:
    """Return the finding of a description that breaks the standard."""
    return FmuFinding(FmuFault.STANDARD, "", found, step)


# --- the archive and the description --------------------------------------------------------------------------------


def _archive(archive: FmuArchive) -> Iterator[FmuFinding]:
    """Yield the findings about the archive, and the files in it that are damaged."""
    for finding in archive.findings:
        yield replace(finding, found=_end_sentence(finding.found))
    for name in archive.files:
        try:
            for _ in archive.chunks(name):
                pass
        except FmuFileError as error:
            found = f"the archive is damaged: {name}: {error}"
            yield FmuFinding(FmuFault.DAMAGED, name, found, "Copy or export it again.")


def _description(archive: FmuArchive, root: Any, again: str) -> Iterator[FmuFinding]:
    """Yield the faults that FMPy finds (schema, start values, units, model structure), and illegal names."""
    import fmpy
    from fmpy.model_description import ValidationError

    problems = list(_names(root))
    try:
        fmpy.read_model_description(archive.for_fmpy(), validate=True, validate_model_structure=True)
    except ValidationError as error:
        problems += error.problems
    except Exception as error:  # FMPy raises bare exceptions
        # other exceptions are Python's, about lines of FMPy
        known = [str(error)] if type(error) is Exception else repair(deepcopy(root))
        problems += known or ["the description breaks the rules of the standard, so that FMPy can't check the rest."]
    for found in problems:
        yield _breach(_end_sentence(found), _next_step(found, again))


_IDENTIFIER = r"(?:[_a-zA-Z]\w*|'(?:[\w!#$%&()*+,\-./:;<>=?@\[\]^{}| ~]|\\['\"?\\abfnrtv])+')(?:\[\d+(?:,\d+)*\])?"
_STRUCTURED = re.compile(
    rf"{_IDENTIFIER}(?:\.{_IDENTIFIER})*|der\({_IDENTIFIER}(?:\.{_IDENTIFIER})*(?:,\d+)?\)", re.ASCII
)
"""Names by the convention "structured" (FMI 2.0, 2.2.9; FMI 3.0, 2.4.7.5.1); its grammar is regular."""


def _names(root: Any) -> Iterator[str]:
    """Yield variables' names that break the naming convention, which is "flat" if none is said."""
    structured = root.get("variableNamingConvention") == "structured"
    for variable in root.iterfind("ModelVariables/*"):
        name = variable.get("name", "")
        if structured and _STRUCTURED.fullmatch(name) is None:
            yield (
                f'The variable "{name}" (line {variable.sourceline}) breaks the naming convention "structured"; '
                "expected a name such as a.b[1] or der(a.b)"
            )
        elif re.search(r"[\r\n\t]", name):
            yield f"The variable {name!r} (line {variable.sourceline}) has a line break or a tab in its name."


def _next_step(found: str, again: str) -> str:
    """Return the next step for a problem that FMPy found; FMPy gives its text only."""
    if "has no start value" in found:
        return "Give the variable a start value and export it again."
    if "is not defined" in found and "unit" in found:
        return "Define the unit in UnitDefinitions, or leave it out, and export it again."
    return again


def _end_sentence(text: str) -> str:
    text = text.strip()
    return text if text.endswith((".", "!", "?")) else f"{text}."


def _initial_unknowns(root: Any) -> Iterator[str]:
    """Yield faults of the list of initial unknowns, beyond the set that FMPy compares (FMI 2.0, 2.2.8)."""
    structure = root.find("ModelStructure")
    if structure is None:
        return
    three = (root.get("fmiVersion") or "").startswith("3.")
    key = "valueReference" if three else "index"
    unknowns = structure.findall("InitialUnknown" if three else "InitialUnknowns/Unknown")
    references = [u.get(key) for u in unknowns]
    for reference, count in Counter(references).items():
        if count > 1:
            yield f"ModelStructure lists the initial unknown with {key} {reference} {count} times; expected once."
    numbers = [int(r) for r in references if r is not None and r.isdigit()]
    if not three and numbers != sorted(numbers):
        yield "ModelStructure/InitialUnknowns is not in the order of the variables; expected ascending indices."


def _sources(archive: FmuArchive, root: Any) -> Iterator[str]:
    """Yield faults of declared source files that are missing."""
    if BUILD_DESCRIPTION in archive.files:
        try:
            build = parse_xml(archive.path, BUILD_DESCRIPTION, archive.read(BUILD_DESCRIPTION))
        except FmuFileError:
            return  # it is reported already
        declared = [e.get("name") for e in build.findall("BuildConfiguration/SourceFileSet/SourceFile")]
        where = BUILD_DESCRIPTION
    else:
        declared = [e.get("name") for kind in INTERFACES for e in root.findall(f"{kind}/SourceFiles/File")]
        where = DESCRIPTION
    for name in dict.fromkeys(declared):
        if posixpath.normpath(f"sources/{name}") not in archive.files:
            yield f"{where} declares the source file {name}; there is no sources/{name}."


# --- binaries -------------------------------------------------------------------------------------------------------


def _identifiers(root: Any) -> dict[str, str]:
    """Return the model identifier of each interface."""
    if root.get("fmiVersion") == "1.0":
        return {"its interface": root.get("modelIdentifier")}
    found = ((INTERFACES[kind], root.find(kind)) for kind in INTERFACES)
    return {name: element.get("modelIdentifier") for name, element in found if element is not None}


def _binaries(archive: FmuArchive, root: Any, tool: str) -> Iterator[FmuFinding]:
    """Yield faults of libraries: missing, of another name, cut off, or for another machine than their folder's."""
    build = f"Export it again with its tool ({tool}); if it has sources, fmpy compile builds it for this machine."
    folders = binaries_of(archive.files)
    if not folders and not any(name.startswith("sources/") for name in archive.files):
        found = "it holds neither a binary nor sources, so that nothing can run it."
        yield FmuFinding(FmuFault.NO_BINARY, "", found, build)
    for folder, names in folders.items():
        platform = tuple_of(folder)
        if platform is None:
            continue  # a tool may have its own folders
        for library in sorted({library_name(i, platform) for i in _identifiers(root).values() if i}):
            users = [who for who, i in _identifiers(root).items() if i and library_name(i, platform) == library]
            if library not in names:
                has = f"binaries/{folder} has no {library}, needed for {' and '.join(users)}; it has"
                step = f"Put {library} there, or take the folder out. {build}"
                yield FmuFinding(FmuFault.OTHER_NAME, f"binaries/{folder}", f"{has} {', '.join(names)}.", step)
                continue
            place = f"binaries/{folder}/{library}"
            try:
                header = read_library(archive.read(place))
            except FmuFileError:  # damage, which is reported already
                continue
            if platform not in header.platforms:
                is_for = " and ".join(header.platforms) or "no platform known here: it is no shared library"
                found = f"{place} is for {is_for}; expected {platform}."
                step = f"Put the library that is for {platform} there, or take the folder out."
                yield FmuFinding(FmuFault.OTHER_PLATFORM, place, found, step)
            elif header.damage:
                found = f"{place} can't be loaded: {header.damage}."
                yield FmuFinding(FmuFault.TRUNCATED, place, found, "Copy or export it again.")


# --- running --------------------------------------------------------------------------------------------------------


def reason_not_to_run(kind: str, element: Any, folders: Mapping[str, list[str]]) -> str:
    """Return the reason why an interface can't be run here, by its attributes; empty if there is none.

    An XML element serves as the attributes; libraries by folder are those of `binaries_of`.
    """
    if kind == "ScheduledExecution":
        return "scheduled execution needs a scheduler"
    native = native_platform()
    if native_libraries(native, folders, [element.get("modelIdentifier") or ""]) is not None:
        return ""
    return f"it has no binary for this machine, {native}"
