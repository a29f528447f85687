"""XML files of an FMI 3.0 FMU: ``modelDescription.xml`` and ``sources/buildDescription.xml``."""

from __future__ import annotations

from .model_description import DescribedVariable, ModelDescription, Unknown
from .xml_elements import document, element


def write_description3(about: ModelDescription) -> str:
    """Return the text of ``modelDescription.xml`` (FMI 3.0, 2.4)."""
    both = {
        "modelIdentifier": about.name,
        "canGetAndSetFMUState": True,
        "canSerializeFMUState": True,
        "providesDirectionalDerivatives": about.has_derivatives,
        "providesAdjointDerivatives": about.has_derivatives,
    }
    variables = [_variable(one, about) for one in about.variables]
    structure = {
        "Output": about.outputs,
        "ContinuousStateDerivative": about.rates,
        "InitialUnknown": about.initial,
        "EventIndicator": about.indicators,
    }
    children = [
        *(element(interface, both | {**more}) for interface, more in about.interfaces.items()),
        *about.definitions(element("Float64Type", kind) for kind in about.type_attributes()),
        about.log_categories({}),
        about.experiment(),
        element("ModelVariables", {}, [*variables, *(element("Clock", clock) for clock in about.clocks)]),
        element("ModelStructure", {}, [_unknown(tag, one) for tag, found in structure.items() for one in found]),
    ]
    return document("fmiModelDescription", about.head("3.0", "instantiationToken"), children)


def _variable(one: DescribedVariable, about: ModelDescription) -> str:
    e, v = one.entry, one.entry.variable
    attributes = {
        **one.attributes,
        "intermediateUpdate": one.is_intermediate or None,
        **one.describe_values(about.types),
        "start": " ".join(map(repr, v.flat_start)) or None,
        "clocks": one.clock,
        "derivative": e.of,
        "reinit": one.is_reinitialized or None,
    }
    return element("Float64", attributes, [element("Dimension", {"start": n}) for n in v.shape])


def _unknown(tag: str, unknown: Unknown) -> str:
    """Return an element of the model structure (FMI 3.0, 2.4.8)."""
    knowns = unknown.knowns
    attributes = {
        "valueReference": unknown.entry.reference,
        "dependencies": None if knowns is None else " ".join(str(d.known) for d in knowns),
        "dependenciesKind": None if knowns is None else " ".join(d.kind for d in knowns),
    }
    return element(tag, attributes)


def build_description(name: str) -> str:
    """Return the text of ``sources/buildDescription.xml`` (FMI 3.0, 2.5.1.3) of a model, with one file to compile."""
    files = element("SourceFileSet", {"language": "C11"}, [element("SourceFile", {"name": "model.c"})])
    configuration = element("BuildConfiguration", {"modelIdentifier": name}, [files])
    return document("fmiBuildDescription", {"fmiVersion": "3.0"}, [configuration])
