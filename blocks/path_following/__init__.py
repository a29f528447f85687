"""Blocks of the paper: transverse coordinates, compliance, environments and planar models."""

from .compliance import AdmittanceFilter, ErrorDynamics
from .environment import HandForce, PathSpring
from .planar_model import PlanarModel
from .planar_slopes import PlanarSlopes, planar_slopes
from .transverse import (
    FeedbackLinearization,
    ForceProjection,
    PathProjection,
    PathTracking,
    TransverseTransform,
    expect_model,
    expect_path,
)

__all__ = [
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
    "expect_model",
    "expect_path",
    "planar_slopes",
]
