"""Identifiers of C that are like the names of a diagram, and are no words of C or of its headers."""

from __future__ import annotations

import re

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
