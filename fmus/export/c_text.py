"""C as text: identifiers, numbers, texts, arrays and lines; templates.

Identifiers are like the names of a diagram, and are no words of C or of its headers. Templates, in ``templates/``, are
text with ``${name}`` for what changes, and lines in ``{% for … %}``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jinja2 import Environment

_C_KEYWORDS = """auto break case char const continue default do double else enum extern float for goto if inline int
long register restrict return short signed sizeof static struct switch typedef union unsigned void
volatile while bool true false complex imaginary I NULL errno signgam main t c"""
KEYWORDS = frozenset(_C_KEYWORDS.split())
"""Words that nothing is called: those of C, of its headers as macros, and ours in each function."""
HELPERS = frozenset({"is_finite", "exact", "choose", "sign_of", "choose_of_time", "sign_of_of_time", "start_values"})
"""Functions and constants of each source for a target."""
_MACRO = re.compile(
    r"NAN|INFINITY|HUGE_VAL[FL]?|EOF|BUFSIZ|stdin|stdout|stderr|linux|unix|L_tmpnam|(FILENAME|FOPEN|TMP|RAND)_MAX"
    r"|(DBL|FLT|LDBL|FP|DECIMAL|MATH|SEEK|M)_\w+|U?INT\w*_(MAX|MIN)|(SIZE|PTRDIFF|WCHAR|WINT|SIG_ATOMIC)_(MAX|MIN)"
)
"""Macros of the headers that the source, or a program with it, includes: they are no names of members."""
_FUNCTIONS = """math string float stddef stdint stdbool stdio stdlib errno assert time signal ctype limits locale
abs labs div ldiv exit abort atexit system getenv malloc calloc realloc free rand srand qsort bsearch atoi atof atol
strtod strtol strtoul clock difftime mktime raise setjmp longjmp
printf scanf sprintf snprintf fprintf puts putchar getchar gets remove rename tmpfile perror rewind offsetof va_list
memcpy memmove memset memcmp memchr strcpy strcat strcmp strlen strchr strncpy strncat strncmp strstr strtok
strerror sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp log sqrt fabs floor ceil cbrt erf erfc
expm1 exp2 log1p log2 log10 logb ilogb lgamma tgamma rint lrint llrint round lround llround trunc nearbyint fdim
fmax fmin fma fmod pow hypot atan2 remainder remquo copysign nextafter nexttoward ldexp frexp modf scalbn scalbln
nan gamma j0 j1 jn y0 y1 yn index rindex isnan isinf isfinite isnormal signbit fpclassify isgreater
isless"""
_OF_HEADERS = frozenset(_FUNCTIONS.split())
"""Headers of the standard, and functions in them."""
_OF_A_SOURCE = re.compile(r"(t|(find_in_)?table_|tick_)\d+|(lw|own)_\w+|u?int\w*_t|.*_t")


def identifier(name: str) -> str:
    """Return a C identifier that is like a name, and no macro of a header of the standard."""
    found = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or "x"
    found = f"n{found}" if found[0].isdigit() else found
    return f"{found}_" if found in KEYWORDS or _MACRO.fullmatch(found) else found


def unit_name(name: str) -> str:
    """Return a C identifier that is like a name and may name a type and its files: nothing else there is called so."""
    found = identifier(name)
    single = found[:-1] if found[-1] in "fl" else found  # sinf, sinl
    taken = {found, single} & (HELPERS | _OF_HEADERS) or _OF_A_SOURCE.fullmatch(found)
    return f"{found}_" if taken else found


def distinct(name: str, taken: set[str]) -> str:
    """Return a name that is not taken yet, and take it."""
    found, count = name, 2
    while found in taken:
        found, count = f"{name}_{count}", count + 1
    taken.add(found)
    return found


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


@cache
def _environment() -> Environment:
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader(__package__),
        undefined=jinja2.StrictUndefined,
        variable_start_string="${",  # C is full of double braces, and has no dollar
        variable_end_string="}",
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def fill_template(template: str, **facts: Any) -> str:
    """Return the text of a template, filled with facts; a fact that is missing is an error."""
    return _environment().get_template(f"{template}.j2").render(facts)
