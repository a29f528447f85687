"""Fig. 3 of the paper, its experiments, and their parts of the report."""

from .experiment_numbers import DEFINITIONS, key_numbers
from .experiments import DEFAULTS, EXPERIMENTS, Experiment
from .fig3_diagram import Fig3Diagram, fig3
from .figures import plot_experiment, plot_path
from .wires import Channel, Rig

__all__ = [
    "DEFAULTS",
    "DEFINITIONS",
    "EXPERIMENTS",
    "Channel",
    "Experiment",
    "Fig3Diagram",
    "Rig",
    "fig3",
    "key_numbers",
    "plot_experiment",
    "plot_path",
]
