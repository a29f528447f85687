"""What the numbers of a report mean, by the last part of their paths that is known here."""

from __future__ import annotations

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
        "ke_limit": "The first environment stiffness, on a scan from below, at which contact is no longer stable.",
        "me_limit": "The first environment mass, on a scan from below, at which contact is no longer stable.",
        "be_limit": "The first environment damping, on a scan from below, at which contact is no longer stable.",
        "tool_mass_limit": "The first mass beyond the force sensor, from below, at which the loop is no longer stable.",
        "force_tracking": "The admittance without stiffness (k = 0), which tracks a desired force.",
        "rule_of_thumb": "(d + b_e)/T_d with T_d half a sample, plus a sample for each sample of delay.",
        "first_non_passive": "The lowest frequency at which Re Y(jω) < 0. Re Y ≥ 0 does not prove passivity.",
        "residual": "What is left of the equations at the operating point.",
        "spectral_radius": "The largest magnitude of the closed-loop poles of a sampled loop.",
        "growth_rate": "σ of the fastest closed-loop pole: what is not at rest grows with e^(σt).",
        "deviation": "The largest relative deviation between two computations of the same response.",
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
    for part in reversed(path.split(".")):
        for known in (more, DEFINITIONS):
            if part in known:
                return part, known[part]
    return None
