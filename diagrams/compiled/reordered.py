"""A C function of scalar operations with its operations in another order: what can begin first comes first.

A processor looks a few hundred operations ahead. CasADi writes the operations of one result after those of another, so
that long chains that don't wait for each other would be gone through one after the other.
"""

from __future__ import annotations

import re

_ASSIGNED = re.compile(r"(a\d+)=(.*);")
_RESULT = re.compile(r"if \(res\[(\d+)\]!=0\) res\[\1\]\[(\d+)\]=(a\d+);")
_ARGUMENT = re.compile(r"(arg\[\d+\])\? \1(\[\d+\]) : 0")
_VARIABLE = re.compile(r"\ba\d+\b")
_FUNCTION = re.compile(r"(\w+)\(")
_CYCLES = {"sin": 45, "cos": 45, "tanh": 40, "sqrt": 15, "exp": 40, "log": 40, "pow": 60, "atan2": 60}
_SIMPLE, _DIVISION = 4, 13  # cycles
_CIRCLE = ("sin", "cos")


def reorder(source: str, name: str, limit: str) -> str | None:
    """Return a function of CasADi's C code once more, with its operations in the order in which they can begin.

    Parameters
    ----------
    source : str
        C code of one function whose arguments are all given, and whose results are all wanted.
    name : str
        Name of the new function, ``static int name(const double **arg, double **res)``. It returns 0, or 1 without
        having written anything, where an argument of a sine or a cosine is not below a limit.
    limit : str
        This limit, as C text.

    Returns
    -------
    str or None
        None where the function has other statements than assignments.
    """
    _, begun, body = source.partition("static int casadi_f0(")
    body, ended, _ = body.partition("{\n")[2].partition("  return 0;\n}")
    if not begun or not ended:
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
            results.append(f"  res[{found[1]}][{found[2]}] = v{now[found[3]]};")
            continue
        if not (found := _ASSIGNED.fullmatch(line)):
            return None
        variable, value = found.groups()
        needed = [now[a] for a in _VARIABLE.findall(value)]
        value = _ARGUMENT.sub(r"\1\2", _VARIABLE.sub(lambda a: f"v{now[a[0]]}", value))
        begins.append(max((ends[i] for i in needed), default=0))
        ends.append(begins[-1] + _cycles(value) if needed else 0)
        if (called := _FUNCTION.match(value)) and called[1] in _CIRCLE:
            angles.append(f"v{needed[0]}")
        now[variable] = len(values)
        values.append(value)
    order = sorted(range(len(values)), key=lambda i: (ends[i], i))
    lines = [f"  const double v{i} = {values[i]};" for i in order]
    is_far = " || ".join(f"!(fabs({angle}) < {limit})" for angle in dict.fromkeys(angles)) or "0"
    return "\n".join([
        f"static int {name}(const double **arg, double **res) {{", *lines, f"  if ({is_far}) return 1;", *results,
        "  return 0;", "}\n",
    ])  # fmt: skip


def _cycles(value: str) -> int:
    """Return about how long an operation takes."""
    if found := _FUNCTION.match(value):
        return _CYCLES.get(found[1], _SIMPLE)
    return _DIVISION if "/" in value else _SIMPLE
