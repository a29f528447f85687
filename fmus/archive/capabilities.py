"""Capability flags of an FMU's interface, which versions of FMI name differently."""

from __future__ import annotations

from typing import Any


def has_flag(interface: Any, name: str) -> bool:
    """Whether an element of a description has a flag; not where there is no such element."""
    return interface is not None and interface.get(name) in ("true", "1")


def state_flags(version: str) -> tuple[str, str]:
    """Return the names of the flags of saving and of serializing the state."""
    state = "FMUState" if version.startswith("3.") else "FMUstate"
    return f"canGetAndSet{state}", f"canSerialize{state}"


def derivatives_flag(version: str) -> str:
    """Return the name of the flag of directional derivatives."""
    return "providesDirectionalDerivatives" if version.startswith("3.") else "providesDirectionalDerivative"


def read_capabilities(interface: Any, version: str) -> dict[str, bool]:
    """Return the capabilities that both interfaces have, co-simulation and model exchange, by the names of fields."""
    saves, serializes = state_flags(version)
    return {
        "can_save": has_flag(interface, saves),
        "can_serialize": has_flag(interface, saves) and has_flag(interface, serializes),
        "has_derivatives": has_flag(interface, derivatives_flag(version)),
        "only_once": has_flag(interface, "canBeInstantiatedOnlyOncePerProcess"),
    }
