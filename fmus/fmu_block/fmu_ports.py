"""Ports of an FMU's block: which of the FMU's variables they are, and how they are wired by name."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import (
    Block,
    Call,
    Input,
    Output,
    ParameterError,
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
from ..archive import FmuDescription, FmuVariable, OtherVariable, read_index


@dataclass(frozen=True, eq=False)
class FmuPorts:
    """Variables of an FMU by the names of their ports, in the order of the file."""

    inputs: dict[str, FmuVariable]
    outputs: dict[str, FmuVariable]
    texts: dict[str, OtherVariable]
    """Texts and binary data that are recorded."""


@lru_cache(maxsize=64)
def choose_ports(
    description: FmuDescription, rename: tuple[tuple[str, str], ...], chosen: tuple[str, ...] | None, label: str
) -> FmuPorts:
    """Return the ports of a block; ``chosen`` are the variables that are ports, None for all inputs and outputs.

    Scalars of a gathered array that are renamed are their own ports, and so are the array's other scalars; those that
    are renamed to elements are one port (`join_scalars`).
    """
    members = {n: description.elements[n][0] for n in description.members}
    names = {n: port for n, port in rename if n not in members} | dict(description.joined)
    if chosen is not None:
        chosen = tuple(part for name in chosen for part in taken_apart(description, name) or (name,))
        _check_chosen(description, chosen, label)
        chosen = _choose_joined(description, chosen, members, label)
    # an array is taken apart where one of its scalars is named
    named, elements = (*names, *(chosen or ())), description.elements
    split = {elements[n][0] for n in named if n in elements and n not in description.variables}
    split -= set(chosen or ())
    both: tuple[dict[str, FmuVariable], dict[str, FmuVariable]] = {}, {}
    known: list[str] = []
    for variable in _variables(description, split):
        name, array = variable.name, description.elements.get(variable.name, ("",))[0]
        if chosen is None:
            side = {"input": 0, "output": 1}.get(variable.causality)
        else:
            side = _side(variable) if name in chosen or (array in chosen and array in split) else None
        if side is None:
            continue
        known.append(name)
        port = names.get(name, name)
        if port in both[0] or port in both[1]:
            raise ParameterError(
                "found one name for two ports; rename them to different names.", block=label, port="rename"
            )
        both[side][port] = variable
    texts: dict[str, OtherVariable] = {}
    for name, text in description.texts.items():
        if text.causality == "output" if chosen is None else name in chosen:
            known.append(name)
            texts[names.get(name, name)] = text
    known += [n for n, array in members.items() if array in known]
    for old in (n for n in dict(rename) if n not in known):
        if array := members.get(old, ""):
            joined = description.find(old)
            raise ParameterError(
                f"found {old!r}, a {joined.variability} {joined.causality}, as an element of the port "
                f"{description.joined[array]!r}; expected an input or an output, or a variable that ports= names. "
                "Add it there.",
                block=label,
                port="rename",
            )
        if old in description.aliases:
            raise ParameterError(other_name(description, old), block=label, port="rename")
        raise UnknownNameError(f"it has no port {old!r} to rename. {near(old, known)}", block=label, port="rename")
    return FmuPorts(*both, texts)


def taken_apart(description: FmuDescription, array: str) -> tuple[str, ...]:
    """Return the scalars of an array that would have been gathered, were some not elements of another port now."""
    if array in description.names or array in description.other:
        return ()
    parts = tuple(n for n in description.scalars if read_index(n)[0] == array)
    return parts if any(part in description.members for part in parts) else ()


def _choose_joined(
    description: FmuDescription, chosen: tuple[str, ...], members: Mapping[str, str], label: str
) -> tuple[str, ...]:
    """Return the names of ``ports`` with the arrays that the user has put together in place of their scalars."""
    own = [description.spelled.get(name, name) for name in chosen]
    for name, array in members.items():
        among = [n for n, other in members.items() if other == array and n in own]
        if among and name not in own:
            raise ParameterError(
                f"found {among[0]!r} and not {name!r}, which rename makes elements of one port, "
                f"{description.joined[array]!r}; expected all of them. Add it, or leave ports out.",
                block=label,
                port="ports",
            )
    return tuple(dict.fromkeys(members.get(name, name) for name in own))


def _variables(description: FmuDescription, split: set[str]) -> Iterator[FmuVariable]:
    """Yield all variables, and the scalars of the arrays that are split in their place."""
    parts: dict[str, list[str]] = {array: [] for array in split}
    for name, (array, _) in description.elements.items():
        if array in parts:
            parts[array].append(name)
    for name, variable in description.variables.items():
        if name in parts:
            yield from (description.element(part) for part in parts[name])
        else:
            yield variable


def _side(variable: FmuVariable) -> int | None:
    """Return 0 for a variable that a wire can set, 1 for one that is read, None for others."""
    if variable.causality == "input" or (variable.causality == "parameter" and variable.variability == "tunable"):
        return 0
    return 1 if variable.causality in ("output", "local", "calculatedParameter") else None


def other_name(description: FmuDescription, alias: str) -> str:
    """Return the text of an error on a further name of an input or parameter."""
    first = description.aliases[alias]
    kind = description.find(first).causality
    return f"{alias!r} is another name of its {kind} {first!r}, and the two are one variable. Use {first!r}."


def _check_chosen(description: FmuDescription, chosen: tuple[str, ...], label: str) -> None:
    for name in chosen:
        if name in description.aliases:
            raise ParameterError(other_name(description, name), block=label, port="ports")
        other = description.other.get(name)
        if other is not None and other.is_text and other.causality in ("output", "local", "calculatedParameter"):
            continue
        if other is not None and other.type_is_clock:
            raise ParameterError(
                f"found {name!r}, a {other.interval_variability} {other.causality} clock; expected a number, as no "
                "wire carries a clock. Leave it out: input clocks tick by themselves, triggered ones where an input "
                "that they clock changes.",
                block=label,
                port="ports",
            )
        if other is not None and other.negated_of:
            raise ParameterError(f"found {name!r}, {other.refusal}", block=label, port="ports")
        if other is not None:
            raise ParameterError(
                f"found {name!r}, a {other.causality} of type {other.type}, which no wire carries; expected a "
                "number, or a text or binary output, which is recorded. Leave it out.",
                block=label,
                port="ports",
            )
        if name not in description.names:
            raise UnknownNameError(
                f"the FMU has no variable {name!r}. {near(name, description.names)}", block=label, port="ports"
            )
        variable = description.find(name)
        if _side(variable) is None:
            raise ParameterError(
                f"found {name!r}, a {variable.variability} {variable.causality}; expected an input, an output, a local "
                "variable or a tunable parameter. Give it a value in start= instead.",
                block=label,
                port="ports",
            )


def find_element(
    description: FmuDescription, outputs: Mapping[str, FmuVariable], name: str, label: str
) -> tuple[str, int] | None:
    """Return the port of a vector and the place in it that an FMU's name of an element means; None for other names."""
    array, index = description.elements.get(description.spelled.get(name, name), ("", ()))
    ports = [port for port, v in outputs.items() if v.name == array]
    if not ports:
        return None
    if len(index) != 1:
        raise UnknownNameError(
            f"found {name!r}, an element of the matrix {ports[0]!r}, and a wire takes rows alone. Wire "
            f"plant[{ports[0]!r}][{index[0]}], or make its elements ports: rename={{{name!r}: …}}.",
            block=label,
        )
    return ports[0], index[0]


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
