"""A sweep without its samples, as a value that can be sent to workers: its runs, and what is kept of each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ...blocks.core import OptionError
from ...fmus import Fmu
from ...fmus.fmu_block import setup_of
from ...fmus.platform import is_built_here
from ..flat import FlatDiagram, WiredDiagram
from ..results import RecordedSignals, Run, machine_memory
from ..simulation import RunOptions, Simulation
from .reductions import Reduction, check_reductions
from .samples import Sample, seed_of
from .variation import is_number

LANES = 8
"""Runs that go side by side where ``lanes=True``."""
REFUSED = {
    "to": "of a sweep, to= is the folder of its results",
    "overwrite": "of a sweep, overwrite= belongs to its folder",
}
"""Options of a run that a sweep has itself, with what to write."""
_VARIABLES = ("failed", "failure", "end_time", "t")
"""Variables that the data set of a sweep has for itself."""
_TAKEN = (*_VARIABLES, "sample", "step")
"""These, and names of its dimensions, which a signal's path may have, `step.y`."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A sweep without its samples."""

    diagram: WiredDiagram
    duration: float  # simulated time of each run in s
    options: Mapping[str, Any]
    signals: tuple[str, ...] = ()  # whose samples are kept
    reductions: Mapping[str, Callable[[Run], Any]] = field(default_factory=dict)
    seeds: tuple[str, ...] = ()  # full paths of the parameters that take a sample's seed
    lanes: int = 1  # runs that go side by side in the vector lanes of a processor; 1: one after the other

    @property
    def run_options(self) -> RunOptions:
        """Options of each run: what is recorded is what is asked for."""
        record: list[str] | None = [*self.signals]
        for function in self.reductions.values():
            if isinstance(function, Reduction):
                record = None if record is None else [*record, function.signal]
            else:
                record = None  # a user's function may ask for any signal
        given = {"states": False, "record": record, **self.options}
        return RunOptions.of(given, block=self.diagram.name)

    def parameters_of(self, sample: Sample) -> dict[str, Any]:
        """Return all parameters of a sample, seeds included."""
        seeds = {path: seed_of(sample.seed, k) % 2**53 for k, path in enumerate(self.seeds)}
        return {**sample.parameters, **seeds}

    @property
    def obstacle(self) -> str:
        """Why its runs can't follow each other in a thread, as a clause; empty if nothing of the plan forbids it."""
        if self.options.get("start") is not None:
            return "they continue from a state, start="
        for path, plant in self._plants.items():
            if setup_of(plant).process_limits is not None or not is_built_here(plant.description.digest):
                return f"{path} was not built by Loopwright on this machine, or runs in its own process"
        return ""

    @property
    def is_alone(self) -> bool:
        """Whether a process can run one sample at a time: an FMU of another tool is loaded in it."""
        return not all(
            setup_of(p).process_limits is not None or is_built_here(p.description.digest) for p in self._plants.values()
        )

    @property
    def _plants(self) -> dict[str, Fmu]:
        return {path: block for path, block in self.diagram.scheduled.blocks.items() if isinstance(block, Fmu)}


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
    for option, reason in REFUSED.items():
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
    side_by_side = (LANES if lanes else 1) if isinstance(lanes, bool) else int(lanes)
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


def check_names(plan: Plan, swept: Sequence[str]) -> None:
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
    if taken := [name for name in plan.signals if name in _VARIABLES]:
        raise OptionError(
            f"found a signal called {taken[0]!r}; the results have something else by that name. Give it by the path of "
            "its port.",
            block=plan.diagram.name,
            port="signals",
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
