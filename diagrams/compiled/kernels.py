"""Kernels: C functions over tables, one for each kind of block, made from the C code of the block's function."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any

import casadi as ca

from ...blocks.core import CompilerError
from ..flat import AND, CHOOSE, COPY, LESS, NOT, OR, TRUE, TRUE_OF, FlatDiagram, Program
from .generated_text import BODY, READ, WRITE

_SCRATCH = 8192  # numbers that a kernel keeps on the stack
_SINGLE = {
    COPY: "{0}",
    TRUE_OF: f"{{0}} > {TRUE!r}",
    LESS: f"{{0}} - {TRUE!r}",
    AND: "{0} && {1}",
    OR: "{0} || {1}",
    NOT: "!{0}",
    CHOOSE: "({0} ? {1} : 0) + (!{0} ? {2} : 0)",  # as CasADi writes it: a sum, in which no zero is negative
}
_HEAD = """#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#ifdef _WIN32
#define VISIBLE __declspec(dllexport)
#else
#define VISIBLE __attribute__((visibility("default")))
#endif
"""
_NAME = re.compile(
    r"^CASADI_SYMBOL_EXPORT\s+int\s+k(\d+)\(const\s+casadi_real[^\n]*\n\s*return\s+(casadi_f\d+)\(", re.M
)
_FIRST_LINE = re.compile(r"static\s+int\s+(casadi_f\d+)\(")


@dataclass(frozen=True)
class Kernel:
    """A C function over a table.

    Attributes
    ----------
    place : int
        Its place in the table of kernels.
    columns : tuple of (bool, int)
        Columns of its table: of an argument (False) or a result (True), by number.
    """

    place: int
    columns: tuple[tuple[bool, int], ...]


@dataclass(frozen=True)
class Kernels:
    """The kernels of a diagram.

    Attributes
    ----------
    source : str
        C code of all of them, with the function ``grouped`` that goes over the runs of a tick.
    of : mapping
        The kernel of each kind of operation.
    exact : bool
        Whether all of them are operations on scalars, as they are interpreted.
    operations : int
        Operations of one evaluation of each.
    of_python : mapping
        CasADi functions of the blocks that Python evaluates, by key; they have no kernel.
    """

    source: str
    of: Mapping[int | str, Kernel]
    exact: bool
    operations: int
    of_python: Mapping[int, Any]


def write_kernels(flat: FlatDiagram, programs: Iterable[Program]) -> Kernels:
    """Return the kernels of the block functions of programs, by key, and those of operations on single values.

    Raises
    ------
    CompilerError
        For a function that needs more memory than a kernel has.
    """
    opaque = {id(flat.blocks.of(path, names)) for path, names in flat.order.steps if flat.table.blocks[path].opaque}
    every = {key: f for program in programs for key, f in program.functions.items()}
    functions = {key: f for key, f in every.items() if key not in opaque}
    bodies: dict[str, Kernel] = {}
    texts, found = list[str](), dict[int | str, Kernel]()

    def add(key: int | str, columns: Iterable[tuple[bool, int]], body: str) -> None:
        kept = tuple(columns)
        text = f"{body}\0{kept}"
        if text not in bodies:
            bodies[text] = Kernel(len(bodies), kept)
            texts.append(_loop(bodies[text], body))
        found[key] = bodies[text]

    for name, expression in _SINGLE.items():
        count = 1 + max(map(int, re.findall(r"\{(\d)\}", expression)))
        value = expression.format(*(f"i{k}[0]" for k in range(count)))
        add(name, [*((False, k) for k in range(count)), (True, 0)], f"  r0[0] = {value};\n")
    keys = sorted(functions, key=lambda key: str(functions[key]))
    generator = ca.CodeGenerator("kernels.c")
    for i, key in enumerate(keys):
        function = functions[key]
        arguments = function.sx_in() if function.is_a("SXFunction") else function.mx_in()
        generator.add(ca.Function(f"k{i}", arguments, function.call(arguments)))
    code = re.sub(r"^casadi_real (casadi_\w+\()", r"static inline casadi_real \1", generator.dump(), flags=re.M)
    written, names = dict(BODY.findall(code)), {int(i): name for i, name in _NAME.findall(code)}
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
                f"a block's function needs {function.sz_w()} numbers of memory; at most {_SCRATCH} are compiled. Leave "
                "out compile=True."
            )
        used = [(False, k) for k in range(1, last + 1) if function.numel_in(k)]
        used += [(True, k) for k in range(function.n_out()) if function.numel_out(k)]
        call = [f"  const casadi_real *arg[{function.sz_arg()}] = {{i0}};\n"]
        call.append(f"  casadi_real *res[{function.sz_res()}] = {{0}}, w[{function.sz_w() + 1}];\n")
        call.append(f"  casadi_int iw[{function.sz_iw() + 1}];\n")
        call += [f"  res[{k}] = r{k};\n" if out else f"  arg[{k}] = i{k};\n" for out, k in used]
        add(key, used, _in_p("".join([*call, f"  {name}(arg, res, iw, w, 0);\n"]), last))
    called = set(re.findall(r"\b(casadi_f\d+)\(", "".join(written.values())))  # by functions that are no scalar ones
    kept = "\n".join(_drop(code, [name for name in scalar if name not in called]))
    table = ", ".join(f"kernel{k.place}" for k in bodies.values())
    parts = [_HEAD, kept, *texts]
    parts += ["typedef void (*kernel)(int32_t, const int32_t *, double *, const double *);"]
    return Kernels(
        "\n".join([*parts, f"static const kernel kernels[] = {{{table}}};", _driver()]),
        found,
        len(scalar) == len(keys),
        sum(function.n_instructions() for function in functions.values()),
        {key: f for key, f in every.items() if key in opaque},
    )


def _in_p(body: str, last: int) -> str:
    """Return a body in which the last argument, the parameters, has a name of its own."""
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
        "  const double *const i0 = v;\n  (void)i0, (void)p;" if not any(c == (False, 0) for c in kernel.columns)
        else "  (void)p;",
        f"  for (; n > 0; n--, o += {width}) {{",
        *named,
        body.rstrip("\n"),
        "  }",
        "}",
    ]  # fmt: skip
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


@lru_cache(maxsize=1)
def _driver() -> str:
    return files(__package__).joinpath("grouped.c").read_text(encoding="utf-8")
