"""What a run needs around it, and undoes. Rule: whatever happens inside, cores, memory and processes are as before."""

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
SWITCH_S = 0.0002  # the longest that another thread of this process keeps the interpreter


@contextlib.contextmanager
def on_cores(cores: tuple[int, ...]) -> Iterator[None]:
    """The scheduler runs on `cores`, off those of the other units."""
    before = machine.here.cores()
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextlib.contextmanager
def prompt_answers() -> Iterator[None]:
    """The scheduler answers at once.

    It does not wait for another unit's time slice on its core, for a thread that draws a progress bar, or for garbage
    collection: a run makes no garbage in cycles.
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
    """The fork server, unless the caller has one; the memory; then processes of `kind` that map it, none started."""
    with contextlib.ExitStack() as stack:
        used = starter or stack.enter_context(UnitStarter(pipeline.preload))
        assets_fd = share_assets(assets)
        stack.callback(os.close, assets_fd)
        regions = stack.enter_context(edge_regions(pipeline))
        yield stack.enter_context(contextlib.closing(kind(pipeline, regions, assets_fd, used)))
