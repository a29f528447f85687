"""Plants of a run: loaded, stepped between their communication points, and coupled with one another."""

from .plant_steps import PlantSteps
from .plants import Plant, load_plants, note_fine_steps

__all__ = [
    "Plant",
    "PlantSteps",
    "load_plants",
    "note_fine_steps",
]
