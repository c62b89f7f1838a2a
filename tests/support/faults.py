"""The process of a unit, for tests that hurt it."""

from __future__ import annotations

import psutil

from trilane.pipeline.fork_server import process_name


def unit_process(unit: str) -> psutil.Process:
    """The process of `unit` in the run that this process has under way. Raises LookupError when there is none."""
    for process in psutil.Process().children(recursive=True):
        if process.name() == process_name(unit):
            return process
    raise LookupError(unit)
