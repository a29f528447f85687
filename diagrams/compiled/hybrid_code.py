"""C code of a diagram with continuous states: its ticks, its rates, its events; and the loop that goes over them."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca

from ..flat import NONE, FlatDiagram, TickPattern
from .code import (
    StraightTick,
    TickCode,
    address_of,
    check_size,
    compile_loops,
    load_compiled,
    make_visible,
    read_sources,
    rename,
)

_SOURCES = ("newton.c", "master.c", "methods.c", "radau.c", "events.c", "instants.c", "hybrid.c")

EMBEDDED = ("euler", "heun", "rk4", "RK23", "RK45", "DOP853", "Radau", "auto")
"""Solvers that there are in C."""


@dataclass(frozen=True)
class Compiled:
    """A CasADi function that was compiled, and the address of its C function."""

    function: Any
    address: int


@dataclass(frozen=True, eq=False)
class HybridCode:
    """The C functions of a diagram with continuous states, loaded.

    Attributes
    ----------
    ticks : TickCode
        Its ticks; that at which no clock acts is an instant between ticks.
    between : mapping of str to Compiled
        Its other functions that there are, by name: ``"flow"``, ``"slope"``, ``"indicators"``, ``"jump"``.
    """

    ticks: TickCode
    between: Mapping[str, Compiled]


_COMPILED: WeakKeyDictionary[FlatDiagram, dict[tuple[Any, ...], HybridCode]] = WeakKeyDictionary()


def find_hybrid_obstacle(flat: FlatDiagram, solver: str) -> str | None:
    """Return why a diagram with continuous states can't go from tick to tick in C; None if it can.

    Parameters
    ----------
    solver : str
        Name of the solver.
    """
    if solver not in EMBEDDED:
        return f"there is no solver={solver!r} in C; there are {', '.join(EMBEDDED[:-1])} and {EMBEDDED[-1]}"
    blocks = flat.table.blocks
    delayed = sorted({path for name in flat.plant_inputs.slices if blocks[path := flat.ports[name][0]].transport})
    if delayed:
        return f"the transport delay {delayed[0]!r} keeps its past in Python"
    if flat.outside:
        return f"the FMU {flat.outside[0]!r} in model exchange is evaluated by Python"
    opaque = sorted(path for path in flat.checked.traced if blocks[path].opaque)
    if opaque:
        return f"the block {opaque[0]!r} is evaluated by Python"
    return None


def compile_hybrid(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]], *, stiff: bool) -> HybridCode:
    """Compile the functions of a diagram with continuous states.

    Parameters
    ----------
    acting : sequence of frozenset
        Sets of clocks that act together at some tick.
    stiff : bool
        Whether the derivative of the rates is needed, too.

    Raises
    ------
    CompilerError
        If there is no compiler, it fails, or a function is too large for it.
    FmuError
        If the cache can't be written.
    """
    kinds = (NONE, *(clocks for clocks in acting if clocks))
    known = _COMPILED.setdefault(flat.origin, {})
    if (kinds, stiff) in known:
        return known[kinds, stiff]
    ticks = {clocks: rename(flat.at_tick(clocks).last.fast, f"tick{i}") for i, clocks in enumerate(kinds)}
    others = {"flow": flat.flow.last.fast}
    if stiff:
        looped = bool(flat.active_loops(NONE))
        others["slope"] = flat.jacobian_with_loops.fast if looped else _sparse_slope(flat)
    if flat.events:
        others |= {"indicators": flat.indicators.last.fast, "jump": flat.jump.last.fast}
    others = {name: rename(function, name) for name, function in others.items()}
    generator = ca.CodeGenerator("hybrid.c")
    for function in (*ticks.values(), *others.values()):
        check_size(function)
        generator.add(function)
    library = load_compiled(make_visible(generator.dump()))
    hybrid_master()  # if it can't be compiled, the run is interpreted
    straight = {c: StraightTick(ticks[c], address_of(library, f"tick{i}")) for i, c in enumerate(kinds)}
    between = {name: Compiled(function, address_of(library, name)) for name, function in others.items()}
    made = HybridCode(TickCode(straight, exact=False, library=library, loops=compile_loops(flat, kinds)), between)
    return known.setdefault((kinds, stiff), made)


def _sparse_slope(flat: FlatDiagram) -> Any:
    """Return the derivative of the rates by the integrated states, of which only entries that may not be 0 are made."""
    function = flat.flow.last.fast
    symbols = function.sx_in() if function.is_a("SXFunction") else function.mx_in()
    rates = function.call(symbols)[0]
    return ca.Function("slope", symbols, [ca.jacobian(rates, symbols[1])[:, flat.continuous.tolist()]])


@lru_cache(maxsize=1)
def hybrid_master() -> ctypes.CDLL:
    """Return the library that goes over ticks and between them; it is compiled once on a machine.

    Raises
    ------
    CompilerError
        If there is no compiler, or it fails.
    FmuError
        If the cache can't be written.
    """
    return load_compiled(read_sources(*_SOURCES))
