"""Which texels of the body a capture shows: each pixel of a UV image that lies on the mask sees its texel.

Rule: a texel counts as seen where its surface was seen less steeply than the outline; regions that no frame shows are
named, because their colours are filled from what is round them.
"""

from __future__ import annotations

import numpy as np

from trilane.arrays import F32, Mask
from trilane.training.body_arrays import BodyArrays
from trilane.training.capture.body_regions import REGIONS, vertex_regions
from trilane.training.first_texture import LEAST_WEIGHT, head_on
from trilane.training.texture_layout import grown, lay_out

#: Of a region that counts as never seen, at most this share of texels was seen.
HARDLY = 0.05
#: Side of the texture that coverage is counted on.
SIDE = 256


class TexelCoverage:
    """Which texels of one body were seen, frame by frame."""

    def __init__(self, body: BodyArrays, side: int = SIDE) -> None:
        regions = np.eye(len(REGIONS))[vertex_regions(body)]
        image, self.used = lay_out(regions, body.faces, body.uv, body.uv_faces, side)
        self.region = image.argmax(axis=2)
        self._drawn: Mask = np.zeros((side, side), bool)
        self._side = side

    def add(self, drawn: Mask) -> None:
        """Count a frame that shows the texels `drawn` (S,S)."""
        self._drawn |= drawn

    def drawn(self, uv: F32, mask: Mask) -> Mask:
        """(S,S): texels at which pixels of a frame lie. `uv` (h,w,3): its UV image. `mask` (h,w): its person."""
        shown = (head_on(uv[..., :2].astype(np.float64), uv[..., 2] > 0, self._side) > LEAST_WEIGHT) & mask
        texel = np.minimum((uv[..., :2][shown] * self._side).astype(np.int64), self._side - 1)
        found = np.zeros_like(self._drawn)
        found[texel[:, 1], texel[:, 0]] = True
        return found

    @property
    def seen(self) -> Mask:
        """(S,S): texels of the body that were seen, or lie beside one that was: a pixel spans a texel or two."""
        return np.asarray(grown(self._drawn) & self.used)

    @property
    def unseen(self) -> Mask:
        """(S,S): texels of the body that were not."""
        return np.asarray(self.used & ~self.seen)

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
