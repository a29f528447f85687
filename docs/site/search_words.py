"""Words that users of other tools search for: entries of the index, which the search lists before all else."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from docutils import nodes
from sphinx import addnodes

if TYPE_CHECKING:
    from sphinx.application import Sphinx

WORDS = {
    "scope": ("howto/plots", "howto/from_simulink"),
    "mux": ("howto/formulas", "reference/blocks/Stack"),
    "demux": ("reference/blocks/Demux", "howto/formulas"),
    "bus": ("howto/formulas",),
    "goto": ("howto/from_simulink",),
    "gain": ("reference/blocks/Gain",),
    "transfer function": ("reference/blocks/TransferFunction", "reference/blocks/DiscreteTransferFunction"),
    "pid": ("reference/blocks/PID", "howto/anti_windup"),
    "anti-windup": ("howto/anti_windup",),
    "rate transition": ("howto/from_simulink", "howto/cascade"),
    "zero-order hold": ("reference/blocks/Hold", "explanation/time"),
    "dead time": ("howto/dead_time", "reference/blocks/TransportDelay"),
    "lookup table": ("reference/blocks/Lookup1D", "reference/blocks/Lookup2D"),
    "algebraic loop": ("howto/algebraic_loop",),
    "solver": ("howto/choose_a_solver",),
    "sample time": ("explanation/time", "howto/cascade"),
    "linearize": ("tutorial/margins", "howto/frequency"),
    "bode": ("tutorial/margins", "howto/frequency"),
    "phase margin": ("tutorial/margins", "howto/frequency"),
    "root locus": ("howto/frequency",),
    "fmu": ("tutorial/fmu", "reference/classes/Fmu"),
    "co-simulation": ("tutorial/fmu", "reference/fmus"),
    "s-function": ("howto/from_simulink", "tutorial/own_block"),
    "code generation": ("howto/c_for_a_target",),
    "real time": ("howto/live",),
}
"""A word, and the pages that answer it."""


def _add(app: Sphinx, document: nodes.document) -> None:
    """Add the words of a page to it."""
    section = next(document.findall(nodes.section), None)
    words = [word for word, pages in WORDS.items() if app.env.docname in pages]
    if section is not None and words:
        entries = [("single", word, section["ids"][0], "main", None) for word in words]
        document.insert(0, addnodes.index(entries=entries))
        app.env.get_domain("index").entries.setdefault(app.env.docname, []).extend(entries)


def setup(app: Sphinx) -> dict[str, Any]:
    """Add the words when a page has been read."""
    app.connect("doctree-read", _add)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
