"""Figures of a design report, drawn without pyplot."""

from ...plotting import AxisUnits
from .contact_figures import DOTTED, contact_admittance, contact_map, draw_admittances, fill_growth
from .drawings import with_drawing
from .loop_figures import DrawnLoops, MeasuredCurve, bode, gang, injected, measured, nyquist, response, sensitivities
from .overview_figures import HEIGHTS, fit_overview, overview_bode, overview_step
from .sensitivity_figures import sensitivity_bars
from .step_figures import step_responses

__all__ = [
    "DOTTED",
    "HEIGHTS",
    "AxisUnits",
    "DrawnLoops",
    "MeasuredCurve",
    "bode",
    "contact_admittance",
    "contact_map",
    "draw_admittances",
    "fill_growth",
    "fit_overview",
    "gang",
    "injected",
    "measured",
    "nyquist",
    "overview_bode",
    "overview_step",
    "response",
    "sensitivities",
    "sensitivity_bars",
    "step_responses",
    "with_drawing",
]
