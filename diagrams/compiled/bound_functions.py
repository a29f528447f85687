"""Functions of a diagram as the loop in C calls them: by generated code, by the virtual machine, or by Python."""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any
from weakref import WeakKeyDictionary, WeakSet

import numpy as np

from ...blocks.interrupts import INTERRUPTS
from ..flat import bind_function
from .machine import MachineProgram, make_program

CALL = ctypes.CFUNCTYPE(ctypes.c_int)
"""Kind of a function without arguments whose result is an integer."""
TICK = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 4, ctypes.c_int)
"""Kind of the function of a tick."""


def fields_of(kind: Any, names: str) -> list[tuple[str, Any]]:
    """Return fields of one kind of a struct."""
    return [(name, kind) for name in names.split()]


class TickStructure(ctypes.Structure):
    """A function with its vectors, as C knows it."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("evaluate", "arguments", "results", "iw", "w")]


@dataclass(frozen=True, eq=False)
class BoundFunction:
    """A function bound to vectors: it as C knows it, and whatever must live as long as that."""

    structure: TickStructure
    arguments: Sequence[np.ndarray]
    results: Sequence[np.ndarray]
    inner: Any  # what ``structure.iw`` leads to: a struct, or integers
    memory: np.ndarray  # what it works in; ``structure.w`` leads to it where C is given that
    kept: list[Any]  # whatever else must live
    failures: list[Exception] = field(default_factory=list)
    """The last error of Python within a call that has failed."""


BlockBinder = Callable[..., Any]
"""``bind_block(stage, t, c, again=…)`` returns a block between traced stages, see `model_exchange_in_c`."""


@dataclass(frozen=True, eq=False)
class FunctionInC(ABC):
    """A function of a diagram that the loop in C calls.

    This is the one way to what is behind the loop's pointers, whatever evaluates the function: generated code, the
    virtual machine, Python, tables over either of them, or a sequence of such stages with FMUs between them.
    """

    @abstractmethod
    def bind(
        self, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], bind_block: BlockBinder | None = None
    ) -> BoundFunction:
        """Return it bound to vectors, for one call at a time; what is returned must live as long as C calls it.

        ``bind_block`` binds the blocks that an evaluator evaluates, where there are some.
        """

    @property
    def calls_python(self) -> bool:
        """Whether C has Python evaluate parts of it: an interrupt (Ctrl-C) then waits until C has returned."""
        return False

    def hand_over(self, to: Any) -> None:  # noqa: B027 (most have nothing to hand over)
        """Let generated code of the same function take its place wherever it is bound; C must not run meanwhile."""


@dataclass(frozen=True, eq=False)
class CompiledFunction(FunctionInC):
    """A CasADi function, and the C function of the same name in a library."""

    function: Any
    address: int

    @property
    def pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each entry of its first result that may not be 0."""
        rows, columns = self.function.sparsity_out(0).get_triplet()
        return np.array(rows, dtype=np.int64), np.array(columns, dtype=np.int64)

    def bind(
        self, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], bind_block: BlockBinder | None = None
    ) -> BoundFunction:
        """Return it bound to vectors, for one call at a time."""
        f = self.function
        return self._bind(arguments, results, np.zeros(f.sz_iw() + 1, dtype=np.int64), np.zeros(f.sz_w() + 1))

    def _bind(
        self, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], iw: Any, w: np.ndarray
    ) -> BoundFunction:
        given = list_vectors(arguments, self.function.sz_arg())
        made = list_vectors(results, self.function.sz_res())
        first = at(iw) if isinstance(iw, np.ndarray) else ctypes.addressof(iw)
        structure = TickStructure(self.address, ctypes.addressof(given), ctypes.addressof(made), first, at(w))
        return BoundFunction(structure, arguments, results, iw, w, [given, made])


@dataclass(frozen=True, eq=False)
class MachineFunction(CompiledFunction):
    """A CasADi function as a program of the virtual machine, whose C function is at the address."""

    program: MachineProgram
    _bound: WeakSet[BoundFunction] = field(default_factory=WeakSet)

    def bind(
        self, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], bind_block: BlockBinder | None = None
    ) -> BoundFunction:
        """Return it bound to vectors, for one call at a time."""
        program, values = self.program.bind()
        bound = self._bind(arguments, results, program, values)
        self._bound.add(bound)
        return bound

    def hand_over(self, to: Any) -> None:
        """Let generated code of the same function take over."""
        for bound in self._bound:
            program, made = bound.inner, to.bind(bound.arguments, bound.results)
            program.iw, program.w = made.structure.iw, made.structure.w
            program.generated = made.structure.evaluate
            bound.kept.append(made)


_Vectors = ctypes.POINTER(ctypes.c_void_p)
_Call = ctypes.CFUNCTYPE(ctypes.c_int, _Vectors, _Vectors, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int)


@dataclass(frozen=True, eq=False)
class CalledFunction(CompiledFunction):
    """A CasADi function that C has Python evaluate: one of matrices, such as a table."""

    calls_python = True

    def bind(
        self, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], bind_block: BlockBinder | None = None
    ) -> BoundFunction:
        """Return it bound to vectors, for one call at a time."""
        f = self.function
        taken, made = (
            [np.zeros(size(i)) for i in range(n)] for size, n in ((f.numel_in, f.n_in()), (f.nnz_out, f.n_out()))
        )
        bound, failures = bind_function(f, taken, made), list[Exception]()
        inputs = [(i, v.ctypes.data, v.nbytes) for i, v in enumerate(taken) if v.size]
        outputs = [(i, v.ctypes.data, v.nbytes) for i, v in enumerate(made) if v.size]

        def call(given: Any, wanted: Any, *_: Any) -> int:
            for i, address, size in inputs:
                ctypes.memmove(address, given[i], size)
            try:
                call_for_c(bound.call)
            except Exception as error:  # C can't raise it: Python evaluates this instant again, and says what it is
                failures[:] = [error]
                return 1
            for i, address, size in outputs:
                ctypes.memmove(wanted[i], address, size)
            return 0

        function = _Call(call)
        lists = list_vectors(arguments, f.n_in()), list_vectors(results, f.n_out())
        structure = TickStructure(
            ctypes.cast(function, ctypes.c_void_p).value, *map(ctypes.addressof, lists), None, None
        )
        kept = [taken, made, bound, function, lists]
        return BoundFunction(structure, arguments, results, None, np.zeros(0), kept, failures)


def call_for_c(call: Callable[[], None]) -> None:
    """Call Python for C; an interrupt waits until C has returned."""
    try:
        INTERRUPTS.heard = True
        call()
    except KeyboardInterrupt:
        INTERRUPTS.came = True
    finally:
        INTERRUPTS.heard = False


@dataclass(frozen=True, eq=False)
class CodeOfFunctions(ABC):
    """Where C finds functions: a library of generated code, or the virtual machine."""

    library: ctypes.CDLL

    @abstractmethod
    def find(self, function: Any) -> CompiledFunction:
        """Return a CasADi function as C calls it."""


@dataclass(frozen=True, eq=False)
class GeneratedCode(CodeOfFunctions):
    """A library with the code of functions."""

    def find(self, function: Any) -> CompiledFunction:
        """Return a function that the library holds."""
        return CompiledFunction(function, self.address(function.name()))

    def address(self, name: str) -> int:
        """Return the address of a C function."""
        return address_of(self.library, name)


@dataclass(frozen=True, eq=False)
class Machine(CodeOfFunctions):
    """The virtual machine of a library; functions of other operations than its own are evaluated by Python."""

    def find(self, function: Any) -> CompiledFunction:
        """Return a function as a program, or as a call of Python."""
        if function not in _PROGRAMS:
            names, scalar = operation_names(self.library), function.is_a("SXFunction")
            _PROGRAMS[function] = make_program(function, names) if scalar else None
        if (program := _PROGRAMS[function]) is None:
            return CalledFunction(function, 0)
        return MachineFunction(function, address_of(self.library, "loopwright_machine"), program)


_PROGRAMS: WeakKeyDictionary[Any, MachineProgram | None] = WeakKeyDictionary()


@lru_cache(maxsize=4)
def operation_names(library: ctypes.CDLL) -> tuple[str, ...]:
    """Return the names of the virtual machine's operations, by their codes."""
    function = library["loopwright_operations"]
    function.restype = ctypes.c_char_p
    return tuple(function().decode().split())


def address_of(library: ctypes.CDLL, name: str) -> int:
    """Return the address of a function in a library."""
    address = ctypes.cast(library[name], ctypes.c_void_p).value
    assert address is not None
    return address


class MemoryForC:
    """What lives as long as C may read it: vectors, structs and bound functions, which C finds by their addresses."""

    def __init__(self, *kept: Any):
        self.kept: list[Any] = [*kept]

    def own(self, vector: np.ndarray) -> int | None:
        """Take a vector, and return its address; None without entries."""
        self.kept.append(vector)
        return at(vector)

    def zeros(self, n: int) -> int | None:
        """Return the address of a new vector."""
        return self.own(np.zeros(n))

    def array(self, structures: Sequence[ctypes.Structure]) -> int | None:
        """Return the address of structs, one behind the other; None without any."""
        if not structures:
            return None
        array = (type(structures[0]) * len(structures))(*structures)
        self.kept.append(array)
        return ctypes.addressof(array)

    def bind(
        self,
        function: FunctionInC,
        arguments: Sequence[np.ndarray],
        results: Sequence[np.ndarray],
        bind_block: BlockBinder | None = None,
    ) -> TickStructure:
        """Return a function that is bound to vectors, as C knows it."""
        self.kept.append(function.bind(arguments, results, bind_block))
        structure: TickStructure = self.kept[-1].structure
        return structure


def bind_call(tick: FunctionInC, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> Callable[[], None]:
    """Return a tick bound to the vectors (t, x, w, p) and (x_next, z, log, ok) of a run as a call from Python."""
    bound = tick.bind(arguments, results)
    of = bound.structure
    function = TICK(of.evaluate)

    def call() -> None:
        if function(of.arguments, of.results, of.iw, of.w, 0):
            raise bound.failures.pop()

    def call_kept() -> None:
        with INTERRUPTS.kept():
            call()

    return call_kept if tick.calls_python else call


def list_vectors(vectors: Sequence[np.ndarray], length: int) -> Any:
    """Return the addresses of vectors as C's array of at least this length."""
    found = (ctypes.c_void_p * length)()
    for i, vector in enumerate(vectors):
        found[i] = at(vector)
    return found


def at(vector: np.ndarray) -> int | None:
    """Return the address of a vector; None without entries."""
    return vector.__array_interface__["data"][0] if vector.size else None  # .ctypes.data takes four times as long
