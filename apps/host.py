"""Which cores of this machine each unit gets.

Rule: units have disjoint cores as soon as there are three; the network, where the time goes, gets what is over. With
two cores the CPU and GPU units share one; nobody spins on a core that is shared.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

from trilane.scene.schema import UnitSettings

CORES_PER_GPU_CORE = 4


def allowed_cores() -> tuple[int, ...]:
    """Cores that this process may run on, ascending."""
    return tuple(sorted(os.sched_getaffinity(0)))


def unit_settings(cores: Sequence[int]) -> dict[str, UnitSettings]:
    """Cores, threads and spinning of the three units on `cores`. Raises ValueError when there is none."""
    if not cores:
        raise ValueError("no core to run on")
    if len(cores) < 3:
        shared, own = tuple(cores[:1]), tuple(cores[1:])
        dsp = _settings(own, spin=True) if own else _settings(shared, spin=False)
        return {"cpu": _settings(shared, spin=False), "gpu": _settings(shared, spin=False), "dsp": dsp}
    gpu_end = 1 + max(1, len(cores) // CORES_PER_GPU_CORE)
    return {
        "cpu": _settings(cores[:1], spin=True),
        "gpu": _settings(cores[1:gpu_end], spin=True),
        "dsp": _settings(cores[gpu_end:], spin=True),
    }


def _settings(cores: Sequence[int], *, spin: bool) -> UnitSettings:
    return UnitSettings(cores=tuple(cores), threads=len(cores), spin=spin)
