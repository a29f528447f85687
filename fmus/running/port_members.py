"""Ports of an FMU's block: which of the FMU's variables they are, and how they are wired by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ...blocks.core import Block, Call, Input, Output, Signal, UnknownAttributeError, UnknownNameError, near
from ..archive import FmuDescription, FmuVariable, OtherVariable
from .ports import FmuPorts, choose_ports, find_element, other_name


class PortMembers(Block):
    """Members of an FMU's block that are its ports, or read them."""

    if TYPE_CHECKING:
        start: Mapping[str, Any]
        rename: Mapping[str, str]
        ports: Sequence[str] | None

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
        return {
            port: Input(v.shape, v.unit, v.description, default=self._default(v), name=port)
            for port, v in self.input_variables.items()
        }

    def _default(self, v: FmuVariable) -> Any:
        """Return the value of an input that is not wired; None where one must be."""
        if v.name in self.start:
            return self.start[v.name]
        array, index = self.description.elements.get(v.name, ("", ()))
        if array in self.start:
            return self.start[array][index]
        return v.start if v.causality == "parameter" else None

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
