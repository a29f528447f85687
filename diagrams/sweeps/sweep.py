"""A sweep: samples of parameters, run in parallel, kept on disk, and put together in their order."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ...blocks.core import Kind, accepts, kinds, one_thread
from ..flat import WiredDiagram
from ..results import Run
from ..simulation import ProgressOption, RunOptions, progress_bar
from .outcome import SampleOutcome
from .plan import LANES, REFUSED, check_names, make_plan
from .processes import processors
from .result import Sweep
from .revision import key_of, parts_of
from .samples import read_samples
from .store import Store
from .ways_to_run import run_samples

_MANY_LANES = (2, 4, 8, 16)


class InterruptedSweep(KeyboardInterrupt):
    """Ctrl-C in a sweep: a `KeyboardInterrupt` that keeps the results until then.

    Attributes
    ----------
    sweep : Sweep
        The sweep; samples that were not run have NaN.
    """

    def __init__(self, sweep: Sweep):
        done = sum(outcome is not None for outcome in sweep.outcomes)
        super().__init__(f"interrupted after {done} of {len(sweep.samples)} samples")
        self.sweep = sweep


_LANES_ASKED = Kind(
    f"True for {LANES} runs side by side, {', '.join(map(str, _MANY_LANES))}, or False for one after the other",
    lambda lanes: lanes is False or lanes is True or (isinstance(lanes, int | np.integer) and lanes in _MANY_LANES),
    "Give one of them.",
    kinds.by_name,
)


@accepts(
    duration=kinds.number,
    signals=kinds.names,
    seeds=kinds.names,
    progress=kinds.progress,
    workers=kinds.integer(1).worded("a positive integer, or None for every core", "Give one.", kinds.by_name),
    lanes=_LANES_ASKED,
)
@accepts("{diagram.name}", to=kinds.path.worded("the path of a folder", "Give one."))
def sweep(
    diagram: WiredDiagram,
    parameters: Mapping[str, Any] | None,
    duration: float,
    *,
    samples: Any = "grid",
    count: int | None = None,
    seed: int = 0,
    seeds: str | Iterable[str] = (),
    signals: str | Iterable[str] = (),
    reduce: Mapping[str, Callable[[Run], Any]] | None = None,
    to: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    workers: int | None = None,
    client: Any = None,
    progress: ProgressOption = None,
    lanes: bool | int = False,
    options: Mapping[str, Any],
) -> Sweep:
    """Run a diagram with many values of its parameters; see `Diagram.sweep`."""
    started, name = perf_counter(), diagram.name
    RunOptions.of({option: value for option, value in options.items() if option not in REFUSED}, block=name)
    found = read_samples(diagram, parameters, samples, count=count, seed=seed)
    plan = make_plan(diagram, duration, signals, reduce, seeds, options, count=len(found), lanes=lanes)
    check_names(plan, found.names)
    store, known = None, dict[str, SampleOutcome]()
    if to is not None:
        store = Store(Path(to), parts_of(plan), {"diagram": name, "duration": plan.duration}, overwrite=overwrite)
        known = store.read()
    outcomes: list[SampleOutcome | None] = [None] * len(found)
    reused = 0

    def result() -> Sweep:
        messages = tuple(dict.fromkeys(m for o in outcomes if o is not None for m in o.messages))
        return Sweep(found, tuple(outcomes), name, perf_counter() - started, reused, messages, tuple(plan.reductions))

    # A stored outcome counts only for the same plan and sample; its key is made of both.
    try:
        keys = [key_of(sample, seeded=bool(plan.seeds)) for sample in found] if store is not None else []
        for place, key in enumerate(keys):
            if key in known:
                outcomes[place] = replace(known[key], index=place)
        done = reused = sum(outcome is not None for outcome in outcomes)
        left = [sample for sample in found if outcomes[sample.index] is None]
        run = run_samples(plan, left, processors() if workers is None else int(workers), client)
        bar = progress_bar(name, 0, len(found), progress, "{task.completed:.0f} of {task.total:.0f} samples")
        with one_thread(), bar as show, closing(run) as stream:
            show(done)
            for outcome in stream:
                outcomes[outcome.index] = outcome
                if store is not None:
                    store.add(keys[outcome.index], outcome)
                done += 1
                show(done)
    # What was computed until Ctrl-C is not lost: the error has it, and the store has it on disk.
    except KeyboardInterrupt as interrupt:
        raise InterruptedSweep(result()) from interrupt
    finally:
        if store is not None:
            store.flush()
    return result()
