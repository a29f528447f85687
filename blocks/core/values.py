"""Values: frozen objects whose parameters are their attributes.

Blocks, paths and models are values. The constructor takes parameters and nothing else, `==` compares them, `replace`
makes a variant, and they pickle like plain objects.
"""

from __future__ import annotations

import inspect
import numbers
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace as replace_fields
from functools import lru_cache
from math import isfinite
from typing import Any, ClassVar, Self, dataclass_transform

import numpy as np

from ..names_of_other_tools import BY_POSITION, KEYWORDS, OF_ANY_BLOCK
from .arguments import Kind, shorten
from .brief import count_of
from .control_systems import as_block
from .docstrings import ParameterSignature, parameter_section, with_section
from .errors import DefinitionError, LoopwrightError, ParameterError, near
from .frozen import freeze
from .parameters import MISSING, ParameterSpec
from .parameters import Array as Array
from .parameters import parameter as parameter

_LONGEST = 60
"""Characters of a value up to which an error repeats it in the call that it offers."""


@dataclass_transform(kw_only_default=True, frozen_default=True, eq_default=False, field_specifiers=(parameter,))
class Value:
    """Base of objects that are defined by their parameters: blocks, paths, models."""

    parameter_specs: ClassVar[Mapping[str, ParameterSpec]] = {}
    _keywords: ClassVar[frozenset[str]] = frozenset()  # constructor keywords that are no parameters (a block's name)
    _conditions: ClassVar[tuple[tuple[str, Kind, bool], ...]] = ()  # of parameters, and whether None is their default
    _content: ClassVar[Any] = None  # a further part of equality, such as the digest of a file
    __signature__ = ParameterSignature()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        specs = dict(cls.parameter_specs)
        for name, annotation in inspect.get_annotations(cls).items():
            text = annotation if isinstance(annotation, str) else _annotation_text(annotation)
            if "ClassVar" in text or name.startswith("_") or name in cls._keywords:
                continue
            declared = cls.__dict__.get(name, MISSING)
            spec = declared if isinstance(declared, ParameterSpec) else ParameterSpec(default=declared)
            if name in cls.__dict__:
                delattr(cls, name)  # the value is an attribute of the instance alone
            specs[name] = replace_fields(spec, annotation=text, default=freeze(spec.default))
        for name, declared in vars(cls).items():
            if isinstance(declared, ParameterSpec):
                raise DefinitionError(
                    f"the parameter has no annotation; write {name}: float = parameter(…), or Array for a vector.",
                    block=cls.__name__,
                    port=name,
                )
        cls.parameter_specs = specs
        cls._conditions = tuple(
            (n, spec.kind, spec.default is None) for n, spec in specs.items() if spec.kind is not None
        )
        written = cls.__dict__.get("__doc__") or f"{cls.__name__}."
        section = parameter_section(cls.parameter_specs, cls._keywords)
        cls.__doc__ = with_section(inspect.cleandoc(written), "Parameters", section)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        cls = type(self)
        who = kwargs.get("name") or cls.__name__
        positional = [name for name, spec in cls.parameter_specs.items() if not spec.kw_only]
        if len(args) > len(positional):
            allowed = f"only {', '.join(positional)} may come by position" if positional else "all go by keyword"
            raise ParameterError(
                f"{count_of(len(args), 'argument')} came by position; {allowed}. {_by_keyword(cls, args, kwargs)}.",
                block=who,
            )
        for name, value in zip(positional, args, strict=False):
            if name in kwargs:
                raise ParameterError("found two values, by position and by keyword; give one.", block=who, port=name)
            kwargs[name] = value
        for name in kwargs:
            if name not in cls.parameter_specs and name not in cls._keywords:
                raise ParameterError(
                    f"{cls.__name__} has no parameter {name!r}. {_instead_of(cls, name)}", block=who, port=name
                )
        for name, spec in cls.parameter_specs.items():
            if name not in kwargs and spec.required:
                unit = f" in {spec.unit}" if spec.unit else ""
                raise ParameterError(
                    f"it is required and was not given: {cls.__name__}({name}=…){unit}. {spec.description}",
                    block=who,
                    port=name,
                )
            object.__setattr__(self, name, convert(kwargs.get(name, spec.default), spec, who, name))
        try:
            for name, kind, takes_none in cls._conditions:
                value = self.__dict__[name]
                if not (takes_none and value is None) and not kind.holds(value):
                    raise ParameterError(kind.complaint(name, value), port=name)
            self.check()
        except LoopwrightError as error:
            error.at(block=getattr(self, "label", cls.__name__))
            raise

    def check(self) -> None:
        """Check conditions on several parameters together; override it and raise `ParameterError`.

        The block's name is filled in: ``raise ParameterError("found …; expected …. Exchange them.", port="lower")``.
        """

    @property
    def parameters(self) -> dict[str, Any]:
        """Name and value of every parameter, in the order of declaration."""
        return {name: self.__dict__[name] for name in type(self).parameter_specs}

    def replace(self, **changes: Any) -> Self:
        """Return a variant with some parameters changed.

        Raises
        ------
        ParameterError
            For an unknown name or a value out of its bounds.
        """
        return type(self)(**{**self.parameters, **changes})

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for name in type(self).parameter_specs:  # a pickled array comes back writable
            if name in state:
                self.__dict__[name] = freeze(state[name])

    def __setattr__(self, name: str, value: Any) -> None:
        raise ParameterError(
            f"a {type(self).__name__} is a value and can't be changed; use .replace({name}=…) and keep the result.",
            port=name,
        )

    def __delattr__(self, name: str) -> None:
        self.__setattr__(name, None)

    def __eq__(self, other: object) -> bool:
        if type(self) is not type(other):
            return NotImplemented
        return bool(identity(self) == identity(other))

    def __hash__(self) -> int:
        return hash(identity(self))

    def _is_default(self, name: str, value: Any) -> bool:
        spec = type(self).parameter_specs[name]
        return not spec.required and identity(value) == identity(convert(spec.default, spec, "", name))

    def __repr__(self) -> str:
        shown = (f"{n}={shorten(v)}" for n, v in self.parameters.items() if not self._is_default(n, v))
        return f"{type(self).__name__}({', '.join(shown)})"


def _by_keyword(cls: type[Value], args: Sequence[Any], kwargs: Mapping[str, Any]) -> str:
    """Return how a call with arguments by position is written; the required parameters come first."""
    if len(args) == 1 and (made := as_block(args[0])):
        return made
    order = _order_by_position(cls, len(args) + len(kwargs))
    given = dict(zip((name for name in order if name not in kwargs), args, strict=False)) | dict(kwargs)
    texts = {name: shorten(value) for name, value in given.items()}
    texts = {name: text if len(text) <= _LONGEST and "\n" not in text else "…" for name, text in texts.items()}
    texts |= {name: "…" for name in order if _is_required(cls, name) and name not in texts}
    by_place = [texts.pop(name) for name in order if not cls.parameter_specs[name].kw_only and name in texts]
    return f"Write {cls.__name__}({', '.join([*by_place, *(f'{name}={text}' for name, text in texts.items())])})"


def _order_by_position(cls: type[Value], count: int) -> list[str]:
    """Return the parameters in the order in which people give that many by position."""
    # the order of declaration, without a source's unit, where that has all required ones; else these come first
    known = BY_POSITION.get(cls.__name__, ())
    if 1 < count == len(known):
        return [*known, *(name for name in cls.parameter_specs if name not in known)]
    declared = sorted(cls.parameter_specs, key=lambda name: (cls.parameter_specs[name].kw_only, name == "unit"))
    if any(_is_required(cls, name) for name in declared[count:]):
        declared.sort(key=lambda name: (cls.parameter_specs[name].kw_only, not _is_required(cls, name)))
    return declared


def _is_required(cls: type[Value], name: str) -> bool:
    return cls.parameter_specs[name].required


def _instead_of(cls: type[Value], name: str) -> str:
    """Return what to write for a keyword that is no parameter of a class."""
    known = [KEYWORDS[base.__name__] for base in cls.__mro__ if base.__name__ in KEYWORDS]
    ways = {**OF_ANY_BLOCK, **(known[0] if known else {})} if "name" in cls._keywords else {}
    if name not in ways or name in cls.parameter_specs:
        return near(name, cls.parameter_specs)
    return f"Write {ways[name]}." if name not in OF_ANY_BLOCK else f"It is {ways[name]}."


def identity(value: Any) -> Any:
    """Return a hashable stand-in for a parameter value that is equal exactly when type and value are."""
    # the type counts because equations may branch on it: 1 == True, but their traces differ
    if isinstance(value, Value):
        return type(value), tuple((k, identity(v)) for k, v in value.parameters.items()), value._content
    if isinstance(value, np.ndarray):
        content = tuple(map(identity, value.flat)) if value.dtype == object else value.tobytes()
        return np.ndarray, value.dtype.str, value.shape, content
    if isinstance(value, Mapping):
        return Mapping, frozenset((identity(k), identity(v)) for k, v in value.items())
    if isinstance(value, list | tuple):
        return type(value), tuple(identity(v) for v in value)
    if isinstance(value, frozenset):
        return frozenset, frozenset(identity(v) for v in value)
    return type(value), value


def convert(value: Any, spec: ParameterSpec, owner: str, name: str) -> Any:
    """Bring one parameter value into its stored form and check it against its declaration."""
    # Numbers become float, sequences of numbers read-only float64 arrays, integers stay integers where the declaration
    # says int. Mappings, lists and sets become read-only copies.

    def error(found: str, expected: str) -> ParameterError:
        unit = f" in {spec.unit}" if spec.unit else ""
        about = f": {spec.description.rstrip('.')}" if spec.description else ""
        text = f"found {found}; expected {expected}{unit}. Give {name}= as that{about}."
        return ParameterError(text, block=owner, port=name)

    kinds = _kinds(spec.annotation)
    # Most values are a float within its bounds, which needs no array.
    if type(value) is float and kinds <= _FLOAT and spec.shape is None and isfinite(value) and _is_within(value, spec):
        return value
    array = bool(kinds & {"Array", "ndarray", "NDArray"})
    numeric = array or "float" in kinds
    if value is None and ("None" in kinds or not numeric):
        return None
    for kind, accepted, word in (("bool", bool | np.bool_, "True or False"), ("str", str, "a text")):
        if kinds - {"None"} == {kind} and not isinstance(value, accepted):
            raise error(repr(value), word)
    # A declaration with floats takes integers, too; one of integers alone takes no float, and True is no number.
    if "int" in kinds and not numeric:
        if isinstance(value, bool) or not isinstance(value, numbers.Integral):
            raise error(repr(value), "an integer")
        result: Any = int(value)
    elif numeric and not array and "bool" not in kinds and isinstance(value, bool | np.bool_):
        raise error(repr(value), "a number")
    elif numeric and not isinstance(value, str | Value):
        try:
            result = np.array(value, dtype=float)
        except (TypeError, ValueError):
            raise error(shorten(value), _expected_numbers(value)) from None
        if spec.shape is not None:
            try:
                result = np.array(np.broadcast_to(result, spec.shape))
            except ValueError:
                raise error(f"shape {result.shape}", f"shape {spec.shape}") from None
        elif result.ndim and not array:
            raise error(f"{result.size} numbers", "a single number")
        if not np.all(np.isfinite(result)):
            raise error(repr(value), "finite numbers")
    elif numeric:
        raise error(repr(value), "a number")
    else:
        return _freeze_hashable(value, error)
    # Bounds hold for every entry of an array.
    for bound, holds, words in (
        (spec.above, np.greater, "above"),
        (spec.minimum, np.greater_equal, "at least"),
        (spec.maximum, np.less_equal, "at most"),
    ):
        if bound is not None and not np.all(holds(result, bound)):
            shown = shorten(result if np.ndim(result) else result.item() if isinstance(result, np.ndarray) else result)
            raise error(shown, f"a value {words} {bound:g}")
    if isinstance(result, np.ndarray):
        if result.ndim == 0:
            return float(result)
        result.flags.writeable = False
    return result


def _expected_numbers(value: Any) -> str:
    """Return what is expected in place of a value that is no array of numbers."""
    if not isinstance(value, list | tuple):
        return "numbers"
    if any(isinstance(part, np.ndarray) and part.ndim == 2 for part in value):
        return "one matrix: of the several that a function of python-control returns, give the first, [0]"
    if not all(isinstance(row, list | tuple | np.ndarray) for row in value):
        return "numbers"
    return "rows of one length" if len({len(row) for row in value}) > 1 else "numbers"


_FLOAT = frozenset({"float", "None"})


def _is_within(value: float, spec: ParameterSpec) -> bool:
    return (
        (spec.above is None or value > spec.above)
        and (spec.minimum is None or value >= spec.minimum)
        and (spec.maximum is None or value <= spec.maximum)
    )


def _annotation_text(annotation: Any) -> str:
    """Return an annotation as it is written, since ``float | None`` and ``NDArray[…]`` have no ``__name__``."""
    if isinstance(annotation, type):
        return annotation.__name__
    return re.sub(r"\b(?:\w+\.)+(?=\w)", "", str(annotation))


@lru_cache(maxsize=1024)
def _kinds(annotation: str) -> frozenset[str]:
    """Return the alternatives of an annotation by their bare names: ``np.ndarray | None`` → ndarray, None."""
    depth, parts = 0, [""]
    for character in annotation:
        depth += {"[": 1, "]": -1}.get(character, 0)
        if character == "|" and not depth:
            parts.append("")
        else:
            parts[-1] += character
    return frozenset(part.partition("[")[0].strip().rpartition(".")[2] for part in parts)


def _freeze_hashable(value: Any, error: Callable[[str, str], ParameterError]) -> Any:
    """Return a read-only copy of a value that is no number, and refuse one that can't be hashed."""
    frozen = freeze(value)
    try:
        hash(identity(frozen))
    except TypeError:  # neither == nor the cache of traces could find such a value again
        raise error(
            f"{shorten(value)} of type {type(value).__name__}, which can't be hashed",
            "a number, a text, a tuple, a mapping, a function or an object that is hashable and never changes, such as "
            "one of a @dataclass(frozen=True)",
        ) from None
    return frozen
