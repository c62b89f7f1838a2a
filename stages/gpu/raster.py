"""The raster stage: from a pose packet to the network's input tensor.

Rule: the tensor is written straight into the output slot; a frame with nothing to show costs one fill.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import Shape
from trilane.body.body import ShapedBody
from trilane.errors import TrilaneError
from trilane.pipeline.stage import UnitContext
from trilane.scene.crop import Rect, crop_projection
from trilane.stages.avatar_assets import bodies_drawn, distinct, levels_of, quantisation_of, texture_of
from trilane.stages.config import MAX_CHANNELS, RunConfig, network_parts, posed_vertices
from trilane.stages.gpu.opengl import CONTEXT, checked, counter_of, describe, open_context
from trilane.stages.gpu.packed_pass import PackedAvatar, PackedPass, Placement
from trilane.stages.gpu.skinned_mesh import Mesh, PosedMesh, SkinnedMesh, avatar_mesh
from trilane.transport.packets import Packet


class RasterStage:
    """The raster stage.

    `passes`: draws the tensors of each network. `avatars[i]`: draws the scene's avatar i. `shapes`: tensor shapes
    (height, width) that may come. `posed_vertices`: number of skinned vertices of each avatar in the input slot; empty
    when the GPU skins. `painters`: network of each avatar; empty where one paints all.
    """

    def __init__(
        self,
        passes: Sequence[PackedPass],
        avatars: Sequence[PackedAvatar],
        shapes: Sequence[Shape],
        posed_vertices: Sequence[int] = (),
        painters: Sequence[int] = (),
    ) -> None:
        self._passes, self._avatars, self._shapes, self._counts = passes, avatars, shapes, posed_vertices
        self._ctx, self._painters = passes[0].ctx, painters or [0] * len(avatars)
        self._vertices: list[list[NDArray[np.float32]]] = []
        self._inputs: Sequence[Packet] = ()
        self._outputs: Sequence[Packet] = ()

    def bind(self, inputs: Sequence[Packet], outputs: Sequence[Packet]) -> None:
        """Keep the slots and make a target for every tensor shape."""
        self._inputs, self._outputs = inputs, outputs
        self._vertices = [posed_vertices(packet.payload, self._counts) for packet in inputs]
        for packed, shape in product(self._passes, self._shapes):
            packed.target(shape)

    def run(self, frame: int, slot_in: int | None, slot_out: int | None) -> Mapping[str, float]:
        """Write the tensor of frame `frame`, (h,w,C) uint8, of each network that paints somebody in view.

        Figures: the bytes moved. The least bytes: for each avatar in view the pose that its mesh takes, and the
        tensors.

        Raises TrilaneError when a joint is not a finite number, UnitLostError with the context.
        """
        if slot_in is None or slot_out is None:
            raise ValueError("raster needs an input and an output slot")
        pose, moved = self._inputs[slot_in].header, counter_of(self._ctx)
        moved.start(pose.nbytes)
        shape = (int(pose["tensor_shape"][0]), int(pose["tensor_shape"][1]))
        visible = [a for a in pose["avatars"][: int(pose["avatar_count"])] if a["visible"]]
        _refuse_nan(frame, visible)
        skinned = self._vertices[slot_in]
        parts = network_parts(self._outputs[slot_out].payload, len(self._passes), self._shapes, MAX_CHANNELS)
        for network, (packed, part) in enumerate(zip(self._passes, parts, strict=True)):
            tensor = part[: math.prod(shape) * packed.channels]
            own = [avatar for avatar in visible if self._painters[int(avatar["avatar"])] == network]
            moved.written += tensor.nbytes
            if not own:
                packed.background(tensor)
                continue
            with checked(self._ctx):
                target = packed.begin(shape)
                for avatar in own:
                    number = int(avatar["avatar"])
                    placement = _placement(pose, avatar, skinned[number] if skinned else None)
                    self._avatars[number].draw(target, pose["view"], placement)
                    moved.least += self._avatars[number].meshes[placement.mesh].pose_bytes
                packed.read_into(shape, tensor)
            moved.least += tensor.nbytes
        return moved.figures()

    def close(self) -> None:
        """Let go of the slots; the context goes with the process."""
        self._vertices = []


def _placement(pose: NDArray[np.void], avatar: Any, vertices: NDArray[np.float32] | None) -> Placement:
    top, left, height, width = (int(side) for side in avatar["tensor_rect"])
    return Placement(
        joints=avatar["joints"],
        clip_projection=crop_projection(pose["projection"], Rect(*map(float, avatar["rect"]))),
        rect=(top, left, height, width),
        feature=avatar["pose_feature"],
        vertices=vertices,
        mesh=int(avatar["mesh"]),
    )


def _refuse_nan(frame: int, avatars: Sequence[Any]) -> None:
    for avatar in avatars:
        if not np.isfinite(avatar["joints"]).all():
            raise TrilaneError(f"frame {frame}: avatar {int(avatar['avatar'])} has a joint that is not a finite number")


def build(settings: Mapping[str, Any], unit: UnitContext) -> RasterStage:
    """Build the raster stage of the configuration in `settings`. Raises BadInputError, MissingPartError.

    The driver's kind only decides how the packed pass is drawn.
    """
    config = RunConfig.model_validate(settings["config"])
    ctx = unit.shared(CONTEXT, lambda: open_context(unit.settings.threads))
    folders, filtering = distinct(config), config.scene.texture_filter
    textures = [texture_of(unit.assets, number) for number in range(len(folders))]
    driver = describe(ctx)
    if driver.hardware:
        unit.use_device(driver.renderer)
    levels = [levels_of(unit.assets, number) for number in range(len(folders))]
    deferred = filtering == "linear" and not driver.hardware and all(each is None for each in levels)
    passes: dict[int, PackedPass] = {}
    drawn = {}
    for number, (folder, texture) in enumerate(zip(folders, textures, strict=True)):
        network = config.network_of(config.avatar_dirs.index(folder))
        if network not in passes:
            encoding = quantisation_of(unit.assets, number)
            passes[network] = PackedPass(ctx, texture.shape[2], encoding, deferred, filtering)
        whole, *coarser = _meshes(ctx, bodies_drawn(config, unit.assets, number), config)
        drawn[folder] = PackedAvatar(passes[network], whole, texture, levels[number], coarser)
    avatars = [drawn[folder] for folder in config.avatar_dirs]
    in_order = [passes[network] for network in sorted(passes)]
    return RasterStage(in_order, avatars, config.buckets, config.posed_vertices, config.networks)


def _meshes(ctx: Any, bodies: Sequence[ShapedBody], config: RunConfig) -> list[Mesh]:
    """Return the meshes of a whole body and of its levels. A level of a mesh that encloses a volume does so too.

    Where a level folds over itself, the triangles that face away lie behind others, so it is drawn without them.
    """
    whole, *coarser = (avatar_mesh(body) for body in bodies)
    arrays = [whole, *(replace(level, closed=whole.closed) for level in coarser)]
    if config.posed_vertices:
        return [PosedMesh(ctx, one) for one in arrays]
    return [SkinnedMesh(ctx, one, body.body.posedirs) for one, body in zip(arrays, bodies, strict=True)]
