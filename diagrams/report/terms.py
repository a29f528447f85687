"""What the numbers of an analysis mean, by the parts of their paths."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

DEFINITIONS: Mapping[str, str] = MappingProxyType(
    {
        "sample_time": "Time between two ticks of a subsystem.",
        "affine": "Largest change of a state of the linear model at the operating point itself, per period or second.",
        "residual": "Largest change of a state over a tick, of a continuous one, an FMU's too, in a second, over 1 + "
        "its size.",
        "slowest": "Largest real part of the poles, s = log(z)/T where sampled.",
        "polynomial_difference": "Largest difference of coefficients of two polynomials, scaled, over the largest.",
        "polynomial_spread": "The same difference, largest over the path points and offsets.",
        "coupling": "Largest response from a virtual input to the other direction's coordinate, relative to its own.",
        "from_matched": "The same difference, from the closed loop with matched parameters.",
        "mean": "Mean of the three poles, −a₂/3.",
        "gain_a0": "Gain of the integral that puts the sampled poles where they were asked.",
        "gain_a1": "Gain of the error that puts the sampled poles where they were asked.",
        "gain_a2": "Gain of the rate error that puts the sampled poles where they were asked.",
        "stable": "1 if all closed-loop poles of the loop are stable, else 0.",
        "encirclements": "Clockwise encirclements of −1 by L: closed-loop minus open-loop unstable poles.",
        "control": "python-control's own value of the same number.",
        "gain_low": "Smallest factor in all channels at once within the disk.",
        "gain_high": "Largest factor in all channels at once within the disk.",
        "phase_deg": "Largest rotation in all channels at once within the disk.",
        "ke_frequency": "Frequency at which the coupled loop oscillates at the limit of stiffness.",
        "ke_limit": "First stiffness of the environment at which contact is no longer stable; none up to 1e8 N/m: ∞. "
        "Of the design without friction, where the plant has some that its parameters take out.",
        "ke_limit_friction": "The same with the slope that the friction has at rest, and with its compensation: of the "
        "diagram as it is, as stiffness_limits(AdmittanceLoop.of(diagram)) returns it.",
        "me_limit": "First mass of the environment, from below up to 1e4 kg, at which contact is no longer stable.",
        "me_limit_friction": "The same with the slope that the friction has at rest, and with its compensation.",
        "tool_mass_limit_friction": "The same with the slope that the friction has at rest, and with its compensation.",
        "rule_of_thumb_friction": "(d + b_e)/T_d, which knows no friction.",
        "first_non_passive": "Lowest frequency at which Re Y(jω) < 0; Re Y ≥ 0 does not prove passivity.",
        "growth_rate": "σ of exp(σ t), measured in the co-simulation.",
        "deviation": "Largest relative deviation of the measured L from the linear model's.",
        "uncertainty": "Estimated relative error of the measured L.",
    }
)
"""By the last part of a path that stands here."""
