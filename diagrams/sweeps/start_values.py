"""Start values of many runs of one diagram: the inputs of blocks that start from them, as traced functions."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import Block
from ..flat import NONE, Bound, FlatDiagram, Instant, bind_function, evaluate, is_true
from ..simulation import Workspace, find_initial_state, values_from_left

Port = tuple[str, str]


class StartValues:
    """Computes initial states and first held outputs as `find_start_values` does, from functions that are traced once.

    Parameters
    ----------
    workspace : Workspace
        The numbers of the runs, to which the functions are bound.
    """

    def __init__(self, workspace: Workspace):
        flat = workspace.flat
        self._workspace = workspace
        blocks = {path: flat.table.blocks[path] for path in flat.checked.traced}
        self._starting = [path for path, block in blocks.items() if block.starts_from_inputs]
        self._sources = [path for path, block in blocks.items() if not block.inputs]
        self._bound: dict[tuple[Port, ...], _Functions] = {}
        self._left: tuple[list[Block], dict[Port, np.ndarray]] | None = None
        self._found: dict[str, tuple[Block, bytes, np.ndarray]] = {}

    @staticmethod
    def fits(flat: FlatDiagram) -> bool:
        """Whether a diagram's start can be traced: no block of it is evaluated from outside, or in a loop."""
        opaque = any(flat.table.blocks[path].opaque for path in flat.checked.traced)
        return not (opaque or flat.apart or flat.loops.slices)

    def set(self, workspace: Workspace) -> None:
        """Compute the start values at t = 0 from the values at hand."""
        assert workspace is self._workspace
        flat, x = workspace.flat, workspace.here.x
        if not (self._starting or flat.held.slices or flat.gates.slices or flat.starts.slices):
            return
        left = self._from_left()
        functions = self._functions(left)
        for port, values in left.items():
            functions.left[functions.places[port]] = values
        for path in functions.order:
            bound, names = functions.inputs[path]
            bound.call()
            columns: dict[str, Any] = dict.fromkeys(flat.checked.traced[path].inputs)
            columns |= dict(zip(names, bound.outputs, strict=True))
            x[flat.states.slices[path]] = self._initial(flat, path, columns)
        for path, where in flat.starts.slices.items():
            x[where] = x[flat.states.slices[path]]
        if functions.held is not None:
            functions.held.call()
            for name, values in zip(flat.held.slices, functions.held.outputs, strict=True):
                x[flat.held.slices[name]] = values
        if functions.gates is not None:
            functions.gates.call()
            for name, values in zip(flat.gates.slices, functions.gates.outputs, strict=True):
                x[flat.gates.slices[name]] = float(is_true(values))

    def _initial(self, flat: FlatDiagram, path: str, columns: dict[str, Any]) -> np.ndarray:
        """Return a block's initial state; the last one, where neither the block nor its inputs have changed."""
        block = flat.table.blocks[path]
        key = b"".join(b"-" if column is None else column.tobytes() for column in columns.values())
        known = self._found.get(path)
        if known is None or known[0] is not block or known[1] != key:
            known = self._found[path] = (block, key, find_initial_state(flat, path, columns))
        return known[2]

    def _from_left(self) -> dict[Port, np.ndarray]:
        """Return the values just before t = 0 of the sources that jump there."""
        blocks = self._workspace.flat.table.blocks
        sources = [blocks[path] for path in self._sources]
        if self._left is None or any(new is not old for new, old in zip(sources, self._left[0], strict=True)):
            found = {port: np.asarray(tap(None)) for port, tap in values_from_left(self._workspace).items()}
            self._left = (sources, found)
        return self._left[1]

    def _functions(self, left: dict[Port, np.ndarray]) -> _Functions:
        key = tuple(left)
        if key not in self._bound:
            self._bound[key] = _Functions(self._workspace, self._starting, left)
        return self._bound[key]


class _Functions:
    """The traced functions of a start, bound to a run's vectors, with some sources as they are just before t = 0."""

    def __init__(self, workspace: Workspace, starting: list[str], left: dict[Port, np.ndarray]):
        flat, here = workspace.flat, workspace.here
        self.places, n = dict[Port, slice](), 0
        for port, values in left.items():
            self.places[port] = slice(n, n + values.size)
            n += values.size
        self.left = np.zeros(n)
        vectors = [here.x, here.w, here.p, self.left]
        symbols = [ca.MX.sym(name, v.size) for name, v in zip(("x", "w", "p", "left"), vectors, strict=True)]
        x, w, p, before_start = symbols

        def run(**options: Any) -> Instant:
            return evaluate(flat, flat.blocks, NONE, 0.0, x, w, p, opened=True, **options)

        def tapped(where: slice) -> Callable[[Any], Any]:
            return lambda column: before_start[where]

        taps = {port: tapped(where) for port, where in self.places.items()}
        found: dict[str, dict[str, Any]] = {}

        def before(path: str, inputs: dict[str, Any]) -> None:
            if path in starting and path not in found:
                found[path] = dict(inputs)

        def bind(columns: list[Any]) -> Bound:
            dense = [ca.densify(ca.MX(column)) for column in columns]
            function = ca.Function("start", symbols, dense)
            with suppress(RuntimeError):  # of a table
                function = function.expand()
            return bind_function(function, vectors)

        at_left = run(order=flat.start_order.steps, before=before, taps=taps) if starting else None
        self.order = tuple(found)
        self.inputs: dict[str, tuple[Bound, list[str]]] = {}
        for path, inputs in found.items():
            made = {name: column for name, column in inputs.items() if column is not None}
            self.inputs[path] = bind([*made.values()]), [*made]
        self.held = self.gates = None
        if flat.held.slices or flat.gates.slices:
            now = run()
            if flat.held.slices:
                self.held = bind([now.held[name] for name in flat.held.slices])
            if flat.gates.slices:
                at_left = run(taps=taps)
                self.gates = bind([at_left.control(name) for name in flat.gates.slices])
