"""A scene's avatar with its network quantised again by another method of calibration; nothing else changes.

Rule: the network is quantised from the avatar's own float network, on views drawn as in the training. If a part is
missing, the request is refused; nothing replaces it.
"""

from __future__ import annotations

from dataclasses import replace

import onnx

from trilane.arrays import F32
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import NetworkFile, reshaped
from trilane.bench.lib.full_picture import float_weights
from trilane.errors import BadInputError, MissingPartError
from trilane.stages.avatar_assets import distinct, with_network
from trilane.stages.configure import Checked

#: The name for the network of the avatar's own file.
AS_IT_IS = "as-it-is"
#: Number of views that a network is calibrated on.
VIEWS = 50


class Calibrations:
    """Networks of the avatars of `checked`, made once each."""

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
                self._material = drawn_material(str(self._folder), VIEWS, 0)
            model, frames = self._material
            shape = load_bundle(str(self._folder)).read_network().shape[1:3]
            self._made[method] = reshaped(quantise(model, frames, method).network, *shape)
        return self._made[method]


def drawn_material(avatar: str, views: int, held_out: int) -> tuple[onnx.ModelProto, list[F32]]:
    """Return the float network of `avatar`, and inputs (H,W,C): `views` of the training's kind, then `held_out` others.

    Raises BadInputError for an avatar without a float network here, MissingPartError without PyTorch or OpenGL.
    """
    bundle = load_bundle(avatar)
    weights = float_weights(bundle)
    if weights is None:
        remedy = "`trilane avatar validate --float-network` notes which it is"
        raise BadInputError(bundle.folder, "no float network that its manifest names", "one to quantise", remedy)
    try:
        from trilane.training.make_bundle import float_model, held_out_views, training_views
    except ImportError as error:
        raise MissingPartError(f"quantising an avatar again needs {error.name}", extra="train") from None
    from trilane.training.validate import open_renderer

    renderer = open_renderer(bundle, 1)
    frames = training_views(renderer, bundle, views) + held_out_views(renderer, bundle, held_out)
    return float_model(bundle, weights), frames
