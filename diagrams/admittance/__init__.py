"""Admittance that an environment feels, and coupled stability."""

from .contact import SIDES, Contact, find_sign, make_contact
from .contact_admittance import ContactAdmittance, compute_admittance
from .contact_confirmation import ContactConfirmation, ContactTrial, try_limit
from .contact_limits import ContactLimit, ContactMap, find_limit, find_poles, to_rates
from .contact_loop import check_environment, close_loop, controller_rows, hold_inputs, join_environment
from .contact_parts import restrict
from .contact_ports import PortNames
from .contact_trials import TrialMethod
from .growth_limits import PER_DECADE, UNITS, GrowthMap, describe_limit, scan_points
from .moored_plant import hold_sources
from .passivity import LOWEST, Passivity
from .port_passivity import PassivityReason, PortPassivity
from .sensed_tool import Tool

__all__ = [
    "LOWEST",
    "PER_DECADE",
    "SIDES",
    "UNITS",
    "Contact",
    "ContactAdmittance",
    "ContactConfirmation",
    "ContactLimit",
    "ContactMap",
    "ContactTrial",
    "GrowthMap",
    "Passivity",
    "PassivityReason",
    "PortNames",
    "PortPassivity",
    "Tool",
    "TrialMethod",
    "check_environment",
    "close_loop",
    "compute_admittance",
    "controller_rows",
    "describe_limit",
    "find_limit",
    "find_poles",
    "find_sign",
    "hold_inputs",
    "hold_sources",
    "join_environment",
    "make_contact",
    "restrict",
    "scan_points",
    "to_rates",
    "try_limit",
]
