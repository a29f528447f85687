"""Loops that were measured elsewhere, on a machine, say, next to those of the linear model."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ....blocks.core import LoopwrightError, OptionError
from ...flat import FlatDiagram
from ...frequency import (
    Interval,
    MeasuredMargins,
    Number,
    margins,
    measured_margins,
    read_frequency_data,
    realize,
)
from ...linearization import find_signal
from .. import figures
from ..case import Case
from ..error_sentences import say
from ..pages import Plot, Section, TableForm, Texts
from ..variant import STEP, Variant
from .loops import ROWS

TEXTS = Texts(__package__, "measured")
MEASURED = "measured"
"""Key of what was measured, in place of a variant's, in requirements and their verdicts."""
QUANTITIES = ("phase_margin_deg", "gain_margin_low", "gain_margin_high", "delay_margin_s", "modulus_margin", "ms")
"""Margins that are next to the model's, by their names in dotted paths."""
MARGINS = TableForm(
    "Measured loops, and the model",
    {
        "wire": "wire",
        "margin": "margin",
        "measured": "measured",
        "interval": "interval",
        "model, {model}": "model",
        "model in the interval": "inside",
    },
)
SOURCE = "the data's uncertainty, and the distance of their points"


@dataclass(frozen=True, eq=False)
class MeasuredLoop:
    """A loop that was measured; its key is that of the loop in the report, where the wire is one of them."""

    wire: str
    key: str
    data: Any
    uncertainty: np.ndarray | None  # relative, of each point; None where the data don't say it
    margins: MeasuredMargins

    def intervals(self, dt: float = 0.0) -> dict[str, Interval]:
        """Return the margins by their names in dotted paths; ``dt`` is the sample time of delays in samples."""
        found: dict[str, Interval] = {name: getattr(self.margins, name) for name in QUANTITIES}
        if dt:
            delay = found["delay_margin_s"]
            found["delay_margin_samples"] = Interval(delay.value / dt, delay.low / dt, delay.high / dt, "samples")
        return found

    def path(self, name: str) -> str:
        """Return the dotted path of a number of it."""
        return f"measured.{self.key}.{name}"


def read_measured(case: Case, measured: Mapping[str, Any]) -> tuple[MeasuredLoop, ...]:
    """Return measured loops with their margins."""
    flat = case.diagram.flatten(None if case.diagram.has_clock else STEP)
    known = {_place(flat, wire): key for key, wire in case.named_wires().items()}
    found: dict[str, MeasuredLoop] = {}
    for wire, given in measured.items():
        source = read_frequency_data(given) if isinstance(given, str | os.PathLike) else given
        try:
            margins = measured_margins(source)
        except OptionError as error:
            raise OptionError(
                error.message, block=str(given) if source is not given else wire, port=error.port
            ) from None
        data = getattr(source, "L", source)
        own = getattr(source, "uncertainty", None)
        omega = np.asarray(data.omega, dtype=float)
        spread = None if own is None else np.broadcast_to(np.abs(np.ravel(np.asarray(own, dtype=float))), omega.shape)
        key = known.get(_place(flat, wire), wire.replace(".", "_"))
        if key in found:
            raise OptionError(
                f"found data for {found[key].wire!r} and {wire!r}, which are one wire; expected one file for each. "
                "Leave one of them out.",
                port="measured",
            )
        found[key] = MeasuredLoop(wire, key, data, spread, margins)
    return tuple(found.values())


def _place(flat: FlatDiagram, wire: str) -> tuple[Any, ...]:
    """Return the port and the entries that a wire's name denotes."""
    tap = find_signal(flat, wire)
    return tap.port, tap.entries


def measured_loops(case: Case, loops: Sequence[MeasuredLoop]) -> Section:
    """Return the section on measured loops: their margins with intervals, and those of the diagram as it is."""
    variant = case.actual if case.actual is not None and not case.actual.problem else next(case.usable(), None)
    if variant is None:
        raise OptionError("found no variant that can be analysed; expected one. Mend the diagram.", port="measured")
    numbers: dict[str, Number] = {}
    rows: list[dict[str, Any]] = []
    text, plots = [*TEXTS.paragraphs("data")], []
    for of in loops:
        text += [TEXTS.line("note", wire=of.wire, note=note) for note in of.margins.notes]
        if of.uncertainty is None:
            text.append(TEXTS.line("no_uncertainty", wire=of.wire))
        L, exact = _model(variant, of.wire, text)
        for name, interval in of.intervals(variant.model.dt).items():
            if np.isnan(interval.value):
                continue
            numbers |= _numbers(of.key, name, interval)
            number = numbers[f"{of.key}.{name}"]
            model = None if exact is None else getattr(exact, name)
            inside = "" if model is None else "yes" if float(model) in interval else "no"
            span = f"{interval.low:.4g} … {interval.high:.4g}"
            found = {"measured": number, "interval": span, "model": "" if model is None else model, "inside": inside}
            rows.append({"wire": of.wire, "margin": ROWS[name], **found})
        plots.append(_plot(case, of, L, variant.title))
        if L is not None:
            values = np.ravel(of.data.frdata)
            ours = realize(L).response(np.asarray(of.data.omega, dtype=float))[0]
            far = np.abs(values - ours) / np.abs(ours)
            worst = int(np.argmax(far))
            omega = float(of.data.omega[worst])
            text.append(TEXTS.line("deviation", wire=of.wire, deviation=far[worst], omega=omega))
    tables = (MARGINS.fill(rows, model=variant.title),) if rows else ()
    return Section("measured", "Measured loops", tuple(text), tables, tuple(plots), numbers)


def _numbers(key: str, name: str, interval: Interval) -> dict[str, Number]:
    """Return a measured margin, and the ends of its interval, by their paths in the section."""
    half = max(interval.high - interval.value, interval.value - interval.low)
    ends = {"low": interval.low, "high": interval.high}
    how = f"{SOURCE}: interpolated with the least and the largest error"
    found = {f"{key}.interval.{name}.{end}": Number(at, interval.unit, 0.0, how) for end, at in ends.items()}
    return {f"{key}.{name}": Number(interval.value, interval.unit, half, SOURCE), **found}


def _model(variant: Variant, wire: str, text: list[str]) -> tuple[Any, Any]:
    """Return the model's loop at a wire and its margins; None where it has none, which the text says."""
    try:
        L = variant.loop(wire)
        return L, margins(L)
    except LoopwrightError as error:
        text.append(TEXTS.line("no_model", wire=wire, message=say(error)))
        return None, None


def _plot(case: Case, of: MeasuredLoop, L: Any, title: str) -> Plot:
    """Draw the measured points, and the model's L where there is one."""
    omega = np.asarray(of.data.omega, dtype=float)
    w = np.geomspace(omega[0], omega[-1], 300) if L is not None else np.empty(0)
    model = figures.response(L, w) if L is not None else np.empty(0)
    curve = figures.MeasuredCurve(f"model, {title}", w, model, omega, np.ravel(of.data.frdata), of.uncertainty)
    return figures.measured(f"measured_{of.key}", of.wire, curve, case.axes)
