"""What a unit's process gets at its start, as one JSON document. Rule: plain data, and descriptors by number."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from trilane.pipeline.description import Model, PipelineStage, UnitSettings
from trilane.pipeline.regions import EdgeRegion
from trilane.transport.messages import JobPipeEnd


class UnitSpec(Model):
    """One unit of a run.

    `unit`: name of the unit.
    `endpoint`: address of the heartbeat socket.
    `job_pipe`, `assets_fd`: descriptors of the job pipe and the assets.
    `settings`: settings of the unit.
    `scheduler_cores`: cores of the scheduler.
    `run_cores`: cores of all units.
    `stages`: stages of this unit; messages name a stage by its place in this list.
    `module_folders`: folders that are put before the module search path.
    `edges`: regions with their descriptors, by the edge's name.
    `inputs`, `outputs`: edges of each stage that has any.
    `may_skip`: name of the stage at which the pipeline's bypass begins, or "".
    """

    unit: str
    endpoint: str
    job_pipe: JobPipeEnd
    assets_fd: int
    settings: UnitSettings
    scheduler_cores: tuple[int, ...]
    run_cores: tuple[int, ...]
    stages: tuple[PipelineStage, ...]
    module_folders: tuple[Path, ...]
    edges: dict[str, EdgeRegion]
    inputs: dict[str, tuple[str, ...]]
    outputs: dict[str, str]
    may_skip: str = ""

    @property
    def fds(self) -> list[int]:
        """The descriptors that the process needs, with their numbers in this process."""
        return [*self.job_pipe, self.assets_fd, *(edge.fd for edge in self.edges.values())]

    def renumbered(self, number_of: Mapping[int, int]) -> UnitSpec:
        """Return the same spec with the number `number_of[n]` for each descriptor n."""
        edges = {name: edge.model_copy(update={"fd": number_of[edge.fd]}) for name, edge in self.edges.items()}
        return self.model_copy(
            update={
                "job_pipe": JobPipeEnd(*(number_of[fd] for fd in self.job_pipe)),
                "assets_fd": number_of[self.assets_fd],
                "edges": edges,
            }
        )
