"""Ports of an FMU's block: which of the FMU's variables they are, and how they are wired by name."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import (
    Block,
    Call,
    Input,
    Output,
    Signal,
    UnitError,
    UnknownAttributeError,
    UnknownNameError,
    convert_unit,
    describe_mismatch,
    near,
    same_dimension,
    same_unit,
)
from ..archive import FmuDescription, FmuVariable, OtherVariable
from .fmu_ports import FmuPorts, choose_ports, find_element, other_name


class PortMembers(Block):
    """Members of an FMU's block that are its ports, or read them."""

    if TYPE_CHECKING:
        file: str | os.PathLike[str]
        start: Mapping[str, Any]
        rename: Mapping[str, str]
        ports: Sequence[str] | None
        convert_units: bool

        @property
        def description(self) -> FmuDescription: ...  # noqa: D102

    def _choose_ports(self, description: FmuDescription) -> FmuPorts:
        chosen = None if self.ports is None else tuple(self.ports)
        return choose_ports(description, tuple(self.rename.items()), chosen, self.label)

    @property
    def input_variables(self) -> Mapping[str, FmuVariable]:
        """The FMU's variables that are input ports, by the ports' names."""
        return self._choose_ports(self.description).inputs

    @property
    def output_variables(self) -> Mapping[str, FmuVariable]:
        """The FMU's variables that are output ports, by the ports' names."""
        return self._choose_ports(self.description).outputs

    @property
    def text_variables(self) -> Mapping[str, OtherVariable]:
        """The FMU's texts and binary data that are recorded in a run (``run.texts``), by their ports."""
        return self._choose_ports(self.description).texts

    @property
    def left_out(self) -> Mapping[str, str]:
        """Types of the variables that no wire carries, by name: texts, binaries, clocks, negated aliases."""
        return {name: v.type for name, v in self.description.other.items()}

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """The FMU's inputs, and the parameters among ``ports``."""
        about = self.description
        return {
            port: Input(v.shape, v.unit, v.description, default=self._default(v, about), name=port)
            for port, v in self._choose_ports(about).inputs.items()
        }

    def _default(self, v: FmuVariable, about: FmuDescription) -> Any:
        """Return the value of an input that is not wired; None where one must be."""
        if v.name in self.start:
            return self.start[v.name]
        array, index = about.elements.get(v.name, ("", ()))
        if array in self.start:
            return self.start[array][index]
        return v.start if v.causality == "parameter" else None

    def advise_unwired(self, ports: Collection[str]) -> str:
        """Return how inputs get values without a wire: by `start`, which the FMU's own start values don't replace."""
        names = [self.input_variables[port].name for port in ports]
        shown = ", ".join(f"{name!r}: …" for name in names[:3]) + (", …" if len(names) > 3 else "")
        return f" An input that is to keep one value gets it by Fmu(…, start={{{shown}}})."

    @property
    def held_inputs(self) -> tuple[str, ...]:
        """Input ports that need no wire, as `start` gives them values; where they are not wired they keep these."""
        about = self.description
        inputs = self._choose_ports(about).inputs
        return tuple(p for p, v in inputs.items() if v.causality == "input" and self._default(v, about) is not None)

    def start_of(self, name: str, value: Any, unit: str) -> dict[str, Any]:
        """Return the entry of `start` for a value in a unit that need not be the FMU's: converted as the port's wires.

        Whoever gives a start value to an FMU by its port, in the unit of a wire, asks here: `start` is in the FMU's
        units.

        Parameters
        ----------
        name : str
            Port, or a variable by the FMU's name.
        value : array_like
            The value.
        unit : str
            Its unit.

        Raises
        ------
        UnknownNameError
            If the FMU has neither such a port nor such a variable.
        UnitError
            If the variable is in another unit, and the block doesn't convert units, or they are of other dimensions.
        """
        about = self.description
        variable = {**self.input_variables, **self.output_variables}.get(name)
        if variable is None:
            if name not in about.names:
                raise UnknownNameError(f"the FMU has no variable {name!r}. {near(name, about.names)}", block=self.label)
            variable = about.find(name)
        own = variable.unit
        if own is None or same_unit(unit, own):
            return {variable.name: value}
        if not (self.convert_units and same_dimension(unit, own)):
            advice = ", or give its FMU convert_units=True" if same_dimension(unit, own) else ""
            raise UnitError(
                f"found a start value in {unit}; expected {own}: {describe_mismatch(unit, own)}{advice}",
                block=self.label,
                port=name,
            )
        factor, offset = convert_unit(unit, own)
        return {variable.name: factor * np.asarray(value, dtype=float) + offset}

    @property
    def outputs(self) -> Mapping[str, Output]:  # type: ignore[override]
        """The FMU's outputs, and the local variables among ``ports``."""
        return {port: Output(v.shape, v.unit, v.description, name=port) for port, v in self.output_variables.items()}

    def __call__(self, *args: Any, **kwargs: Any) -> Call:
        """Wire the FMU: signals by position in the order of the inputs, or by keyword.

        Raises
        ------
        UnknownNameError
            For a name that is no input, and for an input that no wire carries.
        """
        left_out = self.description.other, self.description.aliases
        for name in kwargs:
            if any(name in names for names in left_out) and name not in self.inputs:
                raise UnknownNameError(self._no_port(name), block=self.label)
        return super().__call__(*args, **kwargs)

    def __getattr__(self, name: str) -> Signal:
        if name.startswith("_") or "file" not in self.__dict__:
            raise AttributeError(name)
        outputs = self.outputs
        if name in outputs:
            return Signal(self, name)
        raise UnknownAttributeError(self._no_port(name), block=self.label)

    def _no_port(self, name: str) -> str:
        """Return the text of an error: it has no such output, or a port that no wire carries."""
        if name in self.description.aliases:
            return other_name(self.description, name)
        other = self.description.other.get(name)
        if other is None:
            return f"it has no output {name!r}. {near(name, self.outputs)}"
        return f"its {other.causality} {name!r} is {other.refusal}"

    def __getitem__(self, name: Any) -> Signal:
        if isinstance(name, str):
            if name in self.outputs:
                return Signal(self, name)
            element = find_element(self.description, self.output_variables, name, self.label)
            if element is None:
                raise UnknownNameError(self._no_port(name), block=self.label)
            return Signal(self, element[0])[element[1]]
        return super().__getitem__(name)
