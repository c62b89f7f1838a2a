"""What a run needs around it and undoes afterwards.

Rule: whatever happens, cores, memory and processes are as before.
"""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from collections.abc import Iterator
from typing import TypeVar

from trilane import machine
from trilane.pipeline.description import Pipeline
from trilane.pipeline.regions import edge_regions
from trilane.pipeline.shared_assets import Assets, share_assets
from trilane.pipeline.unit_processes import UnitProcesses
from trilane.pipeline.unit_starter import UnitStarter
from trilane.transport.wakeup import DEFAULT, SHORTEST_NS, use_slice

Processes = TypeVar("Processes", bound=UnitProcesses)
SWITCH_S = 0.0002  # seconds for which another thread of this process keeps the interpreter at most


@contextlib.contextmanager
def on_cores(cores: tuple[int, ...]) -> Iterator[None]:
    """Run the scheduler on `cores` inside the `with` block, off the cores of the other units."""
    before = machine.here.cores()
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextlib.contextmanager
def prompt_answers() -> Iterator[None]:
    """Make the scheduler answer at once inside the `with` block.

    It then waits neither for another unit's time slice on its core, nor for a thread that draws a progress bar. It does
    not wait for garbage collection either, because a run makes no garbage in cycles.
    """
    switch_s, collects = sys.getswitchinterval(), gc.isenabled()
    sys.setswitchinterval(SWITCH_S)
    gc.disable()
    use_slice(SHORTEST_NS)
    try:
        yield
    finally:
        use_slice(DEFAULT)
        sys.setswitchinterval(switch_s)
        if collects:
            gc.enable()


@contextlib.contextmanager
def unit_processes(
    pipeline: Pipeline, assets: Assets, starter: UnitStarter | None, kind: type[Processes]
) -> Iterator[Processes]:
    """Yield processes of `kind`, none of them started, with the memory that they map.

    A fork server is made unless the caller gives one as `starter`.
    """
    with contextlib.ExitStack() as stack:
        used = starter or stack.enter_context(UnitStarter(pipeline.preload))
        assets_fd = share_assets(assets)
        stack.callback(os.close, assets_fd)
        regions = stack.enter_context(edge_regions(pipeline))
        yield stack.enter_context(contextlib.closing(kind(pipeline, regions, assets_fd, used)))
