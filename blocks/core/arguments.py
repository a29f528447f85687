"""Arguments of public functions: kinds of values, and an error that names what was found and expected."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

from .errors import OptionError
from .explained_calls import BY_PLACE, EXPLAINED, UnknownArgumentError, misuse, name_of, own_names
from .values import shorten

P = ParamSpec("P")
R = TypeVar("R")
Kind = Callable[[Any], str]
"""Returns in words which values are expected; "" for a value of the kind."""
_LONGEST = 80


def accepts(called: str = "", /, **kinds: Kind) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Check the kinds of a function's arguments before it runs; a default is always right.

    Parameters
    ----------
    called : str
        Name by which users know the function, where it is another one.
    **kinds
        A kind for each argument that is checked; one of ``*args`` or ``**kwargs`` holds for each of their values.

    Raises
    ------
    OptionError
        By the function: an argument of another kind.
    """

    def wrap(function: Callable[P, R]) -> Callable[P, R]:
        signature, who = inspect.signature(function), called or function.__name__
        parameters = {**signature.parameters}
        names = [name for name, p in parameters.items() if p.kind in BY_PLACE]
        needed = {name for name, p in parameters.items() if p.default is p.empty}
        is_plain = not any(p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in parameters.values())

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            given: Mapping[str, Any] = {}
            if is_plain and len(args) <= len(names) and kwargs.keys() <= parameters.keys():
                given = {**dict(zip(names, args, strict=False)), **kwargs}  # without the many calls of `bind`
            if len(given) != len(args) + len(kwargs) or not needed <= given.keys():
                try:
                    given = signature.bind(*args, **kwargs).arguments
                except TypeError as error:
                    raise (misuse(function, args, kwargs, called) or error) from None
            for name, value in given.items():
                kind, parameter = kinds.get(name), parameters[name]
                if kind is None or value is parameter.default:
                    continue
                if parameter.kind is parameter.VAR_KEYWORD:
                    for key, each in value.items():
                        check_argument(each, kind, key, who)
                elif parameter.kind is parameter.VAR_POSITIONAL:
                    for each in value:
                        check_argument(each, kind, name, who)
                else:
                    check_argument(value, kind, name, who)
            try:
                return function(*args, **kwargs)
            except UnknownArgumentError as error:
                if error.argument in kwargs:
                    error.offer(called or name_of(function, args), own_names(function))
                raise

        setattr(checked, EXPLAINED, True)
        return checked

    return wrap


def check_argument(value: Any, kind: Kind, name: str, function: str) -> None:
    """Refuse an argument of another kind.

    Raises
    ------
    OptionError
        It names the function, the argument, what was found and what is expected.
    """
    if expected := kind(value):
        found = shorten(value)
        found = found if len(found) <= _LONGEST else f"{found[:_LONGEST]}…"
        raise OptionError(f"found {found}; expected {expected}. Give {name}= as that.", block=function, port=name)


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


def number(value: Any) -> str:
    """Kind of a real number."""
    return "" if is_real(value) else "a number"


def real(value: Any) -> str:
    """Kind of a real number, NaN among them, which the function refuses with words of its own."""
    return "" if is_real(value) or (isinstance(value, float) and value != value) else "a number"


def finite(value: Any) -> str:
    """Kind of a finite number."""
    return "" if is_real(value) and np.isfinite(float(value)) else "a finite number"


def positive(value: Any) -> str:
    """Kind of a finite number above zero."""
    return "" if not finite(value) and float(value) > 0 else "a positive number"


def whole(value: Any) -> str:
    """Kind of a whole number."""
    return "" if is_real(value) and np.isfinite(float(value)) and float(value) == int(value) else "a whole number"


def count(value: Any) -> str:
    """Kind of a whole number from 0 on."""
    return "" if not whole(value) and float(value) >= 0 else "a whole number, 0 or more"


def numbers(value: Any) -> str:
    """Kind of a number, or an array of numbers, one at least; they are real."""
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.asarray(None)
    return "" if array.dtype.kind in "iuf" and array.size else "a number, or an array of numbers"


def row(value: Any) -> str:
    """Kind of a list of finite numbers."""
    good = not numbers(value) and np.ndim(value) == 1 and np.isfinite(value).all()
    return "" if good else "a list of finite numbers"


def roots(value: Any) -> str:
    """Kind of a list of numbers that may be complex."""
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.asarray(None)
    return "" if array.ndim == 1 and array.dtype.kind in "iufc" and array.size else "a list of numbers"


def matrix(value: Any) -> str:
    """Kind of a matrix of numbers, or what NumPy reads as one."""
    try:
        array = np.asarray(value)
    except ValueError:
        array = np.asarray(None)
    return "" if array.dtype.kind in "iuf" and array.size and array.ndim <= 2 else "a matrix of numbers"


def text(value: Any) -> str:
    """Kind of a text."""
    return "" if isinstance(value, str) else "a text"


def names(value: Any) -> str:
    """Kind of a name, or of several."""
    if isinstance(value, str):
        return ""
    several = isinstance(value, Iterable) and not isinstance(value, Mapping | np.ndarray | bytes)
    if several and (not isinstance(value, list | tuple | set | frozenset) or all(isinstance(v, str) for v in value)):
        return ""
    return "a name, or a list of names"


def several(value: Any) -> str:
    """Kind of a collection of values."""
    return "" if isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping) else "a list"


def flag(value: Any) -> str:
    """Kind of a truth value."""
    return "" if isinstance(value, bool | np.bool_) else "True or False"


def mapping(value: Any) -> str:
    """Kind of a mapping by name."""
    return "" if isinstance(value, Mapping) and all(isinstance(key, str) for key in value) else "a mapping by name"


def path(value: Any) -> str:
    """Kind of a path of a file or folder."""
    good = isinstance(value, str | os.PathLike) and str(value) and "\0" not in str(value)
    return "" if good else "a path"


def paths(value: Any) -> str:
    """Kind of a list of paths; one that is made as it is read is taken as it is."""
    good = not several(value) and not isinstance(value, np.ndarray)
    return "" if good and not (isinstance(value, list | tuple) and any(map(path, value))) else "a list of paths"


def function(value: Any) -> str:
    """Kind of a function."""
    return "" if callable(value) else "a function"


def either(*kinds: Kind) -> Kind:
    """Return the kind of a value that is of one of some kinds."""
    return lambda value: "" if not all(kind(value) for kind in kinds) else ", or ".join(kind(value) for kind in kinds)


def one_of_class(cls: type, said: str) -> Kind:
    """Return the kind of the instances of a class, with its words."""
    return lambda value: "" if isinstance(value, cls) else said


def system(value: Any) -> str:
    """Kind of a linear system of python-control."""
    good = hasattr(value, "ninputs") and hasattr(value, "poles")
    return "" if good else "a control.StateSpace or control.TransferFunction"
