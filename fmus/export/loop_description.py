"""Description of the FMU of a diagram: its variables, input clocks and dependencies, when ticks act; and its page.

Its variables are in the order of ``model.h``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from html import escape

from .dependencies import Dependency
from .html_page import page_of
from .loop_spec import LoopSpec, Placed
from .model_description import Attributes, DescribedVariable, ModelDescription, Unknown
from .model_spec import elements_of
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


_VECTOR_OF = {"fixed": "p", "tunable": "p", "input": "w", "state": "x", "discrete": "x"}
"""Vector that a known is in, by its kind."""
_Rows = list[tuple[Entry, Placed | None]]


def describe_loop(spec: LoopSpec, token: str, fmi: int) -> ModelDescription:
    """Return the description of a diagram: for co-simulation alone."""
    clocks = offered_clocks(spec, fmi)
    rows: _Rows = [*zip(loop_layout(spec), (None, *(one for _, one in loop_rows(spec))), strict=True)]
    outputs = [(entry, one) for entry, one in rows if entry.is_output]
    rates = [(entry, one) for entry, one in rows if entry.kind == "derivative"]
    dependencies = _Dependencies(spec, rows)
    # What an output holds changes at ticks.
    ticks = tuple(Dependency(clock.reference, "dependent") for clock in clocks)
    return ModelDescription(
        name=spec.name,
        text=f"{spec.description} {about_steps(spec, fmi)}".strip(),
        token=token,
        variables=tuple(
            DescribedVariable(entry, _variability(entry, one), _clock_of(entry, one, clocks)) for entry, one in rows
        ),
        has_derivatives=spec.slopes is not None,
        interfaces={"CoSimulation": _stepping(spec, fmi, has_clocks=bool(clocks))},
        stop_time=spec.stop_time,
        step_size=spec.step_size,
        outputs=tuple(Unknown(entry, dependencies.of(entry, one) + ticks) for entry, one in outputs),
        rates=tuple(Unknown(entry, dependencies.of(entry, one)) for entry, one in rates),
        initial=tuple(Unknown(entry) for entry, _ in (*outputs, *rates)),
        clocks=tuple(_clock_attributes(clock, spec) for clock in clocks),
    )


def _stepping(spec: LoopSpec, fmi: int, *, has_clocks: bool) -> Attributes:
    if fmi == 2:
        return {
            "canHandleVariableCommunicationStepSize": True,
            "canInterpolateInputs": False,
            "maxOutputDerivativeOrder": 0,
            "canRunAsynchronuously": False,
        }
    return {
        "canHandleVariableCommunicationStepSize": True,
        "hasEventMode": has_clocks or None,
        "mightReturnEarlyFromDoStep": has_clocks or None,
        "fixedInternalStepSize": float(spec.base) if spec.steps_on_ticks else None,
        "maxOutputDerivativeOrder": 0,
    }


class _Dependencies:
    """The knowns that outputs and rates of a diagram depend on at an instant.

    Without derivatives these are inputs alone. With them all are listed, since an importer takes a derivative as zero
    that isn't: time, parameters, inputs, states.
    """

    def __init__(self, spec: LoopSpec, rows: _Rows):
        self._spec = spec
        self._inputs: dict[int, Entry] = {}
        self._owners: dict[tuple[str, int], Entry] = {}
        for entry, one in rows:
            if one is None:
                self._owners["t", 0] = entry
            elif (vector := _VECTOR_OF.get(entry.kind)) is not None:
                self._owners |= {(vector, place): entry for place in one.places}
                if entry.kind == "input":
                    self._inputs |= dict.fromkeys(one.places, entry)

    def of(self, entry: Entry, one: Placed | None) -> tuple[Dependency, ...]:
        """Return what an output or a rate depends on, in the order of the variables."""
        spec = self._spec
        if spec.slopes is not None:
            assert one is not None
            needed = frozenset[tuple[str, int]]().union(*(spec.knowns.get((one.vector, i), ()) for i in one.places))
            found = {self._owners[known].reference for known in needed if known in self._owners}
            return tuple(Dependency(reference, "dependent") for reference in sorted(found))
        places = spec.depends.get(entry.name.partition("[")[0], tuple(self._inputs))
        references = dict.fromkeys(self._inputs[i].reference for i in places if i in self._inputs)
        return tuple(Dependency(reference, "dependent") for reference in references)


def _variability(entry: Entry, one: Placed | None) -> str:
    if entry.kind in ("fixed", "tunable"):
        return entry.kind
    return "discrete" if one is not None and one.sampled and entry.kind != "input" else "continuous"


def _clock_of(entry: Entry, one: Placed | None, clocks: tuple[OfferedClock, ...]) -> int | None:
    """Return the clock of a variable that is clocked: local ones. Outputs are held, and can be read at any time."""
    if one is None or one.clock is None or not clocks or entry.is_output or entry.kind not in ("discrete", "output"):
        return None
    return clocks[one.clock].reference


def _clock_attributes(clock: OfferedClock, spec: LoopSpec) -> dict[str, object]:
    resolution = spec.base.denominator
    return {
        "name": clock.name,
        "valueReference": clock.reference,
        "description": clock.description,
        "causality": "input",
        "variability": "discrete",
        "intervalVariability": "constant",
        "intervalDecimal": float(clock.interval),
        "shiftDecimal": float(clock.shift) or None,
        "supportsFraction": True,
        "resolution": resolution,
        "intervalCounter": int(clock.interval * resolution),
        "shiftCounter": int(clock.shift * resolution) or None,
    }


def about_steps(spec: LoopSpec, fmi: int) -> str:
    """Return in words when ticks act, which an importer has to know."""
    base = f"{float(spec.base):.9g} s"
    ticks = f"It is sampled (time between two ticks: {base}). " if spec.clocks else ""
    fit = (
        "Communication steps go from tick to tick. "
        if spec.steps_on_ticks
        else "Communication steps may have any length. "
    )
    acts = (
        "A tick acts at the start of a communication step, with the inputs that are set for it: step this FMU before "
        "the plant that it acts on, after its inputs were set from the plant's outputs. An importer that exchanges all "
        "values at once between two steps has one sample more of delay in the loop. "
        if spec.clocks
        else ""
    )
    starts = (
        f"The start of {', '.join(spec.found_at_build)} was found by Python when this was built, for the start values "
        "of the inputs: set it where these start elsewhere. "
        if spec.found_at_build
        else ""
    )
    clocks = [clock.name for clock in offered_clocks(spec, fmi)]
    exact = (
        f"With Event Mode the importer makes the ticks by {'the input clock' if len(clocks) == 1 else 'input clocks,'} "
        f"{', '.join(clocks)}, and values that are exchanged at a tick belong to that tick. "
        if clocks
        else ""
    )
    return f"{ticks}{fit}{acts}{exact}{starts}".strip()


def loop_page(spec: LoopSpec, text: str = "", *, fmi: int = 3) -> str:
    """Return the text of ``documentation/index.html``: when ticks act, and the table of variables."""
    steps = [f"<p>{escape(about_steps(spec, fmi))}</p>"]
    return page_of(spec.name, spec.description, text, {"Steps": steps}, loop_layout(spec), fmi=fmi)
