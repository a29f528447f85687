"""An FMU in the place of another block: its ports against the wires that are there."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher

import numpy as np

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
    describe_shape,
    same_dimension,
    same_unit,
)
from ..archive import FmuVariable
from .fmu_ports import PortMembers

Port = Input | Output | State
Ports = Mapping[str, Port]
_ALIKE = 0.5
"""Similarity of two names, from 0 to 1, from which on one is suggested in place of the other."""
_SHOWN = 12
_AXES = frozenset({*map(str, range(10)), "x", "y", "z", "X", "Y", "Z"})
"""Letters that name the entries of a vector; those that follow one another belong together."""


@dataclass(frozen=True)
class _Misfit:
    """A port that doesn't fit, and the error that says it where it is the only kind."""

    error: type[WiringError]
    text: str


def check_replacement(fmu: PortMembers, old: Block, wired: Collection[str], read: Collection[str]) -> None:
    """Refuse an FMU that doesn't fit the wires of a block, port by port; see `Block.check_place`."""
    try:
        old.inputs, old.outputs  # noqa: B018
    except FmuError:  # its file has changed or is gone
        return
    misfits, rename, elements = _find_misfits(fmu, old, wired, read)
    if not misfits:
        return
    both = _find_names(fmu, old, wired, read, {**rename, **elements}) if rename or elements else {}
    kinds = {misfit.error for misfit in misfits if misfit.error is not UnwiredInputError or not both}
    lines = "\n".join(f"- {misfit.text}" for misfit in misfits)
    advice = "Wire what is extra, give it a value in start=, or take another FMU."
    if kinds == {UnitError}:
        advice = "Convert units, or take another FMU."
    elif both:
        advice = f"Perhaps only names differ: Fmu({str(fmu.file)!r}, rename={both!r})."
        left = _find_misfits(fmu.replace(rename=both), old, wired, read)[0]
        advice += " Wire what is then extra, or give it a value in start=." if left else ""
    elif elements:
        named = {**fmu.rename, **elements}
        advice = (
            f"Perhaps scalars are elements of a port: Fmu({str(fmu.file)!r}, rename={named!r}); "
            "name the others that are missing, too."
        )
    elif guess := _guess_names(fmu, old, wired, read):
        advice = (
            f"If only names differ, say which is which: Fmu({str(fmu.file)!r}, rename={guess!r}), the FMU's name "
            f"first. Several fit, so these pairs are a guess by order: look at them. {advice}"
        )
    raise (kinds.pop() if len(kinds) == 1 else WiringError)(
        f"{fmu.drawn_as} does not fit the wires of {old.drawn_as}:\n{lines}\n{advice}", block=old.name or fmu.label
    )


def _find_names(
    fmu: PortMembers, old: Block, wired: Collection[str], read: Collection[str], rename: Mapping[str, str]
) -> dict[str, str]:
    """Return the names with which an FMU fits, but for inputs that are extra; empty if there are none."""
    both = {**{a: b for a, b in fmu.rename.items() if a not in rename}, **rename}
    try:
        renamed = fmu.replace(rename=both)
    except LoopwrightError:  # another port has such a name already
        return {}
    left = [misfit for misfit in _find_misfits(renamed, old, wired, read)[0] if misfit.error is not UnwiredInputError]
    return {} if left else both


def _guess_names(fmu: PortMembers, old: Block, wired: Collection[str], read: Collection[str]) -> dict[str, str]:
    """Return names with which an FMU fits where several ports may be meant by one; empty if none do.

    A port that is missing gets, of those of its shape and unit, the one that is most alike by name if that is alike at
    all, else the first that is left.
    """
    guess: dict[str, str] = {}
    for ports, before, used, variables in (
        (fmu.inputs, old.inputs, wired, fmu.input_variables),
        (fmu.outputs, old.outputs, read, fmu.output_variables),
    ):
        missing = {name: port for name, port in before.items() if name in used and name not in ports}
        spare = {name: port for name, port in ports.items() if name not in before}
        pairs = _match(missing, spare, converts=fmu.convert_units)
        for name, port in missing.items():
            left = [n for n, p in spare.items() if n not in pairs.values() and _may_be(p, port, fmu.convert_units)]
            if name not in pairs and left:
                pairs[name] = left[0]
        guess |= {variables[pairs[name]].name: name for name in missing if name in pairs}
    return _find_names(fmu, old, wired, read, guess) if guess else {}


def _may_be(new: Port, old: Port, converts: bool) -> bool:
    return new.shape == old.shape and _fits(new.unit, old.unit, converts=converts)


def _find_misfits(
    fmu: PortMembers, old: Block, wired: Collection[str], read: Collection[str]
) -> tuple[list[_Misfit], dict[str, str], dict[str, str]]:
    """Return the ports that don't fit, names for those that may only be called otherwise, and for elements of ports."""
    misfits, rename, elements = list[_Misfit](), dict[str, str](), dict[str, str]()
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
        wanted, free = {n: before[n] for n in missing}, {n: ports[n] for n in spare if n not in before}
        names, parts = _suggest(wanted, free, variables, converts=fmu.convert_units)
        rename |= names
        elements |= parts
    return misfits, rename, elements


def suggest_names(fmu: PortMembers, inputs: Mapping[str, Input], outputs: Mapping[str, Output]) -> dict[str, str]:
    """Return the entries of ``rename`` that an FMU may need to have some ports, as far as they are unique."""
    found: dict[str, str] = {}
    for wanted, ports, variables in (
        (inputs, fmu.inputs, fmu.input_variables),
        (outputs, fmu.outputs, fmu.output_variables),
    ):
        missing = {n: p for n, p in wanted.items() if n not in ports}
        free = {n: p for n, p in ports.items() if n not in wanted}
        names, parts = _suggest(missing, free, variables, converts=fmu.convert_units)
        found |= names | parts
    return found


def _suggest(
    missing: Ports, spare: Ports, variables: Mapping[str, FmuVariable], *, converts: bool
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the FMU's names of ports that may be those that are missing, then of scalars that may be elements."""
    pairs = _match(missing, spare, converts=converts)
    names = {variables[new].name: name for name, new in pairs.items()}
    open_ = {n: p for n, p in missing.items() if n not in pairs}
    free = {n: p for n, p in spare.items() if n not in pairs.values()}
    return names, _match_elements(open_, free, variables, converts=converts)


def _text(side: str, name: str, port: Port) -> str:
    shape = "" if not port.shape else f" {list(port.shape)}"
    return f"{side} {name}{shape}{f' in {port.unit}' if port.unit else ''}"


def _variable(block: Block, side: str, port: str) -> FmuVariable | None:
    variables: Mapping[str, FmuVariable] = getattr(block, f"{side}_variables", {})
    return variables.get(port)


def _compare(
    side: str, name: str, new: Port, old: Port, variable: FmuVariable, before: FmuVariable | None, *, converts: bool
) -> list[_Misfit]:
    """Return the differences in shape, unit and type of a port that both blocks have."""
    found = list[_Misfit]()
    if old.shape is not None and new.shape != old.shape:
        shapes = f"found {'shape ' * bool(new.shape)}{describe_shape(new.shape)}; expected {describe_shape(old.shape)}"
        found.append(_Misfit(ShapeError, f"{side} {name}: {shapes}"))
    one, other = new.unit, old.unit
    if isinstance(one, str) and isinstance(other, str) and not _fits(one, other, converts=converts):
        way = (other, one) if side == "input" else (one, other)
        remedy = ", or give the FMU convert_units=True" if same_dimension(one, other) else ""
        text = f"{side} {name}: found the unit {one}; expected {other}: {describe_mismatch(*way)}{remedy}"
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


def _match(missing: Ports, spare: Ports, *, converts: bool) -> dict[str, str]:
    """Return ports that may be meant by those that are missing: of their shape and unit, and the most alike by name.

    An FMU that ``converts`` units may have one of the same dimension. A port without one that is alike by name gets the
    only one of its shape and unit, if it is the only one for it, too.
    """
    fits = {name: [other for other, q in spare.items() if _may_be(q, p, converts)] for name, p in missing.items()}
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


def _match_elements(
    missing: Ports, spare: Ports, variables: Mapping[str, FmuVariable], *, converts: bool
) -> dict[str, str]:
    """Return elements of missing array ports by the FMU's names of the scalars that may be these.

    They are as many scalars as the port has entries, of its unit and alike, that are the only ones for it: all that
    there are, or those whose names differ by an axis or a number only, ``s_y`` and ``s_z``.
    """
    families: dict[str, list[tuple[str, ...]]] = {}
    for name, port in missing.items():
        size = math.prod(port.shape or ())
        fitting = [n for n, q in spare.items() if not q.shape and _fits(q.unit, port.unit, converts=converts)]
        known = _families(fitting, size)
        if len(fitting) == size and not known:
            known = [tuple(fitting)]
        of = {n: variables[n] for n in fitting}
        like = {
            n: (spare[n].unit, v.type, v.causality, v.variability, v.clocks, tuple(v.items.items()))
            for n, v in of.items()
        }
        families[name] = [f for f in known if port.shape and len({like[n] for n in f}) == 1]
    found: dict[str, tuple[str, ...]] = {}
    ranked = sorted((-_alike(name, _common_part(f)), name, f) for name, known in families.items() for f in known)
    for value, name, family in ranked:
        if -value >= _ALIKE and name not in found and family not in found.values():
            found[name] = family
    for name, known in families.items():
        left = [f for f in known if f not in found.values()]
        rivals = [n for n, other in families.items() if n not in found and n != name and set(other) & set(left)]
        if name not in found and len(left) == 1 and not rivals:
            found[name] = left[0]
    return {
        variables[scalar].name: f"{name}[{','.join(str(i + 1) for i in index)}]"
        for name, family in found.items()
        for scalar, index in zip(family, np.ndindex(missing[name].shape or ()), strict=True)
    }


def _families(names: Sequence[str], size: int) -> list[tuple[str, ...]]:
    """Return the groups of so many names that differ in one character only: consecutive axes (x, y, z) or digits."""
    groups: dict[tuple[str, str], list[str]] = {}
    for name in names:
        for i, letter in enumerate(name):
            if letter in _AXES:
                groups.setdefault((name[:i], name[i + 1 :]), []).append(name)
    found = []
    for (head, _), group in groups.items():
        letters = sorted(name[len(head)] for name in group)
        if len(group) == size and [*map(ord, letters)] == [ord(letters[0]) + k for k in range(size)]:
            found.append(tuple(sorted(group, key=lambda name: name[len(head)])))
    return found


def _common_part(names: Sequence[str]) -> str:
    """Return the letters that names have in common, place by place, without marks at their ends."""
    same = "".join(letters[0] for letters in zip(*names, strict=False) if len(set(letters)) == 1)
    return same.strip("_.[]() ")


def _fits(a: object, b: object, *, converts: bool) -> bool:
    if not (isinstance(a, str) and isinstance(b, str)):
        return True
    return same_unit(a, b) or (converts and same_dimension(a, b))


def _alike(a: str, b: str) -> float:
    return SequenceMatcher(None, a.lower(), b.lower()).ratio()
