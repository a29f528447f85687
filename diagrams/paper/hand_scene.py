"""Experiment C by hand: a pointer that pulls the tool by a spring, and the gantry as a picture in a page."""

from __future__ import annotations

from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks import Constant, Path
from ...blocks.core import Array, Block, Input, Output, parameter

if TYPE_CHECKING:
    from ..web_page import Scene

HAND_STIFFNESS, HAND_LIMIT = 60.0, 8.0
"""Stiffness in N/m of the spring between the hand and the tool, and the largest force of the hand in N."""
TABLE_III = {
    "admittance_par.mass": (0.1, 2.0),
    "admittance_par.damping": (0.5, 20.0),
    "admittance_par.stiffness": (0.0, 50.0),
    "admittance_perp.mass": (0.5, 8.0),
    "admittance_perp.damping_ratio": (0.1, 1.5),
    "admittance_perp.stiffness": (150.0, 2000.0),
    "hand.stiffness": (10.0, 200.0),
}
"""Sliders with their ranges: the impedances of Table III, and the hand's."""
HEADINGS = {
    **{name: "Along the path" for name in TABLE_III if name.startswith("admittance_par")},
    **{name: "Across the path" for name in TABLE_III if name.startswith("admittance_perp")},
    "hand.stiffness": "The hand",
}
LABELS = {
    "admittance_par.mass": "mass m∥",
    "admittance_par.damping": "damping d∥",
    "admittance_par.stiffness": "stiffness k∥",
    "admittance_perp.mass": "mass m⊥",
    "admittance_perp.damping_ratio": "damping ratio ζ⊥",
    "admittance_perp.stiffness": "stiffness k⊥",
    "hand.stiffness": "spring stiffness",
    "xi[1]": "ξ, across the path",
    "xi_p[1]": "ξ of the admittance",
    "eta[1]": "η, along the path",
    "force_projection.f_par": "F∥ along",
    "force_projection.f_perp": "F⊥ across",
    "motor_force[1]": "motor y",
    "motor_force[2]": "motor z",
}
PLOTS = (
    ("xi[1]", "xi_p[1]"),
    ("eta[1]",),
    ("force_projection.f_par", "force_projection.f_perp"),
    ("motor_force",),
)
ABOUT = (
    "A hand guides the gantry (Flixeder, Glück, Böck and Kugi 2014, experiment C). Press on the picture and pull: the "
    "tool yields along its path like a damped mass, and resists across it like a spring."
)
_POINTS = 720


class PointerPull(Block):
    """Hand that pulls the tool by a spring: F = g k (r − y), at most the largest force, with the hand at r."""

    stiffness: float = parameter(default=HAND_STIFFNESS, unit="N/m", above=0.0, description="of the spring")
    largest: float = parameter(default=HAND_LIMIT, unit="N", above=0.0, description="largest force of the hand")
    position = Input(shape=(2,), unit="m", description="position of the tool")
    hand = Input(shape=(2,), unit="m", description="position of the hand")
    grip = Input(description="1 while the hand holds the tool, else 0")
    force = Output(shape=(2,), unit="N", description="force on the tool")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the force in the plane."""
        pull = self.stiffness * (u.hand - u.position)
        size = np.sqrt(pull @ pull + 1e-12)
        return u.grip * pull * np.minimum(1.0, self.largest / size)


def pull_by_hand(position: Any, place: Any) -> Any:
    """Return the force of the hand on the tool; ``place`` is where it is at first, in m."""
    hand = Constant(value=place, unit="m", name="hand_position")
    grip = Constant(value=0.0, name="hand_grip")
    return PointerPull(name="hand")(position=position, hand=hand, grip=grip)


def gantry_scene(path: Path) -> Scene:
    """Return the gantry from above, with its path, as a picture that answers to the pointer."""
    from ..web_page import Scene

    first, last = path.domain if path.period is None else (0.0, path.period)  # type: ignore[misc]
    theta = np.linspace(first, last, _POINTS + 1)
    frames = [path.frame(one) for one in theta]
    data = {
        "axes": ["position[1]", "position[2]"],
        "limit": HAND_LIMIT,
        "path": {
            "size": _POINTS,
            "span": [float(first), float(last)],
            "closed": path.closed,
            **{
                name: [[round(float(v), 6) for v in getattr(frame, name)] for frame in frames]
                for name in ("sigma", "tangent", "normal")
            },
        },
    }
    place, grip = ("hand_position", ["value"]), ("hand_grip", ["value"])
    return Scene(
        script=files(__package__).joinpath("hand_page", "gantry.js").read_text(encoding="utf-8"),
        data=data,
        moved={"hand_y": (place, 0), "hand_z": (place, 1), "grip": (grip, 0)},
        signals=("position", "theta", "hand.force", "xi", "hand_position", "hand_grip"),
    )
