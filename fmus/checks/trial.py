"""Trial run of an FMU in this process, which the FMU may crash.

The command is ``python -m loopwright.fmus.checks.trial FILE INTERFACE REPORT``.

A line of JSON in the report names each stage before it begins, so that a crash shows its stage. The last line of a
complete run has the stage "done".
"""

from __future__ import annotations

import ctypes
import json
import math
import sys
import tempfile
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..archive import DESCRIPTION, FmuArchive, check_binary, find_binary, parse_xml, read_model, write_files

_MESSAGES = 20


def main(file: str, interface: str, report: str) -> None:
    """Instantiate, initialize, step once, get the outputs, terminate."""
    with open(report, "w", encoding="utf-8") as stream, tempfile.TemporaryDirectory(prefix="loopwright-") as folder:

        def tell(stage: str, **more: Any) -> None:
            stream.write(json.dumps({"stage": stage, **more}) + "\n")
            stream.flush()

        messages: deque[str] = deque(maxlen=_MESSAGES)
        stage = "load"

        def begin(name: str) -> None:
            nonlocal stage
            stage = name
            tell(name)

        try:
            begin("load")
            archive = FmuArchive.open(file)
            write_files(archive, Path(folder))
            text = archive.description()
            model, _ = read_model(archive.path, text, parse_xml(archive.path, DESCRIPTION, text))
            library = _find_library(archive, model, interface)
            notes = _run(folder, model, interface, library, begin, messages)
        except Exception as error:
            said = [m for m in messages if m.strip()]
            kind = "" if type(error) is Exception else f"{type(error).__name__}: "  # FMPy raises bare exceptions
            tell("failed", at=stage, error=f"{kind}{error}", messages=said[-3:])
        else:
            tell("done", **notes)


def _find_library(archive: FmuArchive, model: Any, interface: str) -> str:
    """Return the path of the interface's library in the archive, after checking it."""
    about = model.coSimulation if interface == "CoSimulation" else model.modelExchange
    library = find_binary(archive.path, archive.files, model.fmiVersion, about.modelIdentifier)
    check_binary(archive, library, model.fmiVersion, model_exchange=interface == "ModelExchange")
    return library


def _run(
    folder: str, model: Any, interface: str, library: str, begin: Callable[[str], None], messages: deque[str]
) -> dict[str, Any]:
    from fmpy.simulation import instantiate_fmu

    three = model.fmiVersion.startswith("3.")

    def log(*parts: Any) -> None:  # FMI 2.0: environment, instance, status, category, text; 3.0: no instance
        messages.append((parts[-1] or b"").decode(errors="replace"))

    start, stop, step = _times(model, interface)
    fmu = instantiate_fmu(
        folder,
        model,
        fmi_type=interface,
        logger=log,
        debug_logging=True,
        library_path=str(Path(folder, library)),
        require_functions=False,
    )
    begin("initialize")
    if three:
        fmu.enterInitializationMode(startTime=start, stopTime=stop)
    else:
        fmu.setupExperiment(startTime=start, stopTime=stop)
        fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    begin("step")
    if interface == "CoSimulation":
        fmu.doStep(start, step)
        missing: list[str] = []
    else:
        missing = _derivatives(fmu, model, three, start)
    begin("get")
    missing += _not_finite(fmu, model, three)
    begin("terminate")
    fmu.terminate()
    fmu.freeInstance()
    return {"step": step if interface == "CoSimulation" else None, "not_finite": missing}


def _times(model: Any, interface: str) -> tuple[float, float | None, float]:
    """Return start time, stop time and step of the default experiment, with usual values for missing ones."""
    experiment = model.defaultExperiment
    start, stop, step = (
        None if (text := getattr(experiment, name, None)) is None else float(text)
        for name in ("startTime", "stopTime", "stepSize")
    )
    start = start or 0.0
    slave = model.coSimulation
    fixed = getattr(slave, "fixedInternalStepSize", None)
    if interface == "CoSimulation" and fixed is not None and not slave.canHandleVariableCommunicationStepSize:
        step = float(fixed)
    if step is None:
        step = (stop - start) / 1000 if stop is not None and stop > start else 1e-3
    return start, stop if stop is not None and stop >= start + step else None, step


def _derivatives(fmu: Any, model: Any, three: bool, start: float) -> list[str]:
    """Enter Continuous-Time Mode and evaluate the derivatives; return the names of those that are not finite."""
    more = True
    rounds = 0
    while more:
        result = fmu.updateDiscreteStates() if three else fmu.newDiscreteStates()
        more, rounds = bool(result[0]), rounds + 1
        if rounds > 1000:
            raise RuntimeError("the iteration for new discrete states at the start has not ended after 1000 rounds")
    fmu.enterContinuousTimeMode()
    fmu.setTime(start)
    n = fmu.getNumberOfContinuousStates() if three else model.numberOfContinuousStates
    if not n:
        return []
    values = (ctypes.c_double * n)()
    (fmu.getContinuousStateDerivatives if three else fmu.getDerivatives)(values, n)
    return [f"derivative {i + 1}" for i, value in enumerate(values) if not math.isfinite(value)]


def _not_finite(fmu: Any, model: Any, three: bool) -> list[str]:
    """Return the names of outputs that are not finite."""
    found = []
    for v in model.modelVariables:
        if v.causality != "output" or v.clocks or v.type not in ("Real", "Float64", "Float32"):
            continue
        if not three:
            values = fmu.getReal([v.valueReference])
        elif all(d.start is not None for d in v.dimensions or ()):
            n = math.prod(int(d.start) for d in v.dimensions or ())
            get = fmu.getFloat64 if v.type == "Float64" else fmu.getFloat32
            values = get([v.valueReference], n)
        else:
            continue
        if not all(math.isfinite(value) for value in values):
            found.append(v.name)
    return found


if __name__ == "__main__":
    file, interface, report = sys.argv[1:]
    main(str(Path(file)), interface, report)
