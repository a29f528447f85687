"""Examination of a third-party FMU: content, platform, violations of the standard, a short trial run, a verdict."""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...blocks.core import FmuFileError, accepts, kinds
from ..archive import (
    ArchiveLimits,
    FmuArchive,
    FmuFault,
    FmuFinding,
    FmuSeverity,
    check_binary,
    read_description,
    read_library,
)
from ..platform import native_platform
from .diagnosis import FmuDiagnosis, FmuTrial, FmuVerdict
from .libraries import binaries_of, missing_promises, native_libraries, tuple_of
from .summary import INTERFACES, summarize
from .trial import find_step, split_step, try_out
from .validation import reason_not_to_run, validate

_ABSENT = (FmuFault.NO_BINARY, FmuFault.OTHER_PLATFORM, FmuFault.VERSION, FmuFault.INTERFACE)
"""Errors of an FMU that may run elsewhere."""
_FLOATS = ("Real", "Float64", "Float32")
_RUNNERS = {
    "x86_64-windows": "64-bit Windows, or here in Wine with a Python for Windows",
    "x86-windows": "Windows, or here in Wine, with a 32-bit Python",
    "aarch64-windows": "Windows on ARM",
    "x86_64-linux": "64-bit Linux",
    "x86-linux": "Linux with a 32-bit Python, and the system's libraries for i386",
    "aarch64-linux": "64-bit Linux on ARM",
    "x86_64-darwin": "macOS on Intel, or on Apple silicon by Rosetta",
    "aarch64-darwin": "macOS on Apple silicon",
}


@accepts(
    file=kinds.path,
    run=kinds.flag,
    limits=kinds.one_of_class(ArchiveLimits, "ArchiveLimits(…)"),
    progress=kinds.progress,
)
def doctor(
    file: str | os.PathLike[str],
    *,
    run: bool | None = None,
    limits: ArchiveLimits | None = None,
    progress: bool | Callable[[str], object] | None = None,
) -> FmuDiagnosis:
    """Examine an FMU of any tool: its content, whether it runs here, and violations of the standard.

    Nothing of it runs in this process. The trial run is in its own process; it may take a licence's seat.

    Parameters
    ----------
    file : str or PathLike
        The FMU.
    run : bool, optional
        Whether to try it; without it, it is tried unless it says that it needs another program.
    limits : ArchiveLimits, optional
        Limits of its size; the usual ones without it.
    progress : bool or callable, optional
        Announce a trial run that takes more than 2 s on the standard error, with the limit of its calls, or a function
        that is called with that line; it is announced by default.

    Returns
    -------
    FmuDiagnosis
        Its ``verdict``, ``findings`` and ``headline``; ``print`` shows the whole.

    Examples
    --------
    >>> from loopwright import doctor
    >>> print(doctor("absent.fmu").headline)
    is refused: there is no file 'absent.fmu'; expected an FMU
    """
    path = Path(file).expanduser()
    try:
        archive = FmuArchive.open(path, limits)
        summary = summarize(path, limits=limits, load=run is not False)
    except FmuFileError as error:
        reason = _as_error(error, path)
        return FmuDiagnosis(str(path), _decide([reason], [], []), (reason,))
    variables = summary.pop("variables")
    counts = Counter(v["causality"] for v in variables)
    found = [
        *_judge_platform(archive, summary),
        *_judge_content(summary),
        *_judge_names(variables),
        *_judge_numbers(variables),
    ]
    found += _judge_rules(path, archive, found)
    errors = [a for a in found if a.severity == FmuSeverity.ERROR]
    trials: list[FmuTrial] = []
    for kind in summary["interfaces"]:
        trial, finding = _try(path, kind, archive, summary, run, hopeless=bool(errors), progress=progress)
        trials.append(trial)
        found += [] if finding is None else [finding]
    failed = [a for a in found if a.severity == FmuSeverity.ERROR and a.fault == FmuFault.TRIAL]
    order = list(FmuSeverity)
    return FmuDiagnosis(
        str(path),
        _decide(errors, failed, trials),
        tuple(sorted(found, key=lambda a: order.index(a.severity))),
        summary,
        dict(counts),
        tuple(trials),
    )


def _decide(errors: list[FmuFinding], failed: list[FmuFinding], trials: list[FmuTrial]) -> FmuVerdict:
    if errors:
        here = (*_ABSENT, FmuFault.MISSING_LIBRARY)
        return FmuVerdict.NOT_HERE if any(a.fault in here for a in errors) else FmuVerdict.REFUSED
    if failed and not any(trial.ran for trial in trials):
        return FmuVerdict.FAILS
    return FmuVerdict.RUNS if any(trial.ran for trial in trials) else FmuVerdict.EXPECTED


def _as_error(error: FmuFileError, path: Path) -> FmuFinding:
    """Return an error as a finding; its text ends with the next step."""
    fault = FmuFault(error.fault) if error.fault is not None else FmuFault.DESCRIPTION
    text = error.message.rstrip()
    who = repr(str(path))
    if text.startswith(who):
        text = f"it{text.removeprefix(who)}"
    found, step = split_step(text)
    return FmuFinding(fault, error.subject or "", found, step, FmuSeverity.ERROR)


# --- this machine ---------------------------------------------------------------------------------------------------


def _judge_platform(archive: FmuArchive, summary: Mapping[str, Any]) -> Iterator[FmuFinding]:
    """Yield what keeps an FMU from running on this machine: libraries and functions that are missing or unfit."""
    native, binaries = native_platform(), binaries_of(archive.files)
    identifiers = [str(attributes.get("modelIdentifier")) for attributes in summary["interfaces"].values()]
    found = native_libraries(native, binaries, identifiers)
    if found is None:
        if not any(tuple_of(folder) == native and names for folder, names in binaries.items()):
            yield _absent(native, binaries, summary)
        return  # of several libraries with other names, the description's reading says which
    folder, names = found
    for name in names:
        place = f"binaries/{folder}/{name}"
        try:
            exchange = "CoSimulation" not in summary["interfaces"]
            check_binary(archive, place, summary["fmi_version"], model_exchange=exchange)
        except FmuFileError as error:
            yield _as_error(error, archive.path)
            continue
        yield from missing_promises(read_library(archive.read(place)), place, summary)
    lost = summary["native"]["missing_libraries"]
    if lost:
        inside = [f"{name} is in the FMU, as {p}" for name in lost for p in archive.files if p.endswith(f"/{name}")]
        own = f" But {'; '.join(inside)}: set LD_LIBRARY_PATH to its folder." if inside else ""
        yield FmuFinding(
            FmuFault.MISSING_LIBRARY,
            lost[0],
            f"its library needs {'shared libraries' if len(lost) > 1 else 'a shared library'} that "
            f"{'are' if len(lost) > 1 else 'is'} missing here: {', '.join(lost)}.",
            f"Install {'them' if len(lost) > 1 else 'it'}, in that version.{own}",
            FmuSeverity.ERROR,
        )
    undefined = summary["native"]["undefined_symbols"]
    if undefined and not lost and not summary["python"]:
        python = sum(name.startswith(("Py", "_Py")) for name in undefined) == len(undefined)
        more = f" and {len(undefined) - 1} more" if len(undefined) > 1 else ""
        yield FmuFinding(
            FmuFault.PYTHON if python else FmuFault.UNDEFINED_SYMBOL,
            undefined[0],
            f"its library takes the symbol {undefined[0]}{more} from the program that loads it.",
            "Load it in Python, which has them." if python else "If loading fails, ask its maker for a complete one.",
            FmuSeverity.NOTE if python else FmuSeverity.WARNING,
        )


def _absent(native: str, binaries: Mapping[str, list[str]], summary: Mapping[str, Any]) -> FmuFinding:
    """Return the finding that there is no library for this machine, with what would run the FMU."""
    runners = {_RUNNERS[p] for folder in binaries if (p := tuple_of(folder)) in _RUNNERS and binaries[folder]}
    steps = [f"Run it on {'; or on '.join(sorted(runners))}"] if runners else []
    if any(name.endswith((".c", ".cpp")) for name in summary["sources"]):
        steps.append("build a library for this machine from its sources (fmpy compile)")
    steps.append(f"export it for {native} with its tool ({summary['generation_tool'] or 'not named'})")
    text = "; or ".join(steps)
    there = ", ".join(sorted(binaries)) or "none"
    return FmuFinding(
        FmuFault.NO_BINARY,
        native,
        f"it has no library for this machine, {native}; it has: {there}.",
        f"{text[0].upper()}{text[1:]}.",
        FmuSeverity.ERROR,
    )


# --- the description ------------------------------------------------------------------------------------------------


def _judge_content(summary: Mapping[str, Any]) -> Iterator[FmuFinding]:
    """Yield notes on tools that an FMU needs, and faults of its default experiment."""
    tool = summary["generation_tool"] or "not named"
    for kind, attributes in summary["interfaces"].items():
        if _needs_tool(attributes, summary):
            yield FmuFinding(
                FmuFault.TOOL,
                kind,
                f"its {INTERFACES[kind]} says that it needs another program to run (needsExecutionTool).",
                f"If it does not run, install its tool ({tool}) with a licence. --run tries it.",
                FmuSeverity.NOTE,
            )
    if summary["python"]:
        yield FmuFinding(
            FmuFault.PYTHON,
            "",
            "its equations are Python code that runs in an interpreter (PythonFMU), with packages that they import.",
            "Install these packages here. On Linux it loads only in a process with libpython, such as Python's own.",
            FmuSeverity.NOTE,
        )
    given = summary["default_experiment"]
    numbers = {name: _number(value) for name, value in given.items()}
    for name, value in numbers.items():
        low = name in ("step_size", "tolerance")
        if not math.isfinite(value) or (low and value <= 0.0):
            yield _experiment(
                name, f"has the {name.replace('_', ' ')} {given[name]}", "a positive" if low else "a finite"
            )
    start, stop = numbers.get("start_time", 0.0), numbers.get("stop_time", math.inf)
    if stop < start:
        yield _experiment("stop_time", f"stops at {stop:g} s, before its start at {start:g} s", "a later")


def _needs_tool(attributes: Mapping[str, Any], summary: Mapping[str, Any]) -> bool:
    """Whether an interface says that it needs another program, other than Python."""
    return attributes.get("needsExecutionTool") in (True, 1) and not summary["python"]


def _judge_names(variables: list[dict[str, Any]]) -> Iterator[FmuFinding]:
    for v in variables:
        if v["name"] == "time" and v["causality"] != "independent":
            yield FmuFinding(
                FmuFault.NAME,
                "time",
                f"its {v['causality']} 'time' is a variable, and not the time of the simulation.",
                "It is recorded under its block's name here; other tools may mix them up: rename it there.",
                FmuSeverity.NOTE,
            )


def _judge_numbers(variables: list[dict[str, Any]]) -> Iterator[FmuFinding]:
    """Yield start values that are NaN, and bounds between which nothing lies."""
    for v in variables:
        name, start, low, high = v["name"], v["start"], v["min"], v["max"]
        if v["type"] in _FLOATS and "nan" in (str(x).lower() for x in (start if isinstance(start, list) else [start])):
            yield FmuFinding(
                FmuFault.STANDARD,
                name,
                f"its {v['causality']} {name!r} has the start value NaN; expected a number.",
                f"Give it one here: start={{{name!r}: …}}, or a wire if it is an input.",
            )
        if isinstance(low, int | float) and isinstance(high, int | float) and low > high:
            yield FmuFinding(
                FmuFault.STANDARD,
                name,
                f"its {v['causality']} {name!r} has min = {low:g} above max = {high:g}; expected min <= max.",
                "Export it again with other bounds, or report it to its makers.",
            )


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def _experiment(name: str, found: str, expected: str) -> FmuFinding:
    return FmuFinding(
        FmuFault.EXPERIMENT,
        name,
        f"its default experiment {found}; expected {expected} number.",
        "Nothing of it is used here but in the trial; give your own times in other tools.",
        FmuSeverity.WARNING,
    )


def _judge_rules(path: Path, archive: FmuArchive, known: list[FmuFinding]) -> list[FmuFinding]:
    """Return what `read_description` refuses, and the problems that `validate` finds and that are not known yet."""
    found: list[FmuFinding] = []
    seen = {a.fault for a in known if a.severity == FmuSeverity.ERROR}
    try:
        description = read_description(path, limits=archive.limits)
        found += [a for a in description.findings if a.fault == FmuFault.NEGATED]
    except FmuFileError as error:
        if error.fault not in seen:
            found.append(_as_error(error, path))
    seen = {a.fault for a in (*known, *found) if a.severity == FmuSeverity.ERROR}
    problems = validate(path, run=False, limits=archive.limits).problems
    return [*found, *(replace(p, severity=FmuSeverity.WARNING) for p in problems if p.fault not in seen)]


# --- the trial ------------------------------------------------------------------------------------------------------


def _try(
    path: Path,
    kind: str,
    archive: FmuArchive,
    summary: Mapping[str, Any],
    run: bool | None,
    *,
    hopeless: bool,
    progress: bool | Callable[[str], object] | None,
) -> tuple[FmuTrial, FmuFinding | None]:
    """Run an interface in its own process, if it is to be tried."""
    attributes = summary["interfaces"][kind]
    folders = binaries_of(archive.files)
    if hopeless:
        return FmuTrial(kind, ran=False, left="it can't run here"), None
    left = reason_not_to_run(kind, attributes, folders)
    if not left and run is None and _needs_tool(attributes, summary):
        left = "it needs another program, and may take a licence; --run tries it"
    if not left and run is False:
        left = "as asked for"
    if left:
        return FmuTrial(kind, ran=False, left=left), None
    began = time.perf_counter()
    problem = try_out(path, kind, summary["default_experiment"], archive.limits, progress=progress)
    took = time.perf_counter() - began
    if problem is None:
        step = None
        if kind == "CoSimulation":
            step = find_step(read_description(path, limits=archive.limits), summary["default_experiment"])
        return FmuTrial(kind, ran=True, seconds=took, step=step), None
    return FmuTrial(kind, ran=False, seconds=took), replace(problem, subject=kind)
