"""Facts of a diagram that a solver is set up with, and what the continuous part of a run keeps from step to step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...blocks.core import Block, SimulationError, identity, is_before
from ..events import Domains, Sliding
from ..flat import Announcer, FlatDiagram, Times, announcers
from ..solvers import Solver
from .transport_delays import Delays
from .workspace import Workspace


def time_scale_of(flat: FlatDiagram) -> float:
    """Return the shortest time within which a source in a continuous subsystem changes."""
    table = flat.table
    paths = (p for p in flat.checked.traced if not table.is_sampled(table.subsystem_of[p]))
    return min((float(table.blocks[p].time_scale()) for p in paths), default=math.inf)


def remembers(flat: FlatDiagram) -> bool:
    """Whether a block in a continuous subsystem has a memory, such as a projection's last foot point."""
    table = flat.table
    return any(table.blocks[p].memory and not table.is_sampled(table.subsystem_of[p]) for p in flat.checked.traced)


def has_guards(flat: FlatDiagram) -> bool:
    """Whether a block in a continuous subsystem has guards, which are looked at after every step."""
    table, traced = flat.table, flat.checked.traced
    return any(traced[p].guards and not table.is_sampled(table.subsystem_of[p]) for p in traced)


def absolute_tolerances(flat: FlatDiagram, atol: float, nominals: np.ndarray | None = None) -> Any:
    """Return the absolute tolerance of each continuous state: ``atol`` times its nominal value.

    Parameters
    ----------
    nominals : ndarray, optional
        Nominal values of the entries of x whose blocks declare none.
    """
    scale = np.ones(flat.width) if nominals is None else nominals.copy()
    for path, own in flat.states.of_block.items():
        for name, where in own.slices.items():
            nominal = flat.table.blocks[path].states[name].nominal
            if nominal is not None:
                scale[where] = nominal
    scale = scale[flat.continuous]
    return atol if np.all(scale == 1.0) or np.ndim(atol) else atol * scale


def longest_step(flat: FlatDiagram, max_step: float | None, time_scale: float, shortest_delay: float) -> float | None:
    """Return the longest step of a solver in s: that asked for, or what memories, sources and delays allow."""
    longest = max_step
    if longest is None and remembers(flat):
        longest = float(flat.base)  # memory is renewed at accepted steps, and must not grow stale
    if longest is None and time_scale < math.inf:
        longest = 5.0 * time_scale  # else a step may fit whole periods of a source
    if shortest_delay < math.inf:
        longest = min(longest or math.inf, shortest_delay)
    return longest


def find_late(sources: Sequence[tuple[str, Announcer]]) -> dict[float, float]:
    """Return the instants in s at which sources are seen at a time just after, and that time."""
    return {t: after for _, one in sources if isinstance(one, Times) for t, after in one.late.items()}


class NextInstants:
    """The next instant of all sources, which are asked again where it is reached, or where time has gone back."""

    def __init__(self, sources: Sequence[tuple[str, Announcer]]):
        self._sources = sources
        self._asked, self._next = math.inf, -math.inf

    def after(self, t: float) -> float:
        """Return the first instant after t, in s; infinity if there is none."""
        if not (self._asked <= t and is_before(t, self._next)):
            self._next = min((next_instant(path, source, t) for path, source in self._sources), default=math.inf)
            self._asked = t
        return self._next


def next_instant(path: str, block: Announcer, t: float) -> float:
    """Return the next instant of a block; one that does not come after t would keep the run where it is."""
    try:
        found = block.next_instant(t)
        later = found > t
    except Exception as error:
        raise SimulationError(
            f"its next_instant({t!r}) failed: {type(error).__name__}: {error}. Expected a time after that, or math.inf "
            "if there is none.",
            block=path,
            t=t,
        ) from error
    if not later:
        raise SimulationError(
            f"its next_instant({t!r}) is {found!r}; expected a time after that, or math.inf if there is none.",
            block=path,
            t=t,
        )
    return found


def _scales(block: Block) -> object:
    return block.time_scale(), [identity(port.nominal) for port in block.states.values()]


class Memory:
    """Part of the continuous part of a run: what it keeps from step to step is saved, restored and forgotten."""

    flat: FlatDiagram
    domains: Domains | None
    """Domains of the indicators; None without events."""
    delays: Delays | None
    """Transport delays; None without any."""
    solver: Solver
    sliding: Sliding
    sources: Sequence[tuple[str, Announcer]]
    late: Mapping[float, float]
    _announced: NextInstants
    _looked: float
    _edge: float
    _left: float
    _sources_edge: float
    _beyond: tuple[float, np.ndarray] | None
    _fresh: Mapping[str, Any]
    """What it keeps before its first run."""

    _told = 0
    """Messages of the solver that were told."""

    def tell_changes(self, workspace: Workspace) -> None:
        """Take the solver's new messages, such as changes of its method, among those of the run."""
        messages = self.solver.statistics.messages
        if len(messages) > self._told:
            workspace.messages += tuple(messages[self._told :])
            self._told = len(messages)

    def save(self) -> dict[str, Any]:
        """Return what is needed to go on from here."""
        return {
            "domains": None if self.domains is None else self.domains.save(),
            "delays": None if self.delays is None else self.delays.save(),
            "solver": self.solver.save(),
            "sliding": self.sliding.save(),
        }

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Go back to what `save` returned."""
        if self.domains is not None and saved["domains"] is not None:
            self.domains.restore(saved["domains"])
        if self.delays is not None and saved["delays"] is not None:
            self.delays.restore(saved["delays"])
        self.solver.restore(saved["solver"])
        self.sliding.restore(saved["sliding"])

    def fits(self, old: Mapping[str, Block], new: Mapping[str, Block]) -> bool:
        """Whether it fits variants of some blocks: no tolerance and no limit of a step changes with them.

        Parameters
        ----------
        old, new : mapping of str to Block
            By path: the blocks that it was set up with, and those that differ.
        """
        return self.delays is None and all(_scales(block) == _scales(old[path]) for path, block in new.items())

    def begin_anew(self, flat: FlatDiagram) -> None:
        """Forget the run before: another one begins, with other numbers of the diagram."""
        self.flat, self.sources = flat, announcers(flat)
        self._announced, self.late = NextInstants(self.sources), find_late(self.sources)
        self._edge, self._left, self._sources_edge = math.inf, math.inf, math.inf
        self._beyond, self._looked = None, math.nan
        self.restore(self._fresh)
        self.sliding.forget()
