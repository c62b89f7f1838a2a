"""Which texels of the body a capture shows: each pixel of a UV image that lies on the mask sees its texel.

Rule: a texel counts as seen where its surface was seen less steeply than the outline; regions that no frame shows are
named, because their colours are filled from what is round them.
"""

from __future__ import annotations

import numpy as np

from trilane.arrays import F32, F64, Mask
from trilane.training.body_arrays import BodyArrays
from trilane.training.capture.body_regions import REGIONS, vertex_regions
from trilane.training.first_texture import LEAST_WEIGHT, head_on
from trilane.training.texture_layout import lay_out

#: Of a region that counts as never seen, at most this share of texels was seen.
HARDLY = 0.05
#: Side of the texture that coverage is counted on.
SIDE = 256


class TexelCoverage:
    """Counts how well each texel of one body was seen."""

    def __init__(self, body: BodyArrays, side: int = SIDE) -> None:
        regions = np.eye(len(REGIONS))[vertex_regions(body)]
        image, self.used = lay_out(regions, body.faces, body.uv, body.uv_faces, side)
        self.region = image.argmax(axis=2)
        self.weight: F64 = np.zeros((side, side))
        self._side = side

    def add(self, uv: F32, mask: Mask) -> None:
        """Count the UV image (h,w,3) of a frame whose person is `mask` (h,w)."""
        weight = head_on(uv[..., :2].astype(np.float64), uv[..., 2] > 0, self._side) * mask
        seen = weight > 0
        texel = np.minimum((uv[..., :2][seen] * self._side).astype(np.int64), self._side - 1)
        np.maximum.at(self.weight, (texel[:, 1], texel[:, 0]), weight[seen])

    @property
    def seen(self) -> Mask:
        """(S,S): texels of the body that were seen, or lie beside one that was: a pixel spans a texel or two."""
        near = _grown(self.weight > LEAST_WEIGHT)
        return np.asarray(near & self.used)

    def share(self) -> float:
        """Share of the body's texels that were seen."""
        return float(self.seen.sum() / self.used.sum())

    def share_by_region(self) -> dict[str, float]:
        """The same of each region's texels."""
        seen, shares = self.seen, {}
        for number, name in enumerate(REGIONS):
            inside = self.used & (self.region == number)
            shares[name] = float(seen[inside].mean()) if inside.any() else 1.0
        return shares

    def never_seen(self) -> list[str]:
        """Regions of which hardly any texel was seen."""
        return [name for name, share in self.share_by_region().items() if share <= HARDLY]


def _grown(mask: Mask) -> Mask:
    padded = np.pad(mask, 1)
    rows = padded[:-2] | padded[1:-1] | padded[2:]
    return np.asarray(rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:])
