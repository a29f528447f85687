"""A diagram as a value: its structure, checked, and its variants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace as replace_fields
from fractions import Fraction
from typing import Self

from ...blocks.core import (
    Block,
    OptionError,
    WiringError,
    check_argument,
    check_name,
    explain_calls,
    kinds,
    without_collection,
)
from ...blocks.tracing import check_method
from .check import Checked, check
from .collector import Collector
from .delay_blocks import add_delay_blocks
from .order import Order, find_orders
from .parameter_names import find_name, find_path
from .structure import Structure, SubsystemSettings, Wire, stepped_blocks
from .subsystems import exact_time
from .units import add_unit_conversions
from .variants import apply_changes

LOOPS = ("error", "solve")


@explain_calls
class CheckedDiagram:
    """Blocks and wires as one value; `loopwright.diagrams.Diagram` adds its uses.

    Parameters
    ----------
    name : str
        Name of the diagram.
    *roots : Call
        The calls that close it.
    loops : {"error", "solve"}
        Whether algebraic loops are an error, or solved.

    Raises
    ------
    WiringError
        One of its kinds, with the path of the block and its port.
    TraceError
        A block whose equations can't be traced.
    """

    @without_collection
    def __init__(self, name: str, *roots: object, loops: str = "error"):
        if not isinstance(name, str):
            raise WiringError(
                f'found {name!r} where the name is expected; write Diagram("name", …), the calls after the name.'
            )
        if not roots:
            raise WiringError("a diagram needs at least one call, such as plant(motor_force=u).", block=name)
        if not isinstance(loops, str) or loops not in LOOPS:
            raise OptionError(
                f"found loops={loops!r}; expected {' or '.join(map(repr, LOOPS))}.", block=name, port="loops"
            )
        self._set(check_name(name), Collector(roots).structure(), loops)

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        explain_calls(cls)

    name: str
    loops: str
    structure: Structure
    """Blocks, wires and subsystems as they were wired."""
    scheduled: Structure
    """The structure that the scheduler sees: computational delays and conversions of units have become blocks."""
    checked: Checked
    """Traces of the scheduled blocks, and shapes and units of their ports."""
    orders: tuple[Order, Order]
    """Orders of evaluation of the scheduled blocks: at an instant, and of initialization."""

    @without_collection
    def _set(self, name: str, table: Structure, loops: str) -> None:
        runs = add_unit_conversions(add_delay_blocks(table))
        checked = check(runs)
        orders = find_orders(runs, checked.traced, solve=loops == "solve")
        self.__dict__.update(name=name, loops=loops, structure=table, scheduled=runs, checked=checked, orders=orders)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"a diagram is a value: {name!r} can't be set. Use replace(…), or build another one.")

    @classmethod
    def _of(cls, name: str, table: Structure, loops: str = "error") -> Self:
        diagram = cls.__new__(cls)
        diagram._set(name, table, loops)
        return diagram

    def with_structure(self, structure: Structure, loops: str | None = None) -> Self:
        """Return the diagram of another structure, under the same name, and with other ``loops``, where given."""
        return type(self)._of(self.name, structure, self.loops if loops is None else loops)

    def __reduce__(self) -> tuple[object, ...]:
        return type(self)._of, (self.name, self.structure, self.loops)

    def __repr__(self) -> str:
        paths = [path for path in self.structure.subsystems if path]
        return f"<diagram {self.name}: {len(self.blocks)} blocks{', in ' + ', '.join(paths) if paths else ''}>"

    @property
    def blocks(self) -> Mapping[str, Block]:
        """Every block by its dotted path."""
        return dict(self.structure.blocks)

    @property
    def subsystems(self) -> Mapping[str, SubsystemSettings]:
        """Every subsystem by its dotted path; the diagram itself is ""."""
        return dict(self.structure.subsystems)

    @property
    def wires(self) -> Mapping[tuple[str, str], Wire]:
        """The source of every wired input, by (block path, input)."""
        return dict(self.structure.wires)

    @property
    def names(self) -> Mapping[str, Wire]:
        """Every named wire."""
        return dict(self.structure.names)

    def __getitem__(self, path: str) -> Block:
        """Return the block at a path, or at the unique end of one."""
        return self.structure.blocks[find_path(path, self.structure.blocks, "block", self.name)]

    def replace(self, changes: Mapping[str, object] | None = None, /, **more: object) -> Self:
        """Return a variant: other blocks, parameters or sample times.

        Parameters
        ----------
        changes : mapping, optional
            By dotted path, or its unique end: a block (``"plant"``), a parameter
            (``"controller.admittance_par.stiffness"``), an entry of an array, counted from 1
            (``"motor.denominator[1]"``), a subsystem's ``sample_time``, ``method``, ``offset`` or
            ``delay`` (``"controller.sample_time"``; None: that of its surroundings), a plant's start value
            (``"plant.start.position"``, or ``"plant.position"`` where the block has no parameter of that name).
        **more
            Changes whose paths are identifiers, as keywords: ``replace(plant=Fmu("other.fmu"))``.

        Raises
        ------
        UnknownNameError, ParameterError, WiringError
            A name that isn't there, a value out of bounds, a block that doesn't fit the wires.
        OptionError
            Two names of one parameter, or of one block.

        Notes
        -----
        Blocks are replaced first, then whole parameters, then parts of them, in whatever order they are given:
        ``{"plant.mass": 3, "plant": Fmu("other.fmu")}`` gives the other FMU a mass of 3.
        """
        if changes is not None:
            check_argument(changes, kinds.mapping, "changes", self.name)
        table = apply_changes(self.structure, [*(changes or {}).items(), *more.items()], self.name)
        return self.with_structure(table)

    def continuous(self) -> Self:
        """Return the diagram with every sampled subsystem as its ideal: continuous, without sampling, hold or delay.

        A projection then solves its equation at each evaluation, from the foot point of the last accepted step. A run
        with an FMU still exchanges signals with it at multiples of ``step`` only, and holds its inputs between. The
        linear model comes from the FMU's equations and has no such hold.

        Raises
        ------
        SampleTimeError
            A block that is defined at samples only, such as a `UnitDelay`.
        """
        table = self.structure.copy()
        for path, settings in table.subsystems.items():
            table.subsystems[path] = replace_fields(settings, sample_time=None, offset=Fraction(0), delay=0)
        return self.with_structure(table)

    def sampled(self, sample_time: float | Fraction, method: str = "exact") -> Self:
        """Return the diagram with all its continuous blocks sampled.

        Each block is discretized by itself, with its inputs held over a sample. So a plant drawn with `Integrator`
        blocks becomes forward Euler between them, of first order, whatever the method. For a method to act on a plant
        as a whole, write the plant as one block: a `StateSpace`, a `TransferFunction`, or a `Block` of your own.

        Parameters
        ----------
        sample_time : float or Fraction
            Sample time in s. Subsystems with a sample time of their own keep it.
        method : {"exact", "forward", "semi_implicit", "trapezoidal"}
            Discretization of the blocks that were continuous; see `loopwright.blocks.hold`. As inputs are held,
            ``trapezoidal`` is not Tustin's method, python-control's ``c2d(…, "bilinear")``, which averages them too.

        Raises
        ------
        SampleTimeError
            A sample time that is not positive, or an unknown method.
        """
        check_method(method)
        table = self.structure.copy()
        for path, settings in sorted(table.subsystems.items()):
            if self.structure.clock(path) is None:
                table.subsystems[path] = replace_fields(settings, method=method)
        top = replace_fields(table.subsystems[""], sample_time=exact_time(sample_time, block=self.name))
        table.subsystems[""] = top
        return self.with_structure(table)

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
        """Whether a block in it is stepped from outside, such as an FMU."""
        return bool(stepped_blocks(self.structure))


def find_parameter(diagram: CheckedDiagram, name: object) -> str:
    """Return the full path of a parameter of a diagram; see `find_name`."""
    return find_name(diagram.structure, name, diagram.name)
