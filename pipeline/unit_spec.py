"""What a unit's process gets when it starts, as one JSON document. Rule: plain data, and descriptors by number."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from trilane.pipeline.description import Model, PipelineStage, UnitSettings
from trilane.pipeline.regions import EdgeRegion
from trilane.transport.messages import JobPipeEnd


class UnitSpec(Model):
    """One unit of a run.

    `endpoint`: of the heartbeat socket.
    `job_pipe`, `assets_fd`: descriptors, as are those of the regions.
    `settings`: the unit's own; `scheduler_cores`: where the scheduler runs; `run_cores`: those of all units.
    `stages`: those of this unit; messages name a stage by its place in this list.
    `module_folders`: put before the module search path.
    `edges`: regions by the edge's name; `inputs`, `outputs`: stage to edges, for those that have any.
    `may_skip`: the stage at which the pipeline's bypass begins.
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
        """The descriptors that the process needs, as they are numbered here."""
        return [*self.job_pipe, self.assets_fd, *(edge.fd for edge in self.edges.values())]

    def renumbered(self, number_of: Mapping[int, int]) -> UnitSpec:
        """The same where descriptor n has the number `number_of[n]`."""
        edges = {name: edge.model_copy(update={"fd": number_of[edge.fd]}) for name, edge in self.edges.items()}
        return self.model_copy(
            update={
                "job_pipe": JobPipeEnd(*(number_of[fd] for fd in self.job_pipe)),
                "assets_fd": number_of[self.assets_fd],
                "edges": edges,
            }
        )
