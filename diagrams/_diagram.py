"""The diagram: blocks and wires as one value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace as replace_fields
from fractions import Fraction
from typing import Any

from ..blocks._block import Block
from ..blocks._discretization import check_method
from ..blocks._errors import UnknownNameError, WiringError, near
from ..blocks._signals import check_name
from ..blocks._values import Value
from ._check import Checked, check
from ._flat import FlatDiagram, flatten
from ._order import evaluation_order
from ._run import Run
from ._structure import Collector, Frame, Structure, Wire
from ._subsystem import exact_time


class Diagram:
    """A diagram: what its last calls need, found by walking the wires backwards.

    Building it checks everything: unwired inputs, double drives, shapes, units, names, algebraic loops.

    Parameters
    ----------
    name : str
        Name of the diagram.
    *roots : Call
        The calls that close it, such as ``plant(motor_force=u)``; what they are wired to belongs to the diagram.

    Raises
    ------
    WiringError
        One of its kinds, with the path of the block and its port.
    TraceError
        A block whose equations can't be traced.

    Examples
    --------
    >>> from loopwright.blocks import Sine, Gain
    >>> wave = Gain(gain=2, name="twice")(Sine(frequency=1)).named("wave")
    >>> run = Diagram("demo", wave).simulate(0.5, step=0.125, progress=False)
    >>> [round(float(v), 6) for v in run["wave"]]
    [0.0, 1.414214, 2.0, 1.414214, 0.0]
    """

    def __init__(self, name: str, *roots: Any):
        if not isinstance(name, str):
            raise WiringError(
                f'found {name!r} where the name is expected; write Diagram("name", …), the calls after the name.'
            )
        if not roots:
            raise WiringError("a diagram needs at least one call, such as plant(motor_force=u).", block=name)
        self._set(check_name(name), Collector(roots).structure())

    name: str
    _table: Structure
    _checked: Checked
    _flat: dict[Fraction | None, FlatDiagram]

    def _set(self, name: str, table: Structure) -> None:
        checked = check(table)
        for start in (False, True):
            evaluation_order(table, checked.traced, start=start)
        self.__dict__.update(name=name, _table=table, _checked=checked, _flat={})

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"a diagram is a value: {name!r} can't be set. Use replace(…), or build another one.")

    @classmethod
    def _of(cls, name: str, table: Structure) -> Diagram:
        diagram = cls.__new__(cls)
        diagram._set(name, table)
        return diagram

    def __reduce__(self) -> Any:
        return Diagram._of, (self.name, self._table)

    def __repr__(self) -> str:
        boxes = [path for path in self._table.frames if path]
        return f"<diagram {self.name}: {len(self.blocks)} blocks{', in ' + ', '.join(boxes) if boxes else ''}>"

    @property
    def blocks(self) -> Mapping[str, Block]:
        """Every block by its dotted path."""
        return dict(self._table.blocks)

    @property
    def frames(self) -> Mapping[str, Frame]:
        """Every subsystem by its dotted path; the diagram itself is ""."""
        return dict(self._table.frames)

    @property
    def wires(self) -> Mapping[tuple[str, str], Wire]:
        """The source of every wired input, by (block path, input)."""
        return dict(self._table.wires)

    @property
    def names(self) -> Mapping[str, Wire]:
        """Every named wire."""
        return dict(self._table.names)

    def __getitem__(self, path: str) -> Block:
        """Return the block at a path, or at the unique end of one."""
        return self._table.blocks[self._find(path)]

    def _find(self, path: str) -> str:
        return _unique(path, self._table.blocks, "block", self.name)

    def replace(self, changes: Mapping[str, Any] | None = None, /, **more: Any) -> Diagram:
        """Return a variant: other blocks, parameters or sample times.

        Parameters
        ----------
        changes : mapping, optional
            By dotted path, or its unique end: a block (``"plant"``), a parameter
            (``"controller.admittance_par.stiffness"``), a subsystem's ``sample_time`` or ``method``
            (``"controller.sample_time"``; None: that of what surrounds it), a plant's start value
            (``"plant.start.position"``).
        **more
            The same, for paths that are identifiers: ``replace(plant=Fmu("other.fmu"))``.

        Raises
        ------
        UnknownNameError, ParameterError, WiringError
            A name that isn't there, a value out of bounds, a block that doesn't fit the wires.
        """
        table = Structure(**{k: dict(v) for k, v in vars(self._table).items()})
        for path, value in {**(changes or {}), **more}.items():
            self._change(table, path, value)
        return Diagram._of(self.name, table)

    def _change(self, table: Structure, path: str, value: Any) -> None:
        head, _, last = path.rpartition(".")
        if isinstance(value, Block):
            full = self._find(path)
            table.blocks[full] = value.replace(name=full.rpartition(".")[2])
        elif last in ("sample_time", "method") and (frame := self._frame(table, head, last)) is not None:
            new = exact_time(value, block=frame) if last == "sample_time" and value is not None else value
            if last == "method":
                check_method(value)
            changed: dict[str, Any] = {last: new}
            table.frames[frame] = replace_fields(table.frames[frame], **changed)
        elif path in table.blocks:
            raise WiringError(
                f"found {value!r}; expected a block in its place, such as Fmu('other.fmu'), or the name of a parameter "
                f"({path}.…).",
                block=path,
            )
        else:
            full, keys = self._split(table, path)
            table.blocks[full] = _changed(table.blocks[full], keys, value)

    def _frame(self, table: Structure, path: str, what: str) -> str | None:
        """Return the subsystem that a path means; None where it means none, but perhaps a block."""
        boxes = {frame: None for frame in table.frames if frame}
        if path:
            found = [f for f in boxes if f == path or f.endswith("." + path)]
            return _unique(path, boxes, "subsystem", self.name) if found else None
        offered = ", ".join(f"{frame}.{what}" for frame in boxes) or "none: this diagram has no subsystem"
        raise UnknownNameError(f"a diagram has no {what!r} of its own; its subsystems have: {offered}.")

    def _split(self, table: Structure, path: str) -> tuple[str, list[str]]:
        """Return the block and the parameter path that a dotted path means."""
        parts = path.split(".")
        for cut in range(len(parts) - 1, 0, -1):
            try:
                return self._find(".".join(parts[:cut])), parts[cut:]
            except UnknownNameError:
                continue
        owners = [p for p, block in sorted(table.blocks.items()) if path in type(block).parameter_specs]
        if len(owners) == 1:
            return owners[0], [path]
        if owners:
            raise UnknownNameError(
                f"{path!r} is a parameter of {', '.join(owners)}; write the path, such as '{owners[0]}.{path}'."
            )
        known = {f"{p}.{q}" for p, block in table.blocks.items() for q in type(block).parameter_specs} | set(
            table.blocks
        )
        raise UnknownNameError(f"nothing is called {path!r} in diagram {self.name!r}. {near(path, known)}")

    def flatten(self, step: float | Fraction | None = None) -> FlatDiagram:
        """Return the diagram as one CasADi function of a tick.

        Parameters
        ----------
        step : float or Fraction, optional
            Seconds between two ticks, where no subsystem has a sample time (or to look between samples).
        """
        key = None if step is None else exact_time(step, block=self.name)
        if key not in self._flat:
            self._flat[key] = flatten(self._table, self._checked, key)
        return self._flat[key]

    def simulate(self, duration: float, *, step: float | Fraction | None = None, progress: bool | None = None) -> Run:
        """Run the diagram from t = 0 and return what it recorded.

        Parameters
        ----------
        duration : float
            Simulated time in s, a multiple of the step between ticks.
        step : float or Fraction, optional
            Seconds between two ticks (and communication points of the FMUs). Without one it is the greatest common
            divisor of all sample times.
        progress : bool, optional
            Show a progress bar; by default on a terminal, and in a notebook where ipywidgets is installed.

        Returns
        -------
        Run
            Every output at every tick.

        Raises
        ------
        SimulationError
            `PathDomainError`, `GuardError`, `NonFiniteError` or `FmuRuntimeError`; ``error.run`` holds what was
            recorded until then.
        OptionError
            A duration that is not positive, or no multiple of the step.
        """
        from ._simulation import simulate

        return simulate(self, duration, step=step, progress=progress)


def _unique(path: str, known: Mapping[str, Any], kind: str, diagram: str) -> str:
    """Return the full path that ``path`` is, or is the unique end of."""
    if not isinstance(path, str):
        raise UnknownNameError(f"found {path!r}; expected the path of a {kind}, such as {next(iter(known), '')!r}.")
    if path in known:
        return path
    found = sorted(p for p in known if p.endswith("." + path))
    if len(found) == 1:
        return found[0]
    if found:
        raise UnknownNameError(f"{path!r} stands for several {kind}s: {', '.join(found)}. Write more of the path.")
    raise UnknownNameError(f"no {kind} {path!r} in diagram {diagram!r}. {near(path, known)}")


def _changed(block: Value, keys: list[str], value: Any) -> Any:
    """Return ``block`` with the parameter at a path of attribute names or mapping keys changed."""
    name = keys[0]
    if len(keys) == 1:
        return block.replace(**{name: value})
    inner = block.__dict__.get(name)
    if isinstance(inner, Value):
        return block.replace(**{name: _changed(inner, keys[1:], value)})
    if isinstance(inner, Mapping):
        return block.replace(**{name: {**inner, ".".join(keys[1:]): value}})
    raise UnknownNameError(f"it has no parameter {'.'.join(keys)!r}. {near(name, type(block).parameter_specs)}")
