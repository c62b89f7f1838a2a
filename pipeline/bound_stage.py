"""A stage bound to its slots, as a unit's loop runs it.

Rule: headers are passed on here; no stage has to think of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, cast

from trilane.arrays import U8
from trilane.errors import TrilaneError
from trilane.pipeline.stage import Skip, SkippingStage, Stage, SteppedStage, UnitContext
from trilane.transport.packets import FRAME_FIELDS, Packet

WAKE_UP_NS = 150_000  # a sleep ends about this much late


class BoundStage:
    """A stage with its slots."""

    def __init__(
        self,
        name: str,
        stage: Stage,
        inputs: list[Packet],
        outputs: list[Packet],
        pace_ns: int,
        unit: UnitContext,
        may_skip: bool = False,
    ) -> None:
        """Bind `stage` to its slots.

        `pace_ns`: least time in ns for which a job is held.
        `unit`: context of the unit that it runs on.
        `may_skip`: whether a bypass begins at it.
        """
        self.name, self._pace_ns, self._may_skip = name, pace_ns, may_skip
        self._stage, self._outputs, self._unit = stage, outputs, unit
        self._is_first, self._rung = not inputs, 0
        self._pass_on = _header_copier(inputs, outputs)
        stage.bind(inputs, outputs)

    def run(
        self, frame: int, slot_in: int, slot_out: int, epoch: int, fresh: bool = False, rung: int = 0
    ) -> Mapping[str, float]:
        """Do the job, hold it until its pace has passed, and return the stage's metrics.

        The metrics are a `Skip` if the frame skips. A slot is -1 where the stage has no such edge.

        `fresh`: whether the stage must ignore what earlier frames left behind.
        `rung`: rung of the frame's work, which the first stage is told.

        Raises TrilaneError for a `Skip` of a stage that may not skip.
        """
        if fresh and self._may_skip:
            cast(SkippingStage, self._stage).forget()
        if self._is_first and rung != self._rung:
            self._rung = rung
            cast(SteppedStage, self._stage).step_to(rung)
        end_ns = time.monotonic_ns() + self._pace_ns
        if slot_out >= 0:
            if slot_in >= 0:
                self._pass_on(slot_in, slot_out)
            else:
                header = self._outputs[slot_out].header
                header["frame"], header["t_sampled_ns"] = frame, time.monotonic_ns()
            self._outputs[slot_out].header["epoch"] = epoch
        metrics = self._stage.run(frame, slot_in if slot_in >= 0 else None, slot_out if slot_out >= 0 else None)
        if isinstance(metrics, Skip) and not self._may_skip:
            raise TrilaneError(f"stage {self.name} returned a Skip, and the pipeline's bypass does not begin at it")
        if self._pace_ns:
            hold_until(end_ns)
        return metrics

    @property
    def works_asleep(self) -> bool:
        """Whether the job goes on while its threads sleep.

        It does on hardware other than the cores, and when it is held to the pace of a chip.
        """
        return self._pace_ns > 0 or self._unit.has_device

    def sampled_ns(self, slot_in: int, slot_out: int) -> int:
        """Return when the frame in the output slot of a pipeline's first stage was sampled; 0 for other stages."""
        return int(self._outputs[slot_out].header["t_sampled_ns"]) if slot_in < 0 <= slot_out else 0

    def close(self) -> None:
        self._stage.close()


def hold_until(end_ns: int) -> None:
    """Return at `end_ns` of CLOCK_MONOTONIC, or at once if that has passed: sleep first, then watch the clock."""
    while (left_ns := end_ns - time.monotonic_ns()) > 0:
        if left_ns > WAKE_UP_NS:
            time.sleep((left_ns - WAKE_UP_NS) / 1e9)


def _header_copier(inputs: list[Packet], outputs: list[Packet]) -> Callable[[int, int], None]:
    """Return a function that copies the header from an input slot to an output slot.

    If the headers differ, it copies only the frame's fields.
    """
    if inputs and outputs and inputs[0].header.dtype != outputs[0].header.dtype:
        return lambda slot_in, slot_out: _copy_fields(inputs[slot_in].header, outputs[slot_out].header)
    sources, targets = [_bytes_of(packet) for packet in inputs], [_bytes_of(packet) for packet in outputs]

    def copy(slot_in: int, slot_out: int) -> None:
        targets[slot_out][:] = sources[slot_in]

    return copy


def _copy_fields(source: Any, target: Any) -> None:
    for name, _ in FRAME_FIELDS:
        target[name] = source[name]


def _bytes_of(packet: Packet) -> U8:
    return packet.header.reshape(1).view("u1")
