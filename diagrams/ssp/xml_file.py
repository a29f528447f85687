"""One XML file of an SSP, of SSP 1.0 or 2.0: its elements, units and enumerations, and files that it refers to.

Elements of the standard that are not known here are errors; annotations, geometry, meta data and elements of other
namespaces are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any
from urllib.parse import unquote

from ...blocks.core import BASE_UNITS, SspFileError
from ...fmus.archive import FmuArchive, FmuFault, FmuUnits, parse_xml
from .ssp_files import PackagedFile, as_ssp_errors

_SPACE = "http://ssp-standard.org/SSP1/"
FULL_NAMESPACE = f"{_SPACE}SystemStructure"
_ROOTS = {
    "Description": "SystemStructureDescription",
    "ParameterValues": "ParameterSet",
    "ParameterMapping": "ParameterMapping",
    "SignalDictionary": "SignalDictionary",
}
"""Root element of each kind of file, by the end of its namespace."""
_LEFT_OUT = {
    "Annotations",
    "ElementGeometry",
    "ConnectorGeometry",
    "ConnectionGeometry",
    "SystemGeometry",
    "GraphicalElements",
    "MetaData",
    "Signature",
}
"""Elements without an effect on values."""


class XmlFile:
    """One XML file of an SSP: its place, its units and enumerations, and ways to its elements.

    ``notes``: takes remarks on what has no effect.
    """

    def __init__(self, notes: list[str], place: PackagedFile, root: Any, kind: str):
        self.notes, self.place, self.root = notes, place, root
        space, _, tag = str(root.tag).rpartition("}")
        known = f"{{{FULL_NAMESPACE}{kind}", f"{{{_SPACE}{kind}"  # some tools leave a part out
        if tag != _ROOTS[kind] or space not in known:
            raise self.error(
                f"found the root element {tag!r} of {space[1:] or 'no namespace'!r}; expected {_ROOTS[kind]} of "
                f"{FULL_NAMESPACE + kind!r}, as in SSP 1.0 and 2.0. Export it again."
            )
        if space != known[0]:
            notes.append(f"{place.name} has the namespace {space[1:]}; expected {known[0][1:]}")
        version = root.get("version", "")
        if version not in ("1.0", "2.0"):
            raise self.error(f"found version {version!r}; expected 1.0 or 2.0. Export it by one of them.")
        self.units = FmuUnits({u.get("name", ""): self._unit(u) for u in self.members("Units", self.root, "Unit")})
        self.enumerations = {
            e.get("name", ""): {i.get("name", ""): self._whole(i, "value") for i in self.children(e)}
            for e in self.members("Enumerations", self.root, "Enumeration")
        }

    # --- XML ---------------------------------------------------------------------------------------------------------

    def error(self, found: str, element: str = "", fault: FmuFault = FmuFault.DESCRIPTION) -> SspFileError:
        """Return an error in this file, at an element by its names from the root down."""
        where = f"the file {self.place.name} of {str(self.place.package.file)!r}"
        return SspFileError(f"in {where}: {found}", fault=fault, subject=self.place.name, block=element or None)

    def children(self, element: Any) -> Iterator[Any]:
        """Yield the child elements of the standard's namespaces that have an effect."""
        for child in element:
            space, _, tag = str(child.tag).rpartition("}")
            if space.startswith(f"{{{_SPACE}") and tag not in _LEFT_OUT:
                yield child

    def expect(self, child: Any, *known: str, at: str = "") -> str:
        """Return the name of an element that must be one of those known here."""
        tag = tag_of(child)
        if tag not in known:
            raise self.error(
                f"found the element {tag!r} in {tag_of(child.getparent())!r}, which is not supported here; expected "
                f"{' or '.join(known) or 'none'}. Leave it out, or export by SSP 1.0.",
                at,
            )
        return tag

    def expect_children(self, element: Any, *known: str, at: str = "") -> None:
        """Refuse child elements of other names than those known here."""
        for child in self.children(element):
            self.expect(child, *known, at=at)

    def one(self, tag: str, element: Any) -> Any:
        """Return the child element of a name; None without one."""
        return next((child for child in self.children(element) if tag_of(child) == tag), None)

    def members(self, group: str, element: Any, *known: str, at: str = "") -> Iterator[Any]:
        """Yield what is in a group of an element, of these names; nothing where it has no such group."""
        found = self.one(group, element)
        for child in () if found is None else self.children(found):
            self.expect(child, *known, at=at)
            yield child

    def number(self, element: Any, name: str, default: float | None = None, at: str = "") -> float:
        """Return an attribute that must be a number."""
        text = element.get(name)
        if text is None and default is not None:
            return default
        try:
            return float(text)
        except (TypeError, ValueError):
            raise self.error(
                f"found {name}={text!r} in {tag_of(element)!r}; expected a number. Export it again.", at
            ) from None

    def _whole(self, element: Any, name: str) -> int:
        text = element.get(name)
        try:
            return int(text)
        except (TypeError, ValueError):
            raise self.error(
                f"found {name}={text!r} in {tag_of(element)!r}; expected a whole number. Export it again."
            ) from None

    def _unit(self, element: Any) -> Any:
        base = self.one("BaseUnit", element)
        if base is None:
            return SimpleNamespace(baseUnit=None)
        powers = {name: int(self.number(base, name, 0.0)) for name in BASE_UNITS}
        return SimpleNamespace(
            baseUnit=SimpleNamespace(
                factor=self.number(base, "factor", 1.0), offset=self.number(base, "offset", 0.0), **powers
            )
        )

    def find_unit(self, name: str | None) -> str | None:
        """Return a unit of this file, as this library reads it."""
        found = self.units.find(name)
        if name and found is None:
            self.notes.append(f"the unit {name!r} has no definition here, and is not converted")
        self.notes += [f"{text} in {self.place.name}" for text in self.units.complaints]
        self.units.complaints.clear()
        return found

    def shape(self, element: Any, at: str) -> tuple[int, ...]:
        """Return the shape that the dimensions of an element make; () without them, and where a connector has them."""
        sizes = []
        for child in self.children(element):
            if tag_of(child) == "Dimension":
                if child.get("size") is None:
                    if child.get("sizeConnector") is None:
                        return ()
                    raise self.error(
                        f"found a dimension by the connector {child.get('sizeConnector')!r}; expected a size. Write "
                        "the number.",
                        at,
                    )
                sizes.append(self._whole(child, "size"))
        return tuple(sizes)

    def name_of(self, element: Any, at: str) -> str:
        """Return the name of an element, which must have one."""
        name = element.get("name")
        if not name:
            raise self.error(f"found a {tag_of(element)} without a name; expected one. Export it again.", at)
        return str(name)

    def expect_type(self, element: Any, kind: str, at: str) -> None:
        """Refuse another format of values than the standard's own."""
        if element.get("type", kind) != kind:
            raise self.error(
                f"found the type {element.get('type')!r} of a {tag_of(element)}; expected {kind!r}, the standard's own "
                "format. Write the values in it.",
                at,
            )

    def part(self, element: Any, kind: str, inline: Any, at: str, component: PackagedFile | None) -> XmlFile | None:
        """Return the file that an element refers to by its source, or that is inside of another element."""
        source = element.get("source")
        if source is None:
            inside = None if inline is None else next(self.children(inline), None)
            return None if inside is None else XmlFile(self.notes, self.place, inside, kind)
        subject = f"{at or 'the root system'}"
        if element.get("sourceBase") == "component":
            if component is None:
                raise self.error(
                    f"found the source {source!r} within the component at an element that is none; expected sourceBase="
                    "'SSD'. Correct it.",
                    at,
                )
            return XmlFile(self.notes, component, self._inside(component, source, subject), kind)
        place = self.place.resolve(source, subject)
        return XmlFile(self.notes, place, place.parse(subject), kind)

    def _inside(self, component: PackagedFile, source: str, subject: str) -> Any:
        """Return the XML of a file inside of an FMU, or inside of another package."""
        path, name = component.path(subject), unquote(source).removeprefix("./")
        with as_ssp_errors():
            archive = FmuArchive.open(path, self.place.package.limits)
            return parse_xml(path, name, archive.read(name, archive.limits.description), "SSP")


def tag_of(element: Any) -> str:
    """Return the name of an element, without its namespace."""
    return str(element.tag).rpartition("}")[2]


def flag(element: Any, name: str) -> bool:
    """Whether an attribute is set to true."""
    return element.get(name) in ("true", "1")
