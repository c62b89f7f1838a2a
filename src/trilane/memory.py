"""Decides whether a failure comes from a lack of memory, by the need of a run and its limits.

Rule: a shortage is reported only where a limit is below what a run takes, or where the kernel has ended a process for
it. The figures are measured (docs/limits.md); a larger scene, avatar or background takes more.
"""

from __future__ import annotations

import resource
from typing import Final

from trilane import machine
from trilane.errors import TrilaneError

MB: Final = 1 << 20
#: Addresses of the largest process of a default run: unit dsp, with OpenVINO.
ADDRESS_BYTES: Final = 1700 * MB
#: Addresses without which no run can begin: no OpenGL driver loads. NumPy ends a process that has fewer than half.
LEAST_ADDRESS_BYTES: Final = 512 * MB
#: Memory without which the kernel ends the processes of the smallest run: tensors of 64x64, pictures of 160x120.
LEAST_RUN_BYTES: Final = 255 * MB
#: Memory of all processes of a default run, with shared pages counted once.
RUN_BYTES: Final = 600 * MB
NEEDED: Final = f"a run takes {RUN_BYTES // MB} MB"

_KILLS = machine.here.oom_kills()


def require_memory(part: int = 1) -> None:
    """Raise TrilaneError when a limit is below a `part`th of what the smallest run takes."""
    if (limit := _address_limit()) < LEAST_ADDRESS_BYTES // part:
        found = f"found a limit of {limit // MB} MB of addresses (ulimit -v)"
        expected = f"expected at least {ADDRESS_BYTES // MB} MB for a run"
        raise TrilaneError(f"memory: {found}, {expected}: ulimit -v unlimited")
    group = machine.here.memory_limit_bytes()
    if group is not None and group < LEAST_RUN_BYTES // part:
        found = f"found a limit of {group // MB} MB for the control group"
        raise TrilaneError(f"memory: {found}, expected at least {RUN_BYTES // MB} MB for a run")


def shortage() -> str:
    """Return the evidence that memory is short, as part of a sentence; "" without evidence.

    Call it after a failure that a lack of memory may have caused: a run of small tensors may need less than the limit.
    """
    if (limit := _address_limit()) < ADDRESS_BYTES:
        needed = f"a run's largest process takes {ADDRESS_BYTES // MB} MB: ulimit -v unlimited"
        return f"each process may have {limit // MB} MB of addresses (ulimit -v), and {needed}"
    group = machine.here.memory_limit_bytes()
    if group is not None and group < RUN_BYTES:
        return f"the control group may have {group // MB} MB of memory, and {NEEDED}"
    return ended_by_system()


def ended_by_system() -> str:
    """Return that the kernel has ended a process since this one began, as part of a sentence; "" where it has not."""
    if machine.here.oom_kills() <= _KILLS:
        return ""
    free = f"{machine.here.free_bytes() // MB} MB are free now"
    return f"the system has meanwhile ended a process because memory ran out, and {NEEDED}; {free}"


def _address_limit() -> float:
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return float("inf") if limit == resource.RLIM_INFINITY else limit
