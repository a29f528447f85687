"""Structure of a diagram: blocks, wires, subsystems, checks and the order of evaluation."""

from .buses import Bus
from .check import Checked, check
from .collector import Collector
from .delay_blocks import add_delay_blocks
from .evaluation_order import Order, OrderStep, find_cyclic_parts, find_orders
from .first_order_hold import first_order_hold
from .parameter_names import find_control, find_name, find_path, find_place, index_of, split_entry, split_path
from .structure import Structure, Wire, explain_absent_state, join, sheet_of_structure, stepped_blocks
from .subsystem_settings import SubsystemSettings, SubsystemTable, exact_time
from .subsystems import Subsystem, SubsystemCall, subsystem
from .variants import apply_changes, change_parameter, change_parameters
from .wire_units import add_unit_conversions

__all__ = [
    "Bus",
    "Checked",
    "Collector",
    "Order",
    "OrderStep",
    "Structure",
    "Subsystem",
    "SubsystemCall",
    "SubsystemSettings",
    "SubsystemTable",
    "Wire",
    "add_delay_blocks",
    "add_unit_conversions",
    "apply_changes",
    "change_parameter",
    "change_parameters",
    "check",
    "exact_time",
    "explain_absent_state",
    "find_control",
    "find_cyclic_parts",
    "find_name",
    "find_orders",
    "find_path",
    "find_place",
    "first_order_hold",
    "index_of",
    "join",
    "sheet_of_structure",
    "split_entry",
    "split_path",
    "stepped_blocks",
    "subsystem",
]
