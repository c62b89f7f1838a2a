"""Stages for tests. Doubles spend the time that they are told and check what they are handed.

The payload of a frame is its number, repeated, and each double checks it, so that a slot used twice is seen. Three more
stages are nearly real: the pose stage without skips, a last stage that notes what its slots hold, and the raster stage
that loses its OpenGL context once. Units import this module by name: tests/conftest.py tells them where it is.
"""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trilane.errors import BadInputError
from trilane.hw_profiles.host import host_units
from trilane.pipeline.description import Pipeline, PipelineEdge, PipelineStage
from trilane.pipeline.stage import Skip, Stage, UnitContext
from trilane.scene.planner import FrameWork
from trilane.stages.cpu import pose
from trilane.stages.gpu import raster
from trilane.stages.gpu.opengl import LIBRARY
from trilane.transport.packets import Packet
from trilane.units import AFTER_INFER, BEFORE_INFER, INFER, LATENCY_TO

STAGES = (*BEFORE_INFER, INFER, *AFTER_INFER)
MODULE = "support.doubles"
FACTORY = f"{MODULE}:build"
USUAL_S = 0.001
BAD_FRAME = 3
HANG = f"3600000@{BAD_FRAME}"
PAYLOAD_BYTES = 4096
CHECKED_BYTES = 64
FULL_EVERY = 7
STEPPED_WORKS = (1000, 200)
SLOW_FRAMES = range(10, 30)


class StageDouble:
    """Sleeps through each job, passes the frame's number on in the payload, and writes it to the file `log`, if any.

    `behaviour`: milliseconds of a job as text, or `MS@FRAME`: those of one frame alone, or `raise`: fails at frame 3;
    another job takes 1 ms.
    """

    def __init__(self, behaviour: str, log: str | None) -> None:
        self._behaviour = behaviour
        ms, _, frame = behaviour.partition("@")
        self._spend_s = USUAL_S if behaviour == "raise" else float(ms) / 1000
        self._only = int(frame) if frame else None
        self._log = open(log, "a", encoding="ascii") if log else None  # noqa: SIM115, PTH123 - closed in close()

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        self._inputs, self._outputs = inputs, outputs

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        if self._behaviour == "raise" and frame == BAD_FRAME:
            raise BadInputError("mock.npz", "nothing", "something")
        time.sleep(self._spend_s if self._only in (None, frame) else USUAL_S)
        if slot_in is not None:
            _check(self._inputs[slot_in], frame)
        if slot_out is not None:
            self._outputs[slot_out].payload[:CHECKED_BYTES] = frame % 251
        if self._log is not None:
            self._log.write(f"{frame}\n")
        return {"frame": float(frame)}

    def close(self) -> None:
        if self._log is not None:
            self._log.close()


class SkippingDouble(StageDouble):
    """A first stage after which six of seven frames skip, but not one that must be fresh."""

    _must_be_fresh = False

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        is_full, self._must_be_fresh = self._must_be_fresh or frame % FULL_EVERY == 0, False
        metrics = super().run(frame, slot_in, slot_out)
        return {**metrics, "full": 1.0} if is_full else Skip(metrics, full=0.0)

    def forget(self) -> None:
        self._must_be_fresh = True


class SteppedDouble(StageDouble):
    """A first stage that hands the rung of the frame's work on in the payload."""

    _rung = 0

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        metrics = super().run(frame, slot_in, slot_out)
        assert slot_out is not None
        self._outputs[slot_out].payload[CHECKED_BYTES] = self._rung
        return {**metrics, "rung": float(self._rung)}

    def step_to(self, rung: int) -> None:
        self._rung = rung


class SteppingDouble(StageDouble):
    """A second stage that takes its time in proportion to the work of the frame's rung, three times as long if slow.

    `behaviour`: milliseconds of all the work.
    """

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        assert slot_in is not None
        work = STEPPED_WORKS[int(self._inputs[slot_in].payload[CHECKED_BYTES])] / STEPPED_WORKS[0]
        self._spend_s = float(self._behaviour) / 1000 * work * (3 if frame in SLOW_FRAMES else 1)
        return super().run(frame, slot_in, slot_out)


def _check(packet: Packet, frame: int) -> None:
    if int(packet.header["frame"]) != frame:
        raise RuntimeError(f"header of frame {packet.header['frame']} for frame {frame}")
    if not np.all(packet.payload[:CHECKED_BYTES] == frame % 251):
        raise RuntimeError(f"payload {packet.payload[:4]} for frame {frame}")


def build(settings: Mapping[str, Any], unit: UnitContext) -> StageDouble:
    """The stage that `settings` describe: `behaviour` (also `badbuild`: cannot be built) and `log`."""
    if settings["behaviour"] == "badbuild":
        raise BadInputError("mock.onnx", "nothing", "a network", "train one")
    unit.use_device("a double, which works while it sleeps")
    return StageDouble(settings["behaviour"], settings["log"])


def build_skipping(settings: Mapping[str, Any], unit: UnitContext) -> SkippingDouble:
    """A first stage like that of `build`, at which a bypass begins."""
    unit.use_device("a double, which works while it sleeps")
    return SkippingDouble(settings["behaviour"], settings["log"])


def build_stepped(settings: Mapping[str, Any], unit: UnitContext) -> StageDouble:
    """A first stage that is told the rung of a frame's work, or a stage that follows the work, or any other."""
    unit.use_device("a double, which works while it sleeps")
    kinds = {"pose": SteppedDouble, "infer": SteppingDouble}
    return kinds.get(settings["stage"], StageDouble)(settings["behaviour"], None)


def stepped_pipeline(ms: float) -> Pipeline:
    """Three stages, of which `infer` takes `ms` for all the work of a frame."""
    return Pipeline(
        stages=tuple(
            PipelineStage(
                name=name,
                unit=unit,
                factory=f"{MODULE}:build_stepped",
                settings={"stage": name, "behaviour": behaviour},
            )
            for name, unit, behaviour in (("pose", "cpu", "0"), ("infer", "dsp", str(ms)), ("present", "cpu", "0"))
        ),
        edges=(PipelineEdge(payload_bytes=PAYLOAD_BYTES),) * 2,
        units=host_units(),
        latency_to="infer",
        preload=(MODULE,),
    )


def pipeline_of_doubles(
    log: Path | None = None, pace_ns: Mapping[str, int] | None = None, **behaviour: object
) -> Pipeline:
    """The avatar's stages as doubles. `behaviour`: of a stage, by its name; 1 ms when it is not given.

    `log`: the file in which the last stage writes the frames that it presents.
    """
    last = STAGES[-1][0]
    return Pipeline(
        stages=tuple(
            PipelineStage(
                name=name,
                unit=unit,
                factory=FACTORY,
                settings={"behaviour": str(behaviour.get(name, 1)), "log": str(log) if log and name == last else None},
                pace_ns=(pace_ns or {}).get(name, 0),
            )
            for name, unit in STAGES
        ),
        edges=(PipelineEdge(payload_bytes=PAYLOAD_BYTES),) * (len(STAGES) - 1),
        units=host_units(),
        latency_to=LATENCY_TO,
        preload=(MODULE,),
    )


class FullFrames:
    """Forgets before each frame, and calls work full where nobody is seen."""

    def __init__(self, stage: pose.PoseStage) -> None:
        self._stage = stage
        self._outputs: Sequence[Packet] = ()

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        self._outputs = outputs
        self._stage.bind(inputs, outputs)

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        self._stage.forget()
        metrics = dict(self._stage.run(frame, slot_in, slot_out))
        if slot_out is not None:
            header = self._outputs[slot_out].header
            header["work"], header["picture"] = FrameWork.FULL, frame
        return metrics

    def close(self) -> None:
        self._stage.close()


def build_full_frames(settings: Mapping[str, Any], unit: UnitContext) -> FullFrames:
    """The pose stage of the configuration in `settings`, without skips."""
    return FullFrames(pose.build(settings, unit))


CORNER_PIXELS = 8


class CornerGreys:
    """A last stage in place of `present` that keeps no video, which would lose some of what the slot holds.

    It appends a line `frame mean` to `log`, of the upper left corner of pictures that are `width` pixels wide.
    """

    def __init__(self, log: str, width: int) -> None:
        self._log = open(log, "a", buffering=1, encoding="ascii")  # noqa: SIM115, PTH123 - closed in close()
        self._width = width

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:  # noqa: ARG002 - a last stage has none
        shape = (CORNER_PIXELS, self._width, 3)
        self._rows = [packet.payload[: math.prod(shape)].reshape(shape) for packet in inputs]

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:  # noqa: ARG002
        assert slot_in is not None
        self._log.write(f"{frame} {float(self._rows[slot_in][:, :CORNER_PIXELS].mean())}\n")
        return {}

    def close(self) -> None:
        self._log.close()


def build_corner_greys(settings: Mapping[str, Any], unit: UnitContext) -> CornerGreys:  # noqa: ARG001 - a factory's signature
    """The stage that `settings` describe: `log` and `width`."""
    return CornerGreys(settings["log"], settings["width"])


LOSING_FACTORY = f"{MODULE}:build_losing"
MARK = "lost-context"


def lose_context() -> None:
    """Leave the calling thread without a context, as a driver does that was reset."""
    egl = ctypes.CDLL(LIBRARY)
    egl.eglGetCurrentDisplay.restype = ctypes.c_void_p
    egl.eglMakeCurrent.argtypes = (ctypes.c_void_p,) * 4
    if not egl.eglMakeCurrent(egl.eglGetCurrentDisplay(), None, None, None):
        raise OSError("eglMakeCurrent did not let go of the context")


class LosingStage:
    """`stage`, which loses its context before frame `BAD_FRAME`, once in a run: the file `mark` remembers it."""

    def __init__(self, stage: Stage, mark: Path) -> None:
        self._stage, self._mark = stage, mark

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        self._stage.bind(inputs, outputs)

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        if frame >= BAD_FRAME and not self._mark.exists():
            self._mark.touch()
            lose_context()
        return self._stage.run(frame, slot_in, slot_out)

    def close(self) -> None:
        self._stage.close()


def build_losing(settings: Mapping[str, Any], unit: UnitContext) -> LosingStage:
    """The raster stage of `settings`; the mark is put into the folder `settings["config"]["out_dir"]`."""
    return LosingStage(raster.build(settings, unit), Path(settings["config"]["out_dir"]) / MARK)
