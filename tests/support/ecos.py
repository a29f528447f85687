"""Ecos, another tool's master of co-simulation, as the Python package ecospy."""

import ctypes
import importlib
import sys
from pathlib import Path

import pytest


def load_ecospy():
    """Return the package; skip the test where it, or a library that it needs, is missing."""
    if sys.platform == "linux":  # its library needs libtbb, which the package tbb puts where no loader looks
        for name in ("libtbb.so.12", str(Path(sys.prefix) / "lib" / "libtbb.so.12")):
            try:
                ctypes.CDLL(name, ctypes.RTLD_GLOBAL)
                break
            except OSError:
                continue
        else:
            pytest.skip("ecospy needs libtbb.so.12, which is missing: pip install tbb, or apt-get install libtbb12")
    try:
        return importlib.import_module("ecospy")
    except ImportError:
        pytest.skip("ecospy is not installed (extra: test)")
    except OSError as error:
        pytest.skip(f"ecospy's own library is not made for this platform: {error}")
