"""What a stage is to the process that runs it. Rule: it sees its slots and its settings, nothing else."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

from trilane.pipeline.description import UnitSettings
from trilane.transport.packets import Packet

T = TypeVar("T")


class Stage(Protocol):
    """One stage inside a unit's process, made by a `StageFactory`."""

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Called once, with every slot of the stage's edges, before the first job: allocate here, never later."""

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Do frame `frame` from `inputs[slot_in]` to `outputs[slot_out]`; metrics for the log, often empty.

        The first stage of a pipeline has no input, the last no output. Between stages whose edges have the same
        header, the header of the input slot has already been copied to the output slot.
        """

    def close(self) -> None:
        """Release what the stage holds (files are completed and renamed here)."""


@dataclass(frozen=True)
class UnitContext:
    """What the stages of one unit share in its process. `name`: of the unit."""

    name: str
    settings: UnitSettings
    _shared: dict[Any, Any] = field(default_factory=dict)

    def shared(self, make: Callable[[], T]) -> T:
        """What `make` returns, made once in this process: such as a context that two stages draw with."""
        if make not in self._shared:
            self._shared[make] = make()
        found: T = self._shared[make]
        return found


class StageFactory(Protocol):
    """What `PipelineStage.factory` names."""

    def __call__(self, settings: Mapping[str, Any], unit: UnitContext) -> Stage:
        """The stage, built; everything slow or fallible happens here. Raises BadInputError, MissingPartError."""
