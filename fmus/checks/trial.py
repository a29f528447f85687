"""Trial run of an FMU's interface, in its own process, as a run of a diagram would load it."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np

from ...blocks.core import FmuEnd, FmuFileError, FmuProcessError, LoopwrightError, Wanted
from ..archive import ArchiveLimits, FmuDescription, FmuFault, FmuFinding, FmuSeverity
from ..fmu_block import Fmu
from ..isolation import Isolation
from .summary import INTERFACES

PATIENCE = 120.0
"""Seconds that a call of the FMU may take before it counts as hung."""
NOTICE = 2.0
"""Seconds after which a trial run is announced, so that nobody waits in silence for a call that hangs."""
STEPS = 10
"""Number of steps in co-simulation."""
RUNS = {"CoSimulation": f"run for {STEPS} steps", "ModelExchange": "evaluated at its start"}
"""Kinds of trial runs in words."""
_CHOICES = {"CoSimulation": "co_simulation", "ModelExchange": "model_exchange"}
_LOOK = "Check its start values and inputs: see them with loopwright inspect."
BY_END = {
    FmuEnd.CRASH: "Don't load it into a program whose work you need (isolate=False). Report it to its makers.",
    FmuEnd.KILLED: "The system may have done so, as its memory was short. Free some, and try again.",
    FmuEnd.EXIT: "It may miss a licence or a file; ask its makers. Don't load it with isolate=False.",
    FmuEnd.TIMEOUT: "Run it in the tool that exported it; it may wait for a licence or another program.",
}


def try_out(
    file: Path,
    interface: str,
    experiment: dict[str, Any],
    limits: ArchiveLimits | None = None,
    *,
    progress: bool | Callable[[str], object] | None = None,
) -> FmuFinding | None:
    """Run an FMU for some steps in its own process; return its fault, or None.

    In model exchange the derivatives are evaluated at the start. It must have a library for this machine. The default
    experiment has ``start_time``, ``stop_time`` and ``step_size`` in s, where they are given.
    """
    name = INTERFACES[interface]
    say = progress if callable(progress) else partial(print, file=sys.stderr, flush=True)
    notice = Timer(NOTICE, _announce, [file, interface, say])
    notice.daemon = True
    if progress is not False:
        notice.start()
    try:
        plant = Fmu(
            file,
            name="trial",
            interface=_CHOICES[interface],
            isolate=Isolation(step_time=PATIENCE, start_time=PATIENCE),
            limits=limits,
        )
        lost = _step(plant, experiment) if interface == "CoSimulation" else _evaluate(plant, experiment)
    except FmuProcessError as error:
        found = f"{error.message.partition('. ')[0]}.{error.printed}"  # the rest is about runs
        return _failure(f"{name}: {found}", BY_END.get(error.cause, _LOOK))
    except FmuFileError as error:
        step = "Look at what it says; it may miss a licence, a file or the program that exported it."
        return _failure(f"{name}: {split_step(error.message)[0]}", step)
    except LoopwrightError as error:
        found, step = split_step(error.message)
        when = "" if error.t is None else f" at t = {error.t:.9g} s"
        return _failure(f"{name}{when}: {found}", step)
    finally:
        notice.cancel()
    if lost:
        return _failure(f"{name}: {lost} is no finite number.", _LOOK)
    return None


def _failure(found: str, step: str) -> FmuFinding:
    return FmuFinding(FmuFault.TRIAL, "", found, step, FmuSeverity.ERROR)


def _announce(file: Path, interface: str, say: Callable[[str], object]) -> None:
    say(
        f"{file.name} is being {RUNS[interface]} by {INTERFACES[interface]}, in its own process. A call that "
        f"takes longer than {PATIENCE:g} s counts as hung; Ctrl-C ends it before."
    )


def find_step(description: FmuDescription, experiment: dict[str, Any]) -> float:
    """Return the communication step of a trial run in s."""
    return _times(description, experiment)[2]


def experiment_of(get: Callable[[str], str | None]) -> dict[str, Any]:
    """Return the times of a default experiment that are numbers, from a function that gets its attributes."""
    found = {}
    for key, attribute in (("start_time", "startTime"), ("stop_time", "stopTime"), ("step_size", "stepSize")):
        with suppress(TypeError, ValueError):
            found[key] = float(get(attribute))  # type: ignore[arg-type]  # None is a TypeError
    return found


def split_step(message: str) -> tuple[str, str]:
    """Return an error's message without its last sentence, and that sentence, which is the next step."""
    head, dot, step = message.rstrip().rpartition(". ")
    return (f"{head}.", step) if dot else (message, "Export it again.")


def _step(plant: Fmu, experiment: dict[str, Any]) -> str:
    """Take steps; return the time and names of outputs that are not finite, empty if all are."""
    start, stop, step = _times(plant.description, experiment)
    layout = plant.description.layout([v.name for v in plant.output_variables.values()])
    outputs = np.zeros(layout.total)
    with plant.instantiate([], stop, start_time=start) as run:
        run.bind(np.zeros(0), outputs)
        run.begin()
        for k in range(STEPS):
            run.step(start + k * step, step)
            lost = [name for name, part in layout.split(outputs).items() if not np.isfinite(part).all()]
            if lost:
                steps = "one step" if k == 0 else f"{k + 1} steps"
                return f"after {steps} from its start values, {', '.join(lost)}"
    return ""


def _evaluate(plant: Fmu, experiment: dict[str, Any]) -> str:
    """Evaluate outputs and derivatives at the start; return the names of those that are not finite."""
    start, _, _ = _times(plant.description, experiment)
    with plant.exchange([], start_time=start) as run:
        state = run.begin_exchange()
        evaluate = run.evaluation(Wanted(tuple(plant.outputs), rates=True))
        values = np.asarray(evaluate(start, state, np.zeros(0)), dtype=float)
    bad = [i for i, value in enumerate(values) if not math.isfinite(value)]
    n = len(values) - len(state)
    names = [f"derivative {i - n + 1}" if i >= n else f"output element {i + 1}" for i in bad[:5]]
    return f"at its start, {', '.join(names)}" if names else ""


def _times(description: FmuDescription, experiment: dict[str, Any]) -> tuple[float, float | None, float]:
    """Return start time, stop time and step of the default experiment, with usual values for impossible ones."""
    start, stop, step = (_finite(experiment.get(key)) for key in ("start_time", "stop_time", "step_size"))
    start = start or 0.0
    if description.fixed_internal_step is not None and not description.variable_step:
        step = description.fixed_internal_step
    if step is None or step <= 0.0:
        step = (stop - start) / 1000.0 if stop is not None and stop > start else 1e-3
    return start, stop if stop is not None and stop >= start + STEPS * step else None, step


def _finite(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None
