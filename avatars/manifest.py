"""The manifest of an avatar: name, files, scale and zero point of the network's bytes, and how it was trained.

Rule: every number has a range and every key is known, so what is read needs no further check.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from trilane.avatars.integer_network import MAX_CHANNELS, NetworkFile
from trilane.errors import BadInputError

BANDS = ("far", "full_body", "upper_body", "face")
Finite = Annotated[float, Field(allow_inf_nan=False)]
#: A shape or expression coefficient in standard deviations; values outside describe no human body.
Coefficient = Annotated[float, Field(ge=-100, le=100, allow_inf_nan=False)]
FileName = Annotated[str, Field(min_length=1, max_length=200)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ByteRange(_Model):
    """How bytes stand for real numbers: `real = (q - zero_point) * scale`, q in 0..255."""

    scale: float = Field(ge=1e-12, le=1e12, allow_inf_nan=False)
    zero_point: int = Field(ge=0, le=255)


class NetworkEntry(_Model):
    """The network file and the network in it. `width`: 64 is the full network. `channels`: of the neural texture.

    `input`, `output`: scale and zero point of the file's bytes, which the GPU unit encodes with.
    """

    file: FileName
    encoder: str
    norm: str
    width: int = Field(ge=1, le=256)
    channels: int = Field(ge=1, le=MAX_CHANNELS)
    input: ByteRange
    output: ByteRange = ByteRange(scale=1 / 255, zero_point=0)


class Validation(_Model):
    """Image error on poses and views that were not trained on: PSNR in dB inside the mask's box, IoU and SSIM."""

    model_config = ConfigDict(extra="allow", frozen=True)

    psnr_db_by_band: dict[Literal["far", "full_body", "upper_body", "face"], Finite]
    iou: float = Field(ge=0, le=1)
    ssim: float = Field(ge=-1, le=1)


class Manifest(_Model):
    """`manifest.json`. File names are relative to the bundle's folder."""

    schema_version: Literal[1] = 1
    name: str = Field(min_length=1, max_length=100)
    body: FileName = "body.npz"
    texture: FileName = "texture.npz"
    network: NetworkEntry
    betas: tuple[Coefficient, ...] = Field(default=(), max_length=400)
    expression: tuple[Coefficient, ...] = Field(default=(), max_length=100)
    provenance: dict[str, Any] = {}
    training_command: str = ""
    quantisation: dict[str, Any] = {}
    validation: Validation | None = None


def network_entry(network: NetworkFile, encoder: str, norm: str, width: int) -> NetworkEntry:
    """The manifest's entry for a quantised network, stored as `network.onnx`.

    `network`: the network, whose scales and zero points are written into the entry.
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
    """The manifest in JSON `text`, which was read from `path`. Raises BadInputError naming file and key."""
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
