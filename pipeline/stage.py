"""The interface of a stage to the process that runs it.

Rule: a stage sees its slots, its settings and its unit only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

from trilane.pipeline.description import UnitSettings
from trilane.pipeline.memory import Assets
from trilane.transport.packets import Packet

T = TypeVar("T")


class Skip(dict[str, float]):
    """What `Stage.run` returns, in place of other metrics, for a frame that takes the pipeline's bypass.

    Only the stage at which `Pipeline.bypass` begins may return it.
    """


class Stage(Protocol):
    """One stage inside a unit's process, made by a `StageFactory`.

    The stage at the end of `Pipeline.bypass` takes frames from two edges. Its `inputs` holds the slots of its own edge,
    then those of the edge on which the bypass begins.
    """

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Take every slot of the stage's edges; called once, before the first job. Allocate here, never later."""

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Do `frame` from `inputs[slot_in]` to `outputs[slot_out]`, and return metrics for the log, often none.

        The first stage of a pipeline has no input, the last no output. The header of the output slot already holds the
        frame's number and sampling time. Where both edges have the same header, it already holds all of the input's
        fields.
        """

    def close(self) -> None:
        """Release what the stage holds; files are completed and renamed here."""


class JoiningStage(Protocol):
    """A stage of a graph that has several inputs, or takes the newest frame of one."""

    def bind(self, inputs: Sequence[Sequence[Packet]], outputs: Sequence[Packet]) -> None:
        """Take every slot of each input, in the order of the stage's inputs, and of the output, as `Stage.bind`."""

    def run(self, frame: int, slots_in: tuple[int | None, ...], slot_out: int | None) -> Mapping[str, float]:
        """Do `frame`, as `Stage.run`.

        `slots_in`: slot of each input; None for an input that takes the newest frame, while there is none.

        The header of the output slot already holds the frame's number. It also holds the sampling time of the oldest
        input; inputs that take the newest frame do not count. It holds no other fields of the inputs.
        """

    def close(self) -> None:
        """Release what the stage holds, as `Stage.close`."""


class SteppedStage(Stage, Protocol):
    """The first stage of a pipeline whose frames may be given less work (`run_pipeline`'s `works`)."""

    def step_to(self, rung: int) -> None:
        """Give frames the work of `rung` from now on; called before `run` whenever the rung, at first 0, changes."""


class SkippingStage(Stage, Protocol):
    """The stage at which a pipeline's bypass begins. Its `run` may return a `Skip`."""

    def forget(self) -> None:
        """Do not skip the next frame because of what earlier frames brought to the bypass's end.

        Called before `run` for the first frame. Called again whenever the unit at the bypass's end was restarted, or a
        frame did not skip and was lost or dropped before the bypass's end.
        """


@dataclass(frozen=True)
class UnitContext:
    """The objects that the stages of one unit share in its process.

    `name`: name of the unit.
    `settings`: cores and threads of the unit.
    `assets`: arrays that the run was given, read-only.
    """

    name: str
    settings: UnitSettings
    assets: Assets
    _shared: dict[str, Any] = field(default_factory=dict)
    _devices: set[str] = field(default_factory=set)

    def shared(self, key: str, make: Callable[[], T]) -> T:
        """Return what `make` returned, which is called once per `key` in this process.

        An example is the context with which two stages draw.
        """
        if key not in self._shared:
            self._shared[key] = make()
        made: T = self._shared[key]
        return made

    def use_device(self, name: str) -> None:
        """Note that hardware other than the unit's cores does its work, such as a graphics card.

        A job whose threads sleep then counts as busy, because the device works; otherwise it would count as idle.
        """
        self._devices.add(name)

    @property
    def has_device(self) -> bool:
        """Whether a stage called `use_device`."""
        return bool(self._devices)


class StageFactory(Protocol):
    """The kind of function that `PipelineStage.factory` names."""

    def __call__(self, settings: Mapping[str, Any], unit: UnitContext) -> Stage | JoiningStage:
        """Return the built stage; everything slow or fallible happens here.

        Raises BadInputError or MissingPartError.
        """
