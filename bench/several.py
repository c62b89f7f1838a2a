"""How much does an avatar's picture change if other avatars share its tensor, by the margin between them?

Rule: each avatar is drawn twice in the same cell of the tensor, with and without its neighbours. Nothing else differs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import U8, Shape, shape_buckets
from trilane.avatars.bundle import CLOTHES_STANDOFF_M, load_bundle
from trilane.avatars.network_file import reshaped
from trilane.bench.lib.fixture import ground_truth, load_drawable
from trilane.body.joints import Skeleton
from trilane.errors import BadInputError
from trilane.scene.crop import MARGIN_PX, TensorLayout, crop_projection, lay_out
from trilane.scene.schema import AvatarSpec, CameraSpec, Scene
from trilane.scene.staging import stage_scene
from trilane.stages.cpu.mesh_bounds import MeshBounds
from trilane.stages.dsp.runtime import Binding, RuntimeOptions, load_runtime
from trilane.stages.gpu.raster import PackedAvatar, PackedPass, Placement
from trilane.stages.gpu.skinned_mesh import SkinnedMesh
from trilane.unexpected_value import UnexpectedValue
from trilane.units import MEASURED

BOUND_DB = 0.5
OUTPUT = (480, 640)
MOST_AVATARS = 7  # more are never in view together
MOST_MARGIN = 128
#: Distance between neighbours, and how far every second avatar stands back, metres.
STEP_M, BACK_M = 0.8, 0.7
SECONDS = 10.0


@dataclass(frozen=True)
class _View:
    """The avatars and the camera at one moment of the scene.

    `joints`: skinning matrices (55,3,4) of each avatar.
    `view`, `projection`: matrices (4,4) of the camera.
    `layout`: shape of the tensor, with the crop rectangle and the cell of each avatar.
    """

    joints: tuple[NDArray[np.float32], ...]
    view: NDArray[np.float64]
    projection: NDArray[np.float64]
    layout: TensorLayout


def measure(
    avatars: int = 3, views: int = 12, size: str = "512", margins: tuple[int, ...] = (0, 4, 8, MARGIN_PX, 24, 32)
) -> dict[str, Any]:
    """Compare pictures of the default avatar with ground truth, with and without neighbours in its tensor.

    The tensor has `avatars` copies of the avatar. The copies are drawn at `views` moments of a scene.

    `rows` has a row for each margin:
    `margin`: pixels of the tensor between two avatars.
    `loss_db_median`, `loss_db_worst`: PSNR without neighbours minus PSNR with neighbours, in dB.
    `psnr_db_alone`: median PSNR without neighbours.
    `bytes_mean`, `bytes_max`: mean and largest difference of byte values between both pictures of an avatar's cell.
    `cell_height`: median height of a cell in tensor pixels.

    Further keys:
    `bound_db`: largest acceptable loss of PSNR, in dB.
    `margin_px`: margin of a run.
    `sources`: source of the rows.
    `config`: settings of the bench.

    Raises BadInputError for an option out of range, and if no moment has all avatars in view. Raises MissingPartError
    if a library is not installed.
    """
    _check(avatars, views, size, margins)
    fixture = _CrowdFixture()
    rows = []
    for margin in margins:
        seen = _views(fixture, avatars, views, size, margin)
        found = [row for view in seen for row in fixture.compare(view)]
        if not found:
            where = f"--avatars {avatars}, --views {views}"
            raise BadInputError(where, "no moment with all avatars in view", "at least one", "try more --views")
        figures = np.array(found)
        together, isolated, mean, most, height = figures.T
        loss = isolated - together
        rows.append(
            {
                "margin": margin,
                "loss_db_median": float(np.median(loss)),
                "loss_db_worst": float(loss.max()),
                "psnr_db_alone": float(np.median(isolated)),
                "bytes_mean": float(mean.mean()),
                "bytes_max": int(most.max()),
                "cell_height": float(np.median(height)),
            }
        )
    config = {"avatars": avatars, "views": views, "size": size, "output": list(OUTPUT)}
    sources = {"rows": MEASURED}
    return {"rows": rows, "sources": sources, "bound_db": BOUND_DB, "margin_px": MARGIN_PX, "config": config}


class _CrowdFixture:
    """The default avatar on the GPU, with its network and its ground truth; `packed` draws it into a tensor."""

    def __init__(self) -> None:
        bundle = load_bundle("default")
        self.shaped = bundle.shaped_body()
        self.network = bundle.read_network()
        self._studio, self._image_error = ground_truth(bundle)
        assets, ctx = load_drawable("default"), self._studio.ctx
        self.packed = PackedPass(ctx, assets.texture.shape[2], assets.quantisation, deferred=True)
        self.avatar = PackedAvatar(self.packed, SkinnedMesh(ctx, assets.arrays), assets.texture)
        self._bound: dict[Shape, tuple[U8, U8, Binding]] = {}

    def compare(self, view: _View) -> list[tuple[float, float, float, float, float]]:
        """Return a tuple of five numbers for each avatar that is visible in `view`.

        The first two are the PSNR in dB with and without neighbours. The next two are the mean and the largest
        difference of byte values between both pictures. The last is the height of the avatar's cell in tensor pixels.
        """
        everyone = self._picture(view, range(len(view.joints)))
        rows = []
        for k, (crop, (top, left, height, width)) in enumerate(view.layout.crops):
            cell = np.s_[top : top + height, left : left + width]
            together, isolated = everyone[cell], self._picture(view, [k])[cell]
            projection = crop_projection(view.projection, crop)
            truth = self._studio.clothed_body.render(view.joints[k], view.view, projection, (height, width))
            errors = [self._image_error(picture, truth) for picture in (together, isolated)]
            if None not in errors:
                steps = np.abs(together.astype(np.int16) - isolated)
                psnr_db = [error.psnr_db for error in errors]
                rows.append((*psnr_db, float(steps.mean()), float(steps.max()), float(height)))
        return rows

    def _picture(self, view: _View, shown: Sequence[int]) -> U8:
        """Return the network's picture (h,w,4) uint8 of a tensor that contains only the avatars `shown` of `view`."""
        shape = view.layout.shape
        tensor, image, binding = self._binding(shape)
        target = self.packed.begin(shape)
        for k in shown:
            crop, cell = view.layout.crops[k]
            projection = crop_projection(view.projection, crop)
            self.avatar.draw(target, view.view, Placement(view.joints[k], projection, cell))
        self.packed.read_into(shape, tensor.reshape(-1))
        binding.run()
        picture: U8 = image[0].copy()
        return picture

    def _binding(self, shape: Shape) -> tuple[U8, U8, Binding]:
        if shape not in self._bound:
            tensor = np.empty((1, *shape, self.packed.channels), np.uint8)
            image = np.empty((1, *shape, 4), np.uint8)
            session = load_runtime("ort").load(reshaped(self.network, *shape), RuntimeOptions(threads=1))
            self._bound[shape] = tensor, image, session.bind([tensor], [image])
        return self._bound[shape]


def _views(fixture: _CrowdFixture, avatars: int, views: int, size: str, margin: int) -> Iterator[_View]:
    """Yield moments, evenly spread over the default motion, at which all avatars are in view.

    `views`: number of moments to examine; moments with an avatar out of view are left out. `avatars`: number of
    avatars. `size`: tensor size, as the option `--size`. `margin`: tensor pixels between two avatars.
    """
    specs = tuple(
        AvatarSpec(position=((k - (avatars - 1) / 2) * STEP_M, 0.0, -BACK_M * (k % 2))) for k in range(avatars)
    )
    scene = Scene(avatars=specs, camera=CameraSpec(place="none"))
    staged = stage_scene(scene, [fixture.shaped] * avatars, Path.cwd())
    skeleton = Skeleton(fixture.shaped.joints, fixture.shaped.body.parents)
    bounds = MeshBounds(fixture.shaped, standoff_m=CLOTHES_STANDOFF_M)
    projection = staged.camera.projection(0.0, OUTPUT)
    for t_s in np.linspace(0.0, SECONDS, views, endpoint=False):
        view, rects, joints = staged.camera.sample(t_s), [], []
        for k, mover in enumerate(staged.movers):
            pose, translation = mover.sample(t_s + k * SECONDS / avatars)
            posed = skeleton.pose(pose, translation, mover.world)
            rects.append(bounds.rect(posed, projection @ view))
            joints.append(posed.matrices.copy())
        if None not in rects:
            seen = [rect for rect in rects if rect is not None]
            yield _View(tuple(joints), view, projection, lay_out(seen, OUTPUT, shape_buckets(size), margin))


def _check(avatars: int, views: int, size: str, margins: Sequence[int]) -> None:
    for option, value, most in (("--avatars", avatars, MOST_AVATARS), ("--views", views, 10_000)):
        if not 1 <= value <= most:
            raise BadInputError(option, str(value), f"1 to {most}")
    if bad := [margin for margin in margins if not 0 <= margin <= MOST_MARGIN]:
        raise BadInputError("--margins", str(bad[0]), f"0 to {MOST_MARGIN}")
    try:
        shape_buckets(size)
    except UnexpectedValue as error:
        raise BadInputError.at("--size", error) from error
