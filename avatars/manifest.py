"""The manifest of an avatar: name, files, scale and zero point of the network's bytes, training and validation.

Rule: every number has a range and every key is known, so the read values need no further check.
"""

from __future__ import annotations

import datetime
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from trilane.avatars.network_file import MAX_CHANNELS, NetworkFile, network_files
from trilane.errors import BadInputError

#: Value of `weights` in `provenance` for a network that nobody trained.
UNTRAINED = "untrained: for speed alone"
#: Value of `body` in `provenance` where the person is known by frames alone: nobody can draw another pose or view.
CAPTURED = "that of a capture"
BANDS = ("far", "full_body", "upper_body", "face")
Finite = Annotated[float, Field(allow_inf_nan=False)]
#: A shape or expression coefficient in standard deviations; values outside this range describe no human body.
Coefficient = Annotated[float, Field(ge=-100, le=100, allow_inf_nan=False)]
FileName = Annotated[str, Field(min_length=1, max_length=200)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
#: An existing day, in JSON as YYYY-MM-DD.
Day = Annotated[datetime.date, Field(strict=True)]
Band = Literal["far", "full_body", "upper_body", "face"]
Share = Annotated[float, Field(ge=0, le=1)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ByteRange(_Model):
    """How bytes stand for real numbers: `real = (q - zero_point) * scale`, q in 0..255."""

    scale: float = Field(ge=1e-12, le=1e12, allow_inf_nan=False)
    zero_point: int = Field(ge=0, le=255)


class NetworkEntry(_Model):
    """The network file and the network in it.

    `width`: 64 is the full network. `channels`: channels of the neural texture.
    `input`, `output`: scale and zero point of the file's bytes, which the GPU unit encodes with.
    """

    file: FileName
    encoder: str
    norm: str
    width: int = Field(ge=1, le=256)
    channels: int = Field(ge=1, le=MAX_CHANNELS)
    input: ByteRange
    output: ByteRange = ByteRange(scale=1 / 255, zero_point=0)


class Digests(_Model):
    """SHA-256, hexadecimal, of everything that an avatar's pictures depend on.

    `body`, `texture`, `network`: digests of these files' bytes; offsets count as part of the body. Levels of the mesh
    do not count, because their files name the body, and a validation draws the whole mesh.
    `constants`: digest of the manifest's numbers: shape, expression, and the scales and zero points of the network's
    bytes.
    """

    body: Sha256
    texture: Sha256
    network: Sha256
    constants: Sha256


class WorstView(_Model):
    """The view of the least PSNR, with the numbers that identify it.

    `number`: number of the view among those of `seed`.
    """

    seed: int
    number: int
    band: Band
    psnr_db: Finite
    body_psnr_db: Finite


class SeedFigures(_Model):
    """Figures of the views of one seed, in dB: two means and the least."""

    psnr_db: Finite
    body_psnr_db: Finite
    least_psnr_db: Finite


class AccuracyFigures(_Model):
    """Image error of one network on one runtime, on poses and views that were not trained on.

    `psnr_db_by_band`: PSNR in dB, before random backgrounds, inside the box of the true mask. `see_through`: share of
    the inside of the person whose alpha is less than 0.9. `iou`, `ssim`: means.
    The other keys are those of `summary` in `training/image_error.py`; they are None, and not written, where nobody
    measured them. Without `psnr_db_by_background` the figures are before a single grey, as an older Trilane measured
    them.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    psnr_db_by_band: dict[Band, Finite]
    psnr_db_by_background: dict[str, Finite] | None = None
    see_through: Share | None = None
    see_through_by_band: dict[Band, Share] | None = None
    alpha_inside: Share | None = None
    alpha_edge: Share | None = None
    alpha_outside: Share | None = None
    iou: Share
    ssim: float = Field(ge=-1, le=1)
    body_psnr_db_by_band: dict[Band, Finite] | None = None
    iou_by_band: dict[Band, Share] | None = None
    psnr_db: Finite | None = None
    body_psnr_db: Finite | None = None
    background: Share | None = None
    least_psnr_db: Finite | None = None
    least_body_psnr_db: Finite | None = None
    worst: WorstView | None = None
    by_seed: dict[str, SeedFigures] | None = None
    samples: int | None = Field(default=None, ge=1)

    @model_validator(mode="after")
    def _worst_of_something(self) -> Self:
        if self.worst is not None and (self.by_seed is None or self.samples is None):
            raise ValueError("'worst' needs 'by_seed' and 'samples' beside it")
        return self

    @model_serializer(mode="wrap")
    def _known(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in write(self).items() if value is not None}


class MadeWith(_Model):
    """The software that measured the figures, beside the avatar's files. No digest covers it.

    `trilane`: its version. `revision`, `modified`: state of its checkout in git. All three are None where not known.
    `renderer`: OpenGL's renderer. `runtimes`: name and version of the library, by the runtime's name.
    """

    trilane: str | None
    revision: str | None = None
    modified: bool | None = None
    renderer: str
    runtimes: dict[str, str]


class BySize(_Model):
    """The cost of smaller tensors: the same views painted at several sizes, and enlarged to the first one's.

    `date`: date in UTC. `runtime`: runtime that painted. `seed`, `per_band`, `held_out`: choice of the views.
    `psnr_db`: mean PSNR in dB inside the box of the true mask, by HEIGHTxWIDTH of the tensor; the network's own size
    first.
    """

    date: Day
    runtime: str
    seed: int
    per_band: int = Field(ge=1)
    held_out: tuple[str, ...]
    psnr_db: dict[Annotated[str, Field(pattern=r"^[0-9]{1,4}x[0-9]{1,4}$")], Finite] = Field(min_length=1)


#: Figures that stand at the top of a validation too, taken from its own runtime.
AT_THE_TOP = ("psnr_db_by_band", "psnr_db_by_background", "see_through", "iou", "ssim")


class Validation(AccuracyFigures):
    """The figures of an avatar, and the material on which they were measured.

    `date`: day of the validation, UTC. `date`, `digests`, `figures_digest` and `made_with` are None in a manifest that
    an older Trilane wrote.
    `digests`: digests of the validated files.
    `figures_digest`: digest of all other keys here, by `figures_digest` of `avatars/manifest.py`.
    `made_with`: software that measured.
    `runtime`: runtime that painted the pictures of `integer`, whose errors stand at the top too.
    `other_runtimes`: figures of more runtimes, by name.
    `size`: tensor size, as `trilane run --size` takes it.
    `texture_filter`: filter of the neural texture.
    `by_size`: cost of smaller tensors; None where nobody measured it.
    More keys: `per_band`, views of each band and seed; `held_out`, digest of each motion; `float`, figures of the
    network before it was quantised; `psnr_loss_db`, loss by quantising.
    """

    date: Day | None = None
    digests: Digests | None = None
    figures_digest: Sha256 | None = None
    made_with: MadeWith | None = None
    runtime: str = ""
    size: str = ""
    texture_filter: str = "linear"
    integer: AccuracyFigures | None = None
    other_runtimes: dict[str, AccuracyFigures] = {}
    by_size: BySize | None = None

    def on(self, runtime: str) -> AccuracyFigures | None:
        """Return the figures of `runtime`; None when nothing was painted on it."""
        if runtime != self.runtime:
            return self.other_runtimes.get(runtime)
        return self.integer or AccuracyFigures(**{key: getattr(self, key) for key in AT_THE_TOP})


class Manifest(_Model):
    """`manifest.json`. File names are relative to the bundle's folder; a body without `offsets` is drawn bare.

    `mesh_levels`: levels of the mesh; None where the whole mesh is drawn at every distance.
    """

    schema_version: Literal[1] = 1
    name: str = Field(min_length=1, max_length=100)
    body: FileName = "body.npz"
    offsets: FileName | None = None
    mesh_levels: FileName | None = None
    texture: FileName = "texture.npz"
    network: NetworkEntry
    betas: tuple[Coefficient, ...] = Field(default=(), max_length=400)
    expression: tuple[Coefficient, ...] = Field(default=(), max_length=100)
    provenance: dict[str, Any] = {}
    training_command: str = ""
    quantisation: dict[str, Any] = {}
    validation: Validation | None = None


def network_entry(network: NetworkFile, encoder: str, norm: str, width: int) -> NetworkEntry:
    """Return the manifest's entry for a quantised network, stored as `network.onnx`.

    `network`: network whose scales and zero points are written into the entry.
    `encoder`, `norm`: names, as `trilane avatar network` takes them.
    `width`: 64 is the full network.
    """
    ends = [ByteRange(scale=end.scale, zero_point=end.zero_point) for end in (network.input, network.output)]
    return NetworkEntry(
        file="network.onnx",
        encoder=encoder,
        norm=norm,
        width=width,
        channels=network.channels,
        input=ends[0],
        output=ends[1],
    )


def parse_manifest(text: str, path: Path) -> Manifest:
    """Return the manifest in JSON `text`, which was read from `path`. Raises BadInputError naming file and key."""
    try:
        return Manifest.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(map(str, first["loc"])) or "document"
        raise BadInputError(
            f"{path}: {key}", f"{_short(first['input'])} ({first['msg']})", "a valid manifest"
        ) from error


def _short(value: object) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


# Digests of everything that an avatar's pictures depend on: the bytes of its files and the numbers of its manifest.
#
# Rule: a byte that changes the picture changes a digest; names, provenance and other words change none.

BLOCK = 1 << 20


def digests_of(folder: Path, manifest: Manifest) -> Digests:
    """Return the digests of the files in `folder` that `manifest` names. Raises BadInputError for an unreadable one."""
    return Digests(
        body=sha256_of([folder / file for file in (manifest.body, manifest.offsets) if file is not None]),
        texture=sha256_of([folder / manifest.texture]),
        network=sha256_of(network_files(folder / manifest.network.file)),
        constants=hashlib.sha256(_constants(manifest).encode()).hexdigest(),
    )


def figures_digest(validation: Validation) -> str:
    """Return the SHA-256, hexadecimal, of all of `validation` except this digest, in a canonical form.

    A key that is None counts as not there, so an optional key that a later Trilane adds changes no older digest.
    """
    said = validation.model_dump(mode="json", exclude={"figures_digest"})
    return hashlib.sha256(_in_one_way(said).encode()).hexdigest()


def with_figures_digest(validation: Validation) -> Validation:
    """Return `validation`, which has just been measured, with the digest of its figures."""
    return validation.model_copy(update={"figures_digest": figures_digest(validation)})


def sha256_of(files: Sequence[Path]) -> str:
    """Return the SHA-256, hexadecimal, of the bytes of `files`, one after the other. Raises BadInputError."""
    digest = hashlib.sha256()
    for file in files:
        try:
            with file.open("rb") as stream:
                while block := stream.read(BLOCK):
                    digest.update(block)
        except OSError as error:
            raise BadInputError.of_os_error(file, error, "a readable file") from error
    return digest.hexdigest()


def _constants(manifest: Manifest) -> str:
    """Return the manifest's numbers that the picture depends on, in a canonical form."""
    network = manifest.network
    numbers = {
        "betas": list(manifest.betas),
        "expression": list(manifest.expression),
        "channels": network.channels,
        "input": network.input.model_dump(),
        "output": network.output.model_dump(),
    }
    return _in_one_way(numbers)


def _in_one_way(values: dict[str, Any]) -> str:
    return json.dumps(values, sort_keys=True, separators=(",", ":"))
