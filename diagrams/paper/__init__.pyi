from . import experiments
from .compliance_loop import AdmittanceLoop
from .coupled_stability import (
    StabilityLimit,
    StabilityMap,
    crossing_frequency,
    growth_rate,
    poles,
    rule_of_thumb,
    stability_limit,
    stability_map,
    stiffness_limits,
)
from .experiment_figures import plot_experiment, plot_path
from .experiment_numbers import DEFINITIONS, Theory, key_numbers, theory_numbers
from .experiments import DEFAULTS, EXPERIMENTS, Experiment
from .fig3_diagram import Fig3Diagram, fig3
from .fig3_wires import Channel, Rig
from .rendered import (
    passivity,
    rendered_admittance,
    rendered_response,
    rendered_system,
    target_admittance,
)

__all__ = [
    "DEFAULTS",
    "DEFINITIONS",
    "EXPERIMENTS",
    "AdmittanceLoop",
    "Channel",
    "Experiment",
    "Fig3Diagram",
    "Rig",
    "StabilityLimit",
    "StabilityMap",
    "Theory",
    "crossing_frequency",
    "experiments",
    "fig3",
    "growth_rate",
    "key_numbers",
    "passivity",
    "plot_experiment",
    "plot_path",
    "poles",
    "rendered_admittance",
    "rendered_response",
    "rendered_system",
    "rule_of_thumb",
    "stability_limit",
    "stability_map",
    "stiffness_limits",
    "target_admittance",
    "theory_numbers",
]
