"""Margins, Nyquist, disks and pole placement of linear systems."""

from typing import TYPE_CHECKING

from .carried import with_findings
from .disk import DiskMargin, disk_margin, loop_at, mimo_disk_margin, mu_bound
from .features import find_hidden_unstable
from .loop_class import loop_class
from .loop_margins import find_disk_frequency, margins
from .margin_slopes import MarginSlope, margin_slopes
from .margins_found import GainCrossover, Margins, PhaseCrossover
from .measured_margins import Interval, MeasuredMargins, measured_margins, read_frequency_data
from .number import MARK, Confirmation, Number, method_of
from .nyquist import NyquistCount, nyquist_count
from .periodic_margins import PeriodicMargins, periodic_margins
from .pole_placement import SampledDesign, place, sampled_gains, sampled_poles
from .polynomials import relative_difference
from .python_control import Comparison, compare_margins, compare_with_control
from .realization import Realization
from .sensitivities import GangOfFour, complementary, delayed_hold, delayed_hold_margin, gang_of_four, sensitivity
from .sign_changes import refine_sign_change
from .state_space import read_matrices
from .ties import first_largest, order_key

if TYPE_CHECKING:
    from .loop_transfer import LoopTransfer as LoopTransfer

__all__ = [
    "MARK",
    "Comparison",
    "Confirmation",
    "DiskMargin",
    "GainCrossover",
    "GangOfFour",
    "Interval",
    "MarginSlope",
    "Margins",
    "MeasuredMargins",
    "Number",
    "NyquistCount",
    "PeriodicMargins",
    "PhaseCrossover",
    "Realization",
    "SampledDesign",
    "compare_margins",
    "compare_with_control",
    "complementary",
    "delayed_hold",
    "delayed_hold_margin",
    "disk_margin",
    "find_disk_frequency",
    "find_hidden_unstable",
    "first_largest",
    "gang_of_four",
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
    "place",
    "read_frequency_data",
    "read_matrices",
    "refine_sign_change",
    "relative_difference",
    "sampled_gains",
    "sampled_poles",
    "sensitivity",
    "with_findings",
]
