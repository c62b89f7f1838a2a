"""Reports facts about an avatar's files, makes a new avatar with replaced files, and makes a variant for a run.

Rule: every fact about an avatar comes from its own files or its manifest. When a file is replaced, the new manifest
omits what the old manifest said about the old file. The validation stays only if no validated file has changed.

`remade_avatar` makes a variant with another calibration, width or number of channels of the network. A new calibration
quantises the avatar's own float network, so the pictures of the variant are valid. A network of another width or number
of channels is untrained: only its times are valid, and its manifest says so. A variant is cached under a digest of all
its inputs.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnx
from numpy.typing import NDArray

from trilane.arrays import BUCKET_STEP, F32
from trilane.avatars.bundle import (
    MANIFEST,
    TEXTURE_KEYS,
    Bundle,
    add_mesh_levels,
    load_bundle,
    read_texture,
    require_writable_manifest,
    write_bundle,
)
from trilane.avatars.manifest import CAPTURED, UNTRAINED, Manifest, digests_of, network_entry, sha256_of
from trilane.avatars.mesh_levels import MeshLevel
from trilane.avatars.network_file import NetworkFile, check_integer_layers, read_network, reshaped
from trilane.avatars.validation import refused, validation_facts
from trilane.bench.lib.full_picture import float_weights, weights_name
from trilane.body.body import Body, load_body
from trilane.cache import cache_dir
from trilane.errors import BadInputError, MissingPartError, TrilaneError
from trilane.files import read_npz
from trilane.hw_profiles.network_work import graph_facts
from trilane.stages.avatar_assets import distinct, with_network
from trilane.stages.configure import Checked
from trilane.stages.run_options import AS_IT_IS, VIEWS, RunOptions, calibration_of
from trilane.training.clothing import KEY as LOOK
from trilane.units import CALIBRATION_METHOD, CHANNELS, either

if TYPE_CHECKING:
    from trilane.training.quantising.quantise import Quantised

#: Encoder and norm in the manifest if the operators of a new network differ from those in the replaced network.
OTHER = "other"
#: Scale of a network's output, with zero point 0: the bytes of the picture represent alpha and colour in 0..1.
PICTURE_SCALE = 1 / 255
MAX_WIDTH = 256
NAME_LENGTH = 100


def bundle_facts(bundle: Bundle) -> dict[str, Any]:
    """Return facts about the avatar `bundle`: entries of the manifest, sizes of the files, facts about the network.

    Keys: `name`, `folder`, `files`, `body`, `texture`, `network`, `quantisation`, `provenance`, `training_command`,
    `validation`.
    Raises BadInputError for a file that is missing or wrong.
    """
    manifest = bundle.manifest
    shaped = bundle.shaped_body()
    files = {"body": bundle.body_path, "texture": bundle.texture_path, "network": bundle.network_path}
    files |= {"offsets": bundle.offsets_path} if bundle.offsets_path is not None else {}
    levels, texture = bundle.read_mesh_levels(shaped), bundle.read_texture()
    return {
        "name": manifest.name,
        "folder": str(bundle.folder),
        "files": {key: {"name": path.name, "bytes": path.stat().st_size} for key, path in files.items()},
        "body": {
            "vertices": len(shaped.vertices),
            "triangles": len(shaped.body.faces),
            "levels": [level_facts(level, len(texture)) for level in levels],
        },
        "texture": {"shape": list(texture.shape)},
        "network": {**manifest.network.model_dump(), **network_facts(bundle.read_network())},
        "quantisation": manifest.quantisation,
        "provenance": manifest.provenance,
        "training_command": manifest.training_command,
        "validation": validation_facts(bundle),
    }


def level_facts(level: MeshLevel, side: int) -> dict[str, Any]:
    """Return facts about a coarser level of the mesh.

    `level`: the coarser level.
    `side`: side of the texture, in texels.

    Keys:
    `triangles`: number of triangles.
    `vertices`: number of vertices.
    `rest_mm`: largest distance at rest from the surface of the level to the surface of the whole mesh.
    `seam_texels`: largest distance between the seams of the level and of the whole mesh, in texels.
    """
    return {
        "triangles": len(level.faces),
        "vertices": len(np.unique(level.faces)),
        "rest_mm": round(1000 * float(level.rest.max()), 2),
        "seam_texels": round(level.uv_error * side, 2),
    }


def add_levels(bundle: Bundle) -> dict[str, Any]:
    """Make coarser levels of the mesh of `bundle`, write them into the avatar's folder, and return facts about them.

    Keys:
    `avatar`: path of the folder.
    `triangles`: number of triangles of the whole mesh.
    `levels`: list with the `level_facts` of each level.

    Raises BadInputError for a file that is wrong or cannot be written, MissingPartError without meshoptimizer.
    """
    from trilane.training.mesh_levels import make_mesh_levels

    require_writable_manifest(bundle.folder)
    shaped, side = bundle.shaped_body(), len(bundle.read_texture())
    levels = list(make_mesh_levels(shaped))
    add_mesh_levels(bundle, levels)
    facts = [level_facts(level, side) for level in levels]
    return {"avatar": str(bundle.folder), "triangles": len(shaped.body.faces), "levels": facts}


def network_facts(network: NetworkFile) -> dict[str, Any]:
    """Return facts about `network`: `shape` (N, H, W, C), `sha256`, and the keys of `graph_facts`.

    Raises BadInputError for a network whose work cannot be counted.
    """
    try:
        work = graph_facts(network.model)
    except BadInputError as error:
        raise BadInputError(f"{network.where}, {error.where}", error.found, error.expected, error.remedy) from None
    return {"shape": list(network.shape), "sha256": network.digest, **work}


@dataclass(frozen=True)
class Parts:
    """Files that replace an avatar's own files. None keeps the avatar's own file."""

    network: Path | None = None
    texture: Path | None = None
    body: Path | None = None

    def files(self) -> dict[str, Path]:
        """Return the replacing files by key: `network`, `texture`, `body`. A file that is not replaced has no key."""
        return {key: file for key, file in vars(self).items() if file is not None}


def assemble(base: Bundle, parts: Parts, out: Path) -> dict[str, Any]:
    """Write a new avatar to the folder `out`, and return facts about it.

    `base`: avatar that gives all other files.
    `parts`: files that replace files of `base`.

    Keys: `avatar`, `made_from`, `replaced`, `network`, `texture`, `accuracy`.
    Before anything is written, raises BadInputError for no part, for a part that does not fit, and for an `out` that
    exists and is no empty folder.
    """
    if not parts.files():
        raise BadInputError("avatar create", "no part", "--network, --texture or --body, at least one of them")
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise BadInputError(out, "files" if out.is_dir() else "a file", "a folder that is not there yet")
    network = base.read_network() if parts.network is None else _drawable(read_network(parts.network))
    source = parts.texture or base.texture_path
    texture = _texture(source, network, parts)
    body = parts.body or base.body_path
    if parts.body is not None:
        _check_body(base, load_body(parts.body), parts)
    offsets = base.read_body().offsets if parts.body is None else None
    arrays = read_npz(source, TEXTURE_KEYS, "a neural texture")
    manifest, scale = _manifest(base, parts, network, out.name), arrays.get("scale")
    levels = base.read_mesh_levels(base.shaped_body()) if parts.body is None else ()
    write_bundle(out, manifest, body, arrays["texture"], network, scale, offsets, arrays.get("levels"), levels)
    made = load_bundle(out)
    return {
        "avatar": str(out),
        "made_from": base.manifest.name,
        "replaced": {key: str(file) for key, file in parts.files().items()},
        "network": made.manifest.network.model_dump() | {"shapes": _shapes(network)},
        "texture": {"shape": list(texture.shape), "clipped": _clipped(texture, network)},
        "accuracy": refused(made).get("why", "validated, and unchanged since"),
    }


def _drawable(network: NetworkFile) -> NetworkFile:
    """Return `network` unchanged if the GPU can fill its input, and its output is a picture.

    Raises BadInputError for any other network.
    """
    check_integer_layers(network)
    if network.channels not in CHANNELS:
        expected = f"{either(CHANNELS)}, which the GPU packs"
        raise BadInputError(network.where, f"an input of {network.channels} channels", expected, "pad with zeros")
    output = network.output
    if output.zero_point != 0 or not np.isclose(output.scale, PICTURE_SCALE, rtol=1e-5):
        found = f"an output with scale {output.scale:g}, zero point {output.zero_point}"
        expected = "scale 1/255, zero point 0: the bytes are shown as they are"
        raise BadInputError(network.where, found, expected, "end it with a Sigmoid: trilane avatar quantise")
    return network


def _texture(source: Path, network: NetworkFile, parts: Parts) -> NDArray[np.float32]:
    """Return the neural texture of the file `source`, (H, W, C) float32.

    `network`: network that reads the texture.
    `parts`: replacing files; errors name the options that give them.
    Raises BadInputError for a wrong file, or if texture and network differ in the number of channels.
    """
    arrays = read_npz(source, TEXTURE_KEYS, "a neural texture")
    shape = arrays["texture"].shape if "texture" in arrays else ()
    if len(shape) == 3 and shape[2] != network.channels:
        ends = [(network.where, network.channels, "network"), (str(source), shape[2], "texture")]
        (where, found, what), (beside, expected, other) = ends if parts.network is not None else ends[::-1]
        remedy = f"give a --{other} of {found} channels as well, or another --{what}"
        raise BadInputError(where, f"{found} channels", f"{expected}, as {beside} has", remedy)
    return read_texture(source, network.channels)


def _check_body(base: Bundle, body: Body, parts: Parts) -> None:
    """Raise BadInputError if `body` has another UV layout than the body of `base`, and `parts` has no new texture."""
    own = load_body(base.body_path)
    pairs = ((own.uv, body.uv), (own.uv_faces, body.uv_faces))
    same = all(one.shape == other.shape and np.allclose(one, other, atol=1e-6) for one, other in pairs)
    if not same and parts.texture is None:
        expected = f"that of {base.body_path}, which the texture is laid out for"
        raise BadInputError(str(parts.body), "another UV layout", expected, "give its --texture as well")


def _manifest(base: Bundle, parts: Parts, network: NetworkFile, name: str) -> Manifest:
    own = base.manifest
    entry, quantisation = own.network.model_copy(update={"file": "network.onnx"}), own.quantisation
    if parts.network is not None and network.digest != base.read_network().digest:
        entry, quantisation = network_entry(network, *_kind(base, network)), {}
    coefficients = {} if parts.body is None else {"betas": (), "expression": ()}
    changed = {
        "name": name[:NAME_LENGTH],
        "body": "body.npz",
        "texture": "texture.npz",
        "network": entry,
        "provenance": _provenance(own, parts),
        "training_command": "",
        "quantisation": quantisation,
        **coefficients,
    }
    return own.model_copy(update=changed)


def _provenance(own: Manifest, parts: Parts) -> dict[str, Any]:
    """Return the provenance for the manifest of a new avatar.

    Its key `base` has the whole provenance of the old avatar. The entries about the body also stay at the top if the
    body is not replaced. The entry about the weights stays if the network is not replaced.
    `own`: manifest of the old avatar.
    `parts`: files that replace files of the old avatar.
    """
    stays = {"body": (parts.body, CAPTURED), "weights": (parts.network, UNTRAINED)}
    kept = {key: word for key, (part, word) in stays.items() if part is None and own.provenance.get(key) == word}
    kept |= {LOOK: own.provenance[LOOK]} if parts.body is None and LOOK in own.provenance else {}
    files = {key: file.name for key, file in parts.files().items()}
    return kept | {"made_from": own.name, "replaced": files, "base": own.provenance}


def _kind(base: Bundle, network: NetworkFile) -> tuple[str, str, int]:
    """Return the encoder, norm and width of `network`. The width is the number of channels of the first convolution.

    A network with the operators of the network of `base` gets its encoder and norm. Otherwise, both are `OTHER`.
    """
    own = base.manifest.network
    before, now = ([node.op_type for node in each.model.graph.node] for each in (base.read_network(), network))
    names = (own.encoder, own.norm) if before == now else (OTHER, OTHER)
    return *names, _width(network.model)


def _width(model: onnx.ModelProto) -> int:
    """Return the number of output channels of the first convolution in `model`, at most MAX_WIDTH.

    The result is 1 without a convolution, or if its weights are not found.
    """
    weights = {tensor.name: tensor.dims[0] for tensor in model.graph.initializer if len(tensor.dims) == 4}
    makers = {name: node for node in model.graph.node for name in node.output}
    for node in model.graph.node:
        if node.op_type == "Conv":
            source = node.input[1]
            while source not in weights and source in makers:
                source = makers[source].input[0]
            return int(min(weights.get(source, 1), MAX_WIDTH))
    return 1


def _shapes(network: NetworkFile) -> str:
    """Return a phrase on the tensor shapes at which the network can run."""
    _, height, width, _ = network.shape
    try:
        reshaped(network, BUCKET_STEP * 3, BUCKET_STEP * 5)
    except BadInputError:
        return f"{height}x{width} alone: trilane run --size {height}x{width}"
    return f"any with sides in multiples of {BUCKET_STEP}"


def _clipped(texture: NDArray[np.float32], network: NetworkFile) -> float:
    """Return the share of the texture's values beyond the range of the network's input bytes, from 0 to 1."""
    scale, zero = network.input.scale, network.input.zero_point
    low, high = (-zero - 0.5) * scale, (255 - zero + 0.5) * scale
    return float(((texture < low) | (texture > high)).mean())


#: Seed of an untrained network's weights.
SEED = 0
#: Part of a cached variant's digest. Raise it if a change of this module changes the files of a variant.
VERSION = 2


@dataclass(frozen=True)
class _Recipe:
    """The network of a variant of an avatar.

    `width`: number of channels of the first convolution. `channels`: number of input channels.
    `trained`: whether the avatar's own network has this `width` and these `channels`.
    `method`: method of calibration, None to keep the avatar's network.
    `views`: number of views on which to calibrate.
    """

    width: int
    channels: int
    trained: bool
    method: str | None
    views: int

    def __str__(self) -> str:
        calibrated = "" if self.method is None else f"{self.method} on {self.views} view{'s' * (self.views > 1)}"
        return calibrated if self.trained else f"width {self.width}, {self.channels} channels, untrained; {calibrated}"


def remade_avatar(name: str, options: RunOptions) -> tuple[Path, str]:
    """Return the folder of the variant of an avatar for a run, and a phrase about the variant.

    The variant is made, or found in the cache. If `options` change nothing, the folder is the avatar's own.
    `name`: avatar, by name or folder.
    `options`: options of the run, which may have a width, a number of channels and a calibration.
    Raises BadInputError if the avatar's float network is needed but missing, MissingPartError without PyTorch or
    OpenGL, and TrilaneError if the cache cannot be written.
    """
    bundle = load_bundle(name)
    recipe = _recipe(bundle, options)
    if recipe.trained and recipe.method is None:
        return bundle.folder, "as its files are: it has this width and these channels"
    home = cache_dir("avatars")
    if home is None:
        raise TrilaneError("the cache folder cannot be written: set XDG_CACHE_HOME to one that can")
    folder = home / _digest(bundle, recipe)
    with _alone(home / f"{folder.name}.lock"):
        if not (folder / MANIFEST).exists():
            _make(bundle, recipe, folder)
    what = "" if recipe.trained else "; its times count, its pictures do not"
    return folder, f"made again: {recipe}{what}"


def is_untrained(bundle: Bundle) -> bool:
    return bundle.manifest.provenance.get("weights") == UNTRAINED


def _recipe(bundle: Bundle, options: RunOptions) -> _Recipe:
    own = bundle.manifest.network
    width, channels = options.width or own.width, options.channels or own.channels
    trained = (width, channels) == (own.width, own.channels)
    asked = None if options.calibration is None else calibration_of(options.calibration)
    method, views = asked or ((None, 0) if trained else (CALIBRATION_METHOD, VIEWS))
    return _Recipe(width, channels, trained, method, views)


def _digest(bundle: Bundle, recipe: _Recipe) -> str:
    import onnxruntime

    weights = float_weights(bundle)
    of = {
        "version": VERSION,
        "onnxruntime": onnxruntime.__version__,
        "avatar": digests_of(bundle.folder, bundle.manifest).model_dump(),
        "network": bundle.manifest.network.model_dump(),
        "weights": weights and sha256_of([weights]),
        "recipe": asdict(recipe),
    }
    return hashlib.sha256(json.dumps(of, sort_keys=True).encode()).hexdigest()[:16]


@contextmanager
def _alone(lock: Path) -> Iterator[None]:
    """Hold an exclusive lock on the file `lock` inside the block, so that only one process makes a variant.

    Raises BadInputError if the file cannot be opened.
    """
    try:
        file = lock.open("w+")  # if the path is a named pipe, "w" alone would wait for a reader
    except OSError as error:
        raise BadInputError.of_os_error(lock, error, "a cache that can be written") from error
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _make(bundle: Bundle, recipe: _Recipe, folder: Path) -> None:
    chosen = np.arange(recipe.channels) % bundle.manifest.network.channels
    quantised = _quantised(bundle, recipe, chosen)
    network = reshaped(quantised.network, *bundle.read_network().shape[1:3])
    arrays = read_npz(bundle.texture_path, TEXTURE_KEYS, "a neural texture")
    texture, scale = arrays["texture"][..., chosen], arrays.get("scale")
    if scale is not None and scale.ndim:
        scale = scale[chosen]
    manifest, offsets = _remade_manifest(bundle, recipe, network, quantised), bundle.read_body().offsets
    levels = arrays["levels"][..., chosen] if "levels" in arrays else None
    meshes = bundle.read_mesh_levels(bundle.shaped_body())
    write_bundle(folder, manifest, bundle.body_path, texture, network, scale, offsets, levels, meshes)


def _remade_manifest(bundle: Bundle, recipe: _Recipe, network: Any, quantised: Quantised) -> Manifest:
    own, weights = bundle.manifest, float_weights(bundle)
    facts, provenance = dict(quantised.facts), {**own.provenance, "made_from": own.name}
    if recipe.trained and weights is not None:
        facts["float_network"] = weights_name(weights)
    if not recipe.trained:
        provenance = {"weights": UNTRAINED, "made_from": own.name}
    changed = {
        "name": f"{own.name}, {recipe}"[:NAME_LENGTH],
        "network": network_entry(network, own.network.encoder, own.network.norm, recipe.width),
        "provenance": provenance,
        "quantisation": facts,
        "validation": None,
    }
    return own.model_copy(update=changed)


def _quantised(bundle: Bundle, recipe: _Recipe, chosen: NDArray[np.intp]) -> Quantised:
    try:
        from trilane.training.make_bundle import training_views
        from trilane.training.quantising.quantise import quantise
        from trilane.training.validate import open_renderer
    except ImportError as error:
        raise MissingPartError(f"making an avatar again needs {error.name}", extra="train") from None
    model = _float_model(bundle, recipe)
    views: list[F32] = training_views(open_renderer(bundle, 1), bundle, recipe.views)
    frames = [np.ascontiguousarray(view[..., chosen]) for view in views]
    return quantise(model, frames, recipe.method or CALIBRATION_METHOD)


def _float_model(bundle: Bundle, recipe: _Recipe) -> onnx.ModelProto:
    """Return the network to quantise: the avatar's own float network if `recipe` is trained, else an untrained network.

    Raises BadInputError if the avatar's float network is missing.
    """
    import torch

    from trilane.training.make_bundle import CALIBRATION_SHAPE, float_model
    from trilane.training.network import UNet, export_onnx

    own = bundle.manifest.network
    if not recipe.trained:
        torch.manual_seed(SEED)
        untrained = UNet(own.encoder, own.norm, recipe.width, recipe.channels, input_skip=True)
        return export_onnx(untrained, *CALIBRATION_SHAPE)
    return float_model(bundle, _named_weights(bundle))


def _named_weights(bundle: Bundle) -> Path:
    """Return the file of the float network of `bundle`. Raises BadInputError if the manifest names no such file."""
    weights = float_weights(bundle)
    if weights is None:
        remedy = "`trilane avatar validate --float-network` notes which it is"
        raise BadInputError(bundle.folder, "no float network that its manifest names", "one to quantise", remedy)
    return weights


#: Number of views on which `Calibrations` calibrates.
COMPARED_VIEWS = 50


class Calibrations:
    """Replaces the network of a scene's first avatar by the same network with another calibration.

    Each calibration quantises the avatar's float network once, on views drawn as in training.
    `checked`: checked configuration of a scene.
    """

    def __init__(self, checked: Checked) -> None:
        self._folder = distinct(checked.config)[0]
        self._material: tuple[onnx.ModelProto, list[F32]] | None = None
        self._made: dict[str, NetworkFile] = {}

    def changed(self, checked: Checked, method: str) -> Checked:
        """Return `checked` with the network that `method` calibrates.

        `method`: a name in CALIBRATION_METHODS; `AS_IT_IS` keeps the network.
        Raises BadInputError without the float network, MissingPartError without PyTorch or OpenGL.
        """
        if method == AS_IT_IS:
            return checked
        return replace(checked, assets=with_network(checked.assets, self._network(method)))

    def _network(self, method: str) -> NetworkFile:
        from trilane.training.quantising.quantise import quantise

        if method not in self._made:
            if self._material is None:
                self._material = drawn_material(str(self._folder), COMPARED_VIEWS, 0)
            model, frames = self._material
            shape = load_bundle(str(self._folder)).read_network().shape[1:3]
            self._made[method] = reshaped(quantise(model, frames, method).network, *shape)
        return self._made[method]


def drawn_material(avatar: str, views: int, held_out: int) -> tuple[onnx.ModelProto, list[F32]]:
    """Return the float network of an avatar, and a list of inputs for it, each (H, W, C) float32.

    `avatar`: avatar, by name or folder.
    `views`: number of inputs drawn as in training, first in the list.
    `held_out`: number of inputs from held-out views, last in the list.
    Raises BadInputError if the float network is missing, MissingPartError without PyTorch or OpenGL.
    """
    bundle = load_bundle(avatar)
    weights = _named_weights(bundle)
    try:
        from trilane.training.make_bundle import float_model, held_out_views, training_views
    except ImportError as error:
        raise MissingPartError(f"quantising an avatar again needs {error.name}", extra="train") from None
    from trilane.training.validate import open_renderer

    renderer = open_renderer(bundle, 1)
    frames = training_views(renderer, bundle, views) + held_out_views(renderer, bundle, held_out)
    return float_model(bundle, weights), frames
