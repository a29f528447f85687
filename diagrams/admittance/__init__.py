"""Admittance that an environment feels, and coupled stability."""

from .compliance_loop import SIDES, AdmittanceLoop, control_rate
from .contact import Contact, make_contact
from .contact_admittance import ContactAdmittance
from .contact_confirmation import ContactConfirmation, ContactTrial, try_limit
from .contact_limits import ContactLimit, ContactMap
from .contact_ports import PortNames
from .contact_trials import TrialMethod
from .coupled import crossing_frequency, growth_rate, poles
from .moored_plant import hold_sources
from .port_passivity import PassivityReason, PortPassivity
from .rendered import Passivity, passivity, rendered_admittance, rendered_response, rendered_system, target_admittance
from .shown_plant import check_plant, is_discrete
from .stability_limits import (
    StabilityLimit,
    StabilityMap,
    rule_of_thumb,
    stability_limit,
    stability_map,
    stiffness_limits,
)

__all__ = [
    "SIDES",
    "AdmittanceLoop",
    "Contact",
    "ContactAdmittance",
    "ContactConfirmation",
    "ContactLimit",
    "ContactMap",
    "ContactTrial",
    "Passivity",
    "PassivityReason",
    "PortNames",
    "PortPassivity",
    "StabilityLimit",
    "StabilityMap",
    "TrialMethod",
    "check_plant",
    "control_rate",
    "crossing_frequency",
    "growth_rate",
    "hold_sources",
    "is_discrete",
    "make_contact",
    "passivity",
    "poles",
    "rendered_admittance",
    "rendered_response",
    "rendered_system",
    "rule_of_thumb",
    "stability_limit",
    "stability_map",
    "stiffness_limits",
    "target_admittance",
    "try_limit",
]
