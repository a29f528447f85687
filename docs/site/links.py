"""Links of public names: where a page or a docstring has one as code, it leads to the reference."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from docutils import nodes
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.nodes import make_refnode

if TYPE_CHECKING:
    from sphinx.addnodes import pending_xref
    from sphinx.application import Sphinx
    from sphinx.environment import BuildEnvironment

_NAME = re.compile(r"(?:loopwright\.)?[A-Za-z_][\w.]*?(?=\(|$)")
_INSTANCES = {"diagram": "Diagram", "run": "Run", "fmu": "Fmu"}
"""Names that pages give to instances, and their classes."""


_ALSO_WORDS = {"final", "hold", "maximum", "mean", "minimum"}
"""Functions whose names are those of parameters, too: linked where they are called."""


def _index(env: BuildEnvironment) -> dict[str, tuple[str, str]]:
    """Map the short names of what the reference describes to document and anchor: `PID`, `Diagram.simulate`."""
    found: dict[str, tuple[str, str]] = {}
    for full, entry in env.domaindata["py"]["objects"].items():
        parts = full.split(".")
        if entry.objtype in ("module",):
            continue
        member = entry.objtype in ("method", "property", "attribute")
        short = ".".join(parts[-2:] if member else parts[-1:])
        found.setdefault(short, (entry.docname, entry.node_id))
        found[full] = (entry.docname, entry.node_id)
    return found


def _look_up(env: BuildEnvironment, text: str) -> tuple[str, str] | None:
    match = _NAME.match(text)
    if not match:
        return None
    name, index = match[0], _cached(env)
    head, _, tail = name.partition(".")
    for candidate in (name, f"{_INSTANCES.get(head, head)}.{tail}" if tail else name):
        if candidate in index:
            return index[candidate]
    return None


def _cached(env: BuildEnvironment) -> dict[str, tuple[str, str]]:
    if not hasattr(env, "loopwright_names"):
        env.loopwright_names = _index(env)
    return env.loopwright_names


class LinkedNames(SphinxPostTransform):
    """Code in a text that is a public name, or a call of it, becomes a link to the reference."""

    default_priority = 5

    def run(self, **_: Any) -> None:
        """Replace the literals of one document."""
        builder, here = self.env.app.builder, self.env.docname
        for literal in [*self.document.findall(nodes.literal)]:
            if isinstance(literal.parent, nodes.reference | nodes.title):
                continue
            text = literal.astext()
            target = None if text in _ALSO_WORDS else _look_up(self.env, text)
            if target and target[0] != here:
                literal.replace_self(make_refnode(builder, here, *target, literal.deepcopy()))


def _resolve(app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Node) -> nodes.Node | None:
    """Resolve names in docstrings and signatures, which are short, or of the file that defines them."""
    if node.get("refdomain") != "py":
        return None
    text = node["reftarget"]
    for candidate in (text, text.rpartition(".")[2] if text.startswith("loopwright.") else text):
        target = _look_up(env, candidate)
        if target:
            return make_refnode(app.builder, node["refdoc"], *target, content.deepcopy())
    return None


def setup(app: Sphinx) -> dict[str, Any]:
    """Connect both ways."""
    app.add_post_transform(LinkedNames)
    app.connect("missing-reference", _resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
