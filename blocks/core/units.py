"""Units: strings as FMI and Modelica write them, read into SI base units.

The grammar is that of the Modelica specification (chapter 19), which FMI 3.0 (2.4.3, Units) builds on: factors joined
by a dot (``N.s/m``), one ``/`` at most, a denominator of several factors in parentheses (``J/(kg.K)``), integer
exponents with or without ``^`` (``m/s2``, ``m^2``, ``s-1``). Beyond it are read: a space, ``*`` or ``·`` between two
factors as a dot, raised digits (``m³/s``), a quotient as the denominator (``N/(m/s)``), and what everybody writes
without the dot: ``Nm``, ``Wh``, ``Ah``, ``VA``.
"""

from __future__ import annotations

import difflib
import math
import re
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache

from ..names_of_other_tools import UNITS
from .errors import UnitError, near
from .explained_calls import explain_calls

#: The base units of an FMI ``<BaseUnit>`` element, in the order of `Unit.exponents`.
BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


@explain_calls
@dataclass(frozen=True)
class Unit:
    """A unit: ``value in base units = factor * value + offset`` (FMI 3.0, 2.4.3).

    Parameters
    ----------
    text : str
        The unit as it was written.
    exponents : tuple of int
        Exponents of kg, m, s, A, K, mol, cd, rad.
    factor, offset : float
        Conversion to base units.
    relative : bool or None
        Whether numbers in it are differences, for which no offset counts (FMI's ``relativeQuantity``); None where that
        is not known, as of the sum of two temperatures.
    loose_angle : bool
        Whether the exponent of rad is not known: tools define angles with and without it.
    """

    text: str
    exponents: tuple[int, ...]
    factor: float = 1.0
    offset: float = 0.0
    relative: bool | None = False
    loose_angle: bool = False

    @property
    def base_text(self) -> str:
        """The dimension in base units, such as ``kg.m.s-2``; ``1`` if it has none."""
        powers = [(b, n) for b, n in zip(BASE_UNITS, self.exponents, strict=True) if n]
        return ".".join(base if n == 1 else f"{base}{n}" for base, n in powers) or "1"


class DefinedUnit(str):
    """Name of a unit that is defined elsewhere, as in an FMU's description; it counts as the definition says."""

    unit: Unit

    def __new__(cls, unit: Unit) -> DefinedUnit:
        """Return the name with its definition."""
        made = super().__new__(cls, unit.text)
        made.unit = unit
        return made

    def __getnewargs__(self) -> tuple[Unit]:  # type: ignore[override]
        """Return the arguments with which a copy or a pickle makes it again."""
        return (self.unit,)


def _unit(factor: float = 1.0, offset: float = 0.0, **powers: int) -> Unit:
    return Unit("", tuple(powers.get(base, 0) for base in BASE_UNITS), factor, offset)


# Units that take a prefix (k, m, µ, …), then those that don't.
_PREFIXED = {
    **{base: _unit(**{base: 1}) for base in ("m", "s", "A", "K", "mol", "cd", "rad")},
    "g": _unit(1e-3, kg=1),
    "N": _unit(kg=1, m=1, s=-2),
    "Pa": _unit(kg=1, m=-1, s=-2),
    "J": _unit(kg=1, m=2, s=-2),
    "W": _unit(kg=1, m=2, s=-3),
    "V": _unit(kg=1, m=2, s=-3, A=-1),
    "Ohm": _unit(kg=1, m=2, s=-3, A=-2),
    "Ω": _unit(kg=1, m=2, s=-3, A=-2),
    "S": _unit(kg=-1, m=-2, s=3, A=2),
    "C": _unit(s=1, A=1),
    "F": _unit(kg=-1, m=-2, s=4, A=2),
    "H": _unit(kg=1, m=2, s=-2, A=-2),
    "Wb": _unit(kg=1, m=2, s=-2, A=-1),
    "T": _unit(kg=1, s=-2, A=-1),
    "Hz": _unit(s=-1),
    "l": _unit(1e-3, m=3),
    "L": _unit(1e-3, m=3),
    "bar": _unit(1e5, kg=1, m=-1, s=-2),
    "Nm": _unit(kg=1, m=2, s=-2),
    "Wh": _unit(3600.0, kg=1, m=2, s=-2),
    "Ah": _unit(3600.0, s=1, A=1),
    "VA": _unit(kg=1, m=2, s=-3),
    "rpm": _unit(2 * math.pi / 60, rad=1, s=-1),
}
_PLAIN = {
    "kg": _unit(kg=1),
    "1": _unit(),
    "%": _unit(0.01),
    "deg": _unit(math.pi / 180, rad=1),
    "°": _unit(math.pi / 180, rad=1),
    "rev": _unit(2 * math.pi, rad=1),
    "t": _unit(1e3, kg=1),
    "ppm": _unit(1e-6),
    "min": _unit(60.0, s=1),
    "h": _unit(3600.0, s=1),
    "d": _unit(86400.0, s=1),
    "degC": _unit(1.0, 273.15, K=1),
    "°C": _unit(1.0, 273.15, K=1),
}
_PREFIXES = {"p": 1e-12, "n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1}
_PREFIXES |= {"k": 1e3, "M": 1e6, "G": 1e9}
_FACTOR = re.compile(r"(1|[^\W\d_]+|%|°C?)(?:\^?([+-]?\d+))?")
_FRACTION = re.compile(r"[^\W\d_]\^?\(?[+-]?(\d+\.\d|\d*\.\d|\d+/\d)")
_NEXT = "Write it as FMI does: 'm/s2', 'N.s/m', 'J/(kg.K)', '1' for no dimension."


def _symbol(symbol: str, text: str) -> Unit:
    for table in (_PLAIN, _PREFIXED):
        if symbol in table:
            return table[symbol]
    prefix, rest = symbol[:1], symbol[1:]
    if prefix in _PREFIXES and rest in _PREFIXED:
        base = _PREFIXED[rest]
        return Unit("", base.exponents, base.factor * _PREFIXES[prefix])
    words = difflib.get_close_matches(symbol.casefold(), UNITS, n=1, cutoff=0.8)
    known = UNITS[words[0]] if words else None
    hint = near(symbol, {**_PLAIN, **_PREFIXED}) if known is None else f"Did you mean {known!r}?"
    raise UnitError(f"the unit {text!r} has an unknown symbol {symbol!r}. {hint} {_NEXT}")


_RAISED = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


def _refuse_fractions(text: str) -> None:
    """Raise `UnitError` for a unit that can't be read as it has a power such as 0.5."""
    if _FRACTION.search(text.translate(_RAISED)) or "sqrt" in text:
        raise UnitError(
            f"the unit {text!r} has a power that is no whole number, and units have whole powers alone. Leave the unit "
            "out, or write the equation with a parameter that has one: k √h is q₀ √(h/h₀)."
        )


def _powers(text: str) -> list[tuple[str, int]]:
    """Return the symbols of a unit with their powers, in the order in which they are written."""
    found: list[tuple[str, int]] = []
    rest, sign = text.translate(_RAISED), 1
    while rest:
        top, slash, bottom = rest.partition("/")
        bottom = bottom.strip()
        whole = bottom.startswith("(") and bottom.endswith(")")
        if slash and not whole and len(re.split(r"[.·*/\s]+", bottom)) > 1:
            _refuse_fractions(text)
            hint = "Put a denominator of several factors in parentheses: 'J/(kg.K)'."
            raise UnitError(f"the unit {text!r} is ambiguous after '/'. {hint}")
        for word in re.split(r"[.·*\s]+", top.strip()):
            match = _FACTOR.fullmatch(word)
            if match is None:
                _refuse_fractions(text)
                raise UnitError(f"the unit {text!r} can't be read at {word!r}. {_NEXT}")
            found.append((match[1], sign * int(match[2] or 1)))
        if slash and not bottom.strip("() "):
            raise UnitError(f"the unit {text!r} can't be read at {bottom!r}. {_NEXT}")
        rest, sign = bottom[1:-1] if whole else bottom, -sign
    return found


@explain_calls
def parse_unit(text: str) -> Unit:
    """Read a unit string.

    Parameters
    ----------
    text : str
        Such as ``"m/s2"``, ``"N.s/m"``, ``"kg.m2"``, ``"1"``.

    Returns
    -------
    Unit

    Raises
    ------
    UnitError
        For a unit that can't be read; the message says where, and how to write it.

    Examples
    --------
    >>> parse_unit("N.s/m").base_text
    'kg.s-1'
    >>> parse_unit("mm").factor
    0.001
    """
    if not isinstance(text, str):
        raise UnitError(f"found {text!r}; expected the name of a unit, such as 'N.s/m'. Give a text.")
    return text.unit if isinstance(text, DefinedUnit) else _parse(text)


@lru_cache(maxsize=1024)
def _parse(text: str) -> Unit:
    factors = [(_symbol(symbol, text), power) for symbol, power in _powers(text)]
    if not factors:
        raise UnitError(f"the unit {text!r} can't be read at ''. {_NEXT}")
    if len(factors) > 1 and any(unit.offset for unit, _ in factors):
        raise UnitError(f"the unit {text!r} has a temperature with an offset as a factor. Use 'K' for differences.")
    exponents = tuple(sum(unit.exponents[i] * power for unit, power in factors) for i in range(len(BASE_UNITS)))
    factor = math.prod(unit.factor**power for unit, power in factors)
    offset = factors[0][0].offset if len(factors) == 1 else 0.0
    return Unit(text, exponents, factor, offset)


def _read(unit: Unit | str) -> Unit:
    return parse_unit(unit) if isinstance(unit, str) else unit


def _offsets(a: Unit, b: Unit) -> tuple[float, float]:
    return (0.0, 0.0) if a.relative or b.relative else (a.offset, b.offset)


def _is_open(a: Unit, b: Unit) -> bool:
    """Whether an offset lies between the two, and it isn't known whether it counts."""
    return (a.relative is None or b.relative is None) and not math.isclose(*_offsets(a, b))


def same_dimension(a: Unit | str, b: Unit | str) -> bool:
    """Whether numbers in ``a`` can be converted to ``b``."""
    a, b = _read(a), _read(b)
    return _same_exponents(a, b) and not _is_open(a, b)


def _same_exponents(a: Unit, b: Unit) -> bool:
    n = len(BASE_UNITS) - 1 if a.loose_angle or b.loose_angle else len(BASE_UNITS)  # rad is the last one
    return a.exponents[:n] == b.exponents[:n]


def same_unit(a: Unit | str, b: Unit | str) -> bool:
    """Whether a number in ``a`` means the same in ``b``: equal dimension, factor and offset."""
    a, b = _read(a), _read(b)
    close = math.isclose(a.factor, b.factor, rel_tol=1e-12) and math.isclose(*_offsets(a, b))
    return close and same_dimension(a, b)


def convert_unit(a: Unit | str, b: Unit | str) -> tuple[float, float]:
    """Return the factor and the offset by which a number in ``a`` becomes one in ``b``: factor · number + offset."""
    a, b = _read(a), _read(b)
    if not same_dimension(a, b):
        raise UnitError(f"{describe_mismatch(a, b)}.")
    ours, theirs = _offsets(a, b)
    return a.factor / b.factor, (ours - theirs) / b.factor


def describe_mismatch(a: Unit | str, b: Unit | str) -> str:
    """Name the difference between ``a`` (where a wire starts) and ``b`` (where it ends), and the remedy."""
    a, b = _read(a), _read(b)
    if same_unit(a, b):
        return f"{a.text} and {b.text} are the same"
    plain = all(_is_read_alike(unit) for unit in (a, b))
    between = f"put UnitConversion(from_unit={a.text!r}, to_unit={b.text!r}) between" if plain else ""
    remedy = f"give both in {b.base_text}"
    if _same_exponents(a, b) and _is_open(a, b):
        unclear, other = (a, b) if a.relative is None else (b, a)
        return (
            f"{unclear.text} and {other.text} differ by an offset for temperatures, and by none for differences, and "
            "the signal may be either (as a sum of two temperatures, or one less a number without a unit): give all "
            f"that is added a unit{', or ' + between + ' if it is a temperature' if between else ''}"
        )
    if not same_dimension(a, b):
        both = f"{a.text} ({a.base_text}) and {b.text} ({b.base_text})"
        return f"{both} are of different dimensions: check which ports are meant"
    if not math.isclose(*_offsets(a, b)):
        factor, offset = convert_unit(a, b)
        if factor != 1.0:
            law = f"{b.text} = {factor:.12g} · {a.text} + {offset:.12g}".replace("+ -", "- ")
            return f"{a.text} and {b.text} differ by a factor and an offset, {law}: {between or remedy}"
        return f"{a.text} and {b.text} differ by an offset of {offset:.12g}: {between or remedy}"
    gain = f"{a.factor / b.factor:.12g}"
    return f"{a.text} and {b.text} differ by a factor of {gain}: put Gain(gain={gain}) between"


def combine_units(*factors: tuple[str, int]) -> str | None:
    """Return the unit of a product of powers, such as ``m/s`` of m and s⁻¹; None where a factor has an offset.

    Numbers in it count as angles as well as not, if an angle is among the factors: the speed r ω is in m/s.
    """
    read = [(parse_unit(text), power) for text, power in factors]
    if any(unit.offset and not unit.relative for unit, _ in read):
        return None
    text = _write_unit([(symbol, n * power) for unit, power in read for symbol, n in _symbol_powers(unit)])
    exponents = tuple(sum(u.exponents[i] * n for u, n in read) for i in range(len(BASE_UNITS)))
    made = Unit(text, exponents, math.prod(u.factor**n for u, n in read))
    loose = any(unit.exponents[-1] or unit.loose_angle for unit, _ in read)
    if not loose and not any(isinstance(factor, DefinedUnit) for factor, _ in factors):
        return text
    return DefinedUnit(replace(made, loose_angle=loose))


def difference_unit(text: str) -> str:
    """Return the unit of the difference of two numbers: ``K`` for ``degC``, and the same one without an offset."""
    unit = parse_unit(text)
    if not unit.offset or unit.relative:
        return text
    kelvin = unit.factor == 1.0 and unit.exponents == parse_unit("K").exponents
    return DefinedUnit(
        replace(unit, text="K" if kelvin else unit.text, offset=0.0 if kelvin else unit.offset, relative=True)
    )


def uncertain_unit(text: str) -> str:
    """Return the unit of a number of which it is not known whether it is a difference, as of a sum of temperatures."""
    unit = parse_unit(text)
    return DefinedUnit(replace(unit, relative=None)) if unit.offset and not unit.relative else text


def is_uncertain(text: str) -> bool:
    """Whether it is not known of numbers in a unit whether they are differences."""
    return parse_unit(text).relative is None


def common_unit(*texts: str) -> str:
    """Return the unit of what is one of several numbers in like units: uncertain if only some are differences."""
    absolute = [text for text in texts if (unit := parse_unit(text)).offset and not unit.relative]
    if not absolute or len(absolute) == len(texts):
        return next((text for text in texts if is_uncertain(text)), texts[0])
    return uncertain_unit(absolute[0])


def sum_unit(*terms: tuple[str | None, int]) -> str | None:
    """Return the unit of a sum of numbers in like units, each with its sign, 1 or -1.

    It is that of the first term, but for units with an offset: a temperature less another is a difference, in K, and a
    temperature and a difference are a temperature. What has no unit and is added to a temperature counts as a
    difference. Of other sums, such as that of two temperatures, it is not known what they are.
    """
    first = terms[0][0]
    absolute = [(t, sign) for t, sign in terms if t is not None and (u := parse_unit(t)).offset and not u.relative]
    if not absolute:
        return first
    unit, count = absolute[0][0], sum(sign for _, sign in absolute)
    unknown = [sign for text, sign in terms if text is None]
    if not any(is_uncertain(text) for text, _ in absolute):
        if count == 1 and -1 not in unknown:
            return unit
        if count == 0 and not unknown:
            return difference_unit(unit)
    return None if first is None else uncertain_unit(unit)


def root_unit(text: str, degree: int) -> str | None:
    """Return the unit of a root, such as ``m`` of ``m2``; None where it has none, as of ``m``."""
    unit = parse_unit(text)
    powers = dict(_symbol_powers(unit))
    if unit.offset or any(n % degree for n in (*powers.values(), *unit.exponents)):
        return None
    written = _write_unit([(symbol, n // degree) for symbol, n in powers.items()])
    if not isinstance(text, DefinedUnit):
        return written
    exponents = tuple(n // degree for n in unit.exponents)
    return DefinedUnit(Unit(written, exponents, unit.factor ** (1 / degree), loose_angle=unit.loose_angle))


def raise_unit(text: str, exponent: float) -> str | None:
    """Return the unit of a power, such as ``m2`` of m with exponent 2; None where it has none, as of m with 0.3."""
    ratio = Fraction(exponent).limit_denominator(12)
    if not math.isclose(ratio, exponent, rel_tol=1e-12):
        return None
    whole = combine_units((text, ratio.numerator))
    return whole if whole is None or ratio.denominator == 1 else root_unit(whole, ratio.denominator)


def _is_read_alike(unit: Unit) -> bool:
    """Whether a unit's name means the same without its definition, which only an FMU may have."""
    try:
        return same_unit(_parse(unit.text), replace(unit, relative=False))
    except UnitError:
        return False


def _symbol_powers(unit: Unit) -> list[tuple[str, int]]:
    """Return the symbols of a unit with their powers; a name that is defined elsewhere is one symbol."""
    if not _is_read_alike(unit):
        return [(unit.text, 1)]
    return [(symbol, power) for symbol, power in _powers(unit.text) if symbol != "1"]


def _write_unit(factors: list[tuple[str, int]]) -> str:
    powers: dict[str, int] = {}
    for symbol, n in factors:
        powers[symbol] = powers.get(symbol, 0) + n
    top = [s if n == 1 else f"{s}{n}" for s, n in powers.items() if n > 0]
    bottom = [s if n == -1 else f"{s}{-n}" for s, n in powers.items() if n < 0]
    below = "" if not bottom else f"/{bottom[0]}" if len(bottom) == 1 else f"/({'.'.join(bottom)})"
    return f"{'.'.join(top) or '1'}{below}"


_WRITTEN = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_PRINTED = {"1": "", "deg": "°", "degC": "°C"}


def print_unit(text: str) -> str:
    """Return a unit as it is printed, ``N·s/m`` or ``m/s²``, empty for a pure number."""
    if text in _PRINTED:
        return _PRINTED[text]
    raised = re.sub(r"(?<=[A-Za-z])(-?\d+)", lambda m: m[1].translate(_WRITTEN), text)
    return re.sub(r"(?<=[^\s\d])[.*](?=[^\s\d])", "·", raised)


def with_unit(name: str, unit: str) -> str:
    """Return the name of a quantity with its unit, as heads of tables and axes of figures have it: ``t [s]``."""
    shown = print_unit(unit)
    return f"{name} [{shown}]" if shown else name


def rate_of(text: str) -> str:
    """Return the unit of the time derivative: ``m/s`` for ``m``, ``m/s2`` for ``m/s``."""
    if parse_unit(text).offset:
        return "K/s"
    top, slash, bottom = (part.strip() for part in text.partition("/"))
    if not slash:
        return f"{top}/s"
    if "/" in bottom:
        return _write_unit([*_symbol_powers(parse_unit(text)), ("s", -1)])
    factors = re.split(r"[.·*\s]+", bottom.strip("()"))
    for i, word in enumerate(factors):
        if (match := re.fullmatch(r"s(?:\^?(\d+))?", word)) is not None:
            factors[i] = f"s{int(match[1] or 1) + 1}"
            break
    else:
        factors.append("s")
    return f"{top}/{factors[0]}" if len(factors) == 1 else f"{top}/({'.'.join(factors)})"
