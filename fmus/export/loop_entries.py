"""Variables of an exported diagram as those of its FMU: in the order of ``model.h``, and its input clocks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction

from .loop_spec import LoopSpec, Placed
from .scalars import elements_of
from .variable_entries import Entry, Kind, place_entries, rate_variable


def scalarize_loop(spec: LoopSpec) -> LoopSpec:
    """Return the diagram with every array replaced by its elements."""

    def scalars(group: Iterable[Placed]) -> Iterator[Placed]:
        for one in group:
            if not one.variable.shape:
                yield one
                continue
            rates: list[tuple[int, ...]] = [(rate,) for rate in one.rates]
            each = rates or [()] * len(one.places)
            for element, place, rate in zip(elements_of(one.variable), one.places, each, strict=True):
                yield replace(one, variable=element, places=(place,), rates=rate)

    return replace(
        spec,
        inputs=tuple(scalars(spec.inputs)),
        outputs=tuple(scalars(spec.outputs)),
        signals=tuple(scalars(spec.signals)),
        parameters=tuple(scalars(spec.parameters)),
        states=tuple(scalars(spec.states)),
    )


def loop_rows(spec: LoopSpec) -> list[tuple[Kind, Placed]]:
    """Return the variables behind the time, in the order of ``model.h``."""
    rows: list[tuple[Kind, Placed]] = [
        ("tunable" if one.variable.variability == "tunable" else "fixed", one) for one in spec.parameters
    ]
    rows += [("input", one) for one in spec.inputs]
    integrated = [one for one in spec.states if one.rates]
    rows += [("state", one) for one in integrated]
    rows += [("discrete", one) for one in spec.states if one.variable.state and not one.rates]
    rows += [("derivative", _rate_of(one)) for one in integrated]
    rows += [("output", one) for one in (*spec.outputs, *spec.signals)]
    rows += [("output", one) for one in spec.states if not one.variable.state]
    return rows


def _rate_of(one: Placed) -> Placed:
    """Return the rates of a continuous state as a variable."""
    return Placed(rate_variable(one.variable), "rates", one.rates)


def loop_layout(spec: LoopSpec) -> tuple[Entry, ...]:
    """Return all variables with value references and places among the values, in the order of ``model.h``."""
    rows = [(kind, one.variable, one.variable.name) for kind, one in loop_rows(spec)]
    rates = iter([f"der({name})" for kind, _, name in rows if kind == "state"])
    return place_entries((kind, v, next(rates) if kind == "derivative" else name) for kind, v, name in rows)


@dataclass(frozen=True)
class OfferedClock:
    """A clock of a diagram as a periodic input clock of its FMU (FMI 3.0, 2.2.9).

    ``interval``, ``shift``: seconds between two ticks, and before the first one.
    """

    name: str
    description: str
    reference: int
    interval: Fraction
    shift: Fraction


def offered_clocks(spec: LoopSpec, fmi: int) -> tuple[OfferedClock, ...]:
    """Return the clocks that an FMU of a diagram offers, in the order of `LoopSpec.clocks`; none in FMI 2.0."""
    if fmi != 3 or not spec.offers_clocks:
        return ()
    entries = loop_layout(spec)
    taken = {entry.name for entry in entries}
    found: list[OfferedClock] = []
    for i, ((every, offset), members) in enumerate(zip(spec.clocks, spec.clocked, strict=True)):
        name = "clock" if len(spec.clocks) == 1 else f"clock_{i + 1}"
        while name in taken:
            name += "_"
        taken.add(name)
        about = f"Ticks of {members or spec.name}"
        found.append(OfferedClock(name, about, len(entries) + i, every * spec.base, offset * spec.base))
    return tuple(found)
