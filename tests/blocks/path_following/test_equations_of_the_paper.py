"""Each equation of the paper stands in the docstring of the block that makes it so, beside its number."""

import pytest

from loopwright.blocks import (
    AdmittanceFilter,
    Ellipse,
    ErrorDynamics,
    FeedbackLinearization,
    ForceProjection,
    PathProjection,
    PathTracking,
    PlanarModel,
    TransverseTransform,
)
from loopwright.fmus import gantry

EQUATIONS = {
    1: (PlanarModel, "ẋ_v = f_v(x_c, x_v) + G_v(x_c)(u + dhᵀ F)"),
    2: (type(gantry.nominal).f_v, "f_v = −(F_F + F_G) / M"),
    3: (PlanarModel, "y = h(x_c)"),
    4: (PathProjection, "θ̂ = arg min ‖y − σ̂(θ̂)‖"),
    5: (TransverseTransform, "η₁ = ∫₀^θ̂ ‖σ̂′(τ)‖ dτ"),
    6: (PathTracking, "(y − σ̂(θ̂))ᵀ σ̂′(θ̂) = 0"),
    7: (TransverseTransform, "η₂ = tᵀẏ / q; ξ₁ = nᵀ(y − σ); ξ₂ = nᵀẏ"),
    8: (FeedbackLinearization, "ỹ = (ξ₁, η₁)"),
    9: (FeedbackLinearization, "ỹ¨ = b + D_u (u + dhᵀF)"),
    10: (FeedbackLinearization, "u = (dh G_v)⁻¹ {"),
    11: (FeedbackLinearization, "η̈₁ = v∥ and ξ̈₁ = v⊥"),
    12: (ErrorDynamics, "v = r̈ − a₂ ė − a₁ e − a₀ ∫e dt"),
    13: (ForceProjection, "F∥ = tᵀF, F⊥ = nᵀF"),
    14: (AdmittanceFilter, "m ë + d ė + k e = F − F^d"),
    15: (AdmittanceFilter, "r̈^p = r̈^d + (F − F^d − d ė − k e)/m"),
    16: (Ellipse, "σ(θ) = c + (a cos θ, ± b sin θ)"),
}


def test_no_equation_of_the_paper_is_left_out():
    assert sorted(EQUATIONS) == list(range(1, 17))


@pytest.mark.parametrize("number", EQUATIONS)
def test_who_makes_an_equation_carries_it_and_its_number(number):
    carrier, equation = EQUATIONS[number]
    text = vars(carrier)["__doc__"] if isinstance(carrier, type) else carrier.__doc__  # its own, no inherited one
    assert equation in " ".join(text.split())
    assert f"({number})" in text
