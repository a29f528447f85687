"""Arguments and parameters: declared kinds of values, and one error that names what was found and expected.

A kind is declared at the signature: ``@accepts(windows=kinds.integer(2))`` above a function or a dataclass, and
``parameter(kind=kinds.choice("linear", "previous"))`` in a block.
"""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import wraps
from types import UnionType
from typing import Any, TypeVar

import numpy as np

from .control_systems import system_text
from .errors import LoopwrightError, OptionError, close_names, near
from .explained_calls import BY_PLACE, EXPLAINED, UnknownArgumentError, misuse, name_of, own_names

F = TypeVar("F", bound=Callable[..., Any])
_LONGEST = 80


def shorten(value: Any) -> str:
    """Return a parameter value as a short text, with numbers as people type them."""
    if isinstance(value, np.ndarray):
        return repr(value.tolist()) if value.size <= 12 else f"<{'×'.join(map(str, value.shape))} numbers>"
    if text := system_text(value):
        return text
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key!r}: {shorten(one)}" for key, one in value.items()) + "}"
    if isinstance(value, tuple | list) and any(isinstance(one, np.ndarray | dict) for one in value):
        begin, end = "()" if isinstance(value, tuple) else "[]"
        return begin + ", ".join(map(shorten, value)) + end
    if isinstance(value, list) and len(value) > 100:
        return f"<{len(value)} values>"
    if hasattr(value, "columns") and hasattr(value, "to_numpy"):
        return f"<{type(value).__name__} of {len(value)} rows>"
    if isinstance(value, float) and abs(value) < 1e6 and value == int(value):
        return str(int(value))
    return repr(value)


def shortened(name: str, value: Any) -> str:
    """Return the words for a value that was found, as people type it."""
    found = shorten(value)
    return f"found {found}" if len(found) <= _LONGEST else f"found {found[:_LONGEST]}…"


@dataclass(frozen=True)
class Kind:
    """Declared kind of values, with the words of the error for another one."""

    expected: str  # the kind in words
    holds: Callable[[Any], object]  # whether a value is of the kind
    step: str | Callable[[Any], str] | None = None  # next step, or a function of the value; None: to give such a value
    found: Callable[[str, Any], str] = shortened  # from the argument's name and its value to the error's first words

    def worded(
        self,
        expected: str | None = None,
        step: str | Callable[[Any], str] | None = None,
        found: Callable[[str, Any], str] | None = None,
    ) -> Kind:
        """Return the same kind with other words."""
        return replace(
            self,
            expected=self.expected if expected is None else expected,
            step=self.step if step is None else step,
            found=found or self.found,
        )

    def where(self, condition: Callable[[Any], object]) -> Kind:
        """Return the kind of those values that fulfil a condition, too."""
        return replace(self, holds=lambda value: self.holds(value) and condition(value))

    def or_none(self) -> Kind:
        """Return the same kind with None, where that is not the default."""
        return replace(self, holds=lambda value: value is None or self.holds(value))

    def complaint(self, name: str, value: Any) -> str:
        """Return the error's text for a value that is not of the kind."""
        step = f"Give {name}= as that." if self.step is None else self.step
        return (
            f"{self.found(name, value)}; expected {self.expected}. {step(value) if callable(step) else step}".rstrip()
        )


def accepts(called: str | None = "", error: type[LoopwrightError] = OptionError, /, **kinds: Kind) -> Callable[[F], F]:
    """Check the kinds of a function's arguments before it runs, or of a dataclass's fields; a default is always right.

    ``called`` is the name by which users know the function, where it is another one, or that of an argument's object,
    ``"{diagram.name}"``; None: the callers fill it in. A kind of ``*args`` or ``**kwargs`` holds for each of their
    values.
    """

    def wrap(subject: F) -> F:
        if inspect.isclass(subject):
            vars_of: Any = subject
            vars_of.__init__ = _checked(vars_of.__init__, subject.__name__ if called == "" else called, error, kinds)
            return subject
        return _checked(subject, called, error, kinds)

    return wrap


def _checked(function: F, called: str | None, error: type[LoopwrightError], kinds: Mapping[str, Kind]) -> F:
    signature, who = inspect.signature(function), function.__name__ if called == "" else called
    is_format = who is not None and "{" in who
    own_name = "" if is_format or called is None else called
    parameters = {**signature.parameters}
    names = [name for name, p in parameters.items() if p.kind in BY_PLACE]
    needed = {name for name, p in parameters.items() if p.default is p.empty}
    several = {name for name, p in parameters.items() if p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}
    is_plain = not several
    if unknown := kinds.keys() - parameters.keys():
        raise TypeError(f"{who} has no argument {', '.join(unknown)}, of which a kind is declared.")
    single = [(name, kind, parameters[name].default) for name, kind in kinds.items() if name not in several]
    listed = [(name, kinds[name]) for name in several & kinds.keys()]

    def refuse(value: Any, kind: Kind, name: str, given: Mapping[str, Any]) -> None:
        check_argument(value, kind, name, who.format_map(given) if who and is_format else who, error)

    @wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        given: Mapping[str, Any] = {}
        if is_plain and len(args) <= len(names) and kwargs.keys() <= parameters.keys():
            given = {**dict(zip(names, args, strict=False)), **kwargs}  # without the many calls of `bind`
        if len(given) != len(args) + len(kwargs) or not needed <= given.keys():
            try:
                given = signature.bind(*args, **kwargs).arguments
            except TypeError as unfit:
                raise (misuse(function, args, kwargs, own_name) or unfit) from None
        for name, kind, default in single:
            value = given.get(name, default)
            if value is not default and not kind.holds(value):
                refuse(value, kind, name, given)
        for name, kind in listed:
            values = given.get(name, ())
            for key, each in values.items() if isinstance(values, dict) else ((name, each) for each in values):
                if not kind.holds(each):
                    refuse(each, kind, key, given)
        try:
            return function(*args, **kwargs)
        except UnknownArgumentError as unknown:
            if unknown.argument in kwargs:
                unknown.offer(own_name or name_of(function, args), own_names(function))
            raise

    setattr(checked, EXPLAINED, True)
    return checked  # type: ignore[return-value]  # of the signature of the function that it wraps


def check_argument(
    value: Any, kind: Kind, name: str, function: str | None, error: type[LoopwrightError] = OptionError
) -> None:
    """Refuse an argument of another kind."""
    if not kind.holds(value):
        raise error(kind.complaint(name, value), block=function, port=name)


def is_real(value: Any) -> bool:
    """Whether a value is a real number: no text, truth value, complex number or NaN."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    if isinstance(value, bool | np.bool_ | str | bytes | complex | np.complexfloating):
        return False
    try:
        number = float(value) if not hasattr(value, "__len__") else np.nan
    except (TypeError, ValueError, OverflowError):
        return False
    return number == number


# --- kinds ------------------------------------------------------------------------------------------------------------


def as_array(value: Any) -> np.ndarray:
    """Return a value as NumPy reads it; rows of unequal length as an array of one object."""
    try:
        return np.asarray(value)
    except ValueError:
        return np.asarray(None)


def _is_finite(value: Any) -> bool:
    return is_real(value) and bool(np.isfinite(float(value)))


def _is_row(value: Any) -> bool:
    return bool(numbers.holds(value) and np.ndim(value) == 1 and np.isfinite(value).all())


def _is_names(value: Any) -> bool:
    if isinstance(value, str):
        return True
    several = isinstance(value, Iterable) and not isinstance(value, Mapping | np.ndarray | bytes)
    return several and (not isinstance(value, list | tuple | set | frozenset) or all(isinstance(v, str) for v in value))


def _is_path(value: Any) -> bool:
    return isinstance(value, str | os.PathLike) and bool(str(value)) and "\0" not in str(value)


def _is_paths(value: Any) -> bool:
    good = several.holds(value) and not isinstance(value, np.ndarray)
    return bool(good) and not (isinstance(value, list | tuple) and not all(map(_is_path, value)))


def by_shape(name: str, value: Any) -> str:
    """Return the words for an array of which the shape is wrong."""
    return f"found an array of shape {np.shape(value)}"


number = Kind("a number", is_real)
real = Kind("a number", lambda value: is_real(value) or (isinstance(value, float) and value != value))
"""A real number, or NaN, which the function refuses with its own words."""
finite = Kind("a finite number", _is_finite)
positive = Kind("a positive number", lambda value: _is_finite(value) and float(value) > 0)
above_zero = Kind(
    "a positive number",
    lambda value: isinstance(value, int | float) and not isinstance(value, bool) and value > 0,
    "Give one.",
)
"""A number of Python's above zero, infinity among them: a limit."""
whole = Kind("a whole number", lambda value: _is_finite(value) and float(value) == int(value))
count = Kind("a whole number, 0 or more", lambda value: whole.holds(value) and float(value) >= 0)
numbers = Kind(
    "a number, or an array of numbers",
    lambda value: (array := as_array(value)).dtype.kind in "iuf" and array.size > 0,
)
"""A number, or an array of numbers, one at least; they are real."""
row = Kind("a list of finite numbers", _is_row)
roots = Kind(
    "a list of numbers",
    lambda value: (array := as_array(value)).ndim == 1 and array.dtype.kind in "iufc" and array.size > 0,
)
"""A list of numbers that may be complex."""
matrix = Kind("a matrix of numbers", lambda value: numbers.holds(value) and as_array(value).ndim <= 2)
"""A matrix of numbers, or what NumPy reads as one."""
text = Kind("a text", lambda value: isinstance(value, str))
names = Kind("a name, or a list of names", _is_names)
several = Kind("a list", lambda value: isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping))
flag = Kind("True or False", lambda value: isinstance(value, bool | np.bool_))
mapping = Kind(
    "a mapping by name",
    lambda value: isinstance(value, Mapping) and all(isinstance(key, str) for key in value),
)
path = Kind("a path", _is_path)
"""A path of a file or folder."""
paths = Kind("a list of paths", _is_paths)
"""A list of paths; one that is made as it is read is taken as it is."""
function = Kind("a function", callable)
progress = Kind(
    "True, False or a function",
    lambda value: value is None or flag.holds(value) or callable(value),
    "Leave it out to have it shown on a terminal.",
)
"""Whether progress is shown, or a function that is called with it; None shows it on a terminal."""
system = Kind(
    "a control.StateSpace or control.TransferFunction",
    lambda value: hasattr(value, "ninputs") and hasattr(value, "poles"),
)
"""A linear system of python-control."""


def either(*kinds: Kind) -> Kind:
    """Return the kind of a value that is of one of some kinds."""
    return Kind(", or ".join(kind.expected for kind in kinds), lambda value: any(kind.holds(value) for kind in kinds))


def one_of_class(classes: type | tuple[type, ...] | UnionType, said: str) -> Kind:
    """Return the kind of the instances of a class, or of several, with its words."""
    return Kind(said, lambda value: isinstance(value, classes))


def integer(minimum: int, maximum: float = math.inf) -> Kind:
    """Return the kind of the integers of a range; a number such as 2.0 is none."""
    words = {0: "an integer from 0 on", 1: "a positive integer"}.get(minimum, f"an integer from {minimum} on")
    return Kind(
        words if maximum == math.inf else f"an integer from {minimum} to {maximum:g}",
        lambda value: (
            isinstance(value, int | np.integer) and not isinstance(value, bool) and minimum <= value <= maximum
        ),
    )


def dimensions(most: int) -> Kind:
    """Return the kind of the arrays of a parameter with no more than some dimensions."""
    return Kind(f"at most {most} dimensions", lambda value: np.ndim(value) <= most, found=by_shape)


def choice(*words: str) -> Kind:
    """Return the kind of a text that is one of some words."""
    *first, last = map(repr, words)
    return Kind(
        f"{', '.join(first)} or {last}" if first else last,
        lambda value: isinstance(value, str) and value in words,
        step=lambda value: near(value, words) if close_names(str(value), words) else "Give one of them.",
    )


def _floats(value: Any) -> np.ndarray:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return np.zeros(0)


frequencies = Kind(
    "positive frequencies in rad/s",
    lambda value: (w := _floats(value)).size and np.all(np.isfinite(w)) and np.all(w > 0.0),
    "Give some.",
)


def one_of(*words: str) -> Kind:
    """Return the kind that `choice` returns, with words for a list of them."""
    return choice(*words).worded(f"one of {', '.join(map(repr, words))}", "Choose one of them.")


def by_name(name: str, value: Any) -> str:
    """Return the words for a value that was found, with the argument's name, as it is written."""
    return f"found {name}={value!r}"


def as_written(name: str, value: Any) -> str:
    """Return the words for a value that was found, as it is written."""
    return f"found {value!r}"


def alone(words: str) -> Callable[[str, Any], str]:
    """Return a function that says what was found in fixed words."""
    return lambda name, value: f"found {words}"


rising = Kind(
    "at least two numbers that rise",
    lambda value: np.ndim(value) == 1 and np.size(value) > 1 and bool(np.all(np.diff(value) > 0)),
)
