"""Block of an FMU."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import (
    Array,
    Block,
    Event,
    FmuError,
    FmuFileError,
    FrozenMapping,
    Sheet,
    State,
    kinds,
    parameter,
)
from ...blocks.tracing import NEXT
from ..archive import (
    ArchiveLimits,
    FmuDescription,
    FmuVariable,
    ModelExchangeInfo,
    find_description,
    join_scalars,
    kept_description,
)
from ..calls import FmuInstance, FmuSetup, ModelExchangeInstance, StepOptions, check_offered, is_smooth
from ..isolation import Isolation
from ..platform import is_built_here
from .fmu_point import FmuLinearization
from .fmu_ports import PortMembers
from .fmu_start_values import check_start, check_value, read_sized
from .linearization import STEP, linear_model, step_difference
from .replacement import check_replacement

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


class Fmu(PortMembers):
    """FMU of FMI 1.0, 2.0 or 3.0 as a block, by co-simulation or model exchange; its inputs and outputs are ports.

    Outputs are attributes (``plant.position``). A port whose name is no identifier is read by index
    (``plant["axis.phi"]``), or gets another name by ``rename``. In co-simulation inputs are held between communication
    points, and outputs are those at the end of the last step. Wire each input, or give it a value in ``start``.

    Scalars ``s[1]``, ``s[2]``, as FMI 2.0 writes an array, are one port ``s``, if they are complete from 0 or 1 and
    alike; ``plant["s[1]"]`` reads one of them, ``start`` takes both names, and scalars that ``rename`` or ``ports``
    name are their own ports.

    A wire carries numbers: integers and enumerations as such, a Boolean as 0 or 1. An input of one of these types
    refuses other numbers in a run. Texts, binaries and clocks are no ports (`left_out`); ``start`` takes texts.

    The file is checked when the block is made, and loaded only for a run. The SHA-256 digest of its content belongs to
    the block: blocks are equal only if the contents were equal, and a file that has changed since is an error.

    Attributes
    ----------
    description : FmuDescription
        Variables, capabilities and default experiment, as the file declares them.
    left_out : mapping of str
        Reason for each input and output that is no port.
    used_interface : str
        Interface of its runs: "co_simulation" or "model_exchange".
    can_save, can_serialize : bool
        Whether its state can be saved and restored, and be written to a file.
    variable_step, fixed_internal_step : bool, float or None
        Whether its communication steps may differ, and its fixed internal step in s.

    Methods
    -------
    linear_model(...)
        Return its linear model at a point.
    """

    opaque = True
    file: str | os.PathLike[str] = parameter(
        kw_only=False,
        description="path of the .fmu",
        kind=kinds.one_of_class((str, os.PathLike), "the path of an .fmu file").worded(step="Give one."),
    )
    start: Mapping[str, Any] = parameter(
        default={}, description="start values of parameters, states and inputs, by the FMU's names, in its units"
    )
    rename: Mapping[str, str] = parameter(
        default={},
        description="FMU's name → name of the port",
        kind=kinds.mapping.where(lambda rename: all(isinstance(new, str) for new in rename.values())).worded(
            "two names each", "Give them as {name: port}."
        ),
    )
    isolate: bool | Isolation | None = parameter(
        default=None,
        description="its own process: True, its limits, False; None for all but own builds",
        kind=kinds.one_of_class((bool, Isolation), "True, False, None or an Isolation").worded(step="Give one."),
    )
    ports: Sequence[str] | None = parameter(
        default=None,
        description="FMU's names of the variables that are ports: inputs, outputs, local variables, tunable "
        "parameters as inputs; None for all inputs and outputs",
        kind=kinds.names.where(lambda ports: not isinstance(ports, str)).worded(
            "a list of names of variables", "Give one."
        ),
    )
    convert_units: bool = parameter(
        default=False, description="convert wires to and from other units of a port's dimension, else refused"
    )
    stepping: StepOptions = parameter(
        default=StepOptions(),
        description="options of its co-simulation: Event Mode, retries, tolerance and more",
        kind=kinds.one_of_class(StepOptions, "a StepOptions").worded(step="Give one: StepOptions(event_mode=True)."),
    )
    interface: str | None = parameter(
        default=None,
        description="'co_simulation' or 'model_exchange'; None for co-simulation where it is offered",
        kind=kinds.choice(*INTERFACES).worded(
            f"{' or '.join(map(repr, INTERFACES))}, or None for co-simulation where the FMU offers it", "Give one."
        ),
    )
    dependencies: str = parameter(
        default="declared",
        description="of outputs and derivatives in model exchange: 'declared' by its model structure, or 'all', by "
        "which everything may depend on everything",
        kind=kinds.choice(*DEPENDENCIES),
    )
    limits: ArchiveLimits | None = parameter(
        default=None,
        description="limits of the file; None for the usual ones",
        kind=kinds.one_of_class(ArchiveLimits, "ArchiveLimits(…)").worded(step="Give one."),
    )

    def check(self) -> None:
        """Check the file, the names of ``ports`` and ``rename``, and names, shapes and values of ``start``."""
        who = self.label
        description, sizes = read_sized(self.file, self.start, self.limits, who)
        object.__setattr__(self, "_content", description.digest)
        object.__setattr__(self, "_sizes", sizes)
        description = join_scalars(description, self.rename, who)
        choose_interface(description, self.interface, who)
        check_offered(self.stepping, description, who)
        ports, others = self._choose_ports(description), description.other_ports("output")
        if others and not ports.outputs:
            raise FmuFileError(
                f"found only outputs that no wire carries: {', '.join(map(str, others))}; expected a number among "
                "them. Add one in its tool, or choose a local variable by ports=.",
                block=who,
            )
        object.__setattr__(self, "start", FrozenMapping(check_start(description, self.start, who)))

    def check_place(self, old: Block, wired: Collection[str], read: Collection[str]) -> None:
        """Check that it fits the wires of the block that it replaces.

        Raises
        ------
        WiringError
            Or one of its kinds; the text says port by port what is missing, extra, or of another shape, unit or type.
        """
        check_replacement(self, old, wired, read)

    def entries_of(self, parameter: str) -> Collection[str]:
        """Return the FMU's names for `start` and `rename`: its variables, and the elements of its arrays."""
        about = self.description
        return [*about.variables, *about.elements, *about.spelled] if parameter in ("start", "rename") else ()

    def start_value(self, description: FmuDescription, name: str, value: Any) -> Any:
        """Return a start value in the variable's shape, after checking it.

        Raises
        ------
        UnknownNameError, ParameterError
            For an unknown variable, one that can't be set, another shape or type, and a value out of its range.
        """
        return check_value(description, name, value, self.label)

    @property
    def converts_units(self) -> bool | None:  # type: ignore[override]
        """Whether wires in other units of its ports' dimensions are converted."""
        return self.convert_units

    def __repr__(self) -> str:
        text = super().__repr__()
        about = self._kept_description()
        if about is None:
            return text
        shown = [str(v) for v in about.other.values()]
        used = interface_text(about, choose_interface(about, self.interface, self.label))
        text += f", {used}" if used else ""
        more = f" and {len(shown) - 5} more" if len(shown) > 5 else ""
        return f"{text} without ports for {', '.join(shown[:5])}{more}" if shown else text

    def _sheet(self) -> Sheet:
        about = self._kept_description()
        head = f"FMU {Path(self.file).name!r}" + (f", block {self.name!r}" if self.name else "")
        if about is None:
            return Sheet(head, (("start", dict(self.start)),), (), ("Its description is not in memory: .description.",))
        ports = self._choose_ports(about)
        by_steps = choose_interface(about, self.interface, self.label) == INTERFACES[0]
        facts = (("runs by", "co-simulation" if by_steps else "model exchange"),)
        return about.as_sheet(head, ports.inputs, ports.outputs, self.start, facts)

    def _kept_description(self) -> FmuDescription | None:
        """Return the description where it is in memory, without a look at the file."""
        found = kept_description(str(self._content), self.__dict__["_sizes"])
        return None if found is None else join_scalars(found, self.rename, self.label)

    @property
    def description(self) -> FmuDescription:
        """The FMU's description.

        Raises
        ------
        FmuFileError
            If the file is missing, or has changed since the block was made.
        """
        try:
            found = find_description(self.file, self.__dict__["_sizes"], self.limits)
        except FmuError as error:
            error.at(block=self.label)
            raise
        if found.digest != self._content:
            raise FmuFileError(
                f"the file {str(self.file)!r} has changed since this block was made: found SHA-256 "
                f"{found.digest[:12]}…, expected {str(self._content)[:12]}…. Make the block again from the new file, "
                "with Fmu(…) or .replace(), and build the diagram with it.",
                block=self.label,
                port="file",
            )
        return join_scalars(found, self.rename, self.label)

    @property
    def variable_step(self) -> bool:
        """Whether communication steps may differ in length (canHandleVariableCommunicationStepSize)."""
        return self.description.variable_step

    @property
    def fixed_internal_step(self) -> float | None:
        """Fixed step of the FMU's own integrator in s (fixedInternalStepSize); None if there is none.

        Communication steps must be multiples of it.
        """
        return self.description.fixed_internal_step

    @property
    def can_save(self) -> bool:
        """Whether the state of a run can be saved and restored (canGetAndSetFMUState)."""
        exchange = self.description.exchange if self.in_model_exchange else None
        return self.description.can_save if exchange is None else exchange.can_save

    @property
    def can_serialize(self) -> bool:
        """Whether a saved state can go to another process (canSerializeFMUState)."""
        exchange = self.description.exchange if self.in_model_exchange else None
        return self.description.can_serialize if exchange is None else exchange.can_serialize

    @property
    def label(self) -> str:
        """Name for messages: the name given, else ``fmu``."""
        return self.name or self._hint or "fmu"

    @property
    def drawn_as(self) -> str:
        """Kind of the block as a drawing names it: its file."""
        return f"FMU {Path(self.file).name}"

    def linear_model(
        self,
        t: float = 0.0,
        *,
        state: Any = None,
        inputs: Any = None,
        interface: str | None = None,
        exact: bool | None = None,
    ) -> FmuLinearization:
        """Linearize the FMU's continuous equations about an operating point.

        The method is the first of these that the FMU supports: directional derivatives in model exchange
        (Continuous-Time Mode), in co-simulation (Step Mode); differences in model exchange, in co-simulation
        (Initialization Mode). The clauses are FMI 2.0, 2.1.9, 3.2.3, 4.2.4, and FMI 3.0, 2.2.11, 2.3.3, 3.2, 4.2. It
        loads its own instance. Discrete states and parameters are constant. Directional derivatives of an FMU
        of others are held against differences, used instead if some are plainly wrong (``derivation.refuted``).

        Parameters
        ----------
        t : float
            Time in s.
        state : mapping or array, optional
            States by the FMU's names, discrete ones too, or all continuous states' elements in the order of the model
            structure; other states have their start values.
        inputs : mapping or array, optional
            Inputs by their ports, or all inputs' elements; other inputs have their start values.
        interface : str, optional
            ``"model_exchange"`` or ``"co_simulation"`` to allow this interface only.
        exact : bool, optional
            True to allow directional derivatives only, False differences only.

        Returns
        -------
        FmuLinearization
            The matrices, and the method by which they were computed.

        Raises
        ------
        FmuError
            If the FMU supports no such method, or does not accept the operating point.
        FmuRuntimeError
            If one of the FMU's functions fails.
        ParameterError, UnknownNameError
            For an operating point with unknown names or wrong values.
        """
        # all inputs are set at every evaluation, so that no slope rests on the dependencies that the FMU declares
        return linear_model(setup_of(self.replace(dependencies=DEPENDENCIES[1])), t, state, inputs, interface, exact)

    def step_difference(
        self, h: float, *, t: float = 0.0, state: Any = None, inputs: Any = None, relative_step: float = STEP
    ) -> FmuLinearization:
        """Linearize a communication step: states and outputs after it, by the states before it and the held inputs.

        The method is differences of ``doStep`` in co-simulation. States are moved by their start values, the only way
        that is allowed there (FMI 2.0, 4.2.4; FMI 3.0, 4.2), inputs between steps, from a saved state if the FMU can
        save one. Impacts and switches within the step count. Memory that is no variable of the FMU starts again with
        each difference, such as that of its solver, or the side of a threshold.

        Parameters
        ----------
        h : float
            Length of the step in s.
        t, state, inputs
            See `linear_model`.
        relative_step : float
            Distance by which a state or input is moved, relative to its nominal value, or to its value if that is
            larger. An adaptive solver with a coarse tolerance needs a larger one.

        Returns
        -------
        FmuLinearization
            The matrices, and an estimate of their errors.

        Raises
        ------
        FmuError
            If the FMU's states have no exact start values, or it does not accept the operating point.
        FmuRuntimeError
            If one of the FMU's functions fails.
        ParameterError, UnknownNameError
            For an operating point with unknown names or wrong values.
        """
        return step_difference(setup_of(self), h, t, state, inputs, relative_step)

    @contextmanager
    def instantiate(
        self, wired: Sequence[str], stop_time: float | None, *, start_time: float = 0.0
    ) -> Iterator[FmuInstance]:
        """Load the FMU for a run; it is terminated and freed at the end, in any case.

        Parameters
        ----------
        wired : sequence of str
            Input ports that the run sets at each communication point.
        stop_time : float, optional
            End of the run in s, beyond which an FMU may refuse to step; None for a run that may be continued.
        start_time : float
            Start of the run in s.
        """
        instance = FmuInstance(setup_of(self), wired)  # it reads the description, and so checks the file
        try:
            instance.initialize(stop_time, start_time=start_time)
            yield instance
        finally:
            instance.close()

    # ---- model exchange ----

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
        instance = ModelExchangeInstance(setup_of(self), wired)
        try:
            instance.initialize(None, start_time=start_time)
            instance.add_note(f"it runs {self.interface_text}: the solver integrates it")
            yield instance
        finally:
            instance.close()


def setup_of(block: Fmu) -> FmuSetup:
    """Return all that an instance of a block's FMU knows of the block; the file is checked here, once."""
    about = block.description
    ports = block._choose_ports(about)
    return FmuSetup(
        label=block.label,
        description=about,
        start=block.start,
        input_variables=ports.inputs,
        output_variables=ports.outputs,
        text_variables=ports.texts,
        stepping=block.stepping,
        isolate=block.isolate,
        model_exchange_info=block.model_exchange_info,
        dependencies=block.dependencies,
    )
