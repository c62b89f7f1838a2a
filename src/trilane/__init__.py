"""Trilane: run, measure and predict a neural-avatar pipeline on CPU, GPU and DSP units.

`run`, `predict` and `load_run` are the interface for programs and notebooks (docs/python.md). Rule: importing this
module imports nothing else of Trilane; the interface is imported on first use.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from trilane.apps.interface import Prediction, Run, RunFailedError, load_run, predict, run

__all__ = ["Prediction", "Run", "RunFailedError", "load_run", "predict", "run"]


def __getattr__(name: str) -> Any:
    """Return an object of the interface or the version, loaded on first use; raises AttributeError for other names."""
    if name in __all__:
        from importlib import import_module

        return getattr(import_module("trilane.apps.interface"), name)
    if name != "__version__":
        raise AttributeError(f"module 'trilane' has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("trilane")
    except PackageNotFoundError:  # a source tree that was never installed
        return "0.0.0"


def __dir__() -> list[str]:
    """Return the names of this module and of the interface, so that shells complete both."""
    return [*globals(), *__all__]
