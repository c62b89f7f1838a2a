"""Runs of an avatar, each in a process of its own, so that two can go on at once on the same cores.

Rule: the process does what `trilane run` does, with its own scheduler and its own units; two of them share nothing but
the machine.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

from trilane.bench.lib.interleaved_processes import answer_of, asked_processes
from trilane.scheduler.ledger import JobRecord

START_S, RUN_S = 120.0, 600.0


@dataclass(frozen=True)
class Asked:
    """A run of the default scene.

    `avatar`, `size`, `frames`, `runtime`: as in `trilane.stages.run_options.RunOptions`. `cores`: cores that its units
    share by the rule for any run. `video`: whether a video is encoded. `edge`: rule of all edges.
    """

    avatar: str
    size: str
    frames: int
    runtime: str
    cores: tuple[int, ...]
    video: bool
    edge: str = "double"


class Ran(NamedTuple):
    """The result of a run.

    `jobs`: all jobs that ended. `seats`: each unit's cores, as text.
    """

    jobs: tuple[JobRecord, ...]
    seats: dict[str, str]


class AvatarProcess:
    """The parent's end of a process."""

    def __init__(self, pipe: Connection, name: str) -> None:
        self._pipe, self._name = pipe, name

    def begin(self, policy: str) -> None:
        """Begin a run under `policy`."""
        self._pipe.send(policy)

    def result(self) -> Ran:
        """Return the result of the run that was begun. Raises TrilaneError when it failed."""
        jobs, seats = self.receive(RUN_S)
        return Ran(tuple(JobRecord(*job) for job in jobs), seats)

    def receive(self, wait_s: float) -> Any:
        """Return the process's next answer. Raises TrilaneError."""
        return answer_of(self._pipe, self._name, wait_s)


@contextmanager
def avatar_processes(asked: Sequence[Asked]) -> Iterator[list[AvatarProcess]]:
    """Start a process for each, ready to run; they end with the block. Raises TrilaneError when one does not start."""
    with asked_processes() as start:
        found = [AvatarProcess(start(serve, each), f"{each.avatar} at {each.size}") for each in asked]
        for one in found:
            one.receive(START_S)
        yield found


def serve(pipe: Connection, asked: Asked) -> None:
    """Run the process: say that it is ready, then run under each policy that comes, until `pipe` closes."""
    from trilane.hw_profiles.host import host_units
    from trilane.stages.avatar_pipeline import run_avatar
    from trilane.stages.configure import configure
    from trilane.stages.run_options import RunOptions

    try:
        request = RunOptions(avatar=asked.avatar, size=asked.size, frames=asked.frames, runtime=asked.runtime)
        checked = configure(request, Path.cwd()).changed(units=host_units(asked.cores), record=asked.video)
        seats = {unit: ",".join(map(str, settings.cores)) for unit, settings in checked.config.units.items()}
        pipe.send(True)
        while True:
            policy = pipe.recv()
            with tempfile.TemporaryDirectory(prefix="trilane-bench-") as folder:
                placed = checked.changed(out_dir=Path(folder))
                result = run_avatar(placed.config, placed.assets, policy=policy, edge=asked.edge)
            if result.failure is not None:
                pipe.send(result.failure.message)
                return
            pipe.send(([tuple(job) for job in result.jobs], seats))
    except (EOFError, BrokenPipeError, KeyboardInterrupt):
        return
    except Exception as error:
        pipe.send(f"{type(error).__name__}: {error}")
