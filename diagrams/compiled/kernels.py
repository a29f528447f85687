"""Kernels: a function over a table for each kind of block, as generated code or as programs of the virtual machine."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import chain
from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from ...blocks.core import CompilerError
from ..flat import AND, CHOOSE, COPY, LESS, NOT, OR, TRUE, TRUE_OF, FlatDiagram, Program
from .bound_functions import CodeOfFunctions, GeneratedCode, operation_names
from .generated_text import BODY, READ, WRITE
from .machine import BlockProgram, make_program

_SCRATCH = 8192  # numbers that a kernel keeps on the stack
_TOGETHER, _VALUES = 16, 4096  # blocks that the machine evaluates at a time, and numbers of their memory, at most
_TABLE = "loopwright_kernels"
_HEAD = """#include <math.h>
#include <stdint.h>

#ifdef _WIN32
#define VISIBLE __declspec(dllexport)
#else
#define VISIBLE __attribute__((visibility("default")))
#endif
"""
_NAME = re.compile(
    r"^CASADI_SYMBOL_EXPORT\s+int\s+k(\d+)\(const\s+casadi_real[^\n]*\n\s*return\s+(casadi_f\d+)\(", re.M
)
_CALL = re.compile(r"\b(casadi_f\d+)\(")
_FIRST_LINE = re.compile(r"static\s+int\s+(casadi_f\d+)\(")


@dataclass(frozen=True)
class Kernel:
    """A function over a table, at a place in the table of kernels."""

    place: int
    columns: tuple[tuple[bool, int], ...]  # of an argument (False) or a result (True), by number


@dataclass(frozen=True, eq=False)
class Kernels:
    """The kernels of a diagram where C finds them."""

    of: Mapping[int | str, Kernel]  # by kind of operation
    of_python: Mapping[int, Any]  # functions of blocks that Python evaluates, which have no kernel
    generated: int | None = None  # address of the table of generated kernels; None: programs
    programs: Sequence[BlockProgram] = ()  # of the virtual machine, by place


class BlockKinds:
    """The kinds of blocks in some functions of a large diagram, and the operations on single values."""

    def __init__(self, flat: FlatDiagram, programs: Iterable[Program]):
        opaque = {id(flat.blocks.of(path, names)) for path, names in flat.order.steps if flat.table.blocks[path].opaque}
        self._most = Counter[int | str]()  # operations of each kind in a function
        every = dict[int, Any]()
        for program in programs:
            self._most |= Counter(op.kernel for op in program.operations)
            every |= program.functions
        self._opaque = {key: f for key, f in every.items() if key in opaque}
        self._functions = {key: f for key, f in every.items() if key not in opaque}
        # Whether generated code has the bits of interpreted functions: all are operations on scalars.
        self.exact = all(function.is_a("SXFunction") for function in self._functions.values())
        self.operations = sum(function.n_instructions() for function in self._functions.values())
        self._on_machine: Kernels | None = None

    def find(self, code: CodeOfFunctions) -> Kernels:
        """Return the kernels: in a library of generated code, or for the virtual machine."""
        if isinstance(code, GeneratedCode):
            return Kernels(self._generated[1], self._opaque, code.address(_TABLE))
        if self._on_machine is None:
            self._on_machine = self._make_programs(operation_names(code.library))
        return self._on_machine

    # --- programs ----------------------------------------------------------------------------------------------------

    def _make_programs(self, names: Sequence[str]) -> Kernels:
        """Return programs; blocks that are no scalar operations of the machine are evaluated by Python."""
        of, of_python, programs = dict[int | str, Kernel](), dict(self._opaque), list[BlockProgram]()
        for key, function in chain(single_functions().items(), self._functions.items()):
            if (program := _make_block_program(function, names, self._most[key])) is None:
                assert isinstance(key, int)
                of_python[key] = function
            else:
                of[key] = Kernel(len(programs), _columns(function))
                programs.append(program)
        return Kernels(of, of_python, programs=programs)

    # --- generated code ----------------------------------------------------------------------------------------------

    @property
    def source(self) -> str:
        """C code of all kernels, with their table."""
        return self._generated[0]

    @cached_property
    def _generated(self) -> tuple[str, Mapping[int | str, Kernel]]:
        """The C code, and its kernels: equal code is one, for several keys."""
        bodies: dict[str, Kernel] = {}
        texts, found = list[str](), dict[int | str, Kernel]()

        def add(key: int | str, columns: Iterable[tuple[bool, int]], body: str) -> None:
            kept = tuple(columns)
            text = f"{body}\0{kept}"
            if text not in bodies:
                bodies[text] = Kernel(len(bodies), kept)
                texts.append(_loop(bodies[text], body))
            found[key] = bodies[text]

        # All functions are generated in one go, so that CasADi writes what they share once.
        functions = dict(single_functions())
        functions.update(sorted(self._functions.items(), key=lambda item: str(item[1])))
        keys = [*functions]
        generator = ca.CodeGenerator("kernels.c")
        for i, key in enumerate(keys):
            function = functions[key]
            arguments = function.sx_in() if function.is_a("SXFunction") else function.mx_in()
            generator.add(ca.Function(f"k{i}", arguments, function.call(arguments)))
        code = re.sub(r"^casadi_real (casadi_\w+\()", r"static inline casadi_real \1", generator.dump(), flags=re.M)
        written, names = dict(BODY.findall(code)), {int(i): name for i, name in _NAME.findall(code)}
        # Scalar code is inlined into the loop over the table; other code is called with pointers to its columns.
        scalar = []
        for i, key in enumerate(keys):
            function, name = functions[key], names[i]
            last = function.n_in() - 1
            body = WRITE.sub(r"r\1[\2]=", READ.sub(lambda m: f"i{m[1]}[{m[2]}]", written[name]))
            body = body.replace("  return 0;\n", "")
            if function.is_a("SXFunction") and not re.search(r"\b(arg|res|iw|w)\b", body):
                scalar.append(name)
                used = [(False, int(k)) for k in sorted(set(re.findall(r"\bi(\d+)\[", body)), key=int)]
                used += [(True, int(k)) for k in sorted(set(re.findall(r"\br(\d+)\[", body)), key=int)]
                add(key, [c for c in used if c != (False, 0)], _in_p(body, last))
                continue
            if function.sz_w() > _SCRATCH or function.sz_iw() > _SCRATCH:
                raise CompilerError(
                    f"a block's function needs {function.sz_w()} numbers of memory; at most {_SCRATCH} are compiled. "
                    "Leave out compile=True."
                )
            call = [f"  const casadi_real *arg[{function.sz_arg()}] = {{i0}};\n"]
            call.append(f"  casadi_real *res[{function.sz_res()}] = {{0}}, w[{function.sz_w() + 1}];\n")
            call.append(f"  casadi_int iw[{function.sz_iw() + 1}];\n")
            used = [*_columns(function)]
            call += [f"  res[{k}] = r{k};\n" if out else f"  arg[{k}] = i{k};\n" for out, k in used]
            add(key, used, _in_p("".join([*call, f"  {name}(arg, res, iw, w, 0);\n"]), last))
        # Inlined functions are left out of the text, unless another one calls them.
        called = {name for body in written.values() for name in _CALL.findall(body)}
        kept = "\n".join(_drop(code, [name for name in scalar if name not in called]))
        table = ", ".join(f"kernel{k.place}" for k in bodies.values())
        parts = [_HEAD, kept, *texts, "typedef void (*kernel)(int32_t, const int32_t *, double *, const double *);"]
        declared = f"VISIBLE extern const kernel {_TABLE}[];\nconst kernel {_TABLE}[] = {{{table}}};\n"
        return "\n".join([*parts, declared]), found


def _columns(function: Any) -> tuple[tuple[bool, int], ...]:
    """Return all arguments but the time, and all results, that have entries."""
    given = [(False, k) for k in range(1, function.n_in()) if function.numel_in(k)]
    return (*given, *((True, k) for k in range(function.n_out()) if function.numel_out(k)))


@cache
def single_functions() -> Mapping[int | str, Any]:
    """Return the operations on single values as functions (t, a, …, p), in which t and p are empty."""
    a, b, c = (ca.SX.sym(name) for name in "abc")
    made = {
        COPY: ([a], a),
        TRUE_OF: ([a], a > TRUE),
        LESS: ([a], a - TRUE),
        AND: ([a, b], ca.logic_and(a, b)),
        OR: ([a, b], ca.logic_or(a, b)),
        NOT: ([a], ca.logic_not(a)),
        CHOOSE: ([a, b, c], ca.if_else(a, b, c)),
    }
    empty = ca.SX(0, 1)
    return {name: ca.Function(name, [empty, *given, empty], [result]) for name, (given, result) in made.items()}


_BLOCK_PROGRAMS: WeakKeyDictionary[Any, dict[int, BlockProgram | None]] = WeakKeyDictionary()


def _make_block_program(function: Any, names: Sequence[str], most: int) -> BlockProgram | None:
    """Return the program of a block's function for at most so many blocks; None where the machine has none."""
    if not function.is_a("SXFunction"):
        return None
    together = min(_TOGETHER, max(1, _VALUES // max(1, function.n_instructions()))) if most > 1 else 1
    known = _BLOCK_PROGRAMS.setdefault(function, {})
    if together not in known:
        program = known[together] = None
        if (program := make_program(function, names, together)) is not None:
            columns = np.full(function.n_in() + function.n_out(), -1, dtype=np.int32)
            for j, (out, k) in enumerate(_columns(function)):
                columns[k + function.n_in() * out] = j
            known[together] = BlockProgram(program, together, columns, function.n_in())
    return known[together]


def _in_p(body: str, last: int) -> str:
    """Return a body in which the last argument, the parameters, has its own name."""
    return re.sub(rf"\bi{last}\b", "q", body)


def _loop(kernel: Kernel, body: str) -> str:
    width, named = len(kernel.columns), []
    for j, (out, k) in enumerate(kernel.columns):
        name = f"r{k}" if out else f"i{k}"
        if not out and not re.search(rf"\bi{k}\b", body):  # the parameters
            named.append(f"    const double *q = p + o[{j}];")
        else:
            named.append(f"    {'' if out else 'const '}double *{name} = v + o[{j}];")
    lines = [
        f"static void kernel{kernel.place}(int32_t n, const int32_t *o, double *v, const double *p) {{",
        "  const double *const i0 = v;",
        "  (void)i0, (void)p;",
        f"  for (; n > 0; n--, o += {width}) {{",
        *named,
        body.rstrip("\n"),
        "  }",
        "}",
    ]
    return "\n".join(lines)


def _drop(code: str, names: Iterable[str]) -> list[str]:
    """Return CasADi's code without functions that are written as kernels, and without its lists about functions."""
    dropped = set(names)
    lines, skipping = [], False
    for line in code.split("\n"):
        if match := _FIRST_LINE.match(line):
            skipping = match[1] in dropped
        elif line.startswith("CASADI_SYMBOL_EXPORT"):
            skipping = True
        if not skipping:
            lines.append(line)
        elif line.startswith("}") or (line.startswith("CASADI_SYMBOL_EXPORT") and line.endswith("}")):
            skipping = False
    return lines
