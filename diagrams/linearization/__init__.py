"""Linear models, operating points and trim.

Slopes come from these places. They meet in `LocalDerivatives` (an instant), in `Chain` (ticks, one after the other),
and in `model_at`, which makes the linear models:

- equations of blocks: CasADi's derivatives of the diagram's functions (`derivatives`); those of one block
  (`block_slopes`), with its kinks (`kinks`) and the mean slopes of its stairs (`mean_stairs`);
- FMUs in model exchange: the evaluators of those functions (`exchanged`);
- FMUs that step: their equations, differences of their steps, or models identified from responses (`plant_models`,
  `identification`), by `fmus.fmu_block`; with a coupling that acts within a step `coupled_chain`;
- transport delays: channels around a continuous model (`flow_model`), signals of the past in a sampled one
  (`delayed_flow`);
- parameters: slopes that travel with every number (`derivatives_along`); of start values of FMUs differences of whole
  models (`parameter_slopes`).
"""

from .block_slopes import linearize_block
from .derivatives import moves_between_ticks
from .free_motions import FreeMotion, FreeMotions
from .inserted_blocks import carry_point, cut_to, find_inputs, name_of_cut, name_wire_to, with_passed_values
from .kinks import find_kinks_between
from .left_out_effects import (
    ApproximateDelay,
    BlockFinding,
    CoarseValues,
    CutFromTracking,
    EntryTaken,
    InertConsumer,
    InexactDerivatives,
    Kink,
    MeanSlope,
    ParallelWays,
    RefutedDerivatives,
    SharedCut,
    StepsOnly,
    UnusualStart,
    ZeroSlope,
)
from .linear_model import (
    Linearization,
    find_flow_poles,
    linearize,
    linearize_batch,
    linearize_within,
)
from .operating_points import (
    RUN_OPTIONS,
    PointLike,
    capture,
    check_options,
    copy_point,
    hold_sources,
    operating_point,
    refine_ticks,
    run_to,
)
from .over_a_period import TickModel, model_ticks
from .parameter_slopes import LoopSlope, PointFinder, differentiate_loop, loop_of_variant, rational_loop
from .plant_models import EQUILIBRIUM, PlantEquations, linearize_plant
from .shared_wires import find_ways_back
from .signal_paths import SignalPaths
from .taps import Tap, find_signal, wire_entries
from .trim_search import point_from_states, trim
from .wire_renewals import ticks_between_renewals, ticks_to_renewal

__all__ = [
    "EQUILIBRIUM",
    "RUN_OPTIONS",
    "ApproximateDelay",
    "BlockFinding",
    "CoarseValues",
    "CutFromTracking",
    "EntryTaken",
    "FreeMotion",
    "FreeMotions",
    "InertConsumer",
    "InexactDerivatives",
    "Kink",
    "Linearization",
    "LoopSlope",
    "MeanSlope",
    "ParallelWays",
    "PlantEquations",
    "PointFinder",
    "PointLike",
    "RefutedDerivatives",
    "SharedCut",
    "SignalPaths",
    "StepsOnly",
    "Tap",
    "TickModel",
    "UnusualStart",
    "ZeroSlope",
    "capture",
    "carry_point",
    "check_options",
    "copy_point",
    "cut_to",
    "differentiate_loop",
    "find_flow_poles",
    "find_inputs",
    "find_kinks_between",
    "find_signal",
    "find_ways_back",
    "hold_sources",
    "linearize",
    "linearize_batch",
    "linearize_block",
    "linearize_plant",
    "linearize_within",
    "loop_of_variant",
    "model_ticks",
    "moves_between_ticks",
    "name_of_cut",
    "name_wire_to",
    "operating_point",
    "point_from_states",
    "rational_loop",
    "refine_ticks",
    "run_to",
    "ticks_between_renewals",
    "ticks_to_renewal",
    "trim",
    "wire_entries",
    "with_passed_values",
]
