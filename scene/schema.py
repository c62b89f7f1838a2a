"""What a scene file may say: the TOML schema of a scene, and the resolved configuration every unit receives.

Rule: only shapes and ranges are checked here; whether a file exists and what it holds is its loader's concern.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator, model_validator

MAX_SIDE = 4096
BUCKET_STEP = 32
MAX_DEPTH_RATIO = 1e6  # a depth buffer of 24 bits cannot tell apart what is nearer together
FARTHEST_M = 1e4  # of an avatar from the scene's origin: float32 then still tells millimetres apart

Finite = Annotated[float, Field(allow_inf_nan=False)]
Metres = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]
Shape = tuple[int, int]


class Model(BaseModel):
    """Strict base: unknown keys are errors, values never change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def parse_shape(text: str) -> Shape:
    """`HxW` to (height, width). Raises ValueError naming what was found."""
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if match is None:
        raise ValueError(f"found {text!r}, expected HEIGHTxWIDTH such as 256x256")
    return int(match[1]), int(match[2])


def shape_buckets(size: str) -> list[Shape]:
    """Tensor shapes (height, width) that `size` allows.

    `HxW` gives that one shape. A single number S gives the shapes of sides in multiples of 32, aspect within
    1:4 and area at most S², of which none holds another: tall for a standing body, wide for a lying one, S x S
    between. Raises ValueError when a side is no multiple of 32 or out of range.
    """
    if re.fullmatch(r"\d+", size):
        return _shapes_of_area(_check_side(int(size)))
    height, width = parse_shape(size)
    return [(_check_side(height), _check_side(width))]


def _shapes_of_area(side: int) -> list[Shape]:
    widest = [(h, side * side // h // BUCKET_STEP * BUCKET_STEP) for h in range(BUCKET_STEP, 2 * side + 1, BUCKET_STEP)]
    shapes = [(h, w) for h, w in widest if w and max(h, w) <= min(4 * min(h, w), MAX_SIDE)]
    return [(h, w) for h, w in shapes if not any(b > h and v >= w for b, v in shapes)]


def _check_side(side: int) -> int:
    if side % BUCKET_STEP or not BUCKET_STEP <= side <= MAX_SIDE:
        raise ValueError(f"found side {side}, expected a multiple of {BUCKET_STEP} from {BUCKET_STEP} to {MAX_SIDE}")
    return side


def _checked_size(size: str) -> str:
    shape_buckets(size)
    return size


class OutputSpec(Model):
    """The picture that is presented."""

    width: int = Field(default=640, ge=64, le=MAX_SIDE, multiple_of=2)
    height: int = Field(default=480, ge=64, le=MAX_SIDE, multiple_of=2)


class AvatarSpec(Model):
    """One avatar. `bundle`: `default` or a folder. `motion`: `builtin:NAME` or a file. Position in metres."""

    bundle: str = "default"
    motion: str = "builtin:walk-wave-turn"
    position: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    heading_deg: float = Field(default=0.0, ge=-3600, le=3600, allow_inf_nan=False)
    up_axis: Literal["auto", "y", "z"] = "auto"
    units: Literal["auto", "m", "cm", "in", "cmu"] = "auto"
    ground: Literal["auto", "sequence", "frame", "none"] = "auto"


class CameraSpec(Model):
    """`source`: `builtin:NAME` or a file. `place`: how the scene's anchor is put in front of a recorded camera.

    `fov_y_deg`: of the picture's height; None takes what the file says, else what is usual for its format.
    """

    source: str = "builtin:orbit"
    format: Literal["auto", "arkit", "tum", "nerf"] = "auto"
    fov_y_deg: float | None = Field(default=None, gt=1, lt=170)
    near_m: float = Field(default=0.05, gt=0, allow_inf_nan=False)
    far_m: float = Field(default=100.0, gt=0, allow_inf_nan=False)
    place: Literal["auto", "none"] = "auto"

    @model_validator(mode="after")
    def _near_before_far(self) -> Self:
        if not self.near_m < self.far_m <= MAX_DEPTH_RATIO * self.near_m:
            raise ValueError(
                f"found near_m {self.near_m:g} and far_m {self.far_m:g}, expected near_m below far_m and "
                f"far_m at most {MAX_DEPTH_RATIO:g} times near_m"
            )
        return self


class PlaneSpec(Model):
    """A detected plane to show: a rectangle about `centre` (world, metres) with `normal` (any length but 0).

    `turn_deg`: about the normal; at 0 the first side lies along the world's x on a level plane, else it points up.
    """

    centre: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    normal: tuple[Finite, Finite, Finite] = (0.0, 1.0, 0.0)
    width_m: float = Field(default=2.0, gt=0, le=1000, allow_inf_nan=False)
    depth_m: float = Field(default=2.0, gt=0, le=1000, allow_inf_nan=False)
    turn_deg: Finite = 0.0

    @field_validator("normal")
    @classmethod
    def _normal_has_length(cls, normal: tuple[float, float, float]) -> tuple[float, float, float]:
        if not 1e-6 < math.hypot(*normal) < 1e6:
            raise ValueError(f"found {normal}, expected a direction")
        return normal


class Scene(Model):
    """A scene. `background`: `room`, or a video, image folder or picture. `texture_filter`: of the neural texture.

    `planes`: detected ones, shown over the background. `hud`: frame, rate and age are written on the picture.
    """

    name: str = Field(default="scene", min_length=1, max_length=80, pattern=r"^[\w .-]+$")
    fps: float = Field(default=30.0, gt=0, le=1000, allow_inf_nan=False)
    frames: int = Field(default=300, ge=1, le=10_000_000)
    size: Annotated[str, AfterValidator(_checked_size)] = "256"
    background: str = "room"
    hud: bool = False
    planes: tuple[PlaneSpec, ...] = Field(default=(), max_length=32)
    texture_filter: Literal["linear", "mipmap", "anisotropic"] = "linear"
    error_budget_px: float = Field(default=0.5, ge=0, allow_inf_nan=False)
    output: OutputSpec = OutputSpec()
    camera: CameraSpec = CameraSpec()
    avatars: tuple[AvatarSpec, ...] = Field(default=(AvatarSpec(),), min_length=1, max_length=8)


class UnitSettings(Model):
    """What a unit may use of the host. `cores`: of this machine; `spin`: may threads spin between jobs."""

    cores: tuple[int, ...] = Field(min_length=1)
    threads: int = Field(ge=1)
    spin: bool = False


class NetworkCut(Model):
    """The network is cut at quantised tensor `at`; what follows runs on `unit`."""

    at: str
    unit: Literal["cpu", "gpu", "dsp"]


class RunConfig(Model):
    """Everything a unit's process is told, as plain data. Paths are absolute and were checked by the parent.

    `out_dir` is the temporary run folder. `runtime` names the DSP runtime. `posed_vertices`: of each avatar, when the
    CPU unit skins; empty when the GPU does. `pace_ns`: how long a job of a stage is held, at least. `fake` maps a unit
    to the dotted module of a mock unit and is set by tests alone. `cuts`: of the network; its first part is the DSP's.
    """

    scene: Scene
    out_dir: Path
    avatar_dirs: tuple[Path, ...]
    units: dict[str, UnitSettings]
    runtime: str = "ort"
    record: bool = True
    posed_vertices: tuple[int, ...] = ()
    pace_ns: dict[str, int] = {}
    fake: dict[str, str] = {}
    cuts: tuple[NetworkCut, ...] = ()

    @field_validator("units")
    @classmethod
    def _units_known(cls, units: dict[str, UnitSettings]) -> dict[str, UnitSettings]:
        unknown = set(units) - {"cpu", "gpu", "dsp"}
        if unknown:
            raise ValueError(f"unknown unit {sorted(unknown)}, expected cpu, gpu, dsp")
        return units

    @property
    def buckets(self) -> list[Shape]:
        return shape_buckets(self.scene.size)

    @property
    def infer_units(self) -> tuple[str, ...]:
        """The unit of each part of the network, in the order of the work."""
        return ("dsp", *(cut.unit for cut in self.cuts))

    @property
    def infer_names(self) -> tuple[str, ...]:
        """The stages that run the parts: `infer`, `infer-2`, ..."""
        return ("infer", *(f"infer-{number}" for number in range(2, len(self.cuts) + 2)))

    @property
    def max_tensor_pixels(self) -> int:
        return max(math.prod(shape) for shape in self.buckets)
