"""A diagram as it is wired: one value, checked and ordered, with its variants and its functions."""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Mapping
from dataclasses import fields
from dataclasses import replace as replace_fields
from fractions import Fraction
from typing import Any, Protocol

from ...blocks.core import Block, LoopwrightError, SampleTimeError, check_argument, identity, kinds, without_collection
from ...blocks.tracing import check_method, is_only_sampled
from ..wiring import (
    Checked,
    Order,
    Structure,
    SubsystemSettings,
    Wire,
    add_delay_blocks,
    add_unit_conversions,
    apply_changes,
    check,
    exact_time,
    find_name,
    find_orders,
    find_path,
    stepped_blocks,
)
from .flat_diagram import FlatDiagram
from .flatten import flatten, renumber
from .plant_ticks import own_step

VARIANTS = 8
"""Variants with their own functions that a diagram remembers, as long as they are in use."""
OF_A_RUN = frozenset({"start"})
"""Parameters of a stepped block that a run gives to it, and that no function of the diagram has in it."""
_STRUCTURE = tuple(f.name for f in fields(Structure) if f.name != "blocks")


class HasBase(Protocol):
    """Anything that says where the ticks are: an operating point, which belongs to a sub-package above this one."""

    @property
    def base(self) -> Fraction:
        """Seconds between two ticks."""

    @property
    def asked(self) -> bool:
        """Whether ``base`` was asked for, as a ``step``."""


class WiredDiagram:
    """Blocks and wires, checked and ordered: what functions below the facade take and return as a diagram.

    Parameters
    ----------
    name : str
        Name of the diagram.
    structure : Structure
        Blocks, wires and subsystems as they were wired.
    loops : str
        Whether algebraic loops are an error, or solved.
    facade_class : type
        Class that users hold it as: `Diagram`, or one derived from it.

    Attributes
    ----------
    scheduled : Structure
        The structure that the scheduler sees: computational delays and conversions of units have become blocks.
    checked : Checked
        Traces of the scheduled blocks, and shapes and units of their ports.
    orders : tuple of Order
        Orders of evaluation of the scheduled blocks: at an instant, and of initialization.
    """

    name: str
    loops: str
    structure: Structure
    scheduled: Structure
    checked: Checked
    orders: tuple[Order, Order]
    facade_class: type[Any]
    _facade: weakref.ref[Any] | None
    _flat: dict[tuple[Fraction | None, bool], FlatDiagram]
    _origin: tuple[WiredDiagram, dict[str, Block]] | None
    _variants: list[weakref.ref[WiredDiagram]]

    @without_collection
    def __init__(self, name: str, structure: Structure, loops: str, facade_class: type[Any]):
        self.name, self.structure, self.loops, self.facade_class = name, structure, loops, facade_class
        self.scheduled = add_unit_conversions(add_delay_blocks(structure))
        self.checked = check(self.scheduled)
        self.orders = find_orders(self.scheduled, self.checked.traced, solve=loops == "solve")
        self._forget()

    def _forget(self) -> None:
        self._facade, self._flat, self._origin, self._variants = None, {}, None, []

    def __reduce__(self) -> tuple[object, ...]:
        return WiredDiagram, (self.name, self.structure, self.loops, self.facade_class)

    # --- the user's view of it ---------------------------------------------------------------------------------------

    def show_as(self, facade: Any) -> None:
        """Remember the user's own object of this diagram, as long as it is in use."""
        self._facade = weakref.ref(facade)

    @property
    def facade(self) -> Any:
        """The `Diagram` that users hold: for results that hand one out, and for functions of users."""
        found = None if self._facade is None else self._facade()
        return self.facade_class.of_wired(self) if found is None else found

    @property
    def contact_port(self) -> str | None:
        """Port at which an environment pushes unless a contact names another; known where the class is."""
        found: str | None = self.facade_class.contact_port
        return found

    # --- contents ----------------------------------------------------------------------------------------------------

    @property
    def blocks(self) -> Mapping[str, Block]:
        """Every block by its dotted path, as it was wired."""
        return self.structure.blocks

    @property
    def names(self) -> Mapping[str, Wire]:
        """Every named wire."""
        return self.structure.names

    @property
    def subsystems(self) -> Mapping[str, SubsystemSettings]:
        """Every subsystem by its dotted path; the diagram itself is ""."""
        return self.structure.subsystems

    def __getitem__(self, path: str) -> Block:
        """Return the block at a path, or at the unique end of one."""
        return self.blocks[find_path(path, self.blocks, "block", self.name)]

    @property
    def is_continuous(self) -> bool:
        """Whether the solver has work between ticks: continuous states, events, or a transport delay."""
        table = self.scheduled
        traces = self.checked.traced
        return (
            any(t.advance == "derivative" or t.indicators is not None for t in traces.values())
            or any(table.blocks[p].transport for p in table.blocks if p not in traces)
            or any(table.is_event(path) for path in table.controls)
        )

    @property
    def has_clock(self) -> bool:
        """Whether a subsystem, or the diagram itself, has a sample time."""
        return any(settings.sample_time is not None for settings in self.scheduled.subsystems.values())

    @property
    def has_fmu(self) -> bool:
        """Whether a block in it is stepped by the run, such as an FMU."""
        return bool(stepped_blocks(self.structure))

    @property
    def has_base(self) -> bool:
        """Whether the time between two ticks follows from sample times, or from communication steps of FMUs."""
        return self.has_clock or any(own_step(plant) is not None for plant in stepped_blocks(self.structure).values())

    def find_parameter(self, name: object) -> str:
        """Return the full path of a parameter; see `find_name`."""
        return find_name(self.structure, name, self.name)

    # --- variants ----------------------------------------------------------------------------------------------------

    def replace(self, changes: Mapping[str, object] | None = None, /, **more: object) -> WiredDiagram:
        """Return a variant: other blocks, parameters or sample times; see `Diagram.replace`."""
        if changes is not None:
            check_argument(changes, kinds.mapping, "changes", self.name)
        table = apply_changes(self.structure, [*(changes or {}).items(), *more.items()], self.name)
        return self.with_structure(table)

    def continuous(self) -> WiredDiagram:
        """Return the diagram with every sampled subsystem as its ideal; see `Diagram.continuous`."""
        table = self.structure.copy()
        own = [path for path in self.checked.traced if path in table.blocks]  # not those of a computational delay
        sampled = [path for path in own if table.is_sampled(table.subsystem_of[path])]
        if found := [path for path in sampled if is_only_sampled(table.blocks[path])]:
            block = table.blocks[found[0]]
            ports = f"the inputs {', '.join(block.inputs)} and the outputs {', '.join(block.outputs)}"
            others = f" So are {', '.join(found[1:])}." if found[1:] else ""
            raise SampleTimeError(
                f"continuous() takes the sample times away, and a block {type(block).__name__} is defined at samples "
                f"alone.{others} Replace it first, by a block in continuous time with {ports}: "
                f"diagram.replace({{{found[0]!r}: …}}).continuous().",
                block=found[0],
            )
        for path, settings in table.subsystems.items():
            table.subsystems[path] = replace_fields(settings, sample_time=None, offset=Fraction(0), delay=0)
        try:
            return self.with_structure(table)
        except SampleTimeError as error:
            error.message = f"continuous() takes the sample times away: {error.message}"
            raise

    def sampled(self, sample_time: float | Fraction, method: str = "exact") -> WiredDiagram:
        """Return the diagram with all its continuous blocks sampled; see `Diagram.sampled`."""
        check_method(method, self.name)
        table = self.structure.copy()
        for path, settings in sorted(table.subsystems.items()):
            if self.structure.clock(path) is None:
                table.subsystems[path] = replace_fields(settings, method=method)
        top = replace_fields(table.subsystems[""], sample_time=exact_time(sample_time, block=self.name))
        table.subsystems[""] = top
        return self.with_structure(table)

    def with_structure(self, structure: Structure, loops: str | None = None) -> WiredDiagram:
        """Return the diagram of another structure, under the same name, and with other ``loops``, where given.

        It shares the functions of this diagram, or of one that was made of it lately, where it differs from that in
        numbers alone.
        """
        found = WiredDiagram(self.name, structure, self.loops if loops is None else loops, self.facade_class)
        own = self if self._origin is None else self._origin[0]
        for origin in (own, *(other for ref in reversed(own._variants) if (other := ref()) is not None)):
            blocks = _find_other_numbers(origin, found)
            if blocks is not None:
                found._origin = (origin, blocks)
                break
        else:
            own._variants.append(weakref.ref(found))
            del own._variants[:-VARIANTS]
        return found

    def renumbered(self, blocks: Mapping[str, Block]) -> WiredDiagram:
        """Return a variant with blocks of other numbers alone, which shares the functions; nothing is checked again."""
        found = WiredDiagram.__new__(WiredDiagram)
        found.__dict__.update(self.__dict__)
        found._forget()
        found.structure, found.scheduled = self.structure.copy(), self.scheduled.copy()
        found.structure.blocks.update(blocks)
        found.scheduled.blocks.update(blocks)
        found._origin = (self, dict(blocks))
        return found

    # --- functions ---------------------------------------------------------------------------------------------------

    def flatten(self, step: float | Fraction | None = None) -> FlatDiagram:
        """Return the diagram as one CasADi function of a tick; see `Diagram.flatten`."""
        return self.flattened(None if step is None else exact_time(step, block=self.name))

    def flatten_like(self, other: HasBase) -> FlatDiagram:
        """Return the diagram with the ticks of an operating point, or of another flat diagram."""
        return self.flattened(other.base, asked=other.asked)

    def flattened(self, step: Fraction | None, *, asked: bool | None = None) -> FlatDiagram:
        """Return the diagram for an exact step in s; None takes that of the clocks. ``asked``: a user has given it."""
        asked = step is not None if asked is None else asked
        key = (step, asked)
        if key not in self._flat and self._origin is not None:
            origin, blocks = self._origin
            self._flat[key] = renumber(origin.flattened(step, asked=asked), blocks)
        if key not in self._flat:
            self._flat[key] = flatten(self.scheduled, self.checked, self.orders, step, asked=asked, name=self.name)
        return self._flat[key]


def _find_other_numbers(diagram: WiredDiagram, other: WiredDiagram) -> dict[str, Block] | None:
    """Return the blocks of another diagram that differ from those of a diagram; None where its functions differ.

    Functions are those of the traces: with equal wires and the very traces of the diagram, what differs are values of
    parameters, which the functions take as an argument. A stepped block has no equations in them: its start values
    may differ.
    """
    one, two = diagram.scheduled, other.scheduled
    if diagram.loops != other.loops or one.blocks.keys() != two.blocks.keys():
        return None
    if any(getattr(one, name) != getattr(two, name) for name in _STRUCTURE):
        return None
    if diagram.checked.shapes != other.checked.shapes or diagram.checked.traced.keys() != other.checked.traced.keys():
        return None
    changed = {path: block for path, block in two.blocks.items() if block is not one.blocks[path]}
    if any(trace is not other.checked.traced[path] for path, trace in diagram.checked.traced.items()):
        return None
    try:
        same = all(_has_same_functions(one, path, block) for path, block in changed.items())
    except LoopwrightError:  # the file of an FMU has gone or has changed, which the run will report
        return None
    return changed if same else None


def _has_same_functions(table: Structure, path: str, block: Block) -> bool:
    """Return whether a diagram has the same functions with another block at a path, whose trace is the same one."""
    old = table.blocks[path]
    if type(block) is not type(old) or block.transport or block.in_model_exchange:
        return False
    if block.stepped:
        names = type(old).parameter_specs.keys() - OF_A_RUN
        return old.stepped and _facts(block, names) == _facts(old, names) and _shapes(block) == _shapes(old)
    free = [port for port in old.inputs if (path, port) not in table.wires]  # their defaults are constants in them
    defaults = all(identity(block.inputs[port].default) == identity(old.inputs[port].default) for port in free)
    return defaults and _list_events(block) == _list_events(old)


def _facts(block: Block, names: Iterable[str]) -> object:
    return block._content, {name: identity(block.__dict__[name]) for name in names}


def _shapes(block: Block) -> object:
    ports = {**{("in", n): p for n, p in block.inputs.items()}, **{("out", n): p for n, p in block.outputs.items()}}
    return {key: (port.shape, port.unit) for key, port in ports.items()}


def _list_events(block: Block) -> list[tuple[str, str, float]]:
    return [(name, event.direction, getattr(event, "hysteresis", 0.0)) for name, event in block.events.items()]
