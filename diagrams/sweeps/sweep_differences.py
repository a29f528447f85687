"""Differences between two sweeps, by their parts."""

from __future__ import annotations

from .revision import DIGEST, Parts

_SHOWN = 5
"""Differences that the message lists; the others are counted."""
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
"""Kinds whose parts are values, which the message shows."""


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
