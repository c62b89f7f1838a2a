"""`training.toml`: everything that decides the result of a training, in one file that the bundle keeps.

Rule: the file names no folders. On one thread of a CPU, the same file, capture and machine give the same avatar.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Len
from pydantic import AfterValidator, Field, ValidationError

from trilane.errors import BadInputError, did_you_mean
from trilane.files import read_text
from trilane.scene.schema import LISTED, Table
from trilane.unexpected_value import UnexpectedValue, expected_in, unexpected_in
from trilane.units import MOST_TEXTURE_LEVELS, AvatarName

# Options of a training, in tables of `training.toml`: the optimiser, the batches, and regularisation.
#
# Rule: this module needs no PyTorch, so that settings can be checked without PyTorch.

#: Name of a bundled avatar, or `new`.
BundledName = Literal[AvatarName, "new"]
Repeats = Annotated[int, Field(ge=1, le=100)]


class OptimiserOptions(Table):
    """Table `[optimiser]`.

    `kind`: `adam` (weight decay is part of the gradient) or `adamw` (weight decay is separate).
    `momentum`, `texture_momentum`: Adam's β₁ for the network and for the texture; 0 is off.
    `second_momentum`: Adam's β₂ for both.
    `clip_norm`: upper bound of the norm of all gradients; 0 is off.
    `clip_value`: upper bound of the absolute value of each element of a gradient; 0 is off.
    `batches_per_step`: number of batches whose mean gradient is used for a step.
    """

    kind: Literal["adamw", "adam"] = "adamw"
    momentum: float = Field(default=0.9, ge=0, lt=1)
    texture_momentum: float = Field(default=0.9, ge=0, lt=1)
    second_momentum: float = Field(default=0.99, ge=0, lt=1)
    clip_norm: float = Field(default=1.0, ge=0, le=1e6)
    clip_value: float = Field(default=0.0, ge=0, le=1e6)
    batches_per_step: int = Field(default=1, ge=1, le=1000)


class BatchOptions(Table):
    """Table `[batches]`.

    `sample_share`: share of the samples that is used; they are chosen at random before training.
    `same_zoom`: whether the samples of a batch have about the same zoom.
    `full_body_statistics`: whether only batches of whole bodies update the statistics of batch norms. Other batches use
    these statistics.
    `full_body_from`: share of the steps after which all samples show whole bodies.
    `repeats`: how many times each sample occurs in an epoch, by band: far, full body, upper body, face, anywhere.
    `look_repeats`: factor on `repeats`, by look of the settings; if it is empty, 1 for all.
    """

    sample_share: float = Field(default=1.0, gt=0, le=1)
    same_zoom: bool = False
    full_body_statistics: bool = False
    full_body_from: float = Field(default=1.0, ge=0, le=1)
    repeats: Annotated[tuple[Repeats, Repeats, Repeats, Repeats, Repeats], LISTED] = (1, 1, 1, 1, 1)
    look_repeats: Annotated[tuple[Repeats, ...], LISTED] = ()


class RegularisationOptions(Table):
    """Table `[regularisation]`: random changes to the avatar in each step.

    `texture_noise`, `input_noise`: standard deviations of Gaussian noise on texels, and on the network's input.
    `dropout`: probability that a channel is set to 0 after a level of encoder or decoder.
    """

    texture_noise: float = Field(default=0.0, ge=0, le=1)
    input_noise: float = Field(default=0.0, ge=0, le=1)
    dropout: float = Field(default=0.0, ge=0, lt=1)


class LossWeights(Table):
    """Weight of each term of the loss in `objective`; 0 leaves a term out. The default avatar has the default weights.

    `structure` is one minus MS-SSIM. `perceptual` is a distance of features of VGG-16 if their weights are given, else
    one minus MS-SSIM too. `adversarial` and `features` (feature matching) need discriminators.
    """

    composite: float = Field(default=0.4, ge=0, le=1000)
    decibels: float = Field(default=0.03, ge=0, le=1000)
    colour: float = Field(default=0.1, ge=0, le=1000)
    edges: float = Field(default=0.2, ge=0, le=1000)
    coarse: float = Field(default=0.2, ge=0, le=1000)
    mask: float = Field(default=0.1, ge=0, le=1000)
    background: float = Field(default=0.05, ge=0, le=1000)
    overlap: float = Field(default=0.1, ge=0, le=1000)
    structure: float = Field(default=0.0, ge=0, le=1000)
    perceptual: float = Field(default=0.0, ge=0, le=1000)
    adversarial: float = Field(default=0.0, ge=0, le=1000)
    features: float = Field(default=0.0, ge=0, le=1000)

    @property
    def judged(self) -> bool:
        """Whether a term needs discriminators."""
        return self.adversarial > 0 or self.features > 0

    def by_name(self) -> dict[str, float]:
        """Return the weights by the names of their terms, as `objective.total_loss` takes them."""
        return {str(name): float(value) for name, value in self.model_dump().items()}


# Usual values: defaults of settings that depend on the loss, on the start and on the length of a training.
#
# Rule: usual values are values of `TrainingSettings` and nothing else. All of them are written into the avatar's
# `training.toml`.

#: Losses by name: the weights, and usual values of other settings.
LOSSES: dict[str, dict[str, Any]] = {
    "default": {"loss": {}},
    "thesis": {
        "loss": dict.fromkeys(LossWeights.model_fields, 0.0)
        | {"composite": 25.0, "overlap": 25.0, "perceptual": 20.0, "adversarial": 1.0, "features": 1.0},
        "network_rate": 1e-3,
        "texture_rate": 1e-3,
        "discriminator_rate": 1e-5,
        "weight_decay": 0.0,
        "optimiser": {"kind": "adam", "second_momentum": 0.999, "clip_norm": 0.0},
    },
}
#: Usual values of a training that continues a trained network, and of one that begins with a new network.
TRAINED: dict[str, Any] = {"small_until": 0.0, "freeze_norms_at": 0.3}
NEW: dict[str, Any] = {"small_until": 0.12, "freeze_norms_at": 0.6}
#: By default, a training of a new network in fewer minutes than this has cheap steps and high learning rates
#: (docs/decisions/avatar-training.md).
SHORT_MINUTES = 5.0
MOST_MINUTES = 100_000
SHORT: dict[str, Any] = {"batch": 2, "small_until": 0.8, "network_rate": 5e-3, "texture_rate": 1e-3}


def with_usual(values: dict[str, Any], where: str | Path) -> dict[str, Any]:
    """Return `values` with usual values for missing keys. The name of a loss is replaced by its weights.

    `values`: settings as in `training.toml`. `where`: source of `values`, for messages. Raises BadInputError for an
    unknown name of a loss.
    """
    start, name = values.get("start", "default"), values.get("loss")
    usual = (NEW if start == "new" else TRAINED) | (_of_loss(name, where) if isinstance(name, str) else {})
    minutes = values.get("minutes")
    is_short = "steps" not in values and isinstance(minutes, int | float) and minutes < SHORT_MINUTES
    if start == "new" and is_short:
        usual |= SHORT
    given = {key: value for key, value in values.items() if key != "loss" or not isinstance(name, str)}
    return usual | {key: _over(usual.get(key), value) for key, value in given.items()}


def _of_loss(name: str, where: str | Path) -> dict[str, Any]:
    if name not in LOSSES:
        raise BadInputError(f"{where}: loss", repr(name), f"one of {', '.join(LOSSES)}", did_you_mean(name, LOSSES))
    return LOSSES[name]


def _minutes(minutes: float) -> float:
    if not 0 < minutes <= MOST_MINUTES:  # also refuses NaN
        raise UnexpectedValue(f"{minutes:g}", f"above 0, at most {MOST_MINUTES} minutes")
    return minutes


def _over(usual: Any, value: Any) -> Any:
    """Return `value`. If both are tables, keys that `value` lacks are added from `usual`."""
    return usual | value if isinstance(usual, dict) and isinstance(value, dict) else value


NAME = "training.toml"
EXPECTED = "settings of a training (TOML): docs/captures.md"
HEAD = "# How this avatar was trained; `trilane avatar train --config training.toml` trains one so again.\n"


class TrainingSettings(Table):
    """Everything that decides the result of a training. A share means a share of the steps, 0 to 1.

    `samples`: number of views of the person, rendered before training.
    `minutes`: duration of training. If `steps` is absent, the number of steps follows from it and a measured step.
    `steps`: number of steps.
    `batch`: number of samples in a batch.
    `seed`: seed of all random numbers.
    `threads`: number of PyTorch's threads, and of processes that render samples.
    `device`: device of PyTorch; `auto` is a GPU if there is one, else the CPU.
    `precision`: floating-point format of the network in training.
    `look`: look of the default body, if that is trained; None to train the person of a capture. A list of looks trains
    one network for all of them, with a texture for each.
    `start`: avatar whose network is trained further; `new` begins with random weights.
    `keep_network`: whether the network of `start` stays as it is, so that only textures are trained.
    `texture`: avatar whose texture is trained further; `new` begins with the colours of the samples. `look` is the
    avatar that has the name of the look, or `new` if no bundled avatar has it.
    `width`: width of the network; 64 is the full network.
    `network_rate`, `texture_rate`: peak learning rates.
    `discriminator_rate`: constant learning rate of the discriminators.
    `weight_decay`: weight decay of kernels and texture.
    `small_until`: share up to which only half-size samples are used.
    `freeze_norms_at`: share after which the statistics of batch norms stay fixed.
    `average_share`: time constant of the moving average that becomes the avatar, as a share of the steps so far.
    `noise_steps`: largest noise on activations, in steps of a byte.
    `masked_texture`: whether texels that no sample of a batch shows keep their values and momenta.
    `stand_off`: whether offsets of clothes and hair are measured, and the body is drawn with these offsets.
    `norm`: normalisation of the network.
    `bytes_from`: share after which weights and activations are rounded to the bundle's bytes, in float32.
    `mip_levels`: number of smaller levels of the texture that are learnt with it.
    `vgg`: SHA-256 of the file of VGG-16's weights for the perceptual loss.
    """

    schema_: Literal[1] = Field(default=1, alias="schema")
    samples: int = Field(default=4000, ge=8, le=200_000)
    minutes: Annotated[float, AfterValidator(_minutes)] = 60.0
    steps: int | None = Field(default=None, ge=10, le=10_000_000)
    batch: int = Field(default=4, ge=1, le=64)
    seed: int = Field(default=1, ge=0, lt=2**31)
    threads: int = Field(default=1, ge=1, le=256)
    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["float32", "bfloat16"] = "float32"
    look: str | Annotated[tuple[str, ...], LISTED, Len(2, 16)] | None = None
    start: BundledName = "default"
    keep_network: bool = False
    texture: Literal[BundledName, "look"] = "new"
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
    mip_levels: int = Field(default=0, ge=0, le=MOST_TEXTURE_LEVELS)
    vgg: str | None = Field(default=None, pattern="^[0-9a-f]{64}$")
    loss: LossWeights = LossWeights()
    optimiser: OptimiserOptions = OptimiserOptions()
    batches: BatchOptions = BatchOptions()
    regularisation: RegularisationOptions = RegularisationOptions()

    @property
    def looks(self) -> tuple[str, ...]:
        """The names of the looks; none for a capture."""
        return (self.look,) if isinstance(self.look, str) else self.look or ()


def read_settings(path: Path) -> TrainingSettings:
    """Return the settings in the file `path`. Raises BadInputError if it cannot be read, or for a wrong setting."""
    try:
        values = tomllib.loads(read_text(path, EXPECTED))
    except tomllib.TOMLDecodeError as error:
        raise BadInputError(path, f"no valid TOML ({error})", EXPECTED) from None
    return parsed_settings(values, path)


def parsed_settings(values: dict[str, Any], where: str | Path) -> TrainingSettings:
    """Return the checked settings of `values`, with usual values for missing keys.

    Raises BadInputError for an unknown key, a wrong value, or values that exclude each other (`CLASHES`).

    `values`: settings as in `training.toml`; `loss` may also be the name of a loss. `where`: source of `values`, for
    messages.
    """
    try:
        settings = TrainingSettings.model_validate(with_usual(values, where))
    except ValidationError as error:
        raise _refused(dict(error.errors()[0]), where) from None
    for key, clashes, expected, remedy in CLASHES:
        if clashes(settings):
            raise BadInputError(f"{where}: {key}", str(attrgetter(key)(settings)), expected, remedy)
    return settings


#: Settings that exclude each other: key to blame, function that finds the clash, expected value of the key, remedy.
CLASHES: tuple[tuple[str, Callable[[TrainingSettings], bool], str, str], ...] = (
    ("norm", lambda s: s.start != "new" and s.norm != "batch", "batch of a trained network", 'or start = "new"'),
    ("keep_network", lambda s: s.keep_network and s.start == "new", "false with random weights", "or another start"),
    ("look", lambda s: len(set(s.looks)) < len(s.looks), "each look once", ""),
    (
        "batches.look_repeats",
        lambda s: len(s.batches.look_repeats) not in (0, len(s.looks)),
        "one number for each look",
        "or none",
    ),
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
    """Return the text of a settings file with every value, defaults included."""
    values = settings.model_dump(by_alias=True, exclude_none=True)
    tables = {key: value for key, value in values.items() if isinstance(value, dict)}
    lines = [HEAD, *_lines({key: value for key, value in values.items() if key not in tables})]
    for name, table in tables.items():
        lines += ["", f"[{name}]", *_lines(table)]
    return "\n".join(lines) + "\n"


def _lines(values: dict[str, Any]) -> list[str]:
    return [f"{key} = {json.dumps(value)}" for key, value in values.items()]


def _refused(details: dict[str, Any], where: str | Path) -> BadInputError:
    """Return the error for `details`, one of the `errors()` of a pydantic ValidationError."""
    place, keys = f"{where}: {'.'.join(map(str, details['loc']))}", details["loc"]
    if (unexpected := unexpected_in(details)) is not None:
        return BadInputError.at(place, unexpected)
    if details["type"] != "extra_forbidden":
        return BadInputError(place, repr(details["input"])[:80], expected_in(details))
    table = TrainingSettings.model_fields[keys[0]].annotation if len(keys) > 1 else TrainingSettings
    known = [field.alias or name for name, field in getattr(table, "model_fields", {}).items()]
    return BadInputError(place, "an unknown key", f"one of {', '.join(known)}", did_you_mean(str(keys[-1]), known))
