"""Scene files (TOML): their schema, how they are loaded, and a message about the first error.

The schema checks types and ranges; the loaders check whether a named file exists and what it contains. The values of a
scene file never change, except that its paths are made absolute. The file's name replaces a missing `name`, with
hyphens for characters that a name cannot have.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    Strict,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic.fields import FieldInfo

from trilane.arrays import BUCKET_STEP, MAX_SIDE, checked_size
from trilane.body.joints import JOINT_INDEX
from trilane.errors import BadInputError, did_you_mean
from trilane.files import read_text
from trilane.unexpected_value import EXPECTED, UnexpectedValue, expected_in, unexpected_in
from trilane.units import AVATARS, AVATARS_HELP, ROOM

MAX_DEPTH_RATIO = 1e6  # largest ratio of far to near clip plane; beyond it a depth buffer of 24 bits is too coarse
AUTO = "auto"  # value of a key that Trilane decides
BUILT_IN_PREFIX = "builtin:"
LEAST_FPS = 1e-3  # far below that, a period in nanoseconds overflows
LONGEST_S = 1e6  # longest motion, seconds
FARTHEST_M = 1e4  # farthest coordinate of an avatar, metres; there float32 still resolves millimetres

NAME, LONGEST_NAME = r"^[\w .-]+$", 80

LISTED = Strict(strict=False)  # lets a list of the file become a tuple
Finite = Annotated[float, Field(allow_inf_nan=False)]
Metres = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]


class StrictModel(BaseModel):
    """Base of the models of files: unknown keys are errors, and values never change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Table(StrictModel):
    """A table of a scene file. Each value must have the type of its key; other types are not converted.

    Two exceptions: a whole number may stand for a float, and a list stands for a tuple.
    """

    model_config = ConfigDict(strict=True)


class OutputSpec(Table):
    """The size of the shown picture."""

    width: int = Field(
        default=640, ge=64, le=MAX_SIDE, multiple_of=2, description="Width of the shown picture, pixels."
    )
    height: int = Field(
        default=480, ge=64, le=MAX_SIDE, multiple_of=2, description="Height of the shown picture, pixels."
    )


class AvatarSpec(Table):
    """An avatar, with its place and its motion."""

    name: str | None = Field(
        default=None,
        min_length=1,
        max_length=LONGEST_NAME,
        pattern=NAME,
        description="Name of the avatar, different from all others; `avatar1`, `avatar2`, ... if not given.",
    )
    bundle: str = Field(default="default", description=AVATARS_HELP)
    motion: str = Field(default="builtin:walk-wave-turn", description="`builtin:NAME`, or a motion file.")
    position: Annotated[tuple[Metres, Metres, Metres], LISTED] = Field(
        default=(0.0, 0.0, 0.0), description="Place of the avatar in the world: x, y, z in metres."
    )
    heading_deg: float = Field(
        default=0.0, ge=-3600, le=3600, allow_inf_nan=False, description="Rotation about the vertical axis, degrees."
    )
    up_axis: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = Field(
        default="auto", description="Axis of the motion file that points up."
    )
    units: Literal["auto", "m", "cm", "in", "cmu"] = Field(
        default="auto", description="Unit of lengths in the motion file."
    )
    joint_map: dict[str, str] = Field(
        default={}, description="For joints of the body, their names in the motion file; an empty text for none."
    )
    start_s: float = Field(
        default=0.0,
        ge=0,
        le=LONGEST_S,
        allow_inf_nan=False,
        description="Time in the motion at which it begins, seconds.",
    )
    end_s: float | None = Field(
        default=None,
        gt=0,
        le=LONGEST_S,
        allow_inf_nan=False,
        description="Time in the motion at which it ends, seconds; the end of the file if not given.",
    )
    speed: float = Field(
        default=1.0, ge=0.01, le=100, allow_inf_nan=False, description="Factor on the speed of the motion."
    )
    loop: Literal["auto", "repeat", "back-and-forth", "hold"] = Field(
        default="auto", description="The end of the motion is followed by this; `auto`: as is usual for the motion."
    )
    ground: Literal["auto", "sequence", "frame", "none"] = Field(
        default="auto",
        description="How the motion is put on the floor: for the whole sequence, for each frame, or not at all.",
    )

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


#: Unit vectors of a camera's directions, in axes x right, y up, z back.
DIRECTIONS = {
    "right": (1, 0, 0),
    "left": (-1, 0, 0),
    "up": (0, 1, 0),
    "down": (0, -1, 0),
    "back": (0, 0, 1),
    "forward": (0, 0, -1),
}
AXES_EXPECTED = (
    "directions of x, y and z joined by hyphens, right-handed, such as right-down-forward (cameras), forward-left-up "
    "(robots) or forward-right-down (aircraft)"
)


def axes_of(text: str) -> tuple[tuple[int, int, int], ...] | None:
    """Return the directions of x, y and z that `text` names, such as `forward-left-up`, as vectors of DIRECTIONS.

    The result is None unless they form right-handed axes.
    """
    words = text.split("-")
    if len(words) != 3 or not set(words) <= set(DIRECTIONS):
        return None
    x, y, z = (DIRECTIONS[word] for word in words)
    cross = tuple(x[(k + 1) % 3] * y[(k + 2) % 3] - x[(k + 2) % 3] * y[(k + 1) % 3] for k in range(3))
    return (x, y, z) if cross == z else None


def _camera_axes(text: str) -> str:
    if text != AUTO and axes_of(text) is None:
        raise UnexpectedValue(repr(text), f"{AUTO}, or {AXES_EXPECTED}")
    return text


#: Keys of a camera that say how its file is read.
FILE_KEYS = ("format", "up_axis", "metres_per_unit", "rate_hz", "time_unit", "axes")


class CameraSpec(Table):
    """The camera, with its source, lens and place."""

    source: str = Field(default="builtin:orbit", description="`builtin:NAME`, a file or a folder.")
    format: Literal["auto", "arkit", "colmap", "euroc", "kitti", "nerf", "record3d", "stray", "tum"] = Field(
        default="auto", description="Format of the file."
    )
    fov_y_deg: float | None = Field(
        default=None,
        gt=1,
        lt=170,
        description=(
            "Vertical field of view, degrees. If not given: that of the file, or the usual one of its format."
        ),
    )
    up_axis: Literal["auto", "x", "-x", "y", "-y", "z", "-z"] = Field(
        default="auto", description="Axis of the file's world that points up."
    )
    metres_per_unit: float | None = Field(
        default=None,
        gt=0,
        le=1e6,
        allow_inf_nan=False,
        description="Length of the file's unit in metres. If not given: what the file says, or what is likely.",
    )
    rate_hz: float | None = Field(
        default=None, ge=1e-3, le=1000, allow_inf_nan=False, description="Poses per second, for a file without times."
    )
    time_unit: Literal["auto", "s", "ms", "us", "ns", "frames"] = Field(
        default="auto",
        description=(
            "Unit of a table's times. `frames`: the times are frame numbers; `auto`: by the times themselves."
        ),
    )
    axes: Annotated[str, AfterValidator(_camera_axes)] = Field(
        default=AUTO,
        description=(
            "Where x, y and z of each pose point, such as `forward-left-up`; `auto`: as the format defines them."
        ),
    )
    near_m: float = Field(
        default=0.05, gt=0, allow_inf_nan=False, description="Distance of the near clip plane, metres."
    )
    far_m: float = Field(
        default=100.0,
        gt=0,
        allow_inf_nan=False,
        description=(
            "Distance of the far clip plane, metres. A camera that is placed farther from a body "
            "moves it beyond the body."
        ),
    )
    place: Literal["auto", "none"] = Field(
        default="auto",
        description=(
            "`auto`: a recorded camera is placed so that it films the avatars, and a built-in one "
            "follows them. `none`: it stays where it is."
        ),
    )

    @model_validator(mode="after")
    def _is_of_a_file(self) -> Self:
        """Raise UnexpectedValue if a built-in camera has a key that says how a camera file is read."""
        for key in FILE_KEYS if self.source.startswith(BUILT_IN_PREFIX) else ():
            value = getattr(self, key)
            if value != type(self).model_fields[key].default:
                found = f"{key} = {json.dumps(value)} with source = {json.dumps(self.source)}"
                expected = f"{key} with a file alone: a built-in camera has none"
                raise UnexpectedValue(found, expected, "remove it, or name the file in camera.source")
        return self

    @model_validator(mode="after")
    def _near_before_far(self) -> Self:
        if not self.near_m < self.far_m <= MAX_DEPTH_RATIO * self.near_m:
            raise UnexpectedValue(
                f"near_m {self.near_m:g} and far_m {self.far_m:g}",
                f"near_m below far_m and far_m at most {MAX_DEPTH_RATIO:g} times near_m",
            )
        return self


class PlaneSpec(Table):
    """A plane to show, such as one that a phone has detected: a rectangle."""

    centre: Annotated[tuple[Finite, Finite, Finite], LISTED] = Field(
        default=(0.0, 0.0, 0.0), description="Centre of the rectangle in the world: x, y, z in metres."
    )
    normal: Annotated[tuple[Finite, Finite, Finite], LISTED] = Field(
        default=(0.0, 1.0, 0.0), description="Direction that the rectangle faces; any length but 0."
    )
    width_m: float = Field(
        default=2.0, gt=0, le=1000, allow_inf_nan=False, description="Length of the first side, metres."
    )
    depth_m: float = Field(
        default=2.0, gt=0, le=1000, allow_inf_nan=False, description="Length of the second side, metres."
    )
    turn_deg: Finite = Field(
        default=0.0,
        description=(
            "Rotation about the normal, degrees. At 0 the first side is parallel to the world's x if "
            "the plane is level; otherwise it points up."
        ),
    )

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
    """The content of a scene: what its pictures show, and how they are drawn."""

    name: str = Field(
        default="scene", min_length=1, max_length=LONGEST_NAME, pattern=NAME, description="Name of the scene."
    )
    fps: float = Field(
        default=30.0, ge=LEAST_FPS, le=1000, allow_inf_nan=False, description="Frames per second of the scene's time."
    )
    frames: int = Field(default=300, ge=1, le=10_000_000, description="Number of frames of a run.")
    size: Annotated[str, AfterValidator(_scene_size)] = Field(
        default="256",
        description=(
            "Tensor size: HEIGHTxWIDTH, or a side S for areas up to SxS. `auto`: planned, up to `most_side`² pixels."
        ),
    )
    background: str = Field(default=ROOM, description=f"`{ROOM}`, a video, a folder of images, or a picture.")
    hud: bool = Field(default=False, description="Whether frame number, rate and latency are written on the picture.")
    planes: Annotated[tuple[PlaneSpec, ...], LISTED] = Field(
        default=(), max_length=32, description="Detected planes, drawn over the background."
    )
    texture_filter: Literal["linear", "mipmap", "anisotropic"] = Field(
        default="linear", description="Filter of the neural texture."
    )
    plan: Literal["planned", "fixed", "full"] = Field(
        default="planned",
        description=(
            "`planned`: what the picture does not show is not modelled. `fixed`: everything is "
            "modelled in every frame. `full`: a reference, not in real time."
        ),
    )
    error_budget_px: float = Field(
        default=0.5, gt=0, le=100, allow_inf_nan=False, description="Largest error of a vertex on the picture, pixels."
    )
    error_budget_db: float | None = Field(
        default=None,
        gt=0,
        le=100,
        allow_inf_nan=False,
        description=(
            "Largest loss of an avatar's PSNR against tensors of the size of its training, dB. If not "
            "given: no loss, unless frames would be late."
        ),
    )
    most_side: int = Field(
        default=512,
        ge=BUCKET_STEP,
        le=MAX_SIDE,
        multiple_of=BUCKET_STEP,
        description="Largest side of a planned tensor, pixels.",
    )
    memory_mb: int = Field(
        default=512,
        ge=1,
        le=1_000_000,
        description="Most memory for networks that are made ready for planned shapes, megabytes.",
    )
    output: OutputSpec = Field(default=OutputSpec(), description="The shown picture.")
    camera: CameraSpec = Field(default=CameraSpec(), description="The camera.")
    avatars: Annotated[tuple[AvatarSpec, ...], LISTED] = Field(
        default=(AvatarSpec(),), min_length=1, max_length=8, validate_default=True, description="The avatars."
    )

    @field_validator("avatars")
    @classmethod
    def _avatars_named(cls, avatars: tuple[AvatarSpec, ...]) -> tuple[AvatarSpec, ...]:
        """Give each avatar without a name the name `avatarN`. Raises UnexpectedValue for equal names."""
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
        """Whether the planner chooses the tensor's shapes, which `size = "auto"` asks for."""
        return self.size == AUTO


ENDING = ".toml"
SCENES = Path(__file__).parent / "scenes"
LONGEST_FOUND = 80
#: Expected value in words, by the type of a pydantic error. The only texts with a pattern are names.
WORDS = EXPECTED | {
    "string_too_short": "at least one character",
    "string_pattern_mismatch": "letters, digits, spaces, dots, hyphens and underscores",
}
#: Types of pydantic errors for numbers that are out of range or not a multiple of a step.
IN_STEPS = ("multiple_of", "greater_than_equal", "less_than_equal")
#: Reason why a key cannot have its value, where the range alone does not explain it.
REASONS = {"error_budget_px": "numbers are rounded, so nothing is drawn without an error"}
BUILT_IN = (ROOM, *AVATARS)  # names of a background and of avatars


def bad_input(where: str | Path, error: ValidationError) -> BadInputError:
    """Return a BadInputError about the first defect in `error`. It names the file `where` and the key."""
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    place = f"{where}: {key}" if key else str(where)
    if first["type"] == "extra_forbidden":
        near = did_you_mean(str(first["loc"][-1]), _table_of(first["loc"]).model_fields)
        remedy = near or "correct its spelling or remove it"
        return BadInputError(place, "an unknown key", "a key of the scene schema", remedy)
    if first["type"] == "missing":
        return BadInputError(place, "nothing", "a value", "add the key")
    unexpected = unexpected_in(first)
    if unexpected is not None:
        return BadInputError.at(place, unexpected)
    value = repr(first["input"])
    short = value if len(value) <= LONGEST_FOUND else value[:LONGEST_FOUND] + "..."
    return BadInputError(place, short, _steps(first) or expected_in(first, WORDS), _remedy(first))


def _steps(first: Mapping[str, Any]) -> str:
    """Return the conditions of a number that must be a multiple of a step, in words; "" for other errors."""
    if first["type"] not in IN_STEPS or not isinstance(first["loc"][-1], str):
        return ""
    limits = ("multiple_of", "ge", "le")
    known = {key: getattr(one, key) for one in _field(first["loc"]).metadata for key in limits if hasattr(one, key)}
    return "a multiple of {multiple_of} from {ge} to {le}".format(**known) if len(known) == len(limits) else ""


def _remedy(first: Mapping[str, Any]) -> str:
    """Return how to fix a value, in words; "" when the expected value says it all."""
    if first["type"] == "literal_error":
        return did_you_mean(str(first["input"]), map(str, get_args(_field(first["loc"]).annotation)))
    return REASONS.get(".".join(map(str, first["loc"])), "") if first["type"] == "greater_than" else ""


def _field(loc: tuple[int | str, ...]) -> FieldInfo:
    return _table_of(loc).model_fields[str(loc[-1])]


def _table_of(loc: tuple[int | str, ...]) -> type[BaseModel]:
    """Return the model of the table that has the key at `loc`, the path by which pydantic names the key."""
    table: type[BaseModel] = Scene
    for key in loc[:-1]:
        if isinstance(key, str):
            kind = table.model_fields[key].annotation
            kinds = (each for each in (kind, *get_args(kind)) if isinstance(each, type))
            table = next(each for each in kinds if issubclass(each, BaseModel))
    return table


def scene_from(where: str | Path, values: Mapping[str, Any]) -> Scene:
    """Return the Scene of `values`, the content of a scene file. Raises BadInputError with `where` and the key."""
    try:
        return Scene.model_validate(values)
    except ValidationError as error:
        raise bad_input(where, error) from None


def scene_names() -> list[str]:
    """Return the names of the bundled scenes."""
    return sorted(file.stem for file in SCENES.glob(f"*{ENDING}"))


def find_scene(name: str) -> Path:
    """Return the file of a bundled scene `name`, or `name` as the path of a `.toml` file, which need not exist.

    Raises BadInputError for any other name.
    """
    if name in scene_names():
        return SCENES / f"{name}{ENDING}"
    path = Path(name)
    if path.suffix != ENDING:
        expected = f"a {ENDING} file or one of {', '.join(scene_names())}"
        raise BadInputError("scene", repr(name), expected, did_you_mean(name, scene_names()))
    return path


def load_scene(path: Path) -> dict[str, Any]:
    """Return the values of a scene file, checked against the schema, with absolute paths.

    Relative paths start at the file's folder. Raises BadInputError that names the line or the key.
    """
    try:
        values = tomllib.loads(read_text(path, "a scene file (TOML)"))
    except (ValueError, RecursionError) as error:  # raised also for numbers and lists that are too long
        raise BadInputError(path, f"no valid TOML ({error})", "a scene file (TOML)") from None
    named = "".join(each if each.isalpha() or each.isdecimal() or each in "_ .-" else "-" for each in path.stem)
    values.setdefault("name", named[:LONGEST_NAME])
    scene = scene_from(path, values)
    base = path.absolute().parent
    values["background"] = located(scene.background, base)
    values["camera"] = {**values.get("camera", {}), "source": located(scene.camera.source, base)}
    avatars = values.get("avatars", [{}])
    values["avatars"] = [
        {**raw, "motion": located(spec.motion, base), "bundle": located(spec.bundle, base)}
        for raw, spec in zip(avatars, scene.avatars, strict=True)
    ]
    return values


def located(source: str, base: Path) -> str:
    """Return `source` unchanged if it names something built in, otherwise as a path resolved from the folder `base`.

    Raises BadInputError for an empty text.
    """
    if not source:
        raise BadInputError("name of a file", "nothing", "a path, or the name of something built in")
    return source if source in BUILT_IN or source.startswith(BUILT_IN_PREFIX) else str(base / source)
