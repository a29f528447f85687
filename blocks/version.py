"""The package's version."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("loopwright")
except PackageNotFoundError:
    __version__ = "unknown"  # run from its sources, without an installation
