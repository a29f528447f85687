"""An FMU as a block."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core.block import Block
from ...blocks.core.errors import FmuError, FmuFileError, ParameterError, UnknownNameError, near
from ...blocks.core.frozen import FrozenMapping
from ...blocks.core.ports import Input, Output
from ...blocks.core.signals import Signal, UnknownAttributeError
from ...blocks.core.values import parameter
from ..archive.description import FmuDescription, FmuVariable, read_description
from ..calls.instance import FmuInstance
from .linearization import STEP, FmuLinearization, linear_model, step_difference

_STATUS = ("OK", "warning", "discard", "error", "fatal")


class Fmu(Block):
    """A co-simulation FMU (FMI 3.0, Float64 variables) as a block; its ports are the FMU's inputs and outputs.

    Outputs are attributes (``plant.position``); ports whose names are no identifiers are reached by index
    (``plant["axis.phi"]``) or get another name by ``rename``. Between communication points its inputs are held and its
    outputs are those at the end of the last step. Inputs must be wired, or be given a value in ``start``.

    The file is checked when the block is made, and loaded only while a run lasts. The SHA-256 digest of what it held
    then belongs to the block: two blocks are equal only if the files' contents were, and a file that has changed since
    is an error.
    """

    opaque = True
    stepped = True
    file: str | os.PathLike[str] = parameter(kw_only=False, description="path of the .fmu")
    start: Mapping[str, Any] = parameter(
        default={}, description="start values of parameters, states and inputs, by the FMU's names"
    )
    rename: Mapping[str, str] = parameter(default={}, description="FMU's name → name of the port")

    def check(self) -> None:
        """Check the file, and names, shapes and values of ``start`` and ``rename``."""
        who = self.label
        if not isinstance(self.file, str | os.PathLike):
            raise ParameterError(f"found {self.file!r}; expected the path of an .fmu file.", block=who, port="file")
        try:
            description = read_description(self.file)
        except FmuError as error:
            error.at(block=who)
            raise
        ports = {**description.of("input"), **description.of("output")}
        for old in self.rename:
            if old not in ports:
                raise UnknownNameError(
                    f"it has no port {old!r} to rename. {near(old, ports)}", block=who, port="rename"
                )
        start = {k: self.start_value(description, k, v) for k, v in self.start.items()}
        object.__setattr__(self, "start", FrozenMapping(start))
        object.__setattr__(self, "_content", description.digest)
        new = [self.rename.get(name, name) for name in ports]
        if len(set(new)) < len(new):
            raise ParameterError("two ports get the same name; rename them apart.", block=who, port="rename")

    def start_value(self, description: FmuDescription, name: str, value: Any) -> Any:
        """Return a start value in the variable's shape, after checking it.

        Raises
        ------
        UnknownNameError, ParameterError
            No such variable, one that can't be set, another shape, a value out of its range.
        """
        who, port = self.label, f"start.{name}"
        if name in description.other:
            raise ParameterError(
                f"it is {description.other[name]}; only Float64 can be set so far.", block=who, port=port
            )
        variable = description.variables.get(name)
        if variable is None:
            raise UnknownNameError(
                f"the FMU has no variable {name!r}. {near(name, description.variables)}", block=who, port="start"
            )
        if variable.causality in ("output", "local") and variable.start is None:
            raise ParameterError(
                "it is computed and has no start value; set the states and parameters that it follows from.",
                block=who,
                port=port,
            )
        try:
            array = np.array(np.broadcast_to(np.asarray(value, dtype=float), variable.shape))
        except (TypeError, ValueError):
            raise ParameterError(
                f"found {value!r}; expected numbers of shape {variable.shape}.", block=who, port=port
            ) from None
        if not np.all(np.isfinite(array)):
            raise ParameterError(f"found {value!r}; expected finite numbers{_in(variable)}.", block=who, port=port)
        for bound, wrong in ((variable.minimum, np.less), (variable.maximum, np.greater)):
            if bound is not None and np.any(wrong(array, bound)):
                raise ParameterError(f"found {value!r}; the FMU allows {_range(variable)}.", block=who, port=port)
        return array

    @property
    def description(self) -> FmuDescription:
        """What the FMU's description says.

        Raises
        ------
        FmuFileError
            If the file is gone, or is no longer the one that the block was made with.
        """
        try:
            found = read_description(self.file)
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
        return found

    @property
    def variable_step(self) -> bool:
        """Whether its communication steps may differ in length (canHandleVariableCommunicationStepSize)."""
        return self.description.variable_step

    @property
    def fixed_internal_step(self) -> float | None:
        """The step in s that it computes with inside, None where that is its own matter (fixedInternalStepSize).

        Communication steps are then to be multiples of it.
        """
        return self.description.fixed_internal_step

    @property
    def can_save(self) -> bool:
        """Whether the state of a run can be saved and restored (canGetAndSetFMUState)."""
        return self.description.can_save

    @property
    def can_serialize(self) -> bool:
        """Whether a saved state can go to another process (canSerializeFMUState)."""
        return self.description.can_serialize

    @property
    def label(self) -> str:
        """Name for messages: the given one, else ``fmu``."""
        return self.name or self._hint or "fmu"

    @property
    def drawn_as(self) -> str:
        """Kind of the block as a drawing names it: its file."""
        return f"FMU {Path(self.file).name}"

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """The FMU's inputs."""
        return {
            self.rename.get(n, n): Input(
                v.shape, v.unit, v.description, default=self.start.get(n), name=self.rename.get(n, n)
            )
            for n, v in self.description.of("input").items()
        }

    @property
    def outputs(self) -> Mapping[str, Output]:  # type: ignore[override]
        """The FMU's outputs."""
        return {
            self.rename.get(n, n): Output(v.shape, v.unit, v.description, name=self.rename.get(n, n))
            for n, v in self.description.of("output").items()
        }

    def __getattr__(self, name: str) -> Signal:
        if name.startswith("_") or "file" not in self.__dict__:
            raise AttributeError(name)
        outputs = self.outputs
        if name in outputs:
            return Signal(self, name)
        raise UnknownAttributeError(f"it has no output {name!r}. {near(name, outputs)}", block=self.label)

    def __getitem__(self, name: Any) -> Signal:
        if isinstance(name, str):
            if name in self.outputs:
                return Signal(self, name)
            raise UnknownNameError(f"it has no output {name!r}. {near(name, self.outputs)}", block=self.label)
        return super().__getitem__(name)

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

        They are found by the first of these that the FMU has: directional derivatives in model exchange
        (Continuous-Time Mode), in co-simulation (Step Mode); differences in model exchange, in co-simulation
        (Initialization Mode; FMI 3.0, 2.2.11, 2.3.3, 3.2, 4.2). An instance is loaded for it alone. Discrete states and
        parameters are frozen.

        Parameters
        ----------
        t : float
            Time in s.
        state : mapping or array, optional
            States by the FMU's names, discrete ones too, or all continuous states' elements in the order of the model
            structure; the others have their start values.
        inputs : mapping or array, optional
            Inputs by their ports, or all inputs' elements; the others have their start values.
        interface : str, optional
            ``"model_exchange"`` or ``"co_simulation"``, where it matters.
        exact : bool, optional
            True for directional derivatives alone, False for differences.

        Returns
        -------
        FmuLinearization
            The matrices, and how they were found.

        Raises
        ------
        FmuError
            If the FMU can't, or does not take over the operating point.
        FmuRuntimeError
            If one of its functions fails.
        ParameterError, UnknownNameError
            If the operating point is given wrongly.
        """
        return linear_model(self, t, state, inputs, interface, exact)

    def step_difference(
        self, h: float, *, t: float = 0.0, state: Any = None, inputs: Any = None, relative_step: float = STEP
    ) -> FmuLinearization:
        """Linearize a communication step: states and outputs after it, by the states before it and the held inputs.

        Differences of ``doStep`` in co-simulation: states move by their start values, since nothing else is allowed
        there (FMI 3.0, 4.2), inputs in Step Mode, from a saved state where the FMU can save. Impacts and switches
        within the step are in it. What is no variable of the FMU starts anew: memory of its solver, on which side of a
        threshold it has been.

        Parameters
        ----------
        h : float
            Length of the step in s.
        t, state, inputs
            As for `linear_model`.
        relative_step : float
            How far a state or input is moved, relative to its nominal value, or its value where that is larger. An
            adaptive solver with a coarse tolerance needs more.

        Returns
        -------
        FmuLinearization
            The matrices, and an estimate of their errors.

        Raises
        ------
        FmuError
            If the FMU's states have no exact start values, or it does not take over the operating point.
        FmuRuntimeError
            If one of its functions fails.
        ParameterError, UnknownNameError
            If the operating point is given wrongly.
        """
        return step_difference(self, h, t, state, inputs, relative_step)

    @contextmanager
    def instantiate(
        self, wired: Sequence[str], stop_time: float | None, *, start_time: float = 0.0
    ) -> Iterator[FmuInstance]:
        """Load the FMU for a run; it is terminated and freed whatever happens.

        Parameters
        ----------
        wired : sequence of str
            The input ports that the run will set at each communication point.
        stop_time : float, optional
            End of the run in s; None for a run that may be continued, as an FMU may refuse to step beyond it.
        start_time : float
            Start of the run in s.
        """
        instance = FmuInstance(self, wired)  # it reads the description, and so checks the file
        try:
            instance.initialize(stop_time, start_time=start_time)
            yield instance
        finally:
            instance.close()


def _in(variable: FmuVariable) -> str:
    return f" in {variable.unit}" if variable.unit else ""


def _range(variable: FmuVariable) -> str:
    low, high = variable.minimum, variable.maximum
    if low is not None and high is not None:
        return f"{low:g} to {high:g}{_in(variable)}"
    return f"at least {low:g}{_in(variable)}" if low is not None else f"at most {high:g}{_in(variable)}"
