"""A sweep: samples of parameters, run in parallel, kept on disk, and put together in their order."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ...blocks.core import Kind, OptionError, accepts, kinds, one_thread
from ..flat import FlatDiagram, WiredDiagram
from ..results import RecordedSignals, Run, machine_memory
from ..simulation import ProgressOption, RunOptions, Simulation, progress_bar
from .outcome import SampleOutcome
from .plan import Plan
from .processes import processors, run_in_processes
from .reductions import Reduction, check_reductions
from .result import Sweep
from .revision import key_of, parts_of
from .samples import Sample, read_samples
from .store import Store
from .threads import run_in_threads
from .variation import is_number
from .workers import make_worker

_ASKED = 4
"""Samples asked whether their runs are compiled: one with a value that is refused does not decide for the others."""
_LANES = 8
_MANY_LANES = (2, 4, 8, 16)
_REFUSED = {
    "to": "of a sweep, to= is the folder of its results",
    "overwrite": "of a sweep, overwrite= belongs to its folder",
}


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
    f"True for {_LANES} runs side by side, {', '.join(map(str, _MANY_LANES))}, or False for one after the other",
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
    RunOptions.of({option: value for option, value in options.items() if option not in _REFUSED}, block=name)
    found = read_samples(diagram, parameters, samples, count=count, seed=seed)
    plan = make_plan(diagram, duration, signals, reduce, seeds, options, count=len(found), lanes=lanes)
    _check_names(plan, found.names)
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
        run = _run(plan, left, processors() if workers is None else int(workers), client)
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


def make_plan(
    diagram: WiredDiagram,
    duration: float,
    signals: str | Iterable[str],
    reduce: Mapping[str, Callable[[Run], Any]] | None,
    seeds: str | Iterable[str],
    options: Mapping[str, Any],
    *,
    count: int = 1,
    lanes: bool | int = False,
) -> Plan:
    """Return a sweep as a value, with its names and options checked."""
    name = diagram.name
    for option, reason in _REFUSED.items():
        if option in options:
            raise OptionError(f"found it as an option of a run; {reason}.", block=name, port=option)
    chosen = (signals,) if isinstance(signals, str) else tuple(signals)
    reductions = {} if reduce is None else check_reductions(reduce, name)
    if not chosen and not reductions:
        raise OptionError(
            "a sweep keeps what it is asked for, and nothing was asked for. Give signals=['y'], whose samples are "
            "kept, or reduce={'end': final('y')}, numbers of each run.",
            block=name,
        )
    paths = [diagram.find_parameter(path) for path in ((seeds,) if isinstance(seeds, str) else seeds)]
    if isinstance(record := options.get("record"), Iterable) and not isinstance(record, str):
        options = {**options, "record": tuple(record)}  # for each of the runs
    compiled = all(is_number(diagram, path) for path in paths)  # else each sample would be compiled again
    side_by_side = (_LANES if lanes else 1) if isinstance(lanes, bool) else int(lanes)
    plan = Plan(diagram, duration, {"compile": compiled, **options}, chosen, reductions, tuple(paths), side_by_side)
    flat = Simulation(diagram, plan.run_options, duration=duration).flat  # it checks the options
    signals_of_runs = RecordedSignals.of(flat)
    needed = [*chosen, *(f.signal for f in reductions.values() if isinstance(f, Reduction))]
    _check_recorded(plan, signals_of_runs, [signals_of_runs.resolve(signal) for signal in needed])
    if clash := sorted(set(chosen) & set(reductions)):
        raise OptionError(
            f"found {clash[0]!r} among signals and reductions; give the reduction another name.", block=name
        )
    width = sum(signals_of_runs.entries(signals_of_runs.resolve(name)).size for name in chosen)
    _check_room(plan, flat, count, width)
    return plan


def _check_recorded(plan: Plan, signals: RecordedSignals, needed: Iterable[str]) -> None:
    """Refuse a ``record`` that lacks signals that are kept, or reduced."""
    if plan.options.get("record") is None:
        return
    recorded = signals.choose(plan.run_options.record, states=False)
    if missing := list(dict.fromkeys(name for name in needed if name not in recorded)):
        raise OptionError(
            f"found a choice without {', '.join(map(repr, missing))}, which signals= or reduce= need; expected all "
            "that the sweep keeps. Add them, or leave record= out: each run then records what is kept alone.",
            block=plan.diagram.name,
            port="record",
        )


def _run(plan: Plan, samples: Sequence[Sample], workers: int, client: Any) -> Generator[SampleOutcome, None, None]:
    """Yield the outcomes of samples where they are run best: here, in threads, in processes or on a cluster."""
    if not samples:
        return
    if client is not None:
        from .cluster import run_on_cluster

        yield from run_on_cluster(plan, samples, client)
        return
    with make_worker(plan) as worker:
        if workers == 1:
            for k in range(0, len(samples), worker.width):
                yield from worker.run_all(samples[k : k + worker.width])
            return
        if any(worker.can_compile(sample) for sample in samples[:_ASKED]):
            with closing(run_in_threads(plan, samples, min(workers, len(samples)), worker)) as stream:
                yield from stream
            return
    with closing(run_in_processes(plan, samples, min(workers, len(samples)))) as stream:
        yield from stream


_TAKEN = ("failed", "failure", "end_time", "sample", "step", "t")
"""Names that the data set of a sweep has for itself."""


def _check_names(plan: Plan, swept: Sequence[str]) -> None:
    """Refuse a seed for a parameter that has values, and reductions whose names the data set needs."""
    if twice := [path for path in plan.seeds if path in swept]:
        raise OptionError(
            f"found {twice[0]!r} among the parameters and in seeds; it would take the seed, and not its values. Give "
            "it in one of them.",
            block=plan.diagram.name,
            port="seeds",
        )
    if taken := [name for name in plan.reductions if name in swept or name in _TAKEN]:
        raise OptionError(
            f"found a reduction called {taken[0]!r}; the results have something else by that name. Give it another "
            "name.",
            block=plan.diagram.name,
            port="reduce",
        )


def _check_room(plan: Plan, flat: FlatDiagram, count: int, width: int) -> None:
    """Refuse a sweep whose samples, of ``width`` numbers at each instant, can't fit into memory."""
    rows = int(plan.duration / float(flat.base)) // int(plan.run_options.every) + 2
    needed, there = 2 * 8 * (width + 1) * rows * count, machine_memory()
    if plan.signals and needed > 0.8 * there:
        raise OptionError(
            f"found {count} samples of {rows} instants with {width} numbers each; they need {needed / 2**30:.0f} GiB, "
            f"and this machine has {there / 2**30:.0f}. Keep reductions, such as reduce={{'end': final('y')}}, fewer "
            "signals, or one of so many instants: every=10.",
            block=plan.diagram.name,
            port="signals",
        )
