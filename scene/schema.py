"""The schema of a scene file.

Rule: only types and ranges are checked here; the loaders check whether a named file exists and what is in it.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, field_validator, model_validator

from trilane.body.joints import JOINT_INDEX
from trilane.near_miss import did_you_mean
from trilane.shapes import BUCKET_STEP, MAX_SIDE, checked_size
from trilane.unexpected_value import UnexpectedValue

MAX_DEPTH_RATIO = 1e6  # of far to near clip plane; beyond it a depth buffer of 24 bits is too coarse
AUTO = "auto"  # size of a tensor that is planned
LEAST_FPS = 1e-3  # far below that a period in nanoseconds is no number any more
LONGEST_S = 1e6  # of a motion
FARTHEST_M = 1e4  # of an avatar from the scene's origin; there float32 still resolves millimetres

NAME = r"^[\w .-]+$"

LISTED = Strict(strict=False)  # of a tuple, which is a list in a file
Finite = Annotated[float, Field(allow_inf_nan=False)]
Metres = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]


class Model(BaseModel):
    """Base of all tables: unknown keys are errors, and values never change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Table(Model):
    """A table of a scene file: a value has the type of its key, and nothing else is read as one.

    A number that need not be whole may be written as a whole one, though; and tuples are lists there.
    """

    model_config = ConfigDict(strict=True)


class OutputSpec(Table):
    """Size of the picture that is shown, in pixels."""

    width: int = Field(default=640, ge=64, le=MAX_SIDE, multiple_of=2)
    height: int = Field(default=480, ge=64, le=MAX_SIDE, multiple_of=2)


class AvatarSpec(Table):
    """One avatar.

    `name`: no other avatar of the scene has it; `avatar1`, `avatar2`, ... by its place when it is not given.
    `bundle`: `default`, `hiker` or a folder. `motion`: `builtin:NAME` or a file. `position`: metres. `up_axis`,
    `units`: of the motion file. `joint_map`: joint of the body -> name of the file's, or an empty text for none.
    `start_s`, `end_s`: of the motion's own time, what is played of it; `speed`: how many times as fast; `loop`: what
    follows, by default what is usual for the motion. `ground`: how the motion is put on the floor (`floor.py`).
    """

    name: str | None = Field(default=None, min_length=1, max_length=80, pattern=NAME)
    bundle: str = "default"
    motion: str = "builtin:walk-wave-turn"
    position: Annotated[tuple[Metres, Metres, Metres], LISTED] = (0.0, 0.0, 0.0)
    heading_deg: float = Field(default=0.0, ge=-3600, le=3600, allow_inf_nan=False)
    up_axis: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    units: Literal["auto", "m", "cm", "in", "cmu"] = "auto"
    joint_map: dict[str, str] = Field(default={})
    start_s: float = Field(default=0.0, ge=0, le=LONGEST_S, allow_inf_nan=False)
    end_s: float | None = Field(default=None, gt=0, le=LONGEST_S, allow_inf_nan=False)
    speed: float = Field(default=1.0, ge=0.01, le=100, allow_inf_nan=False)
    loop: Literal["auto", "repeat", "back-and-forth", "hold"] = "auto"
    ground: Literal["auto", "sequence", "frame", "none"] = "auto"

    @field_validator("joint_map")
    @classmethod
    def _joints_exist(cls, joint_map: dict[str, str]) -> dict[str, str]:
        for name in joint_map:
            if name not in JOINT_INDEX:
                expected = "a joint of the body, such as pelvis, left_hip or right_wrist"
                raise UnexpectedValue(f"the joint {name!r}", expected, did_you_mean(name, JOINT_INDEX))
        return joint_map

    @model_validator(mode="after")
    def _starts_before_it_ends(self) -> Self:
        if self.end_s is not None and not self.start_s < self.end_s:
            raise UnexpectedValue(f"start_s {self.start_s:g} and end_s {self.end_s:g}", "start_s below end_s")
        return self


class CameraSpec(Table):
    """The camera.

    `source`: `builtin:NAME`, a file or a folder. `fov_y_deg`: of the picture's height; None for that of the file, or
    the usual one of its format. `up_axis`: of the file's world. `metres_per_unit`: of its lengths; None for what it
    says or is likely. `rate_hz`: of a file without times, or with numbers of frames. `near_m`, `far_m`: clip planes.
    `place`: whether a recorded camera is placed in the scene (`auto`) or stays where it was recorded (`none`).
    """

    source: str = "builtin:orbit"
    format: Literal["auto", "arkit", "colmap", "euroc", "kitti", "nerf", "record3d", "stray", "tum"] = "auto"
    fov_y_deg: float | None = Field(default=None, gt=1, lt=170)
    up_axis: Literal["auto", "x", "-x", "y", "-y", "z", "-z"] = "auto"
    metres_per_unit: float | None = Field(default=None, gt=0, le=1e6, allow_inf_nan=False)
    rate_hz: float | None = Field(default=None, ge=1e-3, le=1000, allow_inf_nan=False)
    near_m: float = Field(default=0.05, gt=0, allow_inf_nan=False)
    far_m: float = Field(default=100.0, gt=0, allow_inf_nan=False)
    place: Literal["auto", "none"] = "auto"

    @model_validator(mode="after")
    def _near_before_far(self) -> Self:
        if not self.near_m < self.far_m <= MAX_DEPTH_RATIO * self.near_m:
            raise UnexpectedValue(
                f"near_m {self.near_m:g} and far_m {self.far_m:g}",
                f"near_m below far_m and far_m at most {MAX_DEPTH_RATIO:g} times near_m",
            )
        return self


class PlaneSpec(Table):
    """A detected plane to show: a rectangle round `centre` (world, metres) with `normal` (of any length but 0).

    `turn_deg`: about the normal. At 0 the first side lies along the world's x if the plane is level, else it points up.
    """

    centre: Annotated[tuple[Finite, Finite, Finite], LISTED] = (0.0, 0.0, 0.0)
    normal: Annotated[tuple[Finite, Finite, Finite], LISTED] = (0.0, 1.0, 0.0)
    width_m: float = Field(default=2.0, gt=0, le=1000, allow_inf_nan=False)
    depth_m: float = Field(default=2.0, gt=0, le=1000, allow_inf_nan=False)
    turn_deg: Finite = 0.0

    @field_validator("normal")
    @classmethod
    def _normal_has_length(cls, normal: tuple[float, float, float]) -> tuple[float, float, float]:
        if not 1e-6 < math.hypot(*normal) < 1e6:
            raise UnexpectedValue(str(normal), "a direction")
        return normal


def _scene_size(size: str) -> str:
    if size == AUTO:
        return size
    try:
        return checked_size(size)
    except UnexpectedValue as error:
        raise UnexpectedValue(error.found, f"{error.expected}, or {AUTO}") from None


class Scene(Table):
    """A scene.

    `background`: `room`, or a video, a folder of images or a picture. `hud`: whether frame, rate and age are written on
    the picture. `planes`: detected ones, shown over the background. `texture_filter`: of the neural texture.

    What may be left out: `plan` is `planned` (what the picture does not show is not modelled), `fixed` (everything is,
    in every frame) or `full` (to compare with: float64 body, supersampled raster, FP32 network; nothing runs it in real
    time). `size`: `auto` plans the tensor, up to `most_side`² pixels; else it is fixed to that size. `error_budget_px`:
    how far a vertex may be off on the picture. `error_budget_db`: how much worse avatars may be painted, in dB of PSNR,
    than in tensors of the size that their network was trained for; None: no worse, unless frames would be late.
    `memory_mb`: of the networks that are made ready for the planned shapes.
    """

    name: str = Field(default="scene", min_length=1, max_length=80, pattern=NAME)
    fps: float = Field(default=30.0, ge=LEAST_FPS, le=1000, allow_inf_nan=False)
    frames: int = Field(default=300, ge=1, le=10_000_000)
    size: Annotated[str, AfterValidator(_scene_size)] = "256"
    background: str = "room"
    hud: bool = False
    planes: Annotated[tuple[PlaneSpec, ...], LISTED] = Field(default=(), max_length=32)
    texture_filter: Literal["linear", "mipmap", "anisotropic"] = "linear"
    plan: Literal["planned", "fixed", "full"] = "planned"
    error_budget_px: float = Field(default=0.5, gt=0, le=100, allow_inf_nan=False)
    error_budget_db: float | None = Field(default=None, gt=0, le=100, allow_inf_nan=False)
    most_side: int = Field(default=512, ge=BUCKET_STEP, le=MAX_SIDE, multiple_of=BUCKET_STEP)
    memory_mb: int = Field(default=512, ge=1, le=1_000_000)
    output: OutputSpec = OutputSpec()
    camera: CameraSpec = CameraSpec()
    avatars: Annotated[tuple[AvatarSpec, ...], LISTED] = Field(
        default=(AvatarSpec(),), min_length=1, max_length=8, validate_default=True
    )

    @field_validator("avatars")
    @classmethod
    def _avatars_named(cls, avatars: tuple[AvatarSpec, ...]) -> tuple[AvatarSpec, ...]:
        """The avatars, each with a name of its own."""
        places: dict[str, int] = {}
        for place, avatar in enumerate(avatars):
            name = avatar.name or f"avatar{place + 1}"
            if name in places:
                found = f"{name!r} as the name of avatars.{places[name]} and of avatars.{place}"
                raise UnexpectedValue(found, "a name of its own for each", "change `name` of one of them")
            places[name] = place
        return tuple(spec.model_copy(update={"name": name}) for name, spec in zip(places, avatars, strict=True))

    @model_validator(mode="after")
    def _sized(self) -> Self:
        if self.size == AUTO and self.plan != "planned":
            raise UnexpectedValue(f'size = "{AUTO}" with plan = "{self.plan}"', "a size such as 512x512")
        if self.error_budget_db is not None and self.size != AUTO:
            raise UnexpectedValue(f'error_budget_db with size = "{self.size}"', f'size = "{AUTO}"')
        return self

    @property
    def plans_tensor(self) -> bool:
        """Whether the tensor's shapes follow from the scene."""
        return self.size == AUTO
