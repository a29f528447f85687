"""Page ``documentation/index.html`` of an FMU: description, equations, events, variables. It needs no other file."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from ...blocks.core import Block
from .equation_text import equations, number
from .model_spec import ModelSpec, Variable, scalarize
from .variable_entries import Entry, layout

_STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; }
pre { white-space: pre-wrap; padding: 0.75rem 1rem; border: 1px solid #8886; border-radius: 0.3rem; }
pre.text { border: 0; padding: 0; }
table { border-collapse: collapse; width: 100%; }
caption { text-align: left; padding-bottom: 0.5rem; }
th, td { text-align: left; vertical-align: top; padding: 0.3rem 0.75rem 0.3rem 0; border-bottom: 1px solid #8886; }
code, pre { font-family: ui-monospace, monospace; font-size: 0.9em; }
"""
_COLUMNS = ("Name", "Causality", "Variability", "Unit", "Start", "Min", "Max", "Description")
_CAUSALITY = {"time": "independent", "fixed": "parameter", "tunable": "parameter", "input": "input"}
_EQUATIONS = ("derivative", "output", "indicators", "jump")  # they may be inherited
_MOST = 12  # numbers of a start value that are listed


_GENERATED = re.compile(r"\n\n(?:Parameters|Inputs|Outputs|States|Events)\n-+\n")


def block_text(block: Block) -> str:
    """Return the text of a block's documentation: its docstrings, and the source of its equations if there is one."""
    cls = type(block)
    module = inspect.getmodule(cls)
    about = module.__doc__ if module is not None and module.__name__ != "__main__" else None
    # the first line is the model's description, and the table's rows replace the sections on parameters and ports
    written = _GENERATED.split(inspect.cleandoc(cls.__doc__ or ""), maxsplit=1)[0].partition("\n")[2]
    parts = [written, inspect.cleandoc(about or "")]
    inherited = {name: getattr(cls, name) for name in _EQUATIONS if getattr(cls, name, None) is not None}
    for member in {**inherited, **vars(cls)}.values():
        function = member.fget if isinstance(member, property) else member
        if inspect.isfunction(function) and not function.__name__.startswith("_"):
            parts.append(_source(function))
    return "\n\n".join(part.strip() for part in parts if part.strip())


def _source(function: Callable[..., Any]) -> str:
    try:
        return textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError):  # typed at a prompt: there is no file
        return ""


def _names(variables: Iterable[Variable]) -> list[str]:
    return [v.name for v in variables]


def _equations(spec: ModelSpec) -> list[tuple[str, str]]:
    """Return groups of equations with their titles; none if one group can't be printed."""
    flat = scalarize(spec)
    knowns = [["time"], _names(flat.states), _names(flat.inputs), _names(flat.parameters)]
    events = [e.name for e in spec.events]
    groups = [
        ("Rates of the states", spec.derivative, knowns, [f"der({v.name})" for v in flat.continuous]),
        ("Outputs", spec.output, knowns, _names(flat.outputs)),
    ]
    if spec.indicators is not None and spec.jump is not None:
        fires = (
            "Event indicators: an event fires when its indicator rises above 0 (rising), or falls to 0 or below "
            "(falling)"
        )
        after = "States after an event; the name of an event is 1 if it fires, else 0"
        groups.append((fires, spec.indicators, knowns, [e.indicator for e in spec.events]))
        groups.append((after, spec.jump, [*knowns, events], [f"next({v.name})" for v in flat.states]))
    found = []
    for title, f, names, unknowns in groups:
        if not unknowns:
            continue
        lines = equations(f, names, unknowns)
        if not lines:
            return []
        kept = {f"next({v.name}) = {v.name}" for v in flat.states}  # unchanged by a jump
        found.append((title, "\n".join(line for line in lines if line not in kept)))
    return found


def _events(spec: ModelSpec) -> list[str]:
    if not spec.events:
        return []
    head = "".join(f'<th scope="col">{name}</th>' for name in ("Name", "Direction", "Nominal", "Description"))
    rows = []
    for e in spec.events:
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in (e.direction, number(e.nominal), e.description))
        rows.append(f'<tr><th scope="row"><code>{escape(e.name)}</code></th>{cells}</tr>')
    return ["<table>", f"<thead><tr>{head}</tr></thead>", "<tbody>", *rows, "</tbody>", "</table>"]


def _start(variable: Variable) -> str:
    values = np.asarray(variable.flat_start)
    if values.size > 1 and (values == values[0]).all():
        return f"all {number(values[0])}"
    more = ", …" if values.size > _MOST else ""
    return ", ".join(number(v) for v in values[:_MOST]) + more


def _minimum_text(minimum: float) -> str:
    """Return a minimum as text; the least number above an open bound is shown as that bound."""
    below = 0.0 if minimum == np.finfo(float).tiny else float(np.nextafter(minimum, -np.inf))
    return f"> {number(below)}" if len(number(below)) < len(number(minimum)) else number(minimum)


def _row(e: Entry) -> str:
    v = e.variable
    shape = f" ({' × '.join(map(str, v.shape))})" if v.shape else ""
    cells = [
        _CAUSALITY.get(e.kind, "output" if e.is_output else "local") + (", state" if e.kind == "state" else ""),
        "continuous" if e.kind in ("time", "derivative") else v.variability,
        v.unit or "",
        _start(v),
        "" if v.minimum is None else _minimum_text(v.minimum),
        "" if v.maximum is None else number(v.maximum),
        v.description,
    ]
    inner = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
    return f'<tr><th scope="row"><code>{escape(e.name)}</code>{escape(shape)}</th>{inner}</tr>'


def _section(title: str, body: Sequence[str]) -> list[str]:
    return [f"<h2>{escape(title)}</h2>", *body] if body else []


def index_html(spec: ModelSpec, text: str = "", *, fmi: int = 3) -> str:
    """Return the text of ``documentation/index.html`` (FMI 3.0, 2.5.1; FMI 2.0, 2.3).

    ``spec``: the model as exported, with arrays or without.
    ``text``: plain text by the author, such as a docstring; shown unchanged.
    Returns: HTML 5 without references to other files.
    """
    traced = _equations(spec)
    if traced:
        printed = [f"<p>{escape(title)}:</p>\n<pre>{escape(lines)}</pre>" for title, lines in traced]
        printed.append("<p>These equations are compiled; <code>where(c, a, b)</code> is a where c holds, else b.</p>")
    else:
        printed = ["<p>The equations are too long to print, or have tables; see <code>sources/model.c</code>.</p>"]
    sections = {"Equations": printed, "Events": _events(spec)}
    return page_of(spec.name, spec.description, text, sections, layout(spec), fmi=fmi)


def page_of(
    name: str, description: str, text: str, sections: Mapping[str, Sequence[str]], entries: Iterable[Entry], *, fmi: int
) -> str:
    """Return the page of a model: its description, sections by title, and the table of its variables."""
    rows = [_row(e) for e in entries]
    head = "".join(f'<th scope="col">{column}</th>' for column in _COLUMNS)
    note = "Arrays are listed row by row." if fmi == 3 else "Elements of arrays count from 1."
    lines = [
        "<!DOCTYPE html>",
        '<html lang="en">',
        "<head>",
        '<meta charset="utf-8"/>',
        '<meta name="viewport" content="width=device-width, initial-scale=1"/>',
        f"<title>{escape(name)}</title>",
        f"<style>{_STYLE}</style>",
        "</head>",
        "<body>",
        f"<h1>{escape(name)}</h1>",
        *([f"<p>{escape(description)}</p>"] if description else []),
        f"<p>An FMU of FMI {fmi}.0. It needs no other software to run.</p>",
        *_section("Description", [f'<pre class="text">{escape(text.strip())}</pre>'] if text.strip() else []),
        *(line for title, body in sections.items() for line in _section(title, body)),
        *_section(
            "Variables",
            [
                "<table>",
                f"<caption>{note}</caption>",
                f"<thead><tr>{head}</tr></thead>",
                "<tbody>",
                *rows,
                "</tbody>",
                "</table>",
            ],
        ),
        "</body>",
        "</html>",
    ]
    return "\n".join(lines) + "\n"
