"""C for a target with the loop of runs inside: continuous states, events and algebraic loops between ticks.

The source is that of an FMU without FMI: the loop's files and the diagram's functions (`write_unit`), behind the
functions ``init``, ``tick``, ``set`` and ``get`` that C for a target has; their text is in ``templates/``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from .c_expressions import OF_MATH
from .c_text import c_constant, fill_template
from .elementary_tables import FUNCTIONS
from .loop_spec import LoopSpec, write_unit
from .target_members import NAMED, Member, Status, label_members, list_statuses, name_members
from .target_text import MOST_SHOWN, TargetText, frame_facts

_VECTORS = {"p": 0, "w": 1, "x": 2, "log": 3}
_SPARE = 64
"""Bytes of a memory beyond those of its members: the count of ticks, and what a compiler puts between members."""


class _Variable(NamedTuple):
    """A variable of the source.

    ``label``: the end of its enumerator.
    ``vector``, ``first``: the vector that it is in, and its first entry in the table of places.
    """

    member: Member
    label: str
    vector: int
    first: int


def write_loop_target(spec: LoopSpec, *, own_functions: bool = False) -> TargetText:
    """Return a diagram as C with the loop of runs inside, in double precision.

    ``own_functions``: as for `write_target`.
    """
    name, bytes_ = spec.name, spec.memory.bytes + _SPARE
    statuses, guards = list_statuses(
        (guard for found in spec.guards for guard in found.names),
        Status("NO_VALUE", "a number is not finite, an equation has no solution, or events don't end"),
    )
    variables = _list_variables(spec)
    facts = frame_facts(spec, about=f"The diagram {name}.", period=c_constant(float(spec.base)), statuses=statuses)
    facts |= {"number": "double", "bytes": bytes_, "variables": variables}
    source = {
        "unit": write_unit(spec, own_functions=own_functions),
        "places": [place for one in variables for place in one.member.places] or [0],
        "range_of": _write_range,
        "guards": [guards[guard] for found in spec.guards for guard in found.names] or ["NO_VALUE"],
    }
    files = {
        f"{name}.h": fill_template("loop.h", **facts),
        f"{name}.c": fill_template("loop.c", **facts, **source),
        f"{name}_example.c": fill_template("loop_example.c", **facts, **_example_facts(variables)),
    }
    own = FUNCTIONS if own_functions else ()
    called = (f for f in OF_MATH if f not in own and re.search(rf"\b{f}\(", files[f"{name}.c"]))
    return TargetText(
        name,
        "double",
        tuple(one.member for one in variables),
        files,
        (),
        {"struct": bytes_},
        tuple(sorted(called)),
        tuple(status.text for status in statuses),
    )


def _list_variables(spec: LoopSpec) -> list[_Variable]:
    members: list[Member] = []
    vectors: list[int] = []
    for group in NAMED:
        found = getattr(spec, group)
        members += name_members(group, ((one.variable, one.places, np.array(one.variable.flat_start)) for one in found))
        vectors += [_VECTORS[one.vector] for one in found]
    firsts = accumulate((member.count for member in members), initial=0)
    return [
        _Variable(member, label, vector, first)
        for (member, label), vector, first in zip(label_members(members).items(), vectors, firsts, strict=False)
    ]


def _write_range(member: Member) -> str:
    low, high = member.variable.minimum, member.variable.maximum
    return ", ".join(("-DBL_MAX" if low is None else c_constant(low), "DBL_MAX" if high is None else c_constant(high)))


def _example_facts(variables: Iterable[_Variable]) -> dict[str, Any]:
    """Return the inputs that an example sets, and the outputs that it prints."""
    return {
        "measured": [
            (one.label, i, c_constant(value))
            for one in variables
            if one.member.group == "inputs"
            for i, value in enumerate(one.member.start.tolist())
        ],
        "shown": [one for one in variables if one.member.group == "outputs"][:MOST_SHOWN],
    }
