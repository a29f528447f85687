"""Margins, Nyquist, disks and pole placement of linear systems."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .delay_matrices import NEUTRAL, DelayMatrices
from .delayed_hold import delayed_hold, delayed_hold_margin
from .delayed_realization import realize
from .disk_margins import DiskMargin, disk_margin, loop_at, mimo_disk_margin
from .drawn_loops import DrawnLoop, phase_of
from .frequency_data import read_frequency_data
from .linear_delays import LinearDelays, find_pade_limit
from .loop_drawing import draw_bode_axes, draw_nyquist_axes
from .loop_margins import GainCrossover, Margins, PhaseCrossover, find_disk_frequency, margins, scan_margins
from .loop_model import find_hidden_unstable
from .margin_analysis import MARGIN_UNITS
from .margin_slopes import MarginSlope, margin_slopes
from .measured_margins import MeasuredMargins, measured_margins
from .number import MARK, Confirmation, Interval, Number, is_at_steps_only, method_of, with_findings
from .nyquist import NyquistCount, nyquist_count
from .periodic_margins import PeriodicMargins, periodic_margins
from .pole_maps import plot_poles
from .pole_placement import place, relative_difference
from .poles_and_zeros import finite_zeros
from .python_control_margins import Comparison, compare_margins, compare_with_control
from .realization import Realization
from .sampled_design import SampledDesign, sampled_gains, sampled_poles
from .scan_refine_confirm import first_largest, order_key, refine_sign_change
from .sensitivities import GangOfFour, complementary, gang_of_four, sensitivity
from .state_space import FourMatrices, advance_held, hold_inputs
from .structured_value import mu_bound

if TYPE_CHECKING:
    from .delayed_system import DelayedSystem as DelayedSystem
    from .loop_transfer import DelayedLoop as DelayedLoop
    from .loop_transfer import LoopTransfer as LoopTransfer


def loop_class() -> type[LoopTransfer]:
    """Return `LoopTransfer`, loaded when the first loop is made: python-control takes a second to import."""
    from .loop_transfer import LoopTransfer

    return LoopTransfer


def delayed_loop_class() -> type[DelayedLoop]:
    """Return `DelayedLoop`, loaded when the first one is made."""
    from .loop_transfer import DelayedLoop

    return DelayedLoop


def delayed_system_class() -> type[DelayedSystem]:
    """Return `DelayedSystem`, loaded when the first one is made."""
    from .delayed_system import DelayedSystem

    return DelayedSystem


__all__ = [
    "MARGIN_UNITS",
    "MARK",
    "NEUTRAL",
    "Comparison",
    "Confirmation",
    "DelayMatrices",
    "DiskMargin",
    "DrawnLoop",
    "FourMatrices",
    "GainCrossover",
    "GangOfFour",
    "Interval",
    "LinearDelays",
    "MarginSlope",
    "Margins",
    "MeasuredMargins",
    "Number",
    "NyquistCount",
    "PeriodicMargins",
    "PhaseCrossover",
    "Realization",
    "SampledDesign",
    "advance_held",
    "compare_margins",
    "compare_with_control",
    "complementary",
    "delayed_hold",
    "delayed_hold_margin",
    "delayed_loop_class",
    "delayed_system_class",
    "disk_margin",
    "draw_bode_axes",
    "draw_nyquist_axes",
    "find_disk_frequency",
    "find_hidden_unstable",
    "find_pade_limit",
    "finite_zeros",
    "first_largest",
    "gang_of_four",
    "hold_inputs",
    "is_at_steps_only",
    "loop_at",
    "loop_class",
    "margin_slopes",
    "margins",
    "measured_margins",
    "method_of",
    "mimo_disk_margin",
    "mu_bound",
    "nyquist_count",
    "order_key",
    "periodic_margins",
    "phase_of",
    "place",
    "plot_poles",
    "read_frequency_data",
    "realize",
    "refine_sign_change",
    "relative_difference",
    "sampled_gains",
    "sampled_poles",
    "scan_margins",
    "sensitivity",
    "with_findings",
]
