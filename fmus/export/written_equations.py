"""The equations of an exported FMU, read back from its sources as functions."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import casadi as ca

from ...blocks.core import FmuError
from .own_sources import are_of_this_version, read_packed_sources

_BINARY: Mapping[str, Callable[[Any, Any], Any]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    "==": ca.eq,
    "!=": ca.ne,
    "&&": ca.logic_and,
    "||": ca.logic_or,
}
_CALLS: Mapping[str, Callable[..., Any]] = {
    "exp": ca.exp,
    "log": ca.log,
    "pow": ca.power,
    "sqrt": ca.sqrt,
    "casadi_sq": lambda a: a * a,
    "sin": ca.sin,
    "cos": ca.cos,
    "tan": ca.tan,
    "asin": ca.asin,
    "acos": ca.acos,
    "atan": ca.atan,
    "floor": ca.floor,
    "ceil": ca.ceil,
    "fmod": ca.fmod,
    "casadi_fabs": ca.fabs,
    "fabs": ca.fabs,
    "casadi_sign": ca.sign,
    "copysign": ca.copysign,
    "erf": ca.erf,
    "casadi_fmin": ca.fmin,
    "casadi_fmax": ca.fmax,
    "fmin": ca.fmin,
    "fmax": ca.fmax,
    "sinh": ca.sinh,
    "cosh": ca.cosh,
    "tanh": ca.tanh,
    "asinh": ca.asinh,
    "acosh": ca.acosh,
    "atanh": ca.atanh,
    "atan2": ca.atan2,
    "casadi_log1p": ca.log1p,
    "log1p": ca.log1p,
    "casadi_expm1": ca.expm1,
    "expm1": ca.expm1,
    "casadi_hypot": ca.hypot,
    "hypot": ca.hypot,
    "remainder": ca.remainder,
}
_DECLARED, _END = re.compile(r"casadi_real\s"), re.compile(r"return\s0;")
_SET = re.compile(r"(\w+)=(.+);")
_GIVEN = re.compile(r"arg\[(\d+)\]\? ?arg\[\d+\]\[(\d+)\] ?: ?0")
_RESULT = re.compile(r"if\s\(res\[0\]!=0\)\sres\[0\]\[(\d+)\]=(\w+);")
_OPERATION = re.compile(r"\((\w+|[12]\.)(\+|-|\*|/|<=|<|==|!=|&&|\|\|)(\w+)\)")
_PREFIX = re.compile(r"\(([-!])(\w+)\)")
_CHOICE = re.compile(r"\((\w+)\? ?(\w+) ?: ?0\)")
_CALL = re.compile(r"(\w+)\((\w+)(?:,(\w+))?\)")
_VARIABLE = re.compile(r'\{"((?:[^"\\]|\\.)*)", LW_([A-Z]+), \w+, \w+, (\d+), (\d+), ')


@dataclass(frozen=True)
class WrittenVariable:
    """A variable of an exported FMU.

    ``kind``: one of time, fixed, tunable, input, state, discrete, derivative, output, indicator.
    ``first``, ``size``: its interval among the values of an instance (``fmu_sources/model.h``).
    """

    name: str
    kind: str
    first: int
    size: int


@dataclass(frozen=True, eq=False)
class WrittenEquations:
    """The equations of an exported FMU.

    ``derivative``, ``output``: ``(t, x, u, p) -> dx`` and ``(t, x, u, p) -> y``, of scalar operations.
    ``states``: number of continuous states; discrete ones follow them in x.
    ``first``: where p, u, x, y and the setting of the internal step begin among the values, and the integrator.
    """

    derivative: Any
    output: Any
    variables: tuple[WrittenVariable, ...]
    states: int
    first: Mapping[str, int]


def read_equations(path: Path) -> WrittenEquations:
    """Read the equations of an FMU that Loopwright has exported from its sources.

    Raises `FmuError` if it has no such sources, or those of another version, has events, or its equations are no scalar
    operations.
    """
    try:
        sources = read_packed_sources(path)
        text = sources["model.c"]
    except (OSError, KeyError, zipfile.BadZipFile) as error:
        raise FmuError(f"its sources can't be read: {error}. Export it with Loopwright.") from None
    if not are_of_this_version(sources):
        raise FmuError("another version of Loopwright has exported it. Export it again.")
    return read_text(text)


@lru_cache(maxsize=8)
def read_text(text: str) -> WrittenEquations:
    """Read the equations of an FMU from the text of its ``model.c``; see `read_equations`."""
    sizes = {name: int(count) for name, count in re.findall(r"#define\sLW_N_([A-Z])\s(\d+)", text)}
    if not sizes.keys() >= {"P", "U", "X", "D", "Y", "Z"}:
        raise FmuError("its sources are others than those of an exported FMU. Export it with Loopwright.")
    if sizes["Z"]:
        raise FmuError("it has events.")
    n = sizes["X"] + sizes["D"]
    given = [1, n, sizes["U"], sizes["P"]]
    derivative = _read_function(text, "lw_derivative", given, sizes["X"])
    output = _read_function(text, "lw_output", given, sizes["Y"])
    table = text[text.index("lw_variables[LW_N_VARIABLES]") :]
    found = _VARIABLE.findall(table[: table.index("};")])
    variables = tuple(WrittenVariable(name, kind.lower(), int(at), int(size)) for name, kind, at, size in found)
    first = {"p": 1, "u": 1 + sizes["P"]}
    first["x"] = first["u"] + sizes["U"]
    first["y"] = first["x"] + n + sizes["X"]
    return WrittenEquations(derivative, output, variables, sizes["X"], first)


def _read_function(text: str, name: str, given: list[int], made: int) -> Any:
    """Return a function of scalar operations from the C text that CasADi has written for it."""
    head = text.find(f"/* {name}:(")
    if head < 0:
        raise FmuError(f"its sources have no function {name!r}.")
    begin = text.index("{\n", head)
    symbols = [ca.SX.sym("txup"[i], size) for i, size in enumerate(given)]
    values: dict[str, Any] = {}
    results = [ca.SX(0)] * made
    for line in map(str.strip, _END.split(text[begin + 2 :], 1)[0].splitlines()):
        if not line or _DECLARED.match(line):
            continue
        if found := _RESULT.fullmatch(line):
            results[int(found[1])] = values[found[2]]
            continue
        if not (found := _SET.fullmatch(line)):
            raise _other(name, line)
        values[found[1]] = _read_value(name, found[2], values, symbols)
    return ca.Function(name, symbols, [ca.vertcat(*results) if results else ca.SX(0, 1)], {"cse": True})


def _read_value(name: str, text: str, values: Mapping[str, Any], symbols: list[Any]) -> Any:
    """Return the value of one operation."""
    if found := _GIVEN.fullmatch(text):
        return symbols[int(found[1])][int(found[2])]
    if found := _OPERATION.fullmatch(text):
        left = ca.SX(float(found[1])) if found[1].endswith(".") else values[found[1]]
        return _BINARY[found[2]](left, values[found[3]])
    if found := _PREFIX.fullmatch(text):
        return -values[found[2]] if found[1] == "-" else ca.logic_not(values[found[2]])
    if found := _CHOICE.fullmatch(text):
        return ca.if_else(values[found[1]], values[found[2]], 0)
    if (found := _CALL.fullmatch(text)) and found[1] in _CALLS:
        return _CALLS[found[1]](*(values[argument] for argument in found.groups()[1:] if argument is not None))
    if text in values:
        return values[text]
    try:
        return ca.SX(float(text.replace("casadi_", "")))
    except ValueError:
        raise _other(name, text) from None


def _other(name: str, text: str) -> FmuError:
    return FmuError(f"found {text[:60]!r} in its function {name!r}; its equations are no scalar operations.")
