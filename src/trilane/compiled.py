"""Which modules are compiled, and whether the compiled ones are current. Rule: only what the sources say runs.

mypyc turns three parts into C while the package is installed (setup.py): the core, the job pipe over which units get
jobs and answer, and the clock around a job. Without a C compiler the same files run as Python, less than half as fast.
The name of the compiled library holds a digest of the sources it was made from.
"""

from __future__ import annotations

import hashlib
import importlib.util
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

#: Relative to the package's folder. They import each other, trilane.errors, trilane.unexpected_value, msgpack and the
#: standard library alone.
MODULES = (
    "scheduler/core.py",
    "scheduler/assignment.py",
    "scheduler/bypass.py",
    "scheduler/causes.py",
    "scheduler/choice.py",
    "scheduler/events.py",
    "scheduler/watchdog.py",
    "scheduler/completion.py",
    "scheduler/flow.py",
    "scheduler/late_frames.py",
    "scheduler/frame_times.py",
    "scheduler/samples.py",
    "scheduler/ledger.py",
    "scheduler/loop.py",
    "scheduler/policy.py",
    "scheduler/recording.py",
    "scheduler/frame_source.py",
    "scheduler/state.py",
    "scheduler/stats.py",
    "scheduler/unit_life.py",
    "scheduler/virtual.py",
    "scheduler/work_ladder.py",
    "transport/messages.py",
    "transport/slots.py",
    "pipeline/core_meter.py",
    "pipeline/core_shares.py",
    "pipeline/job_times.py",
)
PREFIX = "trilane_core_"
STALE = "the scheduler's sources were changed after they were compiled"
MEND = "make compile, or to run them as Python while you edit: make interpreted"
PACKAGE = Path(__file__).resolve().parent


def library(package: Path) -> str:
    """Return the name of the library made from the sources in the package's folder, without mypyc's ending."""
    sources = hashlib.sha256(b"\0".join((package / name).read_bytes() for name in MODULES))
    return PREFIX + sources.hexdigest()[:16]


def form(package: Path = PACKAGE) -> str:
    """Return `compiled`, `interpreted`, or `stale`: compiled, but from other sources than these."""
    stem = package / MODULES[0].removesuffix(".py")
    if not any(stem.with_name(stem.name + suffix).exists() for suffix in EXTENSION_SUFFIXES):
        return "interpreted"
    built = importlib.util.find_spec(f"{library(package)}__mypyc")  # noqa: TID251 - setup.py reads this file alone
    return "stale" if built is None else "compiled"


def check(package: Path = PACKAGE) -> None:
    """Raise MissingPartError when the compiled library was made from other sources."""
    if form(package) == "stale":
        from trilane.errors import MissingPartError  # setup.py reads this file before there is a package

        raise MissingPartError(STALE, MEND)
