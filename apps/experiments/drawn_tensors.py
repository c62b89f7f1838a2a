"""The network's input of any frame of a scene, drawn by the pipeline's own pose and raster stages in this process.

Rule: the stages are those of a run, asked for one frame after the other; what an earlier frame left behind is part of
what they are asked with.
"""

from __future__ import annotations

from trilane.arrays import U8
from trilane.pipeline.stage import UnitContext
from trilane.stages.avatar_assets import network_of
from trilane.stages.avatar_pipeline import edge_bytes
from trilane.stages.config import pose_dtype
from trilane.stages.configure import Checked
from trilane.stages.cpu.pose import build as build_pose
from trilane.stages.gpu.raster import build as build_raster
from trilane.transport.packets import Packet, SlotLayout, view_packet


class DrawnTensors:
    """The two stages of the scene in `checked`, and the slots between them."""

    def __init__(self, checked: Checked) -> None:
        config, assets = checked.config, checked.assets
        sizes, avatars = edge_bytes(config, assets), len(config.avatar_dirs)
        self._posed = _packet(avatars, sizes["pose->raster"])
        self._drawn = _packet(avatars, sizes["raster->infer"])
        settings = {"config": config.model_dump(mode="json")}
        self._pose = build_pose(settings, UnitContext("cpu", config.units["cpu"], assets))
        self._raster = build_raster(settings, UnitContext("gpu", config.units["gpu"], assets))
        self._pose.bind([], [self._posed])
        self._raster.bind([self._posed], [self._drawn])
        self._channels = network_of(assets).channels

    def tensor(self, frame: int) -> U8:
        """(h, w, C) of frame `frame`, valid until the next call; what no avatar of it is seen in has no pixels."""
        self._pose.run(frame, None, 0)
        self._raster.run(frame, 0, 0)
        height, width = self._posed.header["tensor_shape"].tolist()
        tensor: U8 = self._drawn.payload[: height * width * self._channels].reshape(height, width, self._channels)
        return tensor

    @property
    def anybody(self) -> bool:
        """Whether an avatar is seen in the last frame that was asked for."""
        return bool(self._posed.header["avatars"]["visible"].any())


def _packet(avatars: int, payload: int) -> Packet:
    layout = SlotLayout(pose_dtype(avatars), payload)
    return view_packet(memoryview(bytearray(layout.slot_bytes)), layout)
