"""Blocks of the paper: transverse coordinates, compliance, environments and planar models."""

from .compliance import AdmittanceFilter, ErrorDynamics
from .environment import HandForce, PathSpring
from .feedback_linearization import FeedbackLinearization
from .planar_model import PlanarModel, PlanarSlopes, planar_slopes
from .transverse import (
    A_MODEL,
    A_PATH,
    ForceProjection,
    PathProjection,
    PathTracking,
    TransverseTransform,
)

__all__ = [
    "A_MODEL",
    "A_PATH",
    "AdmittanceFilter",
    "ErrorDynamics",
    "FeedbackLinearization",
    "ForceProjection",
    "HandForce",
    "PathProjection",
    "PathSpring",
    "PathTracking",
    "PlanarModel",
    "PlanarSlopes",
    "TransverseTransform",
    "planar_slopes",
]
