"""CasADi's C code, made ready for the compiler: visible functions, vectors without questions, operations in order.

The operations: a processor looks a few hundred of them ahead. CasADi writes those of one result after those of another,
so that long chains that don't wait for each other would be gone through one after the other. Put in another order, what
can begin first comes first.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import casadi as ca

READ = re.compile(r"arg\[(\d+)\]\?\s*arg\[\1\]\[(\d+)\]\s*:\s*0")
"""An entry of an argument, or 0 where the argument is left out."""
WRITE = re.compile(r"if\s*\(res\[(\d+)\]!=0\)\s*res\[\1\]\[(\d+)\]=")
"""An entry of a result, which is written unless the result is left out."""
BODY = re.compile(r"^static\s+int\s+(casadi_f\d+)\(const\s+casadi_real\*\*\s*arg,[^\n]*\{\n(.*?)^\}", re.M | re.S)
"""A function's name and its text."""
_HELPER = re.compile(r"^(?=casadi_real\b)", re.MULTILINE)  # a line that defines one
_CALL = re.compile(r"\b(casadi_f\d+)\(")
_ASSIGNED = re.compile(r"(a\d+)=(.*);")
_RESULT = re.compile(r"res\[(\d+)\]\[(\d+)\]=(a\d+);")
_VARIABLE = re.compile(r"\ba\d+\b")
_FUNCTION = re.compile(r"(\w+)\(")
_CYCLES = {"sin": 45, "cos": 45, "tanh": 40, "sqrt": 15, "exp": 40, "log": 40, "pow": 60, "atan2": 60}
_SIMPLE, _DIVISION = 4, 13
"""Cycles that functions and other operations take, about."""
_CIRCLE = ("sin", "cos")  # angles of these are compared with a limit


def write_functions(name: str, functions: Iterable[Any]) -> str:
    """Return the C code of CasADi functions that can be found in a library; its small helpers are inlined.

    The functions are called with all arguments and results that have entries. So those that others of them don't call
    ask no longer, at each number, whether its vector is there: a tick of many signals takes 5 % less time. ``name``
    sets their helpers apart from those of other texts.
    """
    generator = ca.CodeGenerator(f"{name}.c")
    for function in functions:
        generator.add(function)
    source = generator.dump()
    called = {name for _, body in BODY.findall(source) for name in _CALL.findall(body)}

    def without_questions(found: re.Match[str]) -> str:
        return found[0] if found[1] in called else WRITE.sub(r"res[\1][\2]=", READ.sub(r"arg[\1][\2]", found[0]))

    return "#define GCC_HASCLASSVISIBILITY\n" + _HELPER.sub("static inline ", BODY.sub(without_questions, source))


def put_in_order(source: str) -> str:
    """Return C code of `write_functions` with the operations of each function in the order in which they can begin.

    Every operation is the one it was, so all bits stay. Functions with other statements than assignments stay as they
    are.
    """

    def ordered(found: re.Match[str]) -> str:
        lines = _order(found[2])
        if lines is None:
            return found[0]
        head = found[0][: found.start(2) - found.start()]
        return f"{head}{lines.operations}{lines.results}  return 0;\n}}"

    return BODY.sub(ordered, source)


def reorder(source: str, name: str, limit: str) -> str | None:
    """Return a function of `write_functions` once more, with its operations in the order in which they can begin.

    The new function, ``static int name(const double **arg, double **res)``, returns 0, or 1 without having written
    anything, where an argument of a sine or a cosine is not below ``limit``, a C text. None where it isn't made of
    assignments alone.
    """
    found = BODY.search(source)
    lines = None if found is None else _order(found[2])
    if lines is None:
        return None
    is_far = " || ".join(f"!(fabs({angle}) < {limit})" for angle in dict.fromkeys(lines.angles)) or "0"
    return (
        f"static int {name}(const double **arg, double **res) {{\n{lines.operations}  if ({is_far}) return 1;\n"
        f"{lines.results}  return 0;\n}}\n"
    )


@dataclass(frozen=True)
class _Lines:
    """A function's statements: its operations, the results that are written, and the angles of sines and cosines."""

    operations: str
    results: str
    angles: list[str]


def _order(body: str) -> _Lines | None:
    """Return the statements of a function in another order; None where some are no assignments."""
    body, ended, _ = body.partition("  return 0;\n")
    if not ended:
        return None
    values: list[str] = []
    begins: list[int] = []
    ends: list[int] = []
    results: list[str] = []
    angles: list[str] = []
    now: dict[str, int] = {}
    for line in map(str.strip, body.splitlines()):
        if line.startswith("casadi_real ") or not line:
            continue
        if found := _RESULT.fullmatch(line):
            results.append(f"  res[{found[1]}][{found[2]}]=v{now[found[3]]};\n")
            continue
        if not (found := _ASSIGNED.fullmatch(line)):
            return None
        variable, value = found.groups()
        needed = [now[a] for a in _VARIABLE.findall(value)]
        value = _VARIABLE.sub(lambda a: f"v{now[a[0]]}", value)
        begins.append(max((ends[i] for i in needed), default=0))
        ends.append(begins[-1] + _cycles(value) if needed else 0)
        if (called := _FUNCTION.match(value)) and called[1] in _CIRCLE:
            angles.append(f"v{needed[0]}")
        now[variable] = len(values)
        values.append(value)
    order = sorted(range(len(values)), key=lambda i: (ends[i], i))
    return _Lines("".join(f"  const double v{i}={values[i]};\n" for i in order), "".join(results), angles)


def _cycles(value: str) -> int:
    """Return about how long an operation takes."""
    if found := _FUNCTION.match(value):
        return _CYCLES.get(found[1], _SIMPLE)
    return _DIVISION if "/" in value else _SIMPLE
