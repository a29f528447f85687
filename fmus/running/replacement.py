"""An FMU in the place of another block: its ports against the wires that are there."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from difflib import SequenceMatcher
from typing import Protocol, Self

from ...blocks.core import (
    Block,
    FmuError,
    Input,
    LoopwrightError,
    Output,
    ShapeError,
    State,
    UnitError,
    UnknownNameError,
    UnwiredInputError,
    WiringError,
    describe_mismatch,
    same_dimension,
    same_unit,
)
from ..archive import FmuVariable

_ALIKE = 0.5
"""Similarity of two names, from 0 to 1, from which on one is suggested in place of the other."""
_SHOWN = 12


class _WithVariables(Protocol):
    """Members of an FMU's block that the comparison needs."""

    @property
    def file(self) -> object: ...
    @property
    def label(self) -> str: ...
    @property
    def drawn_as(self) -> str: ...
    @property
    def rename(self) -> Mapping[str, str]: ...
    @property
    def convert_units(self) -> bool: ...
    @property
    def inputs(self) -> Mapping[str, Input]: ...
    @property
    def outputs(self) -> Mapping[str, Output]: ...
    @property
    def input_variables(self) -> Mapping[str, FmuVariable]: ...
    @property
    def output_variables(self) -> Mapping[str, FmuVariable]: ...
    def replace(self, **changes: object) -> Self:
        """Return the block with other parameters."""


@dataclass(frozen=True)
class _Misfit:
    """A port that doesn't fit, and the error that says it where it is the only kind."""

    error: type[WiringError]
    text: str


def check_replacement(fmu: _WithVariables, old: Block, wired: Collection[str], read: Collection[str]) -> None:
    """Refuse an FMU that doesn't fit the wires of a block, port by port; see `Block.check_place`."""
    try:
        old.inputs, old.outputs  # noqa: B018
    except FmuError:  # its file has changed or is gone
        return
    misfits, rename = _find_misfits(fmu, old, wired, read)
    if not misfits:
        return
    both = _find_names(fmu, old, wired, read, rename) if rename else {}
    kinds = {misfit.error for misfit in misfits if misfit.error is not UnwiredInputError or not both}
    lines = "\n".join(f"- {misfit.text}" for misfit in misfits)
    advice = "Wire what is extra, give it a value in start=, or take another FMU."
    if both:
        advice = f"Perhaps only names differ: Fmu({str(fmu.file)!r}, rename={both!r})."
        left = _find_misfits(fmu.replace(rename=both), old, wired, read)[0]
        advice += " Wire what is then extra, or give it a value in start=." if left else ""
    raise (kinds.pop() if len(kinds) == 1 else WiringError)(
        f"{fmu.drawn_as} does not fit the wires of {old.drawn_as}:\n{lines}\n{advice}", block=old.name or fmu.label
    )


def _find_names(
    fmu: _WithVariables, old: Block, wired: Collection[str], read: Collection[str], rename: Mapping[str, str]
) -> dict[str, str]:
    """Return the names with which an FMU fits, but for inputs that are extra; empty if there are none."""
    both = {**{a: b for a, b in fmu.rename.items() if a not in rename}, **rename}
    try:
        renamed = fmu.replace(rename=both)
    except LoopwrightError:  # another port has such a name already
        return {}
    left = [misfit for misfit in _find_misfits(renamed, old, wired, read)[0] if misfit.error is not UnwiredInputError]
    return {} if left else both


def _find_misfits(
    fmu: _WithVariables, old: Block, wired: Collection[str], read: Collection[str]
) -> tuple[list[_Misfit], dict[str, str]]:
    """Return the ports that don't fit, and names for those that may only be called otherwise."""
    misfits, rename = list[_Misfit](), dict[str, str]()
    ports_before = old.inputs, old.outputs
    for side, ports, before, used, variables in (
        ("input", fmu.inputs, ports_before[0], wired, fmu.input_variables),
        ("output", fmu.outputs, ports_before[1], read, fmu.output_variables),
    ):
        missing = [name for name in before if name in used and name not in ports]
        spare = [name for name in ports if name not in used]
        loose = [
            name
            for name in spare
            if side == "input" and name not in before and getattr(ports[name], "default", None) is None
        ]
        misfits += [_Misfit(UnknownNameError, f"{_text(side, n, before[n])} is missing") for n in missing]
        extra = loose if side == "input" else [n for n in spare if missing and n not in before]
        error = UnwiredInputError if side == "input" else UnknownNameError
        note = ", and nothing is wired to it" if side == "input" else ""
        misfits += [_Misfit(error, f"{_text(side, n, ports[n])} is extra{note}") for n in extra[:_SHOWN]]
        for name in (name for name in before if name in used and name in ports):
            pair = ports[name], before[name], variables[name], _variable(old, side, name)
            misfits += _compare(side, name, *pair, converts=fmu.convert_units)
        pairs = _match({n: before[n] for n in missing}, {n: ports[n] for n in spare if n not in before})
        rename |= {variables[new].name: name for name, new in pairs.items()}
    return misfits, rename


def _text(side: str, name: str, port: Input | Output | State) -> str:
    shape = "" if not port.shape else f" {list(port.shape)}"
    return f"{side} {name}{shape}{f' in {port.unit}' if port.unit else ''}"


def _variable(block: Block, side: str, port: str) -> FmuVariable | None:
    variables: Mapping[str, FmuVariable] = getattr(block, f"{side}_variables", {})
    return variables.get(port)


def _compare(
    side: str,
    name: str,
    new: Input | Output | State,
    old: Input | Output | State,
    variable: FmuVariable,
    before: FmuVariable | None,
    *,
    converts: bool,
) -> list[_Misfit]:
    """Return the differences in shape, unit and type of a port that both blocks have."""
    found = list[_Misfit]()
    if old.shape is not None and new.shape != old.shape:
        found.append(_Misfit(ShapeError, f"{side} {name}: found shape {new.shape}; expected {old.shape}"))
    one, other = new.unit, old.unit
    if (
        isinstance(one, str)
        and isinstance(other, str)
        and not (same_unit(one, other) or (converts and same_dimension(one, other)))
    ):
        way = (other, one) if side == "input" else (one, other)
        text = f"{side} {name}: found the unit {one}; expected {other}: {describe_mismatch(*way)}"
        found.append(_Misfit(UnitError, text))
    if side == "input" and before is not None and _kind(variable) not in _ACCEPTED_BY[_kind(before)]:
        text = f"input {name}: found the type {variable.type}; expected {before.type}, whose values it would refuse"
        found.append(_Misfit(WiringError, text))
    return found


_ACCEPTED_BY = {
    "real": ("real",),
    "integer": ("real", "integer"),
    "Boolean": ("real", "integer", "Boolean"),
    "Enumeration": ("real", "integer", "Enumeration"),
}
"""Kinds of inputs that take the values of a kind."""


def _kind(variable: FmuVariable) -> str:
    if not variable.is_integer:
        return "real"
    return variable.type if variable.type in ("Boolean", "Enumeration") else "integer"


def _match(
    missing: Mapping[str, Input | Output | State], spare: Mapping[str, Input | Output | State]
) -> dict[str, str]:
    """Return ports that may be meant by those that are missing: of their shape and unit, and the most alike by name.

    A port without one that is alike by name gets the only one of its shape and unit, if it is the only one for it, too.
    """
    fits = {
        name: [other for other, q in spare.items() if q.shape == p.shape and _same(q.unit, p.unit)]
        for name, p in missing.items()
    }
    found: dict[str, str] = {}
    likeness = sorted(((-_alike(name, other), name, other) for name, others in fits.items() for other in others))
    for value, name, other in likeness:
        if -value >= _ALIKE and name not in found and other not in found.values():
            found[name] = other
    for name, others in fits.items():
        left = [other for other in others if other not in found.values()]
        rivals = [n for n, o in fits.items() if n not in found and n != name and set(o) & set(left)]
        if name not in found and len(left) == 1 and not rivals:
            found[name] = left[0]
    return found


def _same(a: object, b: object) -> bool:
    return same_unit(a, b) if isinstance(a, str) and isinstance(b, str) else True


def _alike(a: str, b: str) -> float:
    return SequenceMatcher(None, a.lower(), b.lower()).ratio()
