"""Numbers, texts and arrays as C text, broken into lines."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

_WIDTH = 110
"""Characters of a line of C for a target."""


def c_number(value: float) -> str:
    """Return a number as C text, exactly; it is of single precision nowhere."""
    if isinstance(value, int):
        return str(value)
    if value != value:
        return "NAN"
    if value in (np.inf, -np.inf):
        return "-INFINITY" if value < 0 else "INFINITY"
    return repr(float(value))


def c_constant(value: float, *, single: bool = False) -> str:
    """Return a number as people write it in C, of double or single precision, exactly, or rounded to the nearest."""
    with np.errstate(over="ignore", under="ignore"):
        number: Any = np.float32(value) if single else np.float64(value)
    if np.isnan(number):
        return "NAN" if single else "(double)NAN"
    if np.isinf(number):
        sign = "" if number > 0 else "-"
        return f"{sign}INFINITY" if single else f"{sign}(double)INFINITY"
    usual = not number or 1e-5 < abs(number) < 1e7
    write = np.format_float_positional if usual else np.format_float_scientific
    text = write(number, unique=True, trim="0")
    return f"{text}f" if single else text


def c_text(text: str) -> str:
    """Return a text as a C string."""
    escaped = (f"\\{byte:03o}" if byte < 32 or byte > 126 or byte in b'"\\?' else chr(byte) for byte in text.encode())
    return f'"{"".join(escaped)}"'


def c_array(kind: str, name: str, values: Iterable[object], *, per_line: int = 8) -> str:
    """Return the definition of a constant array, of at least one element, since C has no empty arrays.

    ``values``: C text of each element.
    """
    texts = [str(value) for value in values] or ["0"]
    lines = [", ".join(texts[i : i + per_line]) for i in range(0, len(texts), per_line)]
    return f"static const {kind} {name}[] = {{\n    " + ",\n    ".join(lines) + "\n};\n"


def sentence(text: str) -> str:
    """Return a text with a full stop, as it may be in a comment."""
    text = in_comment(text)
    return text if not text or text.endswith(".") else f"{text}."


def in_comment(text: str) -> str:
    """Return a text that doesn't end the comment that it is in."""
    return text.replace("*/", "* /")


def fill_lines(head: str, parts: Sequence[str], between: str, tail: str) -> list[str]:
    """Return parts in as many lines as they need."""
    lines, line, inner = [], head, " " * max(4, len(head) - len(head.lstrip()) + 4)
    for i, part in enumerate(parts):
        piece = part + (between.rstrip() if i < len(parts) - 1 else tail)
        if len(line) + len(piece) > _WIDTH and line.strip() and i:
            lines.append(line.rstrip())
            line = inner
        line += piece + (" " if i < len(parts) - 1 else "")
    return [*lines, line.rstrip()] if parts else [head + tail]


def wrap_statements(lines: Iterable[str]) -> Iterator[str]:
    """Yield statements, long ones in several lines that are cut at spaces."""
    for line in lines:
        while len(line) > _WIDTH and (cut := line.rfind(" ", 40, _WIDTH)) > 0:
            yield line[:cut]
            line = f"    {line[cut + 1 :]}"
        yield line
