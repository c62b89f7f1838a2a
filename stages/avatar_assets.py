"""The assets of a run of the avatar: arrays that the parent loads, and that every unit maps.

Rule: files are opened once. An array belongs to what its name begins with: `body0/`, `avatar0/` and `meshes0/` are the
first distinct bundle, `network0/` is the first distinct network, `scene/` is the scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from trilane.arrays import F32, Shape
from trilane.avatars.bundle import Bundle
from trilane.avatars.mesh_levels import MeshLevel, levels_from_arrays, levels_to_arrays
from trilane.avatars.network_file import NetworkFile, check_network, reshaped
from trilane.body.body import Body, ShapedBody
from trilane.errors import BadInputError
from trilane.hw_profiles.network_work import Network, count_work, one_after_the_other
from trilane.pipeline.memory import Assets
from trilane.scene.staging import Staged, staged_from_arrays, staged_to_arrays, with_prefix
from trilane.stages.config import Quantisation, RunConfig

SCENE = "scene/"
HANDS = ("hand_components_left", "hand_components_right")
#: A run draws skin and garments alike, so it does not need `skin`.
BODY_ARRAYS = tuple(field.name for field in fields(Body) if field.name not in ("source", "hand_components", "skin"))


@dataclass(frozen=True)
class AvatarData:
    """The loaded content of one distinct bundle.

    `shaped`: body with the avatar's shape.
    `texture`: neural texture (H,W,C) float32.
    `levels`: smaller levels of the texture, packed by `pack_levels` of avatars/bundle.py; None if it has none.
    `mesh_levels`: levels of the mesh, the finest first.
    """

    bundle: Bundle
    shaped: ShapedBody
    texture: F32
    network: NetworkFile
    levels: F32 | None = None
    mesh_levels: tuple[MeshLevel, ...] = ()


def load_avatar(bundle: Bundle) -> AvatarData:
    """Load the content of `bundle` that a run needs. Raises BadInputError for a file that cannot be read."""
    shaped = bundle.shaped_body()
    texture, network, levels = bundle.read_texture(), bundle.read_network(), bundle.read_levels()
    return AvatarData(bundle, shaped, texture, network, levels, bundle.read_mesh_levels(shaped))


def networks_of_avatars(avatars: Sequence[AvatarData]) -> list[int]:
    """Return, for each of `avatars`, the number of the network that paints it.

    Avatars share a network, and therefore a tensor, if they have equal network files and encodings of the input.
    """
    kinds = [(one.network.digest, one.bundle.manifest.network.input) for one in avatars]
    known = list(dict.fromkeys(kinds))
    return [known.index(kind) for kind in kinds]


def pack_assets(avatars: Sequence[AvatarData], staged: Staged) -> dict[str, NDArray[Any]]:
    """Return all arrays of a run by name. `avatars`: content of each distinct bundle. `staged`: scene of the run."""
    arrays: dict[str, NDArray[Any]] = {}
    for number, avatar in enumerate(avatars):
        body, scale = avatar.shaped.body, avatar.bundle.manifest.network.input
        arrays |= {f"body{number}/vertices": avatar.shaped.vertices, f"body{number}/joints": avatar.shaped.joints}
        arrays |= {f"body{number}/{name}": array for name in BODY_ARRAYS if (array := getattr(body, name)) is not None}
        arrays |= {f"body{number}/{name}": array for name, array in zip(HANDS, body.hand_components, strict=True)}
        arrays[f"avatar{number}/texture"] = avatar.texture
        if avatar.mesh_levels:
            arrays |= {f"meshes{number}/{name}": array for name, array in levels_to_arrays(avatar.mesh_levels).items()}
        if avatar.levels is not None:
            arrays[f"avatar{number}/levels"] = avatar.levels
        arrays[f"avatar{number}/input"] = np.array([scale.scale, scale.zero_point])
    numbers = networks_of_avatars(avatars)
    for number in range(max(numbers) + 1):
        network = avatars[numbers.index(number)].network
        arrays |= {_model(number): _bytes(network), _path(number): np.frombuffer(network.where.encode(), np.uint8)}
    return arrays | {SCENE + name: array for name, array in staged_to_arrays(staged).items()}


def with_network(assets: Assets, network: NetworkFile) -> dict[str, NDArray[Any]]:
    """Return `assets` with `network` as the network of all avatars, and with the scale and zero point of its input.

    Raises BadInputError if the assets have several networks.
    """
    only_network_of(assets)
    encoding = np.array([network.input.scale, network.input.zero_point])
    inputs = {name: encoding for name in assets if name.startswith("avatar") and name.endswith("/input")}
    return {**assets, **inputs, _model(0): _bytes(network)}


def _model(number: int) -> str:
    return f"network{number}/model"


def _path(number: int) -> str:
    return f"network{number}/path"


def _bytes(network: NetworkFile) -> NDArray[np.uint8]:
    return np.frombuffer(network.model.SerializeToString(), np.uint8)


def distinct(config: RunConfig) -> list[Path]:
    """Return the folders of the distinct bundles of `config`, in the order in which assets number them."""
    return list(dict.fromkeys(config.avatar_dirs))


def shaped_body(assets: Assets, number: int) -> ShapedBody:
    """Return the shaped body of the distinct avatar `number`."""
    own = with_prefix(assets, f"body{number}/")
    arrays: dict[str, Any] = {name: own.get(name) for name in BODY_ARRAYS}  # `posedirs` and `offsets` may be None
    hands = (own[HANDS[0]], own[HANDS[1]])
    body = Body(source=f"avatar {number} of the run", hand_components=hands, **arrays)
    return ShapedBody(own["vertices"], own["joints"], body)


def texture_of(assets: Assets, number: int) -> F32:
    """Return the neural texture (H,W,C) of the distinct avatar `number`."""
    return assets[f"avatar{number}/texture"]


def levels_of(assets: Assets, number: int) -> F32 | None:
    """Return the smaller levels of the neural texture of the distinct avatar `number`; None if it has none."""
    return assets.get(f"avatar{number}/levels")


def mesh_levels_of(assets: Assets, number: int) -> tuple[MeshLevel, ...]:
    """Return the levels of the mesh of the distinct avatar `number`, the finest first; empty if it has none."""
    arrays = with_prefix(assets, f"meshes{number}/")
    return levels_from_arrays(arrays) if arrays else ()


def bodies_drawn(config: RunConfig, assets: Assets, number: int) -> list[ShapedBody]:
    """Return the bodies of the distinct avatar `number` that frames may show: the whole body, then its mesh levels.

    If everything is modelled (`RunConfig.budget_px` is 0), there is only the whole body.
    """
    whole = shaped_body(assets, number)
    levels = mesh_levels_of(assets, number) if config.budget_px else ()
    return [whole, *(level.reduced(whole) for level in levels)]


def quantisation_of(assets: Assets, number: int) -> Quantisation:
    """Return scale and zero point of the network's input for the distinct avatar `number`."""
    scale, zero_point = assets[f"avatar{number}/input"].tolist()
    return Quantisation(scale, int(zero_point))


def networks_of(assets: Assets) -> list[NetworkFile]:
    """Return the networks that paint the avatars, by number."""
    numbers = range(sum(name.startswith("network") and name.endswith("/model") for name in assets))
    return [
        check_network(onnx.load_from_string(assets[_model(number)].tobytes()), assets[_path(number)].tobytes().decode())
        for number in numbers
    ]


def painting(networks: Sequence[NetworkFile], shape: Shape, facts: Mapping[str, str]) -> Network:
    """Return all `networks` as one network for predictions, whose input is as high as all their tensors together.

    `shape`: (height, width) of each network's tensor. `facts`: keys that identify the network in reports.
    """
    work = one_after_the_other([count_work(reshaped(network, *shape).model) for network in networks])
    channels = max(network.channels for network in networks)
    return Network(facts, shape[0] * len(networks), shape[1], channels, "packed", work)


def only_network_of(assets: Assets) -> NetworkFile:
    """Return the network that all avatars share. Raises BadInputError if there are several networks."""
    first, *others = networks_of(assets)
    if others:
        raise BadInputError(
            others[0].where,
            f"one of {len(others) + 1} networks in the scene",
            "a scene whose avatars share one network, for what this command computes",
            "name one avatar twice, or take a scene with one of them",
        )
    return first


def staged_of(assets: Assets) -> Staged:
    """Return the scene's movers and camera."""
    return staged_from_arrays(with_prefix(assets, SCENE))
