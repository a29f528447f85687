"""Functions that a library should export: those of the standard, and those of the capabilities that it declares."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from ..archive import FmuFault, FmuFinding, SharedLibrary

_PROMISES = {
    "2": {
        "canGetAndSetFMUstate": ("fmi2GetFMUstate", "fmi2SetFMUstate", "fmi2FreeFMUstate"),
        "canSerializeFMUstate": ("fmi2SerializedFMUstateSize", "fmi2SerializeFMUstate", "fmi2DeSerializeFMUstate"),
        "providesDirectionalDerivative": ("fmi2GetDirectionalDerivative",),
        "canInterpolateInputs": ("fmi2SetRealInputDerivatives",),
    },
    "3": {
        "canGetAndSetFMUState": ("fmi3GetFMUState", "fmi3SetFMUState", "fmi3FreeFMUState"),
        "canSerializeFMUState": ("fmi3SerializedFMUStateSize", "fmi3SerializeFMUState", "fmi3DeserializeFMUState"),
        "providesDirectionalDerivatives": ("fmi3GetDirectionalDerivative",),
        "providesAdjointDerivatives": ("fmi3GetAdjointDerivative",),
        "hasEventMode": ("fmi3EnterEventMode", "fmi3EnterStepMode", "fmi3UpdateDiscreteStates"),
    },
}
"""Functions by the capability flag that promises them (FMI 2.0, 3.3.1, 4.3.1; FMI 3.0, 3.4, 4.4)."""


def missing_promises(library: SharedLibrary, place: str, summary: Mapping[str, Any]) -> Iterator[FmuFinding]:
    """Yield functions that a library lacks: those of capabilities that it declares, and others of the standard."""
    major = summary["fmi_version"][0]
    if library.symbols is None or major not in _PROMISES:
        return
    promised: set[str] = set()
    for flag, names in _PROMISES[major].items():
        if not any(attributes.get(flag) in (True, 1) for attributes in summary["interfaces"].values()):
            continue
        lost = [name for name in names if name not in library.symbols]
        promised.update(lost)
        if lost:
            yield FmuFinding(
                FmuFault.MISSING_SYMBOL,
                lost[0],
                f"it declares {flag}, but {place} lacks {', '.join(lost)}; expected them.",
                "Don't rely on this capability. Report it to its makers.",
            )
    others = sorted(_standard(major, summary["interfaces"]) - library.symbols - promised)
    if others:
        shown = ", ".join(others[:4]) + (f" and {len(others) - 4} more" if len(others) > 4 else "")
        yield FmuFinding(
            FmuFault.MISSING_SYMBOL,
            others[0],
            f"{place} lacks {shown}, which the standard asks for; expected all functions of an interface.",
            "It runs here without them; other tools may refuse it.",
        )


def _standard(major: str, interfaces: Mapping[str, Any]) -> set[str]:
    """Return the functions that a library must export by the standard, as FMPy asks for them."""
    import fmpy.fmi2
    import fmpy.fmi3

    classes = {
        ("2", "CoSimulation"): fmpy.fmi2.FMU2Slave,
        ("2", "ModelExchange"): fmpy.fmi2.FMU2Model,
        ("3", "CoSimulation"): fmpy.fmi3.FMU3Slave,
        ("3", "ModelExchange"): fmpy.fmi3.FMU3Model,
    }
    chosen = [kind for (version, name), kind in classes.items() if version == major and name in interfaces]
    return {name for kind in chosen for name in dir(kind) if name.startswith(f"fmi{major}")}
