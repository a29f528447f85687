"""Blocks of the paper: transverse coordinates, compliance, environments and planar models."""

from .compliance import AdmittanceFilter, ErrorDynamics
from .environment import HandForce, PathSpring
from .planar_model import PlanarModel
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
    "TransverseTransform",
    "expect_model",
    "expect_path",
]
