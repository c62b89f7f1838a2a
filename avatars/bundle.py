"""An avatar on disk: a folder of manifest, body, neural texture and integer network.

Rule: nothing outside the folder is opened, and every number is checked before it is used.
"""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import onnx
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from trilane.avatars.network_file import MAX_CHANNELS, MAX_SIDE, Affine, NetworkFile, read_network
from trilane.errors import BadInputError
from trilane.files import read_npz, read_text, require_file
from trilane.writing import write_folder

MANIFEST = "manifest.json"
DEFAULT = "default"
BANDS = ("far", "full_body", "upper_body", "face")
TEXTURE_KEYS = ("texture", "scale")

Finite = Annotated[float, Field(allow_inf_nan=False)]
#: Of a shape or expression, in standard deviations: what lies outside is no body.
Coefficient = Annotated[float, Field(ge=-100, le=100, allow_inf_nan=False)]
FileName = Annotated[str, Field(min_length=1, max_length=200)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ByteRange(_Model):
    """`real = (q - zero_point) * scale`, q in 0..255."""

    scale: float = Field(ge=1e-12, le=1e12, allow_inf_nan=False)
    zero_point: int = Field(ge=0, le=255)


class NetworkEntry(_Model):
    """The network file and what was exported into it. `width` 64 is full; `channels` of the neural texture."""

    file: FileName
    encoder: str
    norm: str
    width: int = Field(ge=1, le=256)
    channels: int = Field(ge=1, le=MAX_CHANNELS)
    input: ByteRange
    output: ByteRange = ByteRange(scale=1 / 255, zero_point=0)


class Validation(_Model):
    """Image error on poses and views never trained on. PSNR in dB inside the mask's box; IoU, SSIM 0..1."""

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


@dataclass(frozen=True)
class Bundle:
    """A bundle whose manifest is valid and whose files exist inside `folder`."""

    folder: Path
    manifest: Manifest

    @property
    def body_path(self) -> Path:
        return self.folder / self.manifest.body

    @property
    def texture_path(self) -> Path:
        return self.folder / self.manifest.texture

    @property
    def network_path(self) -> Path:
        return self.folder / self.manifest.network.file

    def read_texture(self) -> NDArray[np.float32]:
        """The neural texture, (H, W, C) float32, row 0 at v = 0. Raises BadInputError."""
        arrays = read_npz(self.texture_path, TEXTURE_KEYS, "a neural texture")
        if "texture" not in arrays:
            raise BadInputError(self.texture_path, "no array 'texture'", "a neural texture")
        return _decode_texture(
            arrays["texture"], arrays.get("scale"), self.texture_path, self.manifest.network.channels
        )

    def read_network(self) -> NetworkFile:
        """The checked network. Raises BadInputError, also when it is not what the manifest says."""
        network = read_network(self.network_path)
        entry = self.manifest.network
        if network.channels != entry.channels:
            raise BadInputError(self.network_path, f"{network.channels} channels", f"{entry.channels} by the manifest")
        for side in ("input", "output"):
            _check_same(getattr(network, side), getattr(entry, side), f"{self.network_path} ({side})")
        return network


def bundle_folder(name: str | Path) -> Path:
    """The folder of a bundle: `default` is the embedded avatar, anything else a path."""
    return Path(__file__).parent / DEFAULT if str(name) == DEFAULT else Path(name)


def load_bundle(name: str | Path) -> Bundle:
    """Read a bundle's manifest. Raises BadInputError naming file and key."""
    folder = bundle_folder(name)
    path = folder / MANIFEST
    manifest = _parse(read_text(path, "an avatar's manifest"), path)
    for key, file in (("body", manifest.body), ("texture", manifest.texture), ("network.file", manifest.network.file)):
        _check_inside(folder, file, f"{path}: {key}")
    return Bundle(folder, manifest)


def network_entry(network: NetworkFile, encoder: str, norm: str, width: int) -> NetworkEntry:
    """The manifest's entry of a quantised network, stored as `network.onnx`."""
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


def write_bundle(
    folder: Path, manifest: Manifest, body: Path, texture: NDArray[Any], network: NetworkFile, scale: Any = None
) -> None:
    """Write a bundle beside `folder`, read it back, then put its files in `folder`.

    `body`: an .npz file to copy. `texture`: (H, W, C) float16, or int8 with `scale` (C,) float32.
    Raises BadInputError when the parts do not fit; then nothing is written.
    """
    with write_folder(folder) as draft:
        shutil.copyfile(body, draft / manifest.body)
        arrays: dict[str, Any] = (
            {"texture": texture} if scale is None else {"texture": texture, "scale": np.asarray(scale, np.float32)}
        )
        np.savez_compressed(draft / manifest.texture, **arrays)
        onnx.save(network.model, draft / manifest.network.file)
        (draft / MANIFEST).write_text(manifest.model_dump_json(indent=1) + "\n", encoding="utf-8")
        bundle = load_bundle(draft)
        bundle.read_texture()
        bundle.read_network()


def _parse(text: str, path: Path) -> Manifest:
    try:
        return Manifest.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(map(str, first["loc"])) or "document"
        raise BadInputError(
            f"{path}: {key}", f"{_short(first['input'])} ({first['msg']})", "a valid manifest"
        ) from error
    except (RecursionError, ValueError) as error:
        raise BadInputError(path, str(error), "a JSON manifest") from error


def _short(value: object) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _check_inside(folder: Path, file: str, where: str) -> None:
    resolved = (folder / file).resolve()
    if folder.resolve() not in resolved.parents:
        raise BadInputError(where, f"{file!r}, outside the bundle", "a file of the bundle's folder")
    require_file(resolved, f"the file that {where} names")


def _check_same(found: Affine, expected: ByteRange, where: str) -> None:
    same_scale = math.isclose(found.scale, expected.scale, rel_tol=1e-5)
    if not same_scale or found.zero_point != expected.zero_point:
        raise BadInputError(
            where,
            f"scale {found.scale:g}, zero point {found.zero_point}",
            f"scale {expected.scale:g}, zero point {expected.zero_point} by the manifest",
        )


def _decode_texture(texture: NDArray[Any], scale: Any, path: Path, channels: int) -> NDArray[np.float32]:
    shape = texture.shape
    if len(shape) != 3 or min(shape[:2]) < 2 or max(shape[:2]) > MAX_SIDE or shape[2] != channels:
        raise BadInputError(path, f"a texture of shape {shape}", f"(H, W, {channels}) with sides of 2 to {MAX_SIDE}")
    if texture.dtype == np.int8:
        factor = _check_scale(scale, path, channels)
    elif texture.dtype in (np.float16, np.float32):
        factor = np.ones((), np.float32)
    else:
        raise BadInputError(path, f"a texture of {texture.dtype}", "float16, float32, or int8 with a scale")
    decoded: NDArray[np.float32] = texture.astype(np.float32) * factor
    if not np.isfinite(decoded).all():
        raise BadInputError(path, "a texture with NaN or infinite texels", "finite numbers")
    return decoded


def _check_scale(scale: Any, path: Path, channels: int) -> NDArray[np.float32]:
    if scale is None or scale.shape not in ((), (channels,)) or scale.dtype.kind != "f" or not np.isfinite(scale).all():
        raise BadInputError(
            path, "an int8 texture without a usable scale", f"array 'scale', finite, shape ({channels},)"
        )
    factor: NDArray[np.float32] = scale.astype(np.float32)
    return factor
