"""Links of public names: where a page or a docstring has one as code, it leads to the reference."""

from __future__ import annotations

import builtins
import re
from typing import TYPE_CHECKING, Any, NamedTuple

from docutils import nodes
from sphinx import addnodes
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.nodes import find_pending_xref_condition, make_refnode

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.environment import BuildEnvironment

_NAME = re.compile(r"(?:loopwright\.)?[A-Za-z_][\w.]*?(?=\(|$)")
_INSTANCES = {"diagram": "Diagram", "run": "Run", "fmu": "Fmu"}
"""Names that pages give to instances, and their classes."""

_ALSO_WORDS = {"final", "hold", "maximum", "mean", "minimum"}
"""Functions whose names are those of parameters, too: linked where they are called."""


class _Described(NamedTuple):
    """Where the reference describes a name, and the name in full, which a link to it shows as its title."""

    page: str
    anchor: str
    full: str

    def linked(self, builder: Any, here: str, shown: nodes.Node) -> nodes.Node:
        """Return a link from a page to it."""
        return make_refnode(builder, here, self.page, self.anchor, shown, self.full)


def _index(env: BuildEnvironment) -> dict[str, _Described]:
    """Map the short names of what the reference describes, as `PID` and `Diagram.simulate`, to where that is."""
    found: dict[str, _Described] = {}
    for full, entry in env.domaindata["py"]["objects"].items():
        parts = full.split(".")
        if entry.objtype == "module":
            continue
        member = entry.objtype in ("method", "property", "attribute")
        short = ".".join(parts[-2:] if member else parts[-1:])
        found[full] = _Described(entry.docname, entry.node_id, full)
        found.setdefault(short, found[full])
    return found


def _look_up(env: BuildEnvironment, text: str) -> _Described | None:
    match = _NAME.match(text)
    if not match:
        return None
    name, index = match[0], _cached(env)
    head, _, tail = name.partition(".")
    for candidate in (name, f"{_INSTANCES.get(head, head)}.{tail}" if tail else name):
        if candidate in index:
            return index[candidate]
    return None


def _cached(env: BuildEnvironment) -> dict[str, _Described]:
    if not hasattr(env, "loopwright_names"):
        env.loopwright_names = _index(env)
    return env.loopwright_names


class LinkedNames(SphinxPostTransform):
    """Code in a text that is a public name, or a call of it, becomes a link to the reference; so do names of types.

    It runs before Sphinx looks for the types itself, because that takes a pass over all names for each.
    """

    default_priority = 5

    def run(self, **_: Any) -> None:
        """Replace the literals and the names of types of one document."""
        builder, here = self.env.app.builder, self.env.docname
        for literal in [*self.document.findall(nodes.literal)]:
            if isinstance(literal.parent, nodes.reference | nodes.title | addnodes.pending_xref):
                continue
            text = literal.astext()
            target = None if text in _ALSO_WORDS else _look_up(self.env, text)
            if target and target.page != here:
                literal.replace_self(target.linked(builder, here, literal.deepcopy()))
        for node in [*self.document.findall(addnodes.pending_xref)]:
            if node.get("refdomain") == "py":
                self._link(node)

    def _link(self, node: addnodes.pending_xref) -> None:
        """Link a name in a docstring or signature, which is short, or of the file that defines it."""
        text = node["reftarget"]
        shown = (find_pending_xref_condition(node, "resolved") or node).children[0].deepcopy()
        short = text.rpartition(".")[2] if text.startswith("loopwright.") else text
        target = _look_up(self.env, text) or _look_up(self.env, short)
        if target:
            node.replace_self(target.linked(self.env.app.builder, self.env.docname, shown))
        elif hasattr(builtins, text):
            node.replace_self(shown)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the transform."""
    app.add_post_transform(LinkedNames)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
