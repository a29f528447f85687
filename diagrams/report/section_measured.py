"""Loops that were measured elsewhere, on a machine, say, beside those of the linear model."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...blocks.core import LoopwrightError, OptionError
from .. import report_figures as figures
from ..frequency import Interval, Number, Realization, margins, measured_margins, read_frequency_data
from ..report_writing import Plot, Section, Table, Texts
from .case import Case
from .variant import Variant

TEXTS = Texts(__package__, "measured")
QUANTITIES = ("phase_margin_deg", "gain_margin_low", "gain_margin_high", "delay_margin_s", "ms")
"""Margins that stand beside the model's, by their names in dotted paths."""
SOURCE = "the data's uncertainty, and the distance of their points"


def measured_loops(case: Case, measured: Mapping[str, Any]) -> Section:
    """Return the section on measured loops: their margins with intervals, and the model's.

    Parameters
    ----------
    case : Case
        The diagram with its variants; the measured loops stand beside the diagram as it is.
    measured : mapping of str to data
        By wire: data as `measured_margins` takes them, or the path of a CSV file of them.

    Raises
    ------
    OptionError
        If data don't fit, or no variant can be analysed.
    """
    variant = case.actual if case.actual is not None and not case.actual.problem else next(case.usable(), None)
    if variant is None:
        raise OptionError("found no variant that can be analysed; expected one. Mend the diagram.", port="measured")
    numbers: dict[str, Number] = {}
    rows: list[tuple[Any, ...]] = []
    text, plots = [*TEXTS.paragraphs("data")], []
    for wire, given in measured.items():
        data = read_frequency_data(given) if isinstance(given, str | os.PathLike) else getattr(given, "L", given)
        found = measured_margins(data if isinstance(given, str | os.PathLike) else given)
        text += [TEXTS.line("note", wire=wire, note=note) for note in found.notes]
        L, exact = _model(variant, wire, text)
        for name in QUANTITIES:
            interval: Interval = getattr(found, name)
            if np.isnan(interval.value):
                continue
            half = max(interval.high - interval.value, interval.value - interval.low)
            key = f"{wire.replace('.', '_')}.{name}"
            numbers[key] = Number(interval.value, interval.unit, half, SOURCE)
            model = None if exact is None else getattr(exact, name)
            inside = "" if model is None else "yes" if float(model) in interval else "no"
            span = f"{interval.low:.4g} … {interval.high:.4g}"
            rows.append((wire, name.replace("_", " "), numbers[key], span, "" if model is None else model, inside))
        plots.append(_plot(case, wire, data, L, variant.title))
        if L is not None:
            values = np.ravel(data.frdata)
            ours = Realization.of(L).response(np.asarray(data.omega, dtype=float))[0]
            far = np.abs(values - ours) / np.abs(ours)
            worst = int(np.argmax(far))
            text.append(TEXTS.line("deviation", wire=wire, deviation=far[worst], omega=float(data.omega[worst])))
    columns = ("wire", "margin", "measured", "interval", f"model, {variant.title}", "model in the interval")
    table = Table("Measured loops, and the model", columns, tuple(rows))
    return Section("measured", "Measured loops", tuple(text), (table,) if rows else (), tuple(plots), numbers)


def _model(variant: Variant, wire: str, text: list[str]) -> tuple[Any, Any]:
    """Return the model's loop at a wire and its margins; None where it has none, which is told in the text."""
    try:
        L = variant.loop(wire)
        return L, margins(L)
    except LoopwrightError as error:
        text.append(TEXTS.line("no_model", wire=wire, message=error.message))
        return None, None


def _plot(case: Case, wire: str, data: Any, L: Any, title: str) -> Plot:
    """Draw the measured points, and the model's L where there is one."""
    omega = np.asarray(data.omega, dtype=float)
    w = np.geomspace(omega[0], omega[-1], 300) if L is not None else np.empty(0)
    model = figures.response(L, w) if L is not None else np.empty(0)
    own = getattr(data, "uncertainty", None)
    known = None if own is None else np.broadcast_to(np.abs(np.asarray(own, dtype=float)), omega.shape)
    curve = figures.Measured(f"model, {title}", w, model, omega, np.ravel(data.frdata), known)
    return figures.measured(f"measured_{wire.replace('.', '_')}", wire, curve, case.axes)
