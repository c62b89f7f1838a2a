"""Trilane: run, measure and predict a neural-avatar pipeline on CPU, GPU and DSP units."""

from typing import Any


def __getattr__(name: str) -> Any:
    """`__version__`, looked up when it is asked for: reading it takes longer than a unit's start."""
    if name != "__version__":
        raise AttributeError(name)
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("trilane")
    except PackageNotFoundError:  # a source tree that was never installed
        return "0.0.0"
