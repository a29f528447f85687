"""Digests: of a sweep without its samples, and of a sample; equal digests, equal outcomes.

Two sweeps whose digests differ are compared by their parts, for a message that says in which they do.
"""

from __future__ import annotations

import dis
import hashlib
import inspect
import os
import pickle
import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import OptionError, Value
from ..flat import WiredDiagram
from .plan import Plan
from .reductions import Reduction
from .samples import Sample

_OURS = __name__.partition(".")[0]
_SILENT = ("progress", "compile")
"""Options of a run that change no result; in fused runs, "compile" changes rounding."""

Parts = Mapping[str, Mapping[str, str]]
"""Parts of a sweep by kind and name, as short texts."""
DIGEST = "#"
"""Begins a part that is a digest, and no text of a value."""
_LONGEST = 40
_SHOWN = 5
"""Differences that a message lists; the others are counted."""
_KINDS = {
    "sweep": "the {}",
    "parameter": "the parameter {}",
    "setting": "the setting {}",
    "option": "the option {}",
    "reduction": "the reduction {!r}",
    "block": "the block {}",
    "content": "the content of {}",
    "equations": "the equations of {}",
    "wire": "the wire to {}",
    "control": "the condition of {}",
    "name": "the signal {!r}",
}
"""Kinds of parts in words, the most telling first."""
_VALUES = ("sweep", "parameter", "setting", "option")
"""Kinds whose parts are values, which a message shows."""


def digest_of(parts: Parts) -> str:
    """Return the digest of a sweep's parts: of a sweep without its samples."""
    texts = (f"{kind}\0{name}\0{text}" for kind in sorted(parts) for name, text in sorted(parts[kind].items()))
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()


def parts_of(plan: Plan) -> dict[str, dict[str, str]]:
    """Return all that the outcomes of a sweep depend on, except its samples, by kind and name.

    Each part is a short text of its value, or a digest. Equations count by their traces, so that a change in a function
    that they call is seen; those of blocks that Python evaluates count by their source. FMUs count by their content. A
    function of the user counts by its own code.
    """
    silent = _SILENT[:1] if plan.options.get("fuse") else _SILENT
    single = {
        "duration": repr(float(plan.duration)),
        "signals": repr(plan.signals),
        "seeds": repr(plan.seeds),
        "lanes": repr(plan.lanes > 1),
        "treatment of algebraic loops": plan.diagram.loops,
        "version of CasADi": ca.CasadiMeta.version(),
    }
    return {
        "sweep": single,
        "option": {name: _short(value) for name, value in plan.options.items() if name not in silent},
        "reduction": {name: _short(function) for name, function in plan.reductions.items()},
        **_of_diagram(plan.diagram),
    }


def key_of(sample: Sample, *, seeded: bool) -> str:
    """Return the digest of a sample: its parameters, and its seed where the sweep gives it to a block."""
    text = _text(dict(sample.parameters)) + (repr(sample.seed) if seeded else "")
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _of_diagram(diagram: WiredDiagram) -> dict[str, dict[str, str]]:
    table = diagram.scheduled
    blocks, parameters, contents, settings = (dict[str, str]() for _ in range(4))
    for path, block in table.blocks.items():
        blocks[path] = f"{_name(type(block))} in {table.subsystem_of[path] or diagram.name}"
        parameters |= _of_value(block, path)
        if block._content:
            contents[path] = _short(block._content)
    for path, chosen in table.subsystems.items():
        named = {f.name: _short(getattr(chosen, f.name)) for f in fields(chosen) if f.name != "path"}
        settings |= {f"{path or diagram.name}.{name}": text for name, text in named.items()}
    return {
        "block": blocks,
        "parameter": parameters,
        "content": contents,
        "setting": settings,
        "wire": {".".join(port): _short(wire) for port, wire in table.wires.items()},
        "name": {name: _short(wire) for name, wire in table.names.items()},
        "control": {path: _short(wire) for path, wire in table.controls.items()},
        "equations": _equations_of(diagram),
    }


def _equations_of(diagram: WiredDiagram) -> dict[str, str]:
    found, seen = dict[str, str](), dict[int, str]()
    for path, trace in diagram.checked.traced.items():
        block, own = diagram.scheduled.blocks[path], list[str]()
        if not block.opaque:
            if id(trace) not in seen:
                functions = (trace.function, trace.indicators, trace.jump, trace.system_matrix)
                seen[id(trace)] = _short([f.serialize() for f in functions if f is not None])
            own.append(seen[id(trace)])
        if block.opaque or not type(block).__module__.startswith(_OURS):
            own.append(_source(type(block)))  # its start and its instants are no part of the trace
        found[path] = _short(own)
    return found


def _of_value(value: Value, path: str) -> dict[str, str]:
    """Return the parameters of a value, by their paths; parts of values and of mappings one by one."""
    parts: dict[str, str] = {}
    for name, inner in value.parameters.items():
        if isinstance(inner, Value):
            parts[f"{path}.{name}"] = f"{_name(type(inner))} {_short(inner._content)}"
            parts |= _of_value(inner, f"{path}.{name}")
        elif isinstance(inner, Mapping):
            parts |= {f"{path}.{name}.{key}": _short(entry) for key, entry in inner.items()}
        elif name != "file":
            parts[f"{path}.{name}"] = _short(inner)
    return parts


def _short(value: Any) -> str:
    """Return a short text of a value that is equal in every process exactly for equal values: itself, or a digest."""
    plain = value.item() if isinstance(value, np.ndarray | np.generic) and value.ndim == 0 else value
    if (plain is None or type(plain) in (bool, int, float, str, Fraction)) and len(shown := str(plain)) <= _LONGEST:
        return repr(shown) if isinstance(plain, str) else shown
    return DIGEST + hashlib.sha256(_text(value).encode()).hexdigest()[:24]


def _name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def _source(cls: type) -> str:
    """Return the source of a class and of those of its bases that are no part of Loopwright."""
    found = []
    for each in cls.__mro__:
        if each.__module__.partition(".")[0] not in (_OURS, "builtins", "abc", "typing"):
            try:
                found.append(inspect.getsource(each))
            except (OSError, TypeError):  # of a class without a file
                found += [_text(member) for _, member in sorted(vars(each).items()) if inspect.isfunction(member)]
    return "\0".join(found)


def _text(value: Any) -> str:
    """Return a text of a value that is equal in every process exactly for equal values."""
    if isinstance(value, Value):
        kind = type(value)
        inside = ", ".join(f"{name}={_text(v)}" for name, v in sorted(value.parameters.items()) if name != "file")
        return f"{kind.__module__}.{kind.__qualname__}({inside}; {value._content})"
    if isinstance(value, np.ndarray):
        return f"array({value.dtype.str}, {value.shape}, {np.ascontiguousarray(value).tobytes().hex()})"
    if isinstance(value, np.generic):
        return _text(value.item())
    if isinstance(value, Mapping):
        return "{" + ", ".join(sorted(f"{_text(k)}: {_text(v)}" for k, v in value.items())) + "}"
    if isinstance(value, list | tuple):
        return "(" + ", ".join(map(_text, value)) + ")"
    if isinstance(value, set | frozenset):
        return "{" + ", ".join(sorted(map(_text, value))) + "}"
    if isinstance(value, float):
        return value.hex()
    if value is None or isinstance(value, str | bool | int | bytes | Fraction | Reduction | Enum):
        return repr(value)
    if isinstance(value, os.PathLike):
        return repr(os.fspath(value))
    if isinstance(value, types.CodeType):
        return _text((value.co_name, value.co_code, value.co_names, value.co_consts))
    if isinstance(value, type) or inspect.ismodule(value) or inspect.isbuiltin(value):
        return f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', value.__name__)}"
    if inspect.isfunction(value) or inspect.ismethod(value):
        return _of_function(value)
    if is_dataclass(value):
        inside = ", ".join(f"{f.name}={_text(getattr(value, f.name))}" for f in fields(value) if f.compare)
        return f"{type(value).__module__}.{type(value).__qualname__}({inside})"
    try:
        return hashlib.sha256(pickle.dumps(value, protocol=4)).hexdigest()
    except Exception as error:
        raise OptionError(
            f"found {value!r} in a sweep that is to be kept on disk; its content can't be compared with another's "
            f"({error}). Give it as a value, a dataclass or a function, or leave out to=."
        ) from error


def _of_function(function: Any) -> str:
    """Return a text of a function's own code, its defaults and the plain values that it takes from around it."""
    if inspect.ismethod(function):
        return f"{_text(function.__self__)}.{_of_function(function.__func__)}"
    around = [cell.cell_contents for cell in function.__closure__ or ()]
    plain = [_text(value) for value in around if not inspect.isfunction(value)]
    defaults = _text((function.__defaults__, function.__kwdefaults__))
    return f"function({_text(function.__code__)}, {defaults}, {plain}, {_globals(function)})"


def _globals(function: Any) -> str:
    """Return a text of the global numbers, texts and arrays, and lists of them, that a function's code names."""
    names, codes = set[str](), [function.__code__]
    while codes:
        code = codes.pop()
        names.update(step.argval for step in dis.get_instructions(code) if step.opname == "LOAD_GLOBAL")
        codes += [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
    around = function.__globals__
    return _text({name: around[name] for name in names if name in around and _is_plain(around[name])})


def _is_plain(value: Any) -> bool:
    if isinstance(value, list | tuple | set | frozenset):
        return all(map(_is_plain, value))
    if isinstance(value, dict):
        return all(map(_is_plain, value.values()))
    return isinstance(value, str | bytes | bool | int | float | complex | Fraction | np.ndarray | np.generic)


def describe_differences(old: Parts, new: Parts) -> str:
    """Return in words in what a stored sweep and a new one differ, by their `parts_of`; "" where no part does."""
    differ = [
        (kind, name)
        for kind in _KINDS
        for name in {**new.get(kind, {}), **old.get(kind, {})}
        if old.get(kind, {}).get(name) != new.get(kind, {}).get(name)
    ]
    single = [
        name
        for name in [*old.get("block", {}), *new.get("block", {})]
        if not (name in old.get("block", {}) and name in new.get("block", {}))
    ]
    changed = [name for kind, name in differ if kind in ("block", "parameter", "content")]

    def follows(kind: str, name: str) -> bool:
        """Whether a difference only follows from another one that is listed."""
        if kind == "equations":
            return any(path == name or path.startswith(name + ".") for path in changed)
        if kind == "content":
            return name in single
        return kind in ("parameter", "wire") and any(name.startswith(path + ".") for path in single)

    listed = [part for part in differ if not follows(*part)]
    words = [_describe(*part, old, new) for part in listed[:_SHOWN]]
    if len(listed) > _SHOWN:
        words.append(f"{len(listed) - _SHOWN} more")
    return ", ".join(words[:-1]) + (" and " if words[1:] else "") + words[-1] if words else ""


def _describe(kind: str, name: str, old: Parts, new: Parts) -> str:
    text, there, here = _KINDS[kind].format(name), old.get(kind, {}).get(name), new.get(kind, {}).get(name)
    if kind in _VALUES:
        if any(part is not None and part.startswith(DIGEST) for part in (there, here)):
            return text
        return f"{text} ({there or 'not given'} there, {here or 'not given'} here)"
    if there is None or here is None:
        return f"{text} ({'here' if there is None else 'there'} alone)"
    return text
