"""Checks what must hold before a run begins. Rule: when it raises, nothing was started and nothing has to be undone."""

from __future__ import annotations

import math
import resource
import sys

from trilane import machine
from trilane.errors import BadInputError, TrilaneError
from trilane.pipeline import fork_server
from trilane.pipeline.description import Pipeline

#: Number of files and sockets that a run holds open, with room for a unit that is restarted.
LEAST_FILES = 96


def refuse_in_a_unit() -> None:
    """Raise BadInputError if a unit is importing the module of its stages, as that would start units without end."""
    spec = sys.modules["__main__"].__spec__
    if spec is not None and spec.name == fork_server.__name__:
        found = "run_pipeline was called while a unit imported its stages"
        raise BadInputError("run_pipeline", found, 'a call under `if __name__ == "__main__":`')


def check_open_files() -> None:
    """Raise TrilaneError if this process may open too few files for a run."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if limit != resource.RLIM_INFINITY and limit < LEAST_FILES:
        raise TrilaneError(f"open files: found a limit of {limit}, expected at least {LEAST_FILES}: ulimit -n 1024")


def check_cores(pipeline: Pipeline) -> None:
    """Raise BadInputError for cores that the units could not get."""
    here = machine.here.cores()
    for unit, settings in pipeline.units.items():
        if absent := set(settings.cores).difference(here):
            found, expected = ", ".join(map(str, sorted(absent))), ", ".join(map(str, sorted(here)))
            raise BadInputError(f"cores of unit {unit}", found, f"some of this process's: {expected}")


def check_positive(**values: float | None) -> None:
    """Raise BadInputError for a value that is not None, not above 0 or not finite."""
    for name, value in values.items():
        if value is not None and not 0 < value < math.inf:
            raise BadInputError(name, str(value), "more than 0")
