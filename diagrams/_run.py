"""What a run recorded."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ..blocks._errors import OptionError, UnknownNameError, near
from ._flat import Layout
from ._structure import Wire

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Snapshot:
    """All signals and states at one recorded instant."""

    t: float
    tick: int
    values: dict[str, Any]
    state: np.ndarray
    """The state vector x of the flattened diagram."""
    names: dict[str, Wire]
    """The named wires: two of one short name are told apart by what they carry."""

    def __getitem__(self, name: str) -> Any:
        return self.values[resolve(name, self.names, self.values)]


@dataclass(frozen=True, eq=False)
class Run:
    """A run: every output of every block at every tick.

    ``run.t`` are the times in s, ``run["xi"]`` is an array with one row per tick, reached by a wire's name, by a port's
    dotted path (``"controller.pid_par.v"``), or by any end of such a path that is unique.

    Attributes
    ----------
    t : (N + 1,) ndarray
        Times in s, up to and including the end.
    real_time_factor : float
        Simulated time over elapsed time of the loop.
    """

    t: np.ndarray
    data: np.ndarray = field(repr=False)
    layout: Layout = field(repr=False)
    wires: dict[str, Wire] = field(repr=False)
    units: dict[str, Any] = field(repr=False)
    diagram: Any = field(repr=False)
    elapsed: float = float("nan")
    messages: tuple[str, ...] = ()

    @property
    def real_time_factor(self) -> float:
        """Simulated seconds per elapsed second."""
        return float(self.t[-1] - self.t[0]) / self.elapsed if self.elapsed > 0 and len(self.t) else float("nan")

    @property
    def names(self) -> list[str]:
        """Every name under which a signal was recorded: the wires' names, then the ports' paths."""
        return [*sorted(self.wires), *(n for n in self.layout.slices)]

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a signal, shape (N + 1, *shape of the port).

        Raises
        ------
        UnknownNameError
            If there is none of that name, or several.
        """
        full = resolve(name, self.wires, self.layout.slices)
        index: Any = None
        if full in self.wires:
            wire = self.wires[full]
            full, index = f"{wire.block}.{wire.port}", wire.index
        values = self.data[:, self.layout.slices[full]].reshape(len(self.t), *self.layout.shapes[full])
        values = values if index is None else values[:, index]
        return np.ascontiguousarray(values)

    def _ipython_key_completions_(self) -> list[str]:
        return self.names

    def __contains__(self, name: str) -> bool:
        try:
            resolve(name, self.wires, self.layout.slices)
        except UnknownNameError:
            return False
        return True

    def unit(self, name: str) -> str | tuple[str, ...] | None:
        """Return the unit of a signal, None where it is not declared."""
        full = resolve(name, self.wires, self.layout.slices)
        wire = self.wires.get(full)
        if wire is None:
            return self.units.get(full)
        unit = self.units.get(f"{wire.block}.{wire.port}")
        return unit[wire.index] if isinstance(unit, tuple) and wire.index is not None else unit

    def at(self, t: float) -> Snapshot:
        """Return all signals and states at the last tick not after ``t`` (in s).

        Raises
        ------
        OptionError
            If t is not within the run.
        """
        if not (len(self.t) and self.t[0] <= t <= self.t[-1] * (1 + 1e-12) + 1e-12):
            span = f"{self.t[0]:g} s to {self.t[-1]:g} s" if len(self.t) else "nothing"
            raise OptionError(f"found t = {t!r}; the run holds {span}.")
        k = int(np.searchsorted(self.t, t * (1 + 1e-12) + 1e-12, side="right")) - 1
        values = {name: self.data[k, s].reshape(self.layout.shapes[name]) for name, s in self.layout.slices.items()}
        for name, wire in self.wires.items():
            whole = values[f"{wire.block}.{wire.port}"]
            values[name] = whole if wire.index is None else whole[wire.index]
        width = self.layout.total
        return Snapshot(float(self.t[k]), k, values, self.data[k, width:].copy(), dict(self.wires))

    def plot(self, *names: str, axes: Any = None) -> Figure:
        """Draw signals over time, one below the other, and return the figure.

        Parameters
        ----------
        *names : str
            Signals to draw; a vector's entries share an axis.
        axes : sequence of matplotlib axes, optional
            Axes to draw into, one per name.

        Raises
        ------
        UnknownNameError
            For a name that was not recorded.
        """
        from ._plots import plot_signals

        return plot_signals(self, names, axes)

    def to_csv(self, path: Any, *names: str) -> None:
        """Write ``t`` and the given signals (all wires with a name, if none is given), 17 significant digits."""
        chosen = names or tuple(sorted(self.wires))
        columns, header = [self.t[:, None]], ["t"]
        for name in chosen:
            values = self[name]
            size = int(np.prod(values.shape[1:]))
            header += [name] if values.ndim == 1 else [f"{name}[{i + 1}]" for i in range(size)]
            columns.append(values.reshape(len(self.t), size))
        np.savetxt(path, np.hstack(columns), fmt="%.17g", delimiter=",", header=",".join(header), comments="")


def resolve(name: str, wires: Any, ports: Any) -> str:
    """Return the full name that ``name`` stands for: a wire's or port's path, or a unique end of one; wires go first.

    Raises
    ------
    UnknownNameError
        If there is none, or several.
    """
    if name in wires or name in ports:
        return name
    for group in (wires, ports):
        found = sorted(n for n in group if n.endswith("." + name))
        if found and (len(found) == 1 or (group is wires and len({wires[n] for n in found}) == 1)):
            return str(found[0])
        if found:
            raise UnknownNameError(f"{name!r} stands for several signals: {', '.join(found)}. Write more of the path.")
    short = {n.rpartition(".")[2] for n in (*wires, *ports)}
    raise UnknownNameError(f"no signal {name!r} was recorded. {near(name, short | set(wires) | set(ports))}")


def entries(full: str, layout: Layout, wires: Any) -> np.ndarray:
    """Return where a signal stands in the vector of a sample, in the signal's shape."""
    wire = wires.get(full)
    port = full if wire is None else f"{wire.block}.{wire.port}"
    where = layout.slices[port]
    whole = np.arange(where.start, where.stop).reshape(layout.shapes[port])
    return whole if wire is None or wire.index is None else np.asarray(whole[wire.index])
