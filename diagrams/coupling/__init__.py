"""Plants of a run: loaded, stepped between their communication points, and coupled with one another."""

from .connection_delays import CouplingReport, HeldFrom, LinkKind, report_coupling
from .coupled_steps import CoupledSteps, passes_slopes
from .coupling_options import Coupling, Scheme, refuse_model_exchange, to_coupling
from .fixed_points import find_fixed_point
from .links import Links, note_loops
from .plant_steps import PlantSteps, end_all, runs_apart, step_all
from .plants import Plant, bind, load_plants, note_steps
from .rollback import accept_steps, try_steps

__all__ = [
    "CoupledSteps",
    "Coupling",
    "CouplingReport",
    "HeldFrom",
    "LinkKind",
    "Links",
    "Plant",
    "PlantSteps",
    "Scheme",
    "accept_steps",
    "bind",
    "end_all",
    "find_fixed_point",
    "load_plants",
    "note_loops",
    "note_steps",
    "passes_slopes",
    "refuse_model_exchange",
    "report_coupling",
    "runs_apart",
    "step_all",
    "to_coupling",
    "try_steps",
]
