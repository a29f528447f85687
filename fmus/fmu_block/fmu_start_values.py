"""Start values of an FMU's variables, checked against its description."""

from __future__ import annotations

import os
from collections.abc import Mapping
from math import isfinite
from typing import Any

import numpy as np

from ...blocks.core import FmuError, ParameterError, UnknownNameError, near
from ..archive import ArchiveLimits, FmuDescription, FmuVariable, read_description
from .fmu_ports import taken_apart


def check_start(description: FmuDescription, start: Mapping[str, Any], label: str) -> dict[str, Any]:
    """Return start values in their variables' shapes; those of a gathered array's scalars are put into the array's."""
    found: dict[str, Any] = {}
    parts: dict[str, dict[str, Any]] = {}
    for name, value in start.items():
        checked = check_value(description, name, value, label)
        if (own := description.spelled.get(name)) is not None:
            if own in start and not np.array_equal(check_value(description, own, start[own], label), checked):
                raise ParameterError(
                    f"found {value!r} for {name!r}, and {start[own]!r} for {own!r}; expected one value, as these are "
                    f"two names of one variable. Leave one out.",
                    block=label,
                    port=f"start.{name}",
                )
            name = own
        first = description.aliases.get(name, "")
        if first in start and not np.array_equal(check_value(description, first, start[first], label), checked):
            raise ParameterError(
                f"found {value!r} for {name!r}, and {start[first]!r} for {first!r}; expected one value, as these are "
                f"two names of one variable. Leave {name!r} out.",
                block=label,
                port=f"start.{name}",
            )
        array = description.elements[name][0] if name in description.elements else name
        if array == name or name in description.variables:
            found[name] = checked
        else:
            parts.setdefault(array, {})[name] = checked
    for array, values in parts.items():
        whole = description.variables[array]
        # of an input, elements that nobody gives are not given: its values need not come from the FMU's own
        base = found.get(array, None if whole.causality == "input" else whole.start)
        if base is None and len(values) < whole.size:
            found.update(values)
            continue
        merged = np.zeros(whole.shape) if base is None else np.array(base)
        for name, value in values.items():
            merged[description.elements[name][1]] = value
        found[array] = merged
    return found


def check_state(variable: FmuVariable, value: Any, label: str) -> np.ndarray:
    """Return a state's value in its shape; it need not be one that can be set at the start."""
    try:
        found = np.array(np.broadcast_to(np.asarray(value, dtype=float), variable.shape))
    except (TypeError, ValueError):
        found = np.array(np.nan)
    if not np.all(np.isfinite(found)):
        raise ParameterError(
            f"found {value!r}; expected finite numbers of shape {variable.shape}. Give these.",
            block=label,
            port=variable.name,
        )
    return found


def check_value(description: FmuDescription, name: str, value: Any, label: str) -> Any:
    """Return one start value in its variable's shape, or a text, after checking it; see `check_start`."""
    port = f"start.{name}"

    def refuse(text: str) -> ParameterError:
        return ParameterError(text, block=label, port=port)

    if name in description.other:
        return _check_text(description, name, value, label)
    if not any(name in known for known in (description.variables, description.elements, description.spelled)):
        if parts := taken_apart(description, name):
            raise UnknownNameError(
                f"found {name!r}, of which rename puts elements into another port; expected these by their own names. "
                f"Name them one by one: {', '.join(parts)}.",
                block=label,
                port="start",
            )
        known = {*description.names, *description.texts}
        raise UnknownNameError(f"the FMU has no variable {name!r}. {near(name, known)}", block=label, port="start")
    variable = description.find(name)
    if variable.causality in ("output", "local") and variable.start is None:
        if name in description.states:
            raise refuse(
                "found a state without a start value in the FMU's description, as the FMU computes it when it "
                "initializes; expected a variable that has one. Set the parameters or inputs that it is computed from."
            )
        raise refuse(
            "found a variable that is computed and has no start value; set the states and parameters that it "
            "depends on."
        )
    if variable.variability == "constant" or variable.causality == "calculatedParameter":
        kind = "a constant" if variable.variability == "constant" else "a parameter that is computed"
        raise refuse(f"found {kind}, which can't be set; expected a parameter, a state or an input. Leave it out.")
    if type(value) is float and _is_plainly_within(variable, value):
        return np.array(value)
    numbers = variable.items.get(value, value) if isinstance(value, str) else value
    if isinstance(numbers, str | bytes) or np.asarray(numbers).dtype.kind in "US":
        raise _refuse_words(variable, value, label)
    try:
        array = np.array(np.broadcast_to(np.asarray(numbers, dtype=float), variable.shape))
    except (TypeError, ValueError):
        raise refuse(f"found {value!r}; expected numbers of shape {variable.shape}. Give these.") from None
    if variable.is_integer and _too_large(numbers):  # before it is rounded
        raise refuse(
            f"found {value!r}; expected at most 2**53 in size, up to which a signal holds every integer of its type "
            f"{variable.type}. Give another value."
        )
    if not np.all(np.isfinite(array)):
        unit = f" in {variable.unit}" if variable.unit else ""
        raise refuse(f"found {value!r}; expected finite numbers{unit}. Give these.")
    if reason := variable.complaint(array):
        raise refuse(f"{reason}. Give another value.")
    low, high = variable.limits
    if np.any((array < low) | (array > high)):
        raise refuse(f"found {value!r}; the FMU allows {variable.range_text}. Give a value in that range.")
    return array


def _is_plainly_within(variable: FmuVariable, value: float) -> bool:
    """Whether a number is one of a Float64 scalar within its range; sweeps ask for thousands of them."""
    if variable.type != "Float64" or variable.shape or not isfinite(value):
        return False
    low, high = variable.minimum, variable.maximum
    return (low is None or bool(value >= low)) and (high is None or bool(value <= high))


def _check_text(description: FmuDescription, name: str, value: Any, label: str) -> Any:
    """Return a text or binary data; those of an array as a tuple of its elements, in C order."""
    variable, port = description.other[name], f"start.{name}"

    def refuse(text: str) -> ParameterError:
        return ParameterError(text, block=label, port=port)

    if variable.negated_of:
        raise refuse(f"found {value!r} for {variable.refusal}")
    if not variable.is_text:
        raise refuse(
            f"found {value!r} for a {variable.interval_variability} clock, which ticks in a run alone. Leave it out."
        )
    if variable.causality in ("output", "local", "calculatedParameter"):
        raise refuse(
            f"found {_article(variable.causality)} of type {variable.type}, which the FMU computes. Leave it out."
        )
    kind, noun = (str, "a text") if variable.type == "String" else (bytes, "bytes")
    if not variable.shape:
        if isinstance(value, kind):
            return value
        raise refuse(
            f"found {value!r} for a variable of type {variable.type}; expected {noun}. Give a {kind.__name__}."
        )
    elements = () if isinstance(value, str | bytes) else tuple(np.ravel(np.array(value, dtype=object)).tolist())
    if len(elements) != variable.size or not all(isinstance(element, kind) for element in elements):
        raise refuse(
            f"found {value!r}; expected {noun} for each of {variable.size} elements, of shape {variable.shape}. Give a "
            f"list of {kind.__name__}."
        )
    return elements


def _refuse_words(variable: FmuVariable, value: Any, label: str) -> ParameterError:
    """Return the error of a text in place of a number."""
    port, expected = (
        f"start.{variable.name}",
        "a number" if not variable.shape else f"numbers of shape {variable.shape}",
    )
    if variable.items:
        known = ", ".join(f"{number} for {name!r}" for name, number in variable.items.items())
        text = f"found {value!r}; expected an item of its enumeration or its value, {known}."
        return ParameterError(f"{text} {near(str(value), variable.items)}", block=label, port=port)
    if variable.type == "Boolean":
        expected = "True or False" if not variable.shape else f"True or False in the shape {variable.shape}"
    step = "Leave out the quotes."
    if isinstance(value, str) and variable.unit and not value.strip().replace(".", "", 1).lstrip("+-").isdigit():
        step = f"Give it in {variable.unit}, without the unit."
    return ParameterError(f"found {value!r}; expected {expected}, no text. {step}", block=label, port=port)


def _too_large(numbers: Any) -> bool:
    """Whether an integer is among numbers that a float64 may not hold."""
    found = np.ravel(np.array(numbers, dtype=object))
    return any(isinstance(number, int | np.integer) and abs(int(number)) > 2**53 for number in found)


def _article(noun: str) -> str:
    return f"an {noun}" if noun[0] in "aeio" else f"a {noun}"


def read_sized(
    file: str | os.PathLike[str], start: Mapping[str, Any], limits: ArchiveLimits | None, label: str
) -> tuple[FmuDescription, dict[str, int]]:
    """Return an FMU's description with the sizes of arrays that start values give, and those start values."""
    try:
        description = read_description(file, limits=limits)
        sizes = {n: int(check_value(description, n, v, label)) for n, v in start.items() if n in description.structural}
        return (read_description(file, sizes, limits=limits) if sizes else description), sizes
    except FmuError as error:
        error.at(block=label)
        raise
