"""What the numbers of a report mean, by the last part of their paths that is known here."""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType

LOOP = (
    "L is the loop that is cut behind the named wire, L = −(returned)/(injected), with all other loops closed and the "
    "operating point left as it is; S = 1/(1 + L) and T = L/(1 + L)."
)
"""What the definitions of `LOOP_TERMS` take for granted."""
LOOP_TERMS = frozenset({"phase_margin_deg", "gain_margin_low", "gain_margin_high", "delay_margin_s", "ms", "mt"})

DEFINITIONS: Mapping[str, str] = MappingProxyType(
    {
        "phase_margin_deg": "The smallest rotation of L, to either side, that ends stability.",
        "gain_margin_low": "The largest factor below 1 on L that ends stability; 0 where none does.",
        "gain_margin_high": "The smallest factor above 1 on L that ends stability; infinite where none does.",
        "delay_margin_s": "The smallest delay τ in series with L, e^(−jωτ), that ends stability.",
        "delay_margin_samples": "The delay margin in sample times.",
        "modulus_margin": "The smallest distance of L(jω) to −1, which is 1/M_s.",
        "disk_margin": "α of the symmetric disk, 1/max|(S − T)/2|: gain and phase may vary together within it.",
        "ms": "M_s = max|S|, the peak of the sensitivity.",
        "mt": "M_t = max|T|, the peak of the complementary sensitivity.",
        "ms_frequency": "The frequency of M_s.",
        "mt_frequency": "The frequency of M_t.",
        "bandwidth": "The lowest frequency at which |T| falls below 1/√2 of its value at low frequency.",
        "gain_crossover": "A frequency at which |L| = 1.",
        "phase_crossover": "A frequency at which L is real and negative.",
        "ke_limit": "The first environment stiffness, on a scan from below, at which contact is no longer stable; of "
        "the design without friction, where the plant has some that its parameters take out.",
        "ke_limit_friction": "The same limit of the diagram as it is, with its friction and the compensation, as "
        "stiffness_limits(AdmittanceLoop.of(diagram)) returns it.",
        "me_limit": "The first environment mass, on a scan from below, at which contact is no longer stable.",
        "be_limit": "The first environment damping, on a scan from below, at which contact is no longer stable.",
        "tool_mass_limit": "The first mass beyond the force sensor, from below, at which the loop is no longer stable.",
        "force_tracking": "The admittance without stiffness (k = 0), which tracks a desired force.",
        "rule_of_thumb": "(d + b_e)/T_d with T_d half a sample, plus a sample for each sample of delay.",
        "first_non_passive": "The lowest frequency at which Re Y(jω) < 0. Re Y ≥ 0 does not prove passivity.",
        "residual": "The largest change of a state over the next tick, and of a continuous one in a second, at the "
        "operating point, relative to 1 + its size; 0 at rest.",
        "affine": "The largest entry of the linear model's constant term: 0 at an equilibrium.",
        "t": "The time of the operating point.",
        "spectral_radius": "The largest magnitude of the closed-loop poles of a sampled loop.",
        "growth_rate": "σ of the fastest closed-loop pole: what is not at rest grows with e^(σt).",
        "deviation": "The largest relative deviation between two computations of the same response.",
        "frequency": "The frequency of what stands ahead of it in the path.",
        "gain_margin": "The factor on L with which the closed loop has a pole at this crossing.",
        "encirclements": "Clockwise encirclements of −1 by L: unstable poles, closed loop minus open loop.",
        "stable": "1 where all closed-loop poles are stable, hidden modes aside, else 0.",
        "gain_low": "Down to this factor the gains of all channels may fall at once, within the disk.",
        "gain_high": "Up to this factor the gains of all channels may rise at once, within the disk.",
        "phase_deg": "By this much the phases of all channels may turn at once, to either side, within the disk.",
        "slowest": "The largest real part of the closed-loop poles, s = log(z)/T where sampled; the memory of "
        "projections aside.",
        "coupling": "The largest gain, over frequency, from one direction's virtual input to the other direction's "
        "coordinate, relative to that to its own.",
        "polynomial_spread": "The largest difference between the closed loop's characteristic polynomials at points "
        "along and beside the path, each coefficient relative to the size of the poles.",
        "from_matched": "The same difference from the polynomial with matched parameters.",
        "polynomial_difference": "The largest difference of a coefficient of the characteristic polynomial from what "
        "was asked, time scaled by the size of the poles.",
        "mean": "The mean of the poles, which scatter less together than each by itself.",
        "pole": "A closed-loop pole of the error dynamics, s = log(z)/T where sampled; real and imaginary part.",
        "gain": "The gain of the error dynamics that puts the sampled poles where they were asked.",
        "target": "A parameter of the admittance that is asked for.",
        "ke_frequency": "The frequency at which the loop oscillates at the limit of the environment's stiffness.",
        "me_frequency": "The frequency at which the loop oscillates at the limit of the environment's mass.",
        "be_frequency": "The frequency at which the loop oscillates at the limit of the environment's damping.",
        "tool_mass_frequency": "The frequency at which the loop oscillates at the limit of the tool's mass.",
        "subject": "A parameter of the block that its path names.",
        "control": "python-control's own value of the same number.",
    }
)


def definition(path: str, more: Mapping[str, str] = MappingProxyType({})) -> tuple[str, str] | None:
    """Return the term that defines a number, and its definition; None where none is known.

    Parameters
    ----------
    path : str
        Dotted path of the number.
    more : mapping, optional
        Further definitions, which come first.
    """
    parts = path.split(".")
    if parts[0] == "subject" and parts[-1] != "sample_time":  # boxes, blocks and parameters have names of their own
        parts = ["subject"]
    elif parts[0] == "inner" and parts[3:4] == ["control"]:  # inner.WIRE.VARIANT.control.NUMBER
        parts = ["control"]
    elif parts[0] in ("inner", "injection"):
        del parts[1:2]  # the wire's name
    for part in reversed(parts):
        bare = re.sub(r"^(pole|gain)_[a-z]?\d.*|_friction$|_\d+$", r"\1", part)
        for name in (part, bare):
            for known in (more, DEFINITIONS):
                if name in known:
                    return name, known[name]
    return None
