"""What a stage is to the process that runs it. Rule: it sees its slots, its settings and its unit, nothing else."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

from trilane.pipeline.description import UnitSettings
from trilane.pipeline.shared_assets import Assets
from trilane.transport.packets import Packet

T = TypeVar("T")


class Skip(dict[str, float]):
    """What `Stage.run` returns, in place of other metrics, for a frame that takes the pipeline's bypass.

    Only the stage at which `Pipeline.bypass` begins may return it.
    """


class Stage(Protocol):
    """One stage inside a unit's process, made by a `StageFactory`.

    At the end of `Pipeline.bypass` a stage has two edges from which frames come: `inputs` holds the slots of its own
    edge, then those of the edge that frames skip from.
    """

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Called once, with every slot of the stage's edges, before the first job: allocate here, never later."""

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Do frame `frame` from `inputs[slot_in]` to `outputs[slot_out]`; metrics for the log, often empty.

        The first stage of a pipeline has no input, the last no output. The header of the output slot already holds the
        frame's number and sampling time; where both edges have the same header, all of the input's.
        """

    def close(self) -> None:
        """Release what the stage holds (files are completed and renamed here)."""


class SteppedStage(Stage, Protocol):
    """The first stage of a pipeline whose frames may be given less work (`run_pipeline`'s `works`)."""

    def step_to(self, rung: int) -> None:
        """From now on frames are given the work of `rung`, 0 at first. Called before `run`, where it changes."""


class SkippingStage(Stage, Protocol):
    """The stage at which a pipeline's bypass begins. Its `run` may return a `Skip`."""

    def forget(self) -> None:
        """The next frame must not skip because of what earlier frames brought to the bypass's end.

        Called before `run` for the first frame, and whenever a frame that did not skip has not come to the bypass's
        end, or the unit there was started anew.
        """


@dataclass(frozen=True)
class UnitContext:
    """What the stages of one unit share in its process.

    `name`: of the unit. `settings`: its cores and threads. `assets`: the arrays that the run was given, read-only.
    """

    name: str
    settings: UnitSettings
    assets: Assets
    _shared: dict[str, Any] = field(default_factory=dict)
    _devices: set[str] = field(default_factory=set)

    def shared(self, key: str, make: Callable[[], T]) -> T:
        """What `make` returns, made once in this process: such as the context with which two stages draw."""
        if key not in self._shared:
            self._shared[key] = make()
        made: T = self._shared[key]
        return made

    def use_device(self, name: str) -> None:
        """The unit's work is done by hardware other than its cores, such as a graphics card.

        Then a job whose threads sleep counts as busy: the device works. Else it would count as idle.
        """
        self._devices.add(name)

    @property
    def has_device(self) -> bool:
        """Whether a stage said `use_device`."""
        return bool(self._devices)


class StageFactory(Protocol):
    """What `PipelineStage.factory` names."""

    def __call__(self, settings: Mapping[str, Any], unit: UnitContext) -> Stage:
        """The stage, built; everything slow or fallible happens here. Raises BadInputError, MissingPartError."""
