"""Calls whose arguments don't fit a signature: misspelt keywords, one argument too many, one that is missing."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from typing import Any, TypeVar

from .errors import OptionError, UnknownNameError, close_names, near

F = TypeVar("F", bound=Callable[..., Any])
BY_PLACE = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
"""Kinds of parameters that may be given by position."""
_BY_NAME = (inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
_MADE_BY = ("__init__", "__new__")
_CALLED = (*_MADE_BY, "__call__")
EXPLAINED = "explains_calls"
"""Attribute of functions that explain calls already."""
_ELSEWHERE = "names_elsewhere"


class UnknownArgumentError(OptionError, UnknownNameError):
    """A keyword that a function, or one that it hands its options on to, doesn't know."""

    def __init__(
        self,
        argument: str,
        known: Iterable[str],
        *,
        block: str | None,
        found: str = "it has no argument",
        elsewhere: Mapping[str, str] | None = None,
    ):
        self.argument, self.known, self.found, self.elsewhere = argument, frozenset(known), found, elsewhere or {}
        super().__init__(self._describe(), block=block)

    def _describe(self) -> str:
        exact = [self.argument] if self.argument in self.elsewhere else []
        close = exact or close_names(self.argument, self.known | self.elsewhere.keys())
        offered = " or ".join(dict.fromkeys(self.elsewhere.get(name, repr(name)) for name in close))
        return f"{self.found} {self.argument!r}. " + (
            f"Did you mean {offered}?" if close else near(self.argument, self.known)
        )

    def offer(self, block: str, more: Iterable[str]) -> None:
        """Report the function that was called, which has further arguments than those that it hands on."""
        self.known |= frozenset(more)
        self.block, self.message = block, self._describe()


def offer_elsewhere(**ways: str) -> Callable[[F], F]:
    """Make the errors of a function's calls offer what to write for other names: ``title="about={'title': …}"``."""

    def mark(function: F) -> F:
        setattr(function, _ELSEWHERE, ways)
        return function

    return mark


def explain_calls(subject: F) -> F:
    """Make a function, or the public methods of a class, say which arguments don't fit their signatures.

    Python ends such a call (a misspelt keyword, one argument too many, none where one is needed) in a `TypeError`; it
    becomes an `OptionError` that names the argument and those near it. A class is changed in place, after `dataclass`
    has made its constructor; methods that it inherits stay as they are.
    """
    # the signature is looked at only then: a call whose arguments fit costs one frame more, and nothing else
    if not inspect.isclass(subject):
        return _explained(subject)
    for name, member in [*vars(subject).items()]:
        if name.startswith("_") and name not in _CALLED:
            continue
        if isinstance(member, classmethod | staticmethod):
            setattr(subject, name, type(member)(_explained(member.__func__)))
        elif inspect.isfunction(member):
            setattr(subject, name, _explained(member))
    return subject


def _explained(function: F) -> F:
    if hasattr(function, EXPLAINED):
        return function

    @wraps(function)
    def explained(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except UnknownArgumentError as error:
            if error.argument in kwargs:
                error.offer(name_of(function, args), own_names(function))
            raise
        except TypeError:
            if (wrong := misuse(function, args, kwargs)) is None:
                raise  # the arguments fit: it comes from the function's body
            raise wrong from None

    setattr(explained, EXPLAINED, True)
    return explained  # type: ignore[return-value]  # of the signature of the function that it wraps


def misuse(
    function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any], who: str = ""
) -> OptionError | None:
    """Return the error of a call whose arguments don't fit the function's signature; None if they fit."""
    parameters = inspect.signature(function).parameters
    who, owner = who or name_of(function, args), next(iter(parameters), "") in ("self", "cls")
    placed = [p for p in parameters.values() if p.kind in BY_PLACE]
    named = {name: p for name, p in parameters.items() if p.kind in _BY_NAME}
    has_more = {p.kind for p in parameters.values()}
    shown = own_names(function)
    call = f"{who.rpartition('.')[2]}({{}})"
    if inspect.Parameter.VAR_KEYWORD not in has_more:
        for name in kwargs:
            if name not in named:
                return UnknownArgumentError(name, shown, block=who, elsewhere=getattr(function, _ELSEWHERE, {}))
    if len(args) > len(placed) and inspect.Parameter.VAR_POSITIONAL not in has_more:
        allowed = ", ".join(p.name for p in placed[owner:])
        others = ", ".join(f"{name}=…" for name, p in named.items() if p.kind is p.KEYWORD_ONLY and name in shown)
        return OptionError(
            f"found {len(args) - owner} arguments by position; expected "
            + (f"{len(placed) - owner} at most ({allowed})." if allowed else "none.")
            + (f" The others go by keyword: {call.format(others)}." if others else ""),
            block=who,
        )
    for parameter in placed[: len(args)]:
        if parameter.name in kwargs and parameter.kind is parameter.POSITIONAL_OR_KEYWORD:
            return OptionError(
                "found two values, one by position and one by keyword; give one.", block=who, port=parameter.name
            )
    for parameter in [*placed[len(args) :], *(p for p in named.values() if p.kind is p.KEYWORD_ONLY)]:
        if parameter.default is parameter.empty and parameter.name not in kwargs:
            ways = getattr(function, _ELSEWHERE, {})
            for name in kwargs:
                if name not in named and (name in ways or parameter.name in close_names(name, shown)):
                    return UnknownArgumentError(name, shown, block=who, elsewhere=ways)
            return OptionError(
                f"it is required and was not given: {call.format(parameter.name + '=…')}.",
                block=who,
                port=parameter.name,
            )
    return None


def own_names(function: Callable[..., Any]) -> list[str]:
    """Return the arguments that a function takes by name, without its object or class, and private ones."""
    parameters = inspect.signature(function).parameters.values()
    names = [p.name for p in parameters if p.kind in _BY_NAME and not p.name.startswith("_")]
    return names[1:] if names[:1] in (["self"], ["cls"]) else names


def name_of(function: Callable[..., Any], args: tuple[Any, ...] = ()) -> str:
    """Return the name by which users know a function or method, such as ``"Diagram.report"``; a class by its own."""
    owner, _, name = function.__qualname__.rpartition("<locals>.")[2].rpartition(".")
    if owner and args:
        cls = args[0] if isinstance(args[0], type) else type(args[0])
        owner = cls.__name__ if hasattr(cls, name) else owner
    return owner if name in _MADE_BY else f"{owner}.{name}".lstrip(".")
