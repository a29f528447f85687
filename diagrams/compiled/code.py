"""C code of a diagram's ticks: generated, compiled, kept in the user's cache, and loaded."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca

from ...blocks.core import CompilerError
from ...fmus.export import SUFFIXES, compile_shared, describe_compiler
from ...fmus.platform import cache_folder, native_platform
from ..flat import EXACT_LOOP, FlatDiagram, TickPattern, share_terms
from .generated_text import make_visible
from .grouping import Tables, make_tables
from .kernels import write_kernels
from .reordered import put_in_order
from .staged_functions import Staged

LARGEST = 6_000
"""Operations of a function up to which it is compiled as a whole: the compiler's time grows faster than they do."""
_FLAGS = ("-fno-math-errno", "-fno-trapping-math", "-fno-builtin-pow")
# Nobody reads errno, so that sine and cosine of one angle are one call; a power of two stays a power in every bit.
MASTER = "loopwright_run"


@dataclass(frozen=True, eq=False)
class StraightTick:
    """A tick as one C function of scalar operations.

    Attributes
    ----------
    function : casadi.Function
        The function that was compiled.
    address : int
        Address of the C function.
    """

    function: Any
    address: int


@dataclass(frozen=True, eq=False)
class GroupedTick:
    """A tick as runs of equal blocks.

    Attributes
    ----------
    tables : Tables
        Where the values of each block stand.
    functions : mapping
        CasADi functions of the blocks that Python evaluates, by key.
    address : int
        Address of the C function that goes over the tables.
    """

    tables: Tables
    functions: Mapping[int, Any]
    address: int


@dataclass(frozen=True, eq=False)
class TickCode:
    """The C functions of a diagram's ticks, loaded.

    Attributes
    ----------
    ticks : mapping
        The ticks, by the clocks that act.
    exact : bool
        Whether all bits are those of an interpreted run. Tables and large matrix products are compiled in another form
        than they are interpreted in: there, signs of zeros may differ. Algebraic loops of more than `EXACT_LOOP`
        values are solved with another rounding.
    library : CDLL
        The library, which is loaded as long as this lives.
    loops : mapping
        Equations of the algebraic loops, by the clocks that act, where there are some.
    master : function or None
        The C function that goes over ticks; None for the one that all diagrams share.
    notes : tuple of str
        What a run tells of its code.
    """

    ticks: Mapping[frozenset[TickPattern], StraightTick | GroupedTick | Staged]
    exact: bool
    library: ctypes.CDLL
    loops: Mapping[frozenset[TickPattern], StraightTick] = field(default_factory=dict)
    master: Any = None
    notes: tuple[str, ...] = ()


_COMPILED: WeakKeyDictionary[FlatDiagram, TickCode] = WeakKeyDictionary()


def find_obstacle(flat: FlatDiagram) -> str | None:
    """Return why a diagram's ticks can't be compiled; None if they can."""
    if flat.loops.slices and any(flat.table.blocks[path].opaque for path in flat.checked.traced):
        return "it has an algebraic loop beside blocks that Python evaluates, and Newton's method runs in C alone"
    return None


def compile_ticks(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> TickCode:
    """Compile the ticks at which these sets of clocks act.

    Small ones are one function of scalar operations, in which the values of one block are used by the next without a
    memory in between. Large ones, and those with blocks that are no scalar operations, are grouped: one function for
    each kind of block, called in a loop over all blocks of this kind. Their code knows no numbers and no wiring.

    Raises
    ------
    CompilerError
        If there is no compiler, or it fails.
    FmuError
        If the cache can't be written.
    """
    flat = flat.origin  # other numbers change no code
    if flat in _COMPILED and tuple(_COMPILED[flat].ticks) == tuple(acting):
        return _COMPILED[flat]
    return write_ticks(flat, acting).load()


@dataclass(frozen=True, eq=False)
class TickSources:
    """The C code of a diagram's ticks, written.

    Attributes
    ----------
    texts : sequence of str
        The sources of its libraries.
    operations : int
        Operations in them.
    exact : bool
        Whether compiled ticks have the bits of interpreted ones; see `TickCode`.
    make : callable
        Makes the code of its libraries.
    """

    texts: Sequence[str]
    operations: int
    exact: bool
    make: Callable[[Sequence[ctypes.CDLL]], TickCode]

    def is_compiled(self) -> bool:
        """Whether the cache has all libraries, so that none has to be compiled.

        Raises
        ------
        CompilerError
            If there is no compiler.
        """
        return all(_library_of(text).is_file() for text in (*self.texts, master_source()))

    def load(self) -> TickCode:
        """Return the code; libraries that the cache lacks are compiled.

        Raises
        ------
        CompilerError
            If there is no compiler, or it fails.
        FmuError
            If the cache can't be written.
        """
        master()
        return self.make([load_compiled(text) for text in self.texts])


def write_ticks(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> TickSources:
    """Write the C code of the ticks at which these sets of clocks act; see `compile_ticks`."""
    ticks = None if flat.by_block else _write_straight(flat, acting)
    ticks = ticks or _write_grouped(flat, acting)
    loops = loop_functions(flat, acting)
    if not loops:
        return replace(ticks, make=lambda libraries: _COMPILED.setdefault(flat, ticks.make(libraries)))
    text = write_loops(loops)
    exact = ticks.exact and all(len(flat.active_loops(clocks)) <= EXACT_LOOP for clocks in loops)

    def make(libraries: Sequence[ctypes.CDLL]) -> TickCode:
        found = find_loops(loops, libraries[-1])
        return _COMPILED.setdefault(flat, replace(ticks.make(libraries), exact=exact, loops=found))

    count = sum(function.n_instructions() for function in loops.values())
    return TickSources([*ticks.texts, text], ticks.operations + count, exact, make)


def loop_functions(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> dict[frozenset[TickPattern], Any]:
    """Return the equations of the algebraic loops at ticks: their mismatch, and its derivative."""
    found = {clocks: flat.loop_equations(clocks) for clocks in acting} if flat.loops.slices else {}
    return {c: share_terms(made.fast, f"loops{i}") for i, (c, made) in enumerate(found.items()) if made is not None}


def write_loops(loops: Mapping[frozenset[TickPattern], Any]) -> str:
    """Return the C code of the equations of algebraic loops."""
    generator = ca.CodeGenerator("loops.c")
    for function in loops.values():
        check_size(function)
        generator.add(function)
    return make_visible(generator.dump())


def find_loops(
    loops: Mapping[frozenset[TickPattern], Any], library: ctypes.CDLL
) -> dict[frozenset[TickPattern], StraightTick]:
    """Return the equations of algebraic loops in the library of `write_loops`."""
    return {clocks: StraightTick(f, address_of(library, f.name())) for clocks, f in loops.items()}


def compile_loops(
    flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]
) -> dict[frozenset[TickPattern], StraightTick]:
    """Return the equations of the algebraic loops at ticks, compiled: their mismatch, and its derivative."""
    loops = loop_functions(flat, acting)
    return find_loops(loops, load_compiled(write_loops(loops))) if loops else {}


def check_size(function: Any) -> None:
    """Refuse a function that is too large to be compiled as a whole.

    Raises
    ------
    CompilerError
        If it is.
    """
    if (count := function.n_instructions()) > LARGEST:
        raise CompilerError(
            f"a function of the diagram has {count} operations; at most {LARGEST} are compiled, as a compiler takes "
            "seconds for them. Leave out compile=True, or, if it is the derivative of the rates, take a solver without "
            "one: solver='RK45'."
        )


def _write_straight(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> TickSources | None:
    """Write ticks as one function each; None if they are no scalar operations."""
    found = {clocks: flat.at_tick(clocks).last.fast for clocks in acting}
    if not all(function.is_a("SXFunction") for function in found.values()):
        return None
    generator, functions = ca.CodeGenerator("ticks.c"), {}
    for i, (clocks, function) in enumerate(found.items()):
        functions[clocks] = share_terms(function, f"tick{i}")
        generator.add(functions[clocks])

    def make(libraries: Sequence[ctypes.CDLL]) -> TickCode:
        ticks = {clocks: StraightTick(f, address_of(libraries[0], f.name())) for clocks, f in functions.items()}
        return TickCode(ticks, True, libraries[0])

    count = sum(function.n_instructions() for function in functions.values())
    return TickSources([put_in_order(make_visible(generator.dump()))], count, True, make)


def _write_grouped(flat: FlatDiagram, acting: Sequence[frozenset[TickPattern]]) -> TickSources:
    programs = {clocks: flat.program_at(clocks) for clocks in acting}
    functions = {key: f for tick in programs.values() for key, f in tick.program.functions.items()}
    opaque = {id(flat.blocks.of(path, names)) for path, names in flat.order.steps if flat.table.blocks[path].opaque}
    kernels = write_kernels({key: f for key, f in functions.items() if key not in opaque})
    of_python = {key: f for key, f in functions.items() if key in opaque}

    def make(libraries: Sequence[ctypes.CDLL]) -> TickCode:
        address = address_of(libraries[0], "grouped")
        ticks = {clocks: GroupedTick(make_tables(p, kernels.of), of_python, address) for clocks, p in programs.items()}
        return TickCode(ticks, kernels.exact, libraries[0])

    count = sum(f.n_instructions() for key, f in functions.items() if key not in opaque)
    return TickSources([kernels.source], count, kernels.exact, make)


def address_of(library: ctypes.CDLL, name: str) -> int:
    """Return the address of a function in a library."""
    address = ctypes.cast(library[name], ctypes.c_void_p).value
    assert address is not None
    return address


def read_sources(*names: str) -> str:
    """Return C sources of this package, one behind the other."""
    return "\n".join(files(__package__).joinpath(name).read_text(encoding="utf-8") for name in names)


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
    function = load_compiled(master_source())[MASTER]
    function.restype = None
    return function


def master_source() -> str:
    """Return the C text of the loop over ticks."""
    return read_sources("newton.c", "remote.c", "master.c")


@lru_cache(maxsize=64)
def load_compiled(source: str, flags: tuple[str, ...] = (), known: str = "") -> ctypes.CDLL:
    """Return the library of a C source, which is compiled unless the cache has it.

    Parameters
    ----------
    source : str
        The C text.
    flags : tuple of str
        Flags after those of every library.
    known : str
        Whatever else the code depends on, as the processor that flags ask for.

    The key in the cache covers the source, the compiler with its version and flags, and the platform. A library is
    loaded only from a folder that belongs to the user alone.

    Raises
    ------
    CompilerError
        If there is no compiler, it fails, or others can write to the folder.
    FmuError
        If the cache can't be written.
    """
    library = _library_of(source, flags, known)
    if not _is_whole(library):
        compile_shared({"code.c": source}, library, more_flags=(*_FLAGS, *flags))
        size = _size_file(library)
        made = size.with_suffix(f".{os.getpid()}")
        made.write_text(str(library.stat().st_size))
        os.replace(made, size)
    return ctypes.CDLL(str(library))


def _size_file(library: Path) -> Path:
    return library.with_suffix(".size")


def _is_whole(library: Path) -> bool:
    """Whether a library is in the cache with its full length: to load a part of one ends Python."""
    try:
        return library.stat().st_size == int(_size_file(library).read_text())
    except (OSError, ValueError):
        return False


def _library_of(source: str, flags: tuple[str, ...] = (), known: str = "") -> Path:
    """Return the file of a source's library in the cache, whether it is there or not."""
    platform = native_platform()
    key = hashlib.sha256(
        "\0".join((platform, *describe_compiler(platform), *_FLAGS, *flags, known, source)).encode()
    ).hexdigest()
    folder = cache_folder().absolute() / "compiled"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise CompilerError(
            f"the folder of compiled diagrams can't be made: {error}. Set LOOPWRIGHT_CACHE to a folder of your own."
        ) from error
    _check_owner(folder)
    return folder / f"{key[:40]}{SUFFIXES[platform.rpartition('-')[2]]}"


def _check_owner(folder: Path) -> None:
    """Refuse a folder that others than the user can write to: what stands there is run."""
    if os.name != "posix":
        return
    was_open = folder.stat().st_mode & 0o022
    with suppress(OSError):
        folder.chmod(0o700)
    found = folder.stat()
    if found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise CompilerError(
            f"the folder of compiled diagrams {str(folder)!r} belongs to user {found.st_uid} with permissions "
            f"{found.st_mode & 0o777:o}; expected user {os.getuid()} and 700, since what stands there is run. Remove "
            "it, or set LOOPWRIGHT_CACHE to a folder of your own."
        )
    if was_open:  # what others may have left there would be run, too
        shutil.rmtree(folder)
        folder.mkdir(mode=0o700)
