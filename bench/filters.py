"""What do MIP maps and anisotropic filtering of the neural texture cost, and what do they change?

Rule: every filter draws the same avatar in the same view and poses. The filters run in interleaved rounds. The last
picture of every filter is compared with the same ground truth.
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from trilane.arrays import BUCKET_STEP, U8
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import reshaped
from trilane.bench.lib.fixture import (
    WARM_UP,
    ground_truth,
    interleaved_ms,
    load_drawable,
    standing,
    summary_ms,
)
from trilane.bench.lib.interleaved_processes import SLOTS
from trilane.errors import BadInputError
from trilane.stages.dsp.runtime import RuntimeOptions, load_runtime
from trilane.stages.gpu.opengl import describe
from trilane.stages.gpu.raster import FILTERS, PackedAvatar, PackedPass, Placement
from trilane.stages.gpu.skinned_mesh import SkinnedMesh
from trilane.units import MEASURED

MAX_SIDE = 2048


def measure(sizes: tuple[int, ...] = (64, 128, 256, 512), repeats: int = 20) -> dict[str, Any]:
    """Draw the standing default avatar into square tensors with every texture filter of the packed pass.

    `sizes`: sides of the tensors, pixels. `repeats`: number of timed draws of each filter.

    `rows` has a row for each size and filter:
    `side`: side of the tensor, pixels.
    `filter`: name of the filter.
    `raster_ms`: median time to draw the tensor and read it back.
    `steps_mean`: mean absolute difference of byte values from the tensor of `linear`, over the body's pixels.
    `psnr_db`: PSNR of the network's picture against ground truth; the network was trained with `linear`.

    Further keys:
    `sources`: source of the rows.
    `driver`: facts about the OpenGL driver.
    `config`: settings of the bench.

    Raises BadInputError for an option out of range, MissingPartError if a library is not installed.
    """
    if bad := [side for side in sizes if side % BUCKET_STEP or not BUCKET_STEP <= side <= MAX_SIDE]:
        raise BadInputError("--sizes", str(bad[0]), f"a multiple of {BUCKET_STEP} up to {MAX_SIDE}")
    if repeats < 1:
        raise BadInputError("--repeats", str(repeats), "at least 1")
    fixture = _FilterFixture()
    rows = [row for side in sizes for row in fixture.rows((side, side), repeats)]
    return {
        "rows": rows,
        "sources": {"rows": MEASURED},
        "driver": asdict(describe(fixture.ctx)),
        "config": {"sizes": list(sizes), "repeats": repeats},
    }


class _FilterFixture:
    """The default avatar, ready to be drawn with every filter, with its network and its ground truth."""

    def __init__(self) -> None:
        bundle, assets = load_bundle("default"), load_drawable("default")
        self._studio, self._image_error = ground_truth(bundle)
        self.ctx, self._network = self._studio.ctx, bundle.read_network()
        self._fixture = standing(assets.texture.shape[2])
        self._drawn = {}
        for name in FILTERS:
            packed = PackedPass(self.ctx, assets.texture.shape[2], assets.quantisation, deferred=False, filtering=name)
            self._drawn[name] = packed, PackedAvatar(packed, SkinnedMesh(self.ctx, assets.arrays), assets.texture)

    def rows(self, shape: tuple[int, int], repeats: int) -> list[dict[str, Any]]:
        """Return one row of `measure` for each filter.

        `shape`: (height, width) of the tensor in pixels. `repeats`: number of timed draws of each filter.
        """
        slots = {name: np.empty((SLOTS, *shape, drawn[0].channels), np.uint8) for name, drawn in self._drawn.items()}
        variants = {name: partial(self._draw, name, shape, tensors) for name, tensors in slots.items()}
        times = interleaved_ms(variants, repeats)
        last = WARM_UP + repeats - 1
        tensors = {name: of[last % SLOTS, None] for name, of in slots.items()}
        plain, fixture = tensors["linear"], self._fixture
        body = (plain != self._network.input.zero_point).any(axis=-1)
        truth = self._studio.clothed_body.render(fixture.joints(last), fixture.view, fixture.projection, shape)
        session = load_runtime("ort").load(reshaped(self._network, *shape), RuntimeOptions(threads=1))
        picture = np.empty((1, *shape, 4), np.uint8)
        rows = []
        for name, tensor in tensors.items():
            session.bind([tensor], [picture]).run()
            rows.append(
                {
                    "side": shape[0],
                    "filter": name,
                    "raster_ms": summary_ms(times[name])["median_ms"],
                    "steps_mean": float(np.abs(tensor[body].astype(np.int16) - plain[body]).mean()),
                    "psnr_db": float(self._image_error(picture[0], truth).psnr_db),
                }
            )
        return rows

    def _draw(self, name: str, shape: tuple[int, int], tensors: U8, number: int) -> None:
        packed, avatar = self._drawn[name]
        fixture = self._fixture
        placement = Placement(fixture.joints(number), fixture.projection, (0, 0, *shape))
        avatar.draw(packed.begin(shape), fixture.view, placement)
        packed.read_into(shape, tensors[number % SLOTS].reshape(-1))
