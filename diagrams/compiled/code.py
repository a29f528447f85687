"""C code of a diagram's ticks: generated, compiled, kept in the user's cache, and loaded."""

from __future__ import annotations

import ctypes
import hashlib
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca

from ...blocks.core import CompilerError
from ...fmus.export import SUFFIXES, compile_shared, describe_compiler
from ...fmus.platform import cache_folder, native_platform
from ..flat import FlatDiagram, TickPattern

LARGEST = 6_000
"""Operations of a tick up to which it is compiled: the compiler's time grows faster than they do."""
_MASTER = "loopwright_run"
_EXPORTING = "#define GCC_HASCLASSVISIBILITY\n"  # so that CasADi's code makes its functions visible


@dataclass(frozen=True, eq=False)
class TickCode:
    """The C functions of a diagram's ticks, loaded.

    Attributes
    ----------
    functions : mapping
        CasADi functions that were compiled, by the clocks that act.
    addresses : mapping
        Addresses of the C functions, by the clocks that act.
    exact : bool
        Whether all of them are operations on scalars, as they are interpreted: then all bits are those of an
        interpreted run. Tables and large matrix products are compiled in another form than they are interpreted in;
        there, signs of zeros may differ.
    library : CDLL
        The library, which is loaded as long as this lives.
    """

    functions: Mapping[frozenset[TickPattern], Any]
    addresses: Mapping[frozenset[TickPattern], int]
    exact: bool
    library: ctypes.CDLL


_COMPILED: WeakKeyDictionary[FlatDiagram, TickCode] = WeakKeyDictionary()


def find_obstacle(flat: FlatDiagram) -> str | None:
    """Return why a diagram's ticks can't be compiled; None if they can."""
    if flat.hybrid:
        return "it has continuous states, events or transport delays, and a solver goes from tick to tick"
    if flat.loops.slices:
        return "it has an algebraic loop, which is solved by iteration at every tick"
    opaque = sorted(path for path in flat.checked.traced if flat.table.blocks[path].opaque)
    if opaque:
        return f"the block {opaque[0]!r} is evaluated by Python"
    return None


def compile_ticks(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> TickCode:
    """Compile the ticks at which these sets of clocks act.

    Raises
    ------
    CompilerError
        If there is no compiler, it fails, or a tick is too large for it.
    FmuError
        If the cache can't be written.
    """
    if flat in _COMPILED and tuple(_COMPILED[flat].functions) == tuple(acting):
        return _COMPILED[flat]
    generator, functions = ca.CodeGenerator("ticks.c"), {}
    for i, clocks in enumerate(acting):
        function = functions[clocks] = _named(flat.at_tick(clocks).last.fast, f"tick{i}")
        count = function.n_instructions()
        if count > LARGEST:
            raise CompilerError(
                f"a tick has {count} operations; at most {LARGEST} are compiled, as a compiler takes seconds for them. "
                "Leave out compile=True."
            )
        generator.add(function)
    library = load_compiled(_EXPORTING + generator.dump())
    addresses = {clocks: address_of(library, f"tick{i}") for i, clocks in enumerate(acting)}
    exact = all(f.is_a("SXFunction") for f in functions.values())
    return _COMPILED.setdefault(flat, TickCode(functions, addresses, exact, library))


def _named(function: Any, name: str) -> Any:
    """Return a function under another name; of operations on scalars, equal ones are shared."""
    if function.is_a("SXFunction"):
        symbols = function.sx_in()
        return ca.Function(name, symbols, ca.cse(function.call(symbols)))
    symbols = function.mx_in()
    return ca.Function(name, symbols, function.call(symbols))


def address_of(library: ctypes.CDLL, name: str) -> int:
    """Return the address of a function in a library."""
    address = ctypes.cast(library[name], ctypes.c_void_p).value
    assert address is not None
    return address


@lru_cache(maxsize=1)
def master() -> Any:
    """Return the C function that goes over ticks; it is compiled once on a machine.

    Raises
    ------
    CompilerError
        If there is no compiler, or it fails.
    FmuError
        If the cache can't be written.
    """
    function = load_compiled(files(__package__).joinpath("master.c").read_text(encoding="utf-8"))[_MASTER]
    function.restype = None
    return function


@lru_cache(maxsize=64)
def load_compiled(source: str) -> ctypes.CDLL:
    """Return the library of a C source, which is compiled unless the cache has it.

    The key in the cache covers the source, the compiler with its version and flags, and the platform. A library is
    loaded only from a folder that belongs to the user alone.

    Raises
    ------
    CompilerError
        If there is no compiler, it fails, or others can write to the folder.
    FmuError
        If the cache can't be written.
    """
    platform = native_platform()
    key = hashlib.sha256("\0".join((platform, *describe_compiler(platform), source)).encode()).hexdigest()
    folder = cache_folder().absolute() / "compiled"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    _check_owner(folder)
    library = folder / f"{key[:40]}{SUFFIXES[platform.rpartition('-')[2]]}"
    if not library.is_file():
        compile_shared({"code.c": source}, library)
    return ctypes.CDLL(str(library))


def _check_owner(folder: Path) -> None:
    """Refuse a folder that others than the user can write to: what stands there is run."""
    if os.name != "posix":
        return
    with suppress(OSError):
        folder.chmod(0o700)
    found = folder.stat()
    if found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise CompilerError(
            f"the folder of compiled diagrams {str(folder)!r} belongs to user {found.st_uid} with permissions "
            f"{found.st_mode & 0o777:o}; expected user {os.getuid()} and 700, since what stands there is run. Remove "
            "it, or set LOOPWRIGHT_CACHE to a folder of your own."
        )
