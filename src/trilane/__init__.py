"""Trilane: run, measure and predict a neural-avatar pipeline on CPU, GPU and DSP units."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("trilane")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0.0.0"
