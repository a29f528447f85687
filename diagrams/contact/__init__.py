"""Contact of an environment with a plant: the admittance that it feels, and coupled stability."""

from .admittance import ContactAdmittance, compute_admittance
from .confirmed_limits import ContactConfirmation, ContactTrial, TrialMethod, try_limit
from .contact import SIDES, Contact, find_sign, make_contact
from .contact_loop import close_loop, controller_rows, join_environment
from .contact_ports import PortNames
from .coupled_parts import ContactParts
from .environment import check_properties, check_property
from .held_signals import StateMatrices
from .measured_force import Tool
from .passivity import LOWEST, Passivity
from .port_passivity import PassivityReason, PortPassivity
from .stability_limits import (
    PER_DECADE,
    ContactLimit,
    ContactMap,
    find_limit,
    find_poles,
    scan_points,
    to_rates,
)

__all__ = [
    "LOWEST",
    "PER_DECADE",
    "SIDES",
    "Contact",
    "ContactAdmittance",
    "ContactConfirmation",
    "ContactLimit",
    "ContactMap",
    "ContactParts",
    "ContactTrial",
    "Passivity",
    "PassivityReason",
    "PortNames",
    "PortPassivity",
    "StateMatrices",
    "Tool",
    "TrialMethod",
    "check_properties",
    "check_property",
    "close_loop",
    "compute_admittance",
    "controller_rows",
    "find_limit",
    "find_poles",
    "find_sign",
    "join_environment",
    "make_contact",
    "scan_points",
    "to_rates",
    "try_limit",
]
