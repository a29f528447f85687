"""Signatures and docstring sections of classes, for notebooks and ``help``.

Both are made from the declarations of parameters and ports, so that no class repeats these in words.
"""

from __future__ import annotations

import inspect
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np

from .parameters import ParameterSpec

_NAME = ("name : str, optional", "Name in the diagram; without one the class name in snake case, numbered on repeats.")


class ParameterSignature:
    """Signature shown for a value: a class shows its constructor's, a block its call's."""

    def __get__(self, instance: Any, owner: Any) -> inspect.Signature:
        if instance is None:
            return _constructor(owner.parameter_specs, owner._keywords)
        inputs = getattr(instance, "inputs", None)
        if inputs is None:
            raise AttributeError("__signature__")
        optional, kind = inspect.Parameter.empty, inspect.Parameter.POSITIONAL_OR_KEYWORD
        parameters = [
            inspect.Parameter(n, kind, default=optional if port.default is None else port.default)
            for n, port in inputs.items()
            if n.isidentifier()
        ]
        return inspect.Signature(parameters, __validate_parameters__=False)


def _constructor(specs: Mapping[str, ParameterSpec], keywords: Iterable[str]) -> inspect.Signature:
    parameters = []
    for name, spec in sorted(specs.items(), key=lambda item: item[1].kw_only):
        kind = inspect.Parameter.KEYWORD_ONLY if spec.kw_only else inspect.Parameter.POSITIONAL_OR_KEYWORD
        default = inspect.Parameter.empty if spec.required else spec.default
        parameters.append(inspect.Parameter(name, kind, default=default, annotation=spec.annotation))
    parameters += [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation="str | None")
        for name in sorted(keywords)
    ]
    return inspect.Signature(parameters, __validate_parameters__=False)


def with_section(text: str, title: str, entries: Iterable[tuple[str, str]]) -> str:
    """Return a docstring with a numpydoc section at its end; without entries or with that section, unchanged."""
    header = f"{title}\n{'-' * len(title)}\n"
    lines = [line if not more else f"{line}\n    {more}" for line, more in entries]
    return text if not lines or header in text else f"{text}\n\n{header}" + "\n".join(lines)


def parameter_section(specs: Mapping[str, ParameterSpec], keywords: Collection[str]) -> list[tuple[str, str]]:
    """Return an entry for each parameter of a class: its type, unit, range and default, then the description."""
    entries = [(f"{name} : {', '.join(_describe_parameter(spec))}", spec.description) for name, spec in specs.items()]
    return [*entries, _NAME] if "name" in keywords else entries


def _describe_parameter(spec: ParameterSpec) -> list[str]:
    words = [spec.annotation]
    if spec.shape is not None:
        words.append(f"shape {spec.shape}")
    if spec.unit:
        words.append(f"in {spec.unit}")
    bounds = (("above", spec.above), ("at least", spec.minimum), ("at most", spec.maximum))
    words += [f"{word} {bound:g}" for word, bound in bounds if bound is not None]
    if not spec.required:
        words.append("optional" if spec.default is None else f"default {_number(spec.default)}")
    return words


def port_section(ports: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return an entry for each port: shape, unit, range, default, start or direction, then the description."""
    return [(f"{name} : {', '.join(_describe_port(port))}", port.description) for name, port in ports.items()]


def _describe_port(port: Any) -> list[str]:
    like = getattr(port, "like", None)
    if hasattr(port, "direction"):
        return [port.direction]
    if hasattr(port, "start"):
        words = _describe_start(port)
    elif port.shape is None:
        words = ["any shape" if hasattr(port, "default") else "shape from the equations"]
    else:
        words = [_shape(port.shape)]
    if port.unit is not None:
        words.append("in " + (", ".join(port.unit) if isinstance(port.unit, tuple) else port.unit))
    elif like and not hasattr(port, "start"):
        words.append(f"unit of {like}")
    bounds = (("at least", port.minimum), ("at most", port.maximum))
    words += [f"{word} {bound:g}" for word, bound in bounds if bound is not None]
    if getattr(port, "default", None) is not None:
        words.append(f"default {_number(port.default)}")
    if getattr(port, "secondary", False):
        words.append("read by name only")
    return words


def _describe_start(port: Any) -> list[str]:
    if isinstance(port.start, str):
        start = f"start {port.start}"
    elif callable(port.start):
        start = "start from the parameters"
    else:
        start = f"start {_number(port.start)}"
    if port.like:
        return [f"shape of {port.like}", start]
    computed = isinstance(port.start, str) or callable(port.start)
    return [start] if computed else [_shape(np.shape(port.start)), start]


def _shape(shape: tuple[int, ...]) -> str:
    return f"shape {shape}" if shape else "scalar"


def _number(value: Any) -> str:
    if isinstance(value, float | np.ndarray):
        array = np.asarray(value)
        return f"{array.item():g}" if array.ndim == 0 else str(array.tolist())
    return repr(value)
