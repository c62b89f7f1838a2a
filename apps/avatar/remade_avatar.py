"""Makes a scene's avatar again for a run, with another calibration, width or number of channels of its network.

Rule: a new calibration quantises the avatar's own float network, so its pictures are valid. A network of another width
or number of channels is untrained: only its times are valid, and its manifest says so. The result is cached under a
digest of all its inputs.
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

from trilane.arrays import F32
from trilane.avatars.bundle import MANIFEST, TEXTURE_KEYS, Bundle, load_bundle, write_bundle
from trilane.avatars.manifest import UNTRAINED, Manifest, digests_of, network_entry, sha256_of
from trilane.avatars.network_file import NetworkFile, reshaped
from trilane.bench.lib.full_network import float_weights, weights_name
from trilane.cache import cache_dir
from trilane.errors import BadInputError, MissingPartError, TrilaneError
from trilane.files import read_npz
from trilane.stages.avatar_assets import distinct, with_network
from trilane.stages.configure import Checked
from trilane.stages.run_options import METHOD, VIEWS, RunOptions, calibration_of

if TYPE_CHECKING:
    from trilane.training.quantising.quantise import Quantised

#: Of an untrained network's weights.
SEED = 0
#: Grows when this file makes another avatar of the same.
VERSION = 2


@dataclass(frozen=True)
class _Recipe:
    """The differences of the new avatar. `trained`: whether width and channels are the avatar's own."""

    width: int
    channels: int
    trained: bool
    method: str | None
    views: int

    def __str__(self) -> str:
        calibrated = "" if self.method is None else f"{self.method} on {self.views} view{'s' * (self.views > 1)}"
        return calibrated if self.trained else f"width {self.width}, {self.channels} channels, untrained; {calibrated}"


def remade_avatar(name: str, options: RunOptions) -> tuple[Path, str]:
    """Make avatar `name` again with the network that `options` ask for, or find it in the cache.

    Returns its folder and a sentence about it.

    Raises BadInputError for an avatar whose float network is needed and not here, MissingPartError without PyTorch,
    TrilaneError where nothing can be kept.
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
    method, views = asked or ((None, 0) if trained else (METHOD, VIEWS))
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
    """Wait until no other process makes the same avatar, and keep others from it meanwhile."""
    try:
        file = lock.open("w+")  # "w" alone would wait on a pipe
    except OSError as error:
        raise BadInputError.of_os_error(lock, error, "a cache that can be written") from error
    with file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _make(bundle: Bundle, recipe: _Recipe, folder: Path) -> None:
    from trilane.avatars.network_file import reshaped

    chosen = np.arange(recipe.channels) % bundle.manifest.network.channels
    quantised = _quantised(bundle, recipe, chosen)
    network = reshaped(quantised.network, *bundle.read_network().shape[1:3])
    arrays = read_npz(bundle.texture_path, TEXTURE_KEYS, "a neural texture")
    texture, scale = arrays["texture"][..., chosen], arrays.get("scale")
    if scale is not None and scale.ndim:
        scale = scale[chosen]
    manifest, offsets = _manifest(bundle, recipe, network, quantised), bundle.read_body().offsets
    levels = arrays["levels"][..., chosen] if "levels" in arrays else None
    meshes = bundle.read_mesh_levels(bundle.shaped_body())
    write_bundle(folder, manifest, bundle.body_path, texture, network, scale, offsets, levels, meshes)


def _manifest(bundle: Bundle, recipe: _Recipe, network: Any, quantised: Quantised) -> Manifest:
    own, weights = bundle.manifest, float_weights(bundle)
    facts, provenance = dict(quantised.facts), {**own.provenance, "made_from": own.name}
    if recipe.trained and weights is not None:
        facts["float_network"] = weights_name(weights)
    if not recipe.trained:
        provenance = {"weights": UNTRAINED, "made_from": own.name}
    changed = {
        "name": f"{own.name}, {recipe}"[:100],
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
    frames: list[F32] = training_views(open_renderer(bundle, 1), bundle, recipe.views)
    return quantise(model, [np.ascontiguousarray(frame[..., chosen]) for frame in frames], recipe.method or METHOD)


def _float_model(bundle: Bundle, recipe: _Recipe) -> onnx.ModelProto:
    """Return the network that is quantised: the avatar's own, or an untrained one."""
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
    """Return the file of the float network of `bundle`. Raises BadInputError without one."""
    weights = float_weights(bundle)
    if weights is None:
        remedy = "`trilane avatar validate --float-network` notes which it is"
        raise BadInputError(bundle.folder, "no float network that its manifest names", "one to quantise", remedy)
    return weights


#: The name for the network of the avatar's own file.
AS_IT_IS = "as-it-is"
#: Number of views that networks are calibrated on that are compared with each other.
COMPARED_VIEWS = 50


class Calibrations:
    """The network of the first avatar of `checked` by several methods of calibration, each made once.

    It is quantised from the avatar's own float network, on views drawn as in the training. Nothing else changes.
    """

    def __init__(self, checked: Checked) -> None:
        self._folder = distinct(checked.config)[0]
        self._material: tuple[onnx.ModelProto, list[F32]] | None = None
        self._made: dict[str, NetworkFile] = {}

    def changed(self, checked: Checked, method: str) -> Checked:
        """Return `checked` with the network by `method`, which is `AS_IT_IS` or a name of METHODS.

        Raises BadInputError without the float network, MissingPartError without PyTorch.
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
    """Return the float network of `avatar`, and inputs (H,W,C): `views` of the training's kind, then `held_out` others.

    Raises BadInputError for an avatar without a float network here, MissingPartError without PyTorch or OpenGL.
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
