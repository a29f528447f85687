"""An FMU in model exchange as a block: its states, its events, and what depends on what."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ...blocks.core import Array, Event, FmuFileError, State
from ...blocks.tracing import NEXT
from ..archive import FmuDescription, FmuVariable, ModelExchangeInfo
from ..calls import ModelExchangeInstance, StepOptions, is_smooth
from ..platform import is_built_here
from .port_members import PortMembers

INTERFACES = ("co_simulation", "model_exchange")
"""Interfaces of an FMU, as the parameter ``interface`` names them."""
DEPENDENCIES = ("declared", "all")
"""Dependencies in model exchange, as the parameter ``dependencies`` names them."""
UNNAMED = "continuous_states"
"""Name of the state of an FMU whose continuous states are no variables."""


def interface_text(about: FmuDescription, used: str) -> str:
    """Return the text on the interface that a run uses; empty for co-simulation where there is nothing else."""
    if used != INTERFACES[0]:
        return "by model exchange" if about.co_simulation else "by model exchange, its only interface"
    return "by co-simulation" if about.exchange is not None else ""


def choose_interface(description: FmuDescription, asked: str | None, label: str) -> str:
    """Return the interface by which an FMU runs: that asked for, else co-simulation where it offers it."""
    if asked is None:
        return INTERFACES[0] if description.co_simulation else INTERFACES[1]
    there = description.co_simulation if asked == INTERFACES[0] else description.exchange is not None
    if not there:
        other = INTERFACES[asked == INTERFACES[0]]
        raise FmuFileError(
            f"{str(description.file)!r} has no {asked.replace('_', '-')} interface with a library for this platform; "
            f"expected one. Take interface={other!r}, or export it with both.",
            block=label,
            port="interface",
        )
    return asked


class ModelExchangeMembers(PortMembers):
    """Members of an FMU's block that make it one of model exchange."""

    if TYPE_CHECKING:
        interface: str | None
        dependencies: str
        stepping: StepOptions

        @property
        def variable_step(self) -> bool: ...  # noqa: D102

    @property
    def used_interface(self) -> str:
        """Interface by which a run uses it: ``"co_simulation"``, or ``"model_exchange"``: a solver integrates it."""
        return choose_interface(self.description, self.interface, self.label)

    @property
    def stepped(self) -> bool:  # type: ignore[override]
        """Whether a run steps it (co-simulation)."""
        return self.used_interface == INTERFACES[0]

    @property
    def in_model_exchange(self) -> bool:  # type: ignore[override]
        """Whether a run's solver integrates its states (model exchange)."""
        return self.used_interface == INTERFACES[1]

    @property
    def model_exchange_info(self) -> ModelExchangeInfo | None:
        """Model exchange as the description states it, without its dependencies where these are not to count.

        A state that is an output follows itself alone in any case. Other continuous outputs and derivatives may follow
        all states and the time, but in an FMU that Loopwright has built: tools leave these out of the lists, and so do
        some Reference FMUs. No order of evaluation needs them, as states and time are known before it.
        """
        found, about = self.description.exchange, self.description
        if found is None:
            return None
        states = {key for name in about.states for key in about.find(name).keys}
        if self.dependencies != DEPENDENCIES[0]:
            return replace(found, dependencies={key: frozenset([key]) for key in states})
        if is_built_here(about.digest):
            return found
        smooth = {key for v in about.variables.values() if is_smooth(v) for key in v.keys} - states
        always = states | {found.time} if found.time is not None else states
        declared = {
            key: of if of is None or key not in smooth else of | always for key, of in found.dependencies.items()
        }
        return replace(found, dependencies=declared)

    @property
    def interface_text(self) -> str:
        """Text on the interface that a run uses; empty for co-simulation where there is nothing else."""
        return interface_text(self.description, self.used_interface)

    @property
    def states(self) -> Mapping[str, State]:  # type: ignore[override]
        """The continuous states in model exchange; in co-simulation they are the FMU's own."""
        about, exchange = self.description, self.description.exchange
        if not self.in_model_exchange or exchange is None:
            return {}
        if not about.states:
            n = exchange.state_count
            return {UNNAMED: State(shape=(n,), name=UNNAMED, description="states that are no variables")} if n else {}
        return {name: self._state(about.find(name)) for name in about.states}

    def _state(self, v: FmuVariable) -> State:
        start = self.start.get(v.name, v.start)
        value = np.zeros(v.shape) if start is None else np.broadcast_to(np.asarray(start, dtype=float), v.shape)
        return State(v.unit, v.description, shape=v.shape, start=np.array(value), name=v.name)

    @property
    def events(self) -> Mapping[str, Event]:  # type: ignore[override]
        """The events of the indicators in model exchange; a change of domain in both directions fires one."""
        exchange = self.description.exchange
        if not self.in_model_exchange or exchange is None:
            return {}
        return {name: Event(name=name) for name in exchange.indicators}

    def dependence(self, equation: str) -> Mapping[str, Array]:
        """Return which entries of an output, or of the derivatives, depend on which of the states and inputs.

        It is that of model exchange, by the model structure; see `loopwright.Block`. The states are under ``"x"``,
        inputs under their ports. Discrete inputs and parameters act at events alone.
        """
        about, exchange = self.description, self.model_exchange_info
        assert exchange is not None
        n = exchange.state_count
        states = [about.find(name) for name in about.states]
        if equation != NEXT:
            unknown = [self.output_variables[equation]]
        else:
            unknown = [about.find(name) for name in about.states.values()]
        rows = n if equation == NEXT else unknown[0].size

        def follows(known: FmuVariable) -> np.ndarray:
            parts = [exchange.pattern(of, known) for of in unknown]
            return np.vstack(parts) if parts else np.ones((rows, known.size), dtype=bool)

        found = {port: follows(v) for port, v in self.input_variables.items() if is_smooth(v)}
        found["t"] = np.full((rows, 1), not unknown or any(map(exchange.varies, unknown)))
        found["x"] = np.hstack([follows(v) for v in states]) if states else np.ones((rows, n), dtype=bool)
        return found

    @contextmanager
    def exchange(self, wired: Sequence[str], *, start_time: float = 0.0) -> Iterator[ModelExchangeInstance]:
        """Load the FMU for a run in model exchange; it is terminated and freed at the end, in any case.

        Parameters
        ----------
        wired : sequence of str
            Input ports that the run sets.
        start_time : float
            Start of the run in s.
        """
        instance = ModelExchangeInstance(self, wired)
        try:
            instance.initialize(None, start_time=start_time)
            instance.add_note(f"it runs {self.interface_text}: the solver integrates it")
            yield instance
        finally:
            instance.close()
