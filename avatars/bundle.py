"""An avatar on disk: a folder of manifest, body, neural texture and integer network.

Rule: no file outside the folder is opened, and every number is checked before it is used.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import onnx
from numpy.typing import NDArray

from trilane.arrays import F32, MAX_SIDE
from trilane.avatars.manifest import ByteRange, Manifest, digests_of, parse_manifest
from trilane.avatars.mesh_levels import MESH_LEVELS, MeshLevel, read_mesh_levels, save_mesh_levels
from trilane.avatars.network_file import Affine, NetworkFile, read_network
from trilane.body.body import Body, ShapedBody, load_body
from trilane.errors import BadInputError, did_you_mean
from trilane.files import read_npz, read_text, require_file
from trilane.units import AVATARS, MOST_TEXTURE_LEVELS
from trilane.writing import require_writable, write_atomically, write_bytes, write_folder

MANIFEST, OFFSETS = "manifest.json", "offsets.npz"
DEFAULT = "default"
EXPECTED = f"the folder of an avatar, or one of {', '.join(AVATARS)}"
CAPTURE = "capture.toml"
HOW_TO_TRAIN = "docs/own-avatar.md says how `trilane avatar train` makes one from frames of a person"
HOW_TO_CREATE = "`trilane avatar create --body` puts a body of the same UV layout into an avatar"
TEXTURE_KEYS = ("texture", "scale", "levels")
#: How far, in metres, clothes and hair of an avatar may reach from its body. The pose stage and the training grow the
#: crop rectangle by this distance.
CLOTHES_STANDOFF_M = 0.045


@dataclass(frozen=True)
class Bundle:
    """A bundle with a valid manifest. All files that the manifest names exist inside `folder`."""

    folder: Path
    manifest: Manifest

    @property
    def body_path(self) -> Path:
        return self.folder / self.manifest.body

    @property
    def offsets_path(self) -> Path | None:
        return None if self.manifest.offsets is None else self.folder / self.manifest.offsets

    @property
    def texture_path(self) -> Path:
        return self.folder / self.manifest.texture

    @property
    def network_path(self) -> Path:
        return self.folder / self.manifest.network.file

    def read_body(self) -> Body:
        """Return the body; if the bundle has offsets, the body has them. Raises BadInputError."""
        body = load_body(self.body_path)
        if self.offsets_path is None:
            return body
        return replace(body, offsets=read_offsets(self.offsets_path, len(body.v_template)))

    def shaped_body(self) -> ShapedBody:
        """Return the body in its rest pose, with the shape and expression of the manifest. Raises BadInputError."""
        return self.read_body().shape(self.manifest.betas, self.manifest.expression)

    def read_mesh_levels(self, shaped: ShapedBody) -> tuple[MeshLevel, ...]:
        """Return the coarser levels of the mesh, finest first; empty if the bundle has no file of levels.

        `shaped`: body of this bundle, from `shaped_body`. Raises BadInputError.
        """
        file = self.manifest.mesh_levels
        return () if file is None else read_mesh_levels(self.folder / file, shaped)

    def read_texture(self) -> NDArray[np.float32]:
        """Return the neural texture (H, W, C) float32, with row 0 at v = 0. Raises BadInputError."""
        return read_texture(self.texture_path, self.manifest.network.channels)

    def read_levels(self) -> NDArray[np.float32] | None:
        """Return the smaller levels of the neural texture, packed by `pack_levels`, float32; None if there are none.

        Raises BadInputError.
        """
        arrays = _texture_arrays(self.texture_path, self.manifest.network.channels)
        if "levels" not in arrays:
            return None
        check_levels(arrays["levels"], arrays["texture"], self.texture_path)
        return _decoded(arrays["levels"], arrays.get("scale"), self.texture_path)

    def read_network(self) -> NetworkFile:
        """Return the checked network. Raises BadInputError, also if the network contradicts the manifest."""
        network = read_network(self.network_path)
        entry = self.manifest.network
        if network.channels != entry.channels:
            raise BadInputError(self.network_path, f"{network.channels} channels", f"{entry.channels} by the manifest")
        for side in ("input", "output"):
            _check_same(getattr(network, side), getattr(entry, side), f"{self.network_path} ({side})")
        return network


def read_texture(path: Path, channels: int) -> NDArray[np.float32]:
    """Return the neural texture (H, W, `channels`) float32 in the file `path`, with row 0 at v = 0.

    `channels`: number of channels that the texture must have. Raises BadInputError.
    """
    arrays = _texture_arrays(path, channels)
    return _decoded(arrays["texture"], arrays.get("scale"), path)


def _texture_arrays(path: Path, channels: int) -> dict[str, NDArray[Any]]:
    """Return the arrays in the file `path`: `texture` (H, W, `channels`), and perhaps others. Raises BadInputError."""
    arrays = read_npz(path, TEXTURE_KEYS, "a neural texture")
    if "texture" not in arrays:
        raise BadInputError(path, "no array 'texture'", "a neural texture")
    shape = arrays["texture"].shape
    if len(shape) != 3 or min(shape[:2]) < 2 or max(shape[:2]) > MAX_SIDE or shape[2] != channels:
        raise BadInputError(path, f"a texture of shape {shape}", f"(H, W, {channels}) with sides of 2 to {MAX_SIDE}")
    return arrays


def bundle_folder(name: str | Path) -> Path:
    """Return the folder of a bundle. `name`: one of `AVATARS`, which have folders in the package, or else a path."""
    return Path(__file__).parent / name if str(name) in AVATARS else Path(name)


def load_bundle(name: str | Path) -> Bundle:
    """Return the bundle `name`, as for `bundle_folder`. Raises BadInputError, which names the folder, file or key."""
    folder = bundle_folder(name)
    path = folder / MANIFEST
    if not folder.exists():
        raise BadInputError(folder, "no such folder", EXPECTED, did_you_mean(folder.name, AVATARS) or HOW_TO_TRAIN)
    if folder.is_file():
        raise BadInputError(folder, *_what_it_is(folder))
    if (folder / CAPTURE).is_file() and not path.exists():
        raise BadInputError(folder, "a capture, which avatars are trained on", "an avatar's folder", HOW_TO_TRAIN)
    manifest = parse_manifest(read_text(path, "an avatar's manifest"), path)
    files = {"body": manifest.body, "texture": manifest.texture, "network.file": manifest.network.file}
    files |= {key: file for key in ("offsets", "mesh_levels") if (file := getattr(manifest, key)) is not None}
    for key, file in files.items():
        _check_inside(folder, file, f"{path}: {key}")
    return Bundle(folder, manifest)


def _what_it_is(file: Path) -> tuple[str, str, str]:
    """Return (found, expected, remedy) for the error about `file`, which should be an avatar's folder."""
    try:
        is_body = bool(read_npz(file, ("v_template",), "a body"))
    except BadInputError:
        is_body = False
    found = "a body, which has no texture and no network" if is_body else "a file"
    remedy = f"{HOW_TO_TRAIN}; {HOW_TO_CREATE}" if is_body else HOW_TO_TRAIN
    return found, EXPECTED, remedy


def write_bundle(
    folder: Path,
    manifest: Manifest,
    body: Path,
    texture: NDArray[Any],
    network: NetworkFile,
    scale: Any = None,
    offsets: F32 | None = None,
    levels: NDArray[Any] | None = None,
    mesh_levels: Sequence[MeshLevel] = (),
) -> None:
    """Write a bundle to a temporary folder, read it back as a check, then move its files into `folder`.

    The validation in `manifest` is left out if its digests do not match these files and numbers.

    `folder`: folder of the bundle; made when it does not exist.
    `manifest`: manifest to write; this function sets the file names of `offsets` and `mesh_levels`, or None.
    `body`: .npz file of the body, which is copied.
    `texture`: (H, W, C) float16, or int8 with `scale`.
    `network`: network to write.
    `scale`: scale of each channel of an int8 texture, (C,) float32; None for a float16 texture.
    `offsets`: offsets of the body's vertices at rest, (V,3) metres; None for a body that is drawn bare.
    `levels`: smaller levels of the texture, packed by `pack_levels`, with the texture's dtype; None without levels.
    `mesh_levels`: coarser levels of the mesh, made for this body with these `offsets` and the manifest's shape.

    Raises BadInputError if the parts do not fit together, with `folder` unchanged, or if a file cannot be written.
    Raises OSError if `body` cannot be read.
    """
    with write_folder(folder) as draft:
        shutil.copyfile(body, draft / manifest.body)
        if offsets is not None:
            save_offsets(draft / OFFSETS, offsets)
        names = {"offsets": None if offsets is None else OFFSETS, "mesh_levels": MESH_LEVELS if mesh_levels else None}
        manifest = manifest.model_copy(update=names)
        if mesh_levels:
            shaped = Bundle(draft, manifest).shaped_body()
            save_mesh_levels(draft / MESH_LEVELS, shaped, mesh_levels)
        arrays: dict[str, Any] = (
            {"texture": texture} if scale is None else {"texture": texture, "scale": np.asarray(scale, np.float32)}
        )
        arrays |= {} if levels is None else {"levels": levels}
        np.savez_compressed(draft / manifest.texture, **arrays)
        onnx.save(network.model, draft / manifest.network.file)
        if manifest.validation is not None and manifest.validation.digests != digests_of(draft, manifest):
            manifest = manifest.model_copy(update={"validation": None})
        (draft / MANIFEST).write_bytes(_content(manifest))
        bundle = load_bundle(draft)
        bundle.read_mesh_levels(bundle.shaped_body())
        bundle.read_texture()
        bundle.read_levels()
        bundle.read_network()


def add_mesh_levels(bundle: Bundle, levels: Sequence[MeshLevel]) -> None:
    """Write `levels` of the mesh into `bundle`, in place of any levels there. Raises BadInputError."""
    shaped = bundle.shaped_body()
    with write_atomically(bundle.folder / MESH_LEVELS) as draft, draft.open("wb") as file:
        save_mesh_levels(file, shaped, levels)
    write_manifest(bundle.folder, bundle.manifest.model_copy(update={"mesh_levels": MESH_LEVELS}))


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Replace the manifest of the bundle in `folder` by `manifest`, whole or not at all. Raises BadInputError.

    If the manifest is a symbolic link, the linked file is replaced and the link stays.
    """
    write_bytes(_manifest_file(folder), _content(manifest))


def require_writable_manifest(folder: Path) -> None:
    """Raise BadInputError if `write_manifest` cannot write the manifest in `folder`; called before long work."""
    require_writable(_manifest_file(folder))


def _manifest_file(folder: Path) -> Path:
    return (folder / MANIFEST).resolve()


def _content(manifest: Manifest) -> bytes:
    return (manifest.model_dump_json(indent=1) + "\n").encode()


def _check_inside(folder: Path, file: str, where: str) -> None:
    resolved = (folder / file).resolve()
    if folder.resolve() not in resolved.parents:
        raise BadInputError(where, f"{file!r}, outside the bundle", "a file of the bundle's folder")
    require_file(resolved, f"the file that {where} names")


def _check_same(of_file: Affine, expected: ByteRange, where: str) -> None:
    same_scale = math.isclose(of_file.scale, expected.scale, rel_tol=1e-5)
    if not same_scale or of_file.zero_point != expected.zero_point:
        raise BadInputError(
            where,
            f"scale {of_file.scale:g}, zero point {of_file.zero_point}",
            f"scale {expected.scale:g}, zero point {expected.zero_point} by the manifest",
        )


def _decoded(texture: NDArray[Any], scale: Any, path: Path) -> NDArray[np.float32]:
    if texture.dtype == np.int8:
        factor = _check_scale(scale, path, texture.shape[2])
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


# Smaller levels of a neural texture (H, W, C) are learnt together with the texture. They are sampled where texels are
# smaller than pixels.
#
# Rule: the levels are stored side by side in one array (H/2, W/2 + W/4 + ..., C), each from row 0 on. Therefore all
# levels need only one array, and the width of this array tells the number of levels.


def pack_levels(levels: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return the levels side by side in one array (H/2, W/2 + W/4 + ..., C).

    `levels`: at least one level, (H/2,W/2,C), (H/4,W/4,C), ...
    """
    height = levels[0].shape[0]
    rows = [np.pad(level, ((0, height - level.shape[0]), (0, 0), (0, 0))) for level in levels]
    return np.concatenate(rows, axis=1)


def split_levels(packed: NDArray[Any] | None, width: int) -> list[NDArray[Any]]:
    """Return the levels in `packed`, largest first; an empty list if `packed` is None.

    `packed`: array from `pack_levels`, or None.
    `width`: width of the whole texture in texels.
    """
    levels: list[NDArray[Any]] = []
    left = 0
    while packed is not None and left < packed.shape[1]:
        shift = len(levels)
        side, height = width >> (shift + 1), packed.shape[0] >> shift
        levels.append(np.ascontiguousarray(packed[:height, left : left + side]))
        left += side
    return levels


def check_levels(packed: NDArray[Any], texture: NDArray[Any], where: object) -> None:
    """Raise BadInputError unless `packed` has a shape for levels of `texture` (H,W,C), and the same dtype.

    H and W must be multiples of 2 ** MOST_TEXTURE_LEVELS.

    `packed`: array from `pack_levels`.
    `where`: file that the error names.
    """
    height, width, channels = texture.shape
    widths = [sum(width >> (k + 1) for k in range(count)) for count in range(1, MOST_TEXTURE_LEVELS + 1)]
    fits = packed.ndim == 3 and packed.shape[::2] == (height // 2, channels) and packed.shape[1] in widths
    step = 1 << MOST_TEXTURE_LEVELS
    if not fits or packed.dtype != texture.dtype or height % step or width % step:
        found = f"levels of shape {packed.shape}, {packed.dtype}"
        expected = (
            f"({height // 2}, {widths[0]} to {widths[-1]}, {channels}), {texture.dtype}: 1 to {len(widths)} levels"
        )
        raise BadInputError(where, found, expected)  # type: ignore[arg-type]


# Offsets of a body's vertices, from the skin to the clothes or the hair, as a file of a bundle.
#
# Rule: there is one offset for each vertex; each is finite and at most `LONGEST_M` long. Offsets are stored in float16,
# which is exact to 16 micrometres at 5 cm.

OFFSETS_KEY = "offsets"
OFFSETS_EXPECTED = "offsets of a body's vertices at rest (.npz)"
#: Greatest length of an offset in metres; a point farther from the skin is no part of a body's surface.
LONGEST_M = 0.5


def as_kept(offsets: F32) -> F32:
    """Return `offsets` (V,3), in metres, rounded as a file stores them."""
    return offsets.astype(np.float16).astype(np.float32)


def save_offsets(file: Path | BinaryIO, offsets: F32) -> None:
    """Write `offsets` (V,3), in metres, to an .npz file."""
    np.savez_compressed(file, offsets=offsets.astype(np.float16))


def read_offsets(path: Path, vertices: int) -> F32:
    """Return the offsets (V,3), in metres, in an .npz file. Raises BadInputError.

    `vertices`: number V of the body's vertices.
    """
    array = read_npz(path, (OFFSETS_KEY,), OFFSETS_EXPECTED).get(OFFSETS_KEY)
    if array is None:
        raise BadInputError(path, f"no array {OFFSETS_KEY!r}", OFFSETS_EXPECTED)
    where = f"{path}[{OFFSETS_KEY}]"
    if array.shape != (vertices, 3) or array.dtype.kind != "f":
        raise BadInputError(
            where, f"{array.dtype} of shape {array.shape}", f"floating-point numbers of shape ({vertices}, 3)"
        )
    with np.errstate(over="ignore"):
        offsets: F32 = array.astype(np.float32)
        lengths = np.linalg.norm(offsets, axis=1)
    if not (lengths <= LONGEST_M).all():  # `not` includes NaN, which no comparison holds for
        raise BadInputError(where, "offsets that are not finite or too long", f"at most {LONGEST_M} m")
    offsets.flags.writeable = False
    return offsets
