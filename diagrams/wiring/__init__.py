"""Structure of a diagram: blocks, wires, subsystems, checks and the order of evaluation."""

from .check import Checked
from .checked_diagram import CheckedDiagram, find_parameter
from .collector import Collector
from .cycles import find_cyclic_parts
from .entry_names import index_of, split_entry
from .entry_order import OrderStep
from .order import Order, find_orders
from .parameter_names import find_place, split_path
from .structure import Structure, SubsystemSettings, Wire, join, stepped_blocks
from .subsystems import Subsystem, exact_time, subsystem
from .variants import change_parameter, change_parameters

__all__ = [
    "Checked",
    "CheckedDiagram",
    "Collector",
    "Order",
    "OrderStep",
    "Structure",
    "Subsystem",
    "SubsystemSettings",
    "Wire",
    "change_parameter",
    "change_parameters",
    "exact_time",
    "find_cyclic_parts",
    "find_orders",
    "find_parameter",
    "find_place",
    "index_of",
    "join",
    "split_entry",
    "split_path",
    "stepped_blocks",
    "subsystem",
]
