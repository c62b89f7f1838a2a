"""The manifest of an avatar: name, files, scale and zero point of the network's bytes, training and validation.

Rule: every number that a run uses has a range, so it needs no further check. Unknown keys are refused, except further
figures of the image error.
"""

from __future__ import annotations

import datetime
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from trilane.arrays import MAX_SIDE
from trilane.avatars.network_file import MAX_CHANNELS, NetworkFile, network_files
from trilane.errors import BadInputError

#: Value of `weights` in `provenance` for a network that nobody trained.
UNTRAINED = "untrained: for speed alone"
#: Value of `body` in `provenance` if the person is known only from frames, so that no ground truth of other poses or
#: views can be drawn.
CAPTURED = "that of a capture"

Finite = Annotated[float, Field(allow_inf_nan=False)]
#: A shape or expression coefficient in standard deviations; values outside this range describe no human body.
Coefficient = Annotated[float, Field(ge=-100, le=100, allow_inf_nan=False)]
FileName = Annotated[str, Field(min_length=1, max_length=200)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
#: An existing day, in JSON as YYYY-MM-DD.
Day = Annotated[datetime.date, Field(strict=True)]
#: How much of the person a view shows.
Band = Literal["far", "full_body", "upper_body", "face"]
BANDS: tuple[Band, ...] = get_args(Band)
Share = Annotated[float, Field(ge=0, le=1)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Figures(_Model):
    """Figures; a figure that was not measured is None and not written."""

    @model_serializer(mode="wrap")
    def _known(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in write(self).items() if value is not None}


class ByteRange(_Model):
    """How bytes stand for real numbers: `real = (q - zero_point) * scale`, q in 0..255."""

    scale: float = Field(ge=1e-12, le=1e12, allow_inf_nan=False)
    zero_point: int = Field(ge=0, le=255)


class NetworkEntry(_Model):
    """The network file and the network in it.

    `file`: name of the network's file in the bundle.
    `encoder`, `norm`: names of the encoder and of the normalisation, as `trilane avatar network` takes them.
    `width`: channels of the first layers; 64 is the full network.
    `channels`: channels of the neural texture.
    `input`, `output`: scale and zero point of the network's input and output bytes.
    """

    file: FileName
    encoder: str
    norm: str
    width: int = Field(ge=1, le=256)
    channels: int = Field(ge=1, le=MAX_CHANNELS)
    input: ByteRange
    output: ByteRange = ByteRange(scale=1 / 255, zero_point=0)


class Digests(_Model):
    """SHA-256, hexadecimal, of everything on which an avatar's pictures depend.

    `body`, `texture`, `network`: digests of the bytes of these files; offsets count as part of the body. Levels of the
    mesh have no digest, because their file identifies the body, and a validation draws the whole mesh.
    `constants`: digest of the manifest's numbers: shape, expression, and the scales and zero points of the network's
    bytes.
    """

    body: Sha256
    texture: Sha256
    network: Sha256
    constants: Sha256


class WorstView(_Model):
    """The view with the least PSNR, and the numbers that identify the view.

    `seed`: seed from which the view was drawn.
    `number`: number of the view among the views of `seed`.
    `band`: how much of the person the view shows.
    `psnr_db`, `body_psnr_db`: PSNR of this view in dB, in the bounding box and on the body
    (`training/image_error.py`).
    """

    seed: int
    number: int
    band: Band
    psnr_db: Finite
    body_psnr_db: Finite


class SeedFigures(_Model):
    """Figures of the views of one seed, in dB.

    `psnr_db`, `least_psnr_db`: mean and least PSNR in the bounding box. `body_psnr_db`: mean PSNR on the body.
    """

    psnr_db: Finite
    body_psnr_db: Finite
    least_psnr_db: Finite


class AccuracyFigures(_Figures):
    """Image error of one network on one runtime, on poses and views that were not trained on.

    `psnr_db_by_band`: mean PSNR in dB, by band, in front of random backgrounds, in the bounding box of the true mask.
    `see_through`: share of the pixels inside the person whose alpha is less than 0.9.
    `iou`: intersection over union of the masks. `ssim`: structural similarity of the pictures. Both are means over the
    views.

    All further keys come from `summary` in `training/image_error.py`. A key that was not measured is None and not
    written. If `psnr_db_by_background` is None, an older Trilane measured the figures in front of a single grey.
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


class MadeWith(_Model):
    """The software that measured the figures.

    `trilane`: version of Trilane; None if it is not known.
    `revision`, `modified`: commit of Trilane's checkout in git, and whether files differ from it; None if not known.
    `renderer`: name of OpenGL's renderer.
    `runtimes`: name and version of each runtime's library, by the runtime's name.
    """

    trilane: str | None
    revision: str | None = None
    modified: bool | None = None
    renderer: str
    runtimes: dict[str, str]


#: Side in pixels of a square with as many pixels as a rectangle.
Side = Annotated[int, Field(ge=8, le=MAX_SIDE)]


class BySize(_Figures):
    """Image error by the sizes of body and tensor, from which the planner takes its curve.

    `date`: date in UTC. `runtime`: runtime that ran the network. `seed`, `per_band`, `held_out`: choice of the views.
    `psnr_db_by_picture`: mean PSNR in dB inside the bounding box of the true mask, by two sides, in pixels. The first
    side is for bodies that cover side x side pixels of the picture, the second for tensors of side x side pixels. All
    rows have the same tensors.
    `psnr_db`: what an older Trilane measured instead: PSNR by HEIGHTxWIDTH of the tensor, the network's own size first.
    """

    date: Day
    runtime: str
    seed: int
    per_band: int = Field(ge=1)
    held_out: tuple[str, ...]
    psnr_db: dict[Annotated[str, Field(pattern=r"^[0-9]{1,4}x[0-9]{1,4}$")], Finite] | None = Field(
        default=None, min_length=1
    )
    psnr_db_by_picture: dict[Side, Annotated[dict[Side, Finite], Field(min_length=2)]] | None = Field(
        default=None, min_length=1
    )

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.psnr_db is None) == (self.psnr_db_by_picture is None):
            raise ValueError("one of 'psnr_db_by_picture' and 'psnr_db' is needed")
        rows = list((self.psnr_db_by_picture or {}).values())
        if any(row.keys() != rows[0].keys() for row in rows):
            raise ValueError("'psnr_db_by_picture' needs the same tensors in all rows")
        return self


#: Keys of the figures that a validation repeats at its top level; they are the figures of its `runtime`.
AT_THE_TOP = ("psnr_db_by_band", "psnr_db_by_background", "see_through", "iou", "ssim")


class Validation(AccuracyFigures):
    """The figures of an avatar, and the material on which they were measured.

    The first four keys are None in a manifest that an older Trilane wrote.

    `date`: day of the validation in UTC.
    `digests`: digests of the validated files and numbers.
    `figures_digest`: digest of all other keys here, by the function `figures_digest`.
    `made_with`: software that measured the figures.
    `runtime`: runtime of the figures in `integer`. The keys of `AT_THE_TOP` repeat these figures.
    `size`: tensor size, as `trilane run --size` takes it.
    `texture_filter`: filter of the neural texture.
    `other_runtimes`: figures on other runtimes, by runtime.
    `by_size`: image error by tensor size; None if it was not measured.
    More keys: `per_band`, number of views of each band and seed; `held_out`, origin of each motion, by name; `float`,
    figures of the network before it was quantised; `psnr_loss_db`, loss of PSNR by quantising, by band.
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
        """Return the figures of `runtime`; None if the avatar was not validated on that runtime."""
        if runtime != self.runtime:
            return self.other_runtimes.get(runtime)
        return self.integer or AccuracyFigures(**{key: getattr(self, key) for key in AT_THE_TOP})


class Manifest(_Model):
    """`manifest.json`. File names are relative to the bundle's folder.

    `offsets`: file of the offsets of the body's vertices; None if the body is drawn bare.
    `mesh_levels`: file of the levels of the mesh; None if the whole mesh is drawn at every distance.
    `betas`, `expression`: coefficients of shape and of expression, in standard deviations.
    `provenance`: how the avatar was made, such as `weights` (UNTRAINED) and `body` (CAPTURED).
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
    """Return the manifest's entry for a quantised network in the file `network.onnx`.

    `encoder`, `norm`, `width`: as in `NetworkEntry`.
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
    """Return the manifest from its JSON `text`. Raises BadInputError, which names the file `path` and the key."""
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


# Digests of everything on which an avatar's pictures depend: the bytes of its files and the numbers of its manifest.
#
# Rule: a byte that may change a picture changes a digest. Names, provenance and other texts change no digest.

BLOCK = 1 << 20


def digests_of(folder: Path, manifest: Manifest) -> Digests:
    """Return the digests of the files in `folder` that `manifest` names, and of the manifest's numbers.

    Raises BadInputError for a file that cannot be read.
    """
    return Digests(
        body=sha256_of([folder / file for file in (manifest.body, manifest.offsets) if file is not None]),
        texture=sha256_of([folder / manifest.texture]),
        network=sha256_of(network_files(folder / manifest.network.file)),
        constants=hashlib.sha256(_constants(manifest).encode()).hexdigest(),
    )


def figures_digest(validation: Validation) -> str:
    """Return the SHA-256, hexadecimal, of `validation` as canonical JSON without the key `figures_digest`.

    Optional keys of figures are left out if they are None. Therefore a new optional key changes no older digest.
    """
    said = validation.model_dump(mode="json", exclude={"figures_digest"})
    return hashlib.sha256(_in_one_way(said).encode()).hexdigest()


def with_figures_digest(validation: Validation) -> Validation:
    """Return a newly measured `validation` with its key `figures_digest` set."""
    return validation.model_copy(update={"figures_digest": figures_digest(validation)})


def sha256_of(files: Sequence[Path]) -> str:
    """Return the SHA-256, hexadecimal, of the joined bytes of `files`. Raises BadInputError."""
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
    """Return, as canonical JSON, the numbers of the manifest on which pictures depend."""
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
