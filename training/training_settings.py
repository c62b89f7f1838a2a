"""`training.toml`: everything that decides what a training makes, in one file that the bundle keeps.

Rule: no folders are in it; the same file, capture and machine give the same avatar on one thread of a CPU.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from trilane.errors import BadInputError
from trilane.files import read_text
from trilane.near_miss import did_you_mean
from trilane.scene.schema import Table
from trilane.training.loss_weights import LossWeights
from trilane.training.training_options import BatchOptions, OptimiserOptions, RegularisationOptions
from trilane.training.usual_settings import with_usual

NAME = "training.toml"
EXPECTED = "settings of a training (TOML): docs/captures.md"
HEAD = "# How this avatar was trained; `trilane avatar train --config training.toml` trains one so again.\n"


class TrainingSettings(Table):
    """One training.

    `samples`: views of the person, drawn before training. `minutes`: of training, which `steps` are counted
    for by measured time where they are not given. `batch`: samples of a step. `seed`: of all random numbers. `threads`:
    of PyTorch. `device`: auto is a GPU that PyTorch can use, where there is one. `precision`: of the network while it
    is trained. `look`: the default body in these clothes is who is trained; none: the person of a capture. `start`: the
    avatar whose network is trained further, or one of random weights. `width`: of a new one. `texture`: the avatar
    whose texture is trained further, or one of the samples' colours.
    `network_rate`, `texture_rate`: peaks of the learning rates. `small_until`, `freeze_norms_at`: shares of the steps,
    up to which only half-size samples are used, and after which batch statistics stay. `average_share`: of the steps so
    far, time constant of the average that becomes the avatar. `discriminator_rate`: of learning, for discriminators; it
    stays as it is. `noise_steps`: on activations, steps of a byte. `masked_texture`: texels that a batch does not show
    keep their values and their momentum. `stand_off`: the body is drawn with clothes and hair raised by what masks
    show. `norm`: of a new network. `mip_levels`: smaller levels of the texture that are learnt with it. `bytes_from`:
    share of the steps after which weights and activations are rounded as the bundle's are, in float32. `vgg`: SHA-256
    of VGG-16's weights that the perceptual loss is by.
    """

    schema_: Literal[1] = Field(default=1, alias="schema")
    samples: int = Field(default=4000, ge=8, le=200_000)
    minutes: float = Field(default=60.0, gt=0, le=100_000)
    steps: int | None = Field(default=None, ge=10, le=10_000_000)
    batch: int = Field(default=4, ge=1, le=64)
    seed: int = Field(default=1, ge=0, lt=2**31)
    threads: int = Field(default=1, ge=1, le=256)
    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["float32", "bfloat16"] = "float32"
    look: str | None = None
    start: Literal["default", "hiker", "new"] = "default"
    texture: Literal["default", "hiker", "new"] = "new"
    width: int = Field(default=16, ge=4, le=64)
    network_rate: float = Field(default=1.5e-3, gt=0, le=1)
    texture_rate: float = Field(default=4e-4, gt=0, le=1)
    discriminator_rate: float = Field(default=1e-5, gt=0, le=1)
    weight_decay: float = Field(default=1e-3, ge=0, le=1)
    small_until: float = Field(ge=0, le=1)
    freeze_norms_at: float = Field(ge=0, le=1)
    average_share: float = Field(default=0.1, gt=0, le=1)
    noise_steps: float = Field(default=1.0, ge=0, le=16)
    masked_texture: bool = False
    stand_off: bool = True
    norm: Literal["batch", "instance", "group", "none"] = "batch"
    bytes_from: float = Field(default=1.0, ge=0, le=1)
    mip_levels: int = Field(default=0, ge=0, le=5)
    vgg: str | None = Field(default=None, pattern="^[0-9a-f]{64}$")
    loss: LossWeights = LossWeights()
    optimiser: OptimiserOptions = OptimiserOptions()
    batches: BatchOptions = BatchOptions()
    regularisation: RegularisationOptions = RegularisationOptions()


def read_settings(path: Path) -> TrainingSettings:
    """The settings in the file `path`. Raises BadInputError."""
    try:
        values = tomllib.loads(read_text(path, EXPECTED))
    except tomllib.TOMLDecodeError as error:
        raise BadInputError(path, f"no valid TOML ({error})", EXPECTED) from None
    return parsed_settings(values, path)


def parsed_settings(values: dict[str, Any], where: str | Path) -> TrainingSettings:
    """The settings of `values`, which stand at `where`; `loss` may be the name of one. Raises BadInputError."""
    try:
        settings = TrainingSettings.model_validate(with_usual(values, where))
    except ValidationError as error:
        raise _refused(dict(error.errors()[0]), where) from None
    for key, clashes, expected, remedy in CLASHES:
        if clashes(settings):
            raise BadInputError(f"{where}: {key}", str(getattr(settings, key)), expected, remedy)
    return settings


#: What does not go together: key, test, what is expected of the key, and another way.
CLASHES: tuple[tuple[str, Callable[[TrainingSettings], bool], str, str], ...] = (
    ("norm", lambda s: s.start != "new" and s.norm != "batch", "batch of a trained network", 'or start = "new"'),
    (
        "bytes_from",
        lambda s: s.bytes_from < 1 and s.norm in ("instance", "group"),
        "1 with a norm that is not folded into the weights",
        'or norm = "batch" or "none"',
    ),
    (
        "bytes_from",
        lambda s: s.norm == "batch" and s.bytes_from < s.freeze_norms_at,
        "no less than freeze_norms_at: the weights are rounded with the batch statistics in them",
        "or a lower freeze_norms_at",
    ),
)


def settings_text(settings: TrainingSettings) -> str:
    """The text of a file of `settings`: every value, also where it is the default."""
    values = settings.model_dump(by_alias=True, exclude_none=True)
    tables = {key: value for key, value in values.items() if isinstance(value, dict)}
    lines = [HEAD, *_lines({key: value for key, value in values.items() if key not in tables})]
    for name, table in tables.items():
        lines += ["", f"[{name}]", *_lines(table)]
    return "\n".join(lines) + "\n"


def _lines(values: dict[str, Any]) -> list[str]:
    return [f"{key} = {json.dumps(value)}" for key, value in values.items()]


def _refused(details: dict[str, Any], where: str | Path) -> BadInputError:
    """One of the `errors()` of a ValidationError."""
    place, keys = f"{where}: {'.'.join(map(str, details['loc']))}", details["loc"]
    if details["type"] != "extra_forbidden":
        return BadInputError(place, repr(details["input"])[:80], details["msg"].removeprefix("Input should be "))
    table = TrainingSettings.model_fields[keys[0]].annotation if len(keys) > 1 else TrainingSettings
    known = [field.alias or name for name, field in getattr(table, "model_fields", {}).items()]
    return BadInputError(place, "an unknown key", f"one of {', '.join(known)}", did_you_mean(str(keys[-1]), known))
