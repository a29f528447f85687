"""XML of an FMU or an SSP, parsed without expanding or fetching anything."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...blocks.core import FmuFileError
from .faults import FmuFault


def parse_xml(path: Path, name: str, text: bytes, noun: str = "FMU") -> Any:
    """Return the root element of an XML file of an FMU or an SSP (``noun``), as lxml has it, without comments.

    Entities are refused, since no tool writes any: an entity can hold others many times over, or another file. The
    parser has its own limits: for the depth of elements, and for the size of one text.
    """
    from lxml import etree

    parser = etree.XMLParser(
        resolve_entities=False, load_dtd=False, no_network=True, huge_tree=False, remove_comments=True, remove_pis=True
    )
    try:
        root = etree.fromstring(text, parser)
    except etree.XMLSyntaxError as error:
        bomb = b"<!ENTITY" in text
        raise FmuFileError(
            f"the {name} of {str(path)!r} "
            + ("defines XML entities, which may be made to fill the memory" if bomb else "is no XML")
            + f": {error.msg}. Export the {noun} again.",
            fault=FmuFault.ENTITY if bomb else FmuFault.XML,
            subject=name,
        ) from None
    kinds: Any = root.getroottree().docinfo.internalDTD
    entity = next((e.name for e in kinds.iterentities()), None) if kinds is not None else None
    if entity is not None:
        raise FmuFileError(
            f"the {name} of {str(path)!r} defines the XML entity {entity!r}; expected none. Entities may be made to "
            f"read your files or to fill the memory. Export the {noun} again, or ask its maker.",
            fault=FmuFault.ENTITY,
            subject=name,
        )
    if kinds is not None and (kinds.system_url or kinds.external_id):
        raise FmuFileError(
            f"the {name} of {str(path)!r} refers to another file, {kinds.system_url!r}; expected none. Export the "
            f"{noun} again, or ask its maker.",
            fault=FmuFault.ENTITY,
            subject=name,
        )
    return root
