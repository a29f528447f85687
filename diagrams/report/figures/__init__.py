"""Figures of a design report, drawn without pyplot."""

from .axes import AxisUnits, set_powers
from .contact_figures import contact_admittance, contact_map, fill_growth, tint
from .drawings import with_drawing
from .loop_figures import DrawnLoops, bode, gang, nyquist, response, sensitivities
from .measured_figures import Measured, injected, measured
from .sensitivity_figures import sensitivity_bars
from .step_figures import step_responses

__all__ = [
    "AxisUnits",
    "DrawnLoops",
    "Measured",
    "bode",
    "contact_admittance",
    "contact_map",
    "fill_growth",
    "gang",
    "injected",
    "measured",
    "nyquist",
    "response",
    "sensitivities",
    "sensitivity_bars",
    "set_powers",
    "step_responses",
    "tint",
    "with_drawing",
]
