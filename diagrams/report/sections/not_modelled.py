"""The section on effects that the numbers of a report leave out."""

from __future__ import annotations

from ....blocks import AdmittanceFilter, Backlash, DeadZone, Encoder, Quantizer, RateLimiter, Relay, Saturation
from ...linearization import MeanSlope
from ..case import Case
from ..pages import Section, Texts

TEXTS = Texts(__package__, "limits")
LIMITS_TITLE = "What is not modelled"
NOT_SMOOTH = (Saturation, Encoder, Quantizer, DeadZone, Relay, Backlash, RateLimiter)
"""Blocks that a linear model knows by their slope only."""


def not_modelled(case: Case) -> Section:
    """Return the section on effects that the numbers of a report leave out."""
    text = [TEXTS.line("small_motions")]
    for v in case.usable():
        text += [f"{v.title}: {finding}" for finding in v.model.findings]
    means = {f.block for v in case.usable() for f in v.model.findings if isinstance(f, MeanSlope)}
    for path, block in sorted(case.diagram.blocks.items()):
        if isinstance(block, NOT_SMOOTH) and path not in means:
            text.append(TEXTS.line("slope", block=path, kind=type(block).__name__))
        if isinstance(block, AdmittanceFilter) and block.has_limits:
            text.append(TEXTS.line("reference_limits", block=path))
        elif getattr(block, "has_limits", False):
            text.append(TEXTS.line("limits", block=path))
    if any(v.implementation.delay for v in case.usable()):
        text.append(TEXTS.line("delay"))
    for v in case.usable():
        if v.model.uncertainty:
            text.append(TEXTS.line("differenced", variant=v.title, uncertainty=v.model.uncertainty))
    return Section("limits", LIMITS_TITLE, tuple(dict.fromkeys(text)))
