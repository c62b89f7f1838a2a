"""The parts of the network's picture that show anything: by hand, pixel by pixel, and drawn as the whole is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trilane.arrays import F64, U8
from trilane.stages.gpu import composite_painters, opengl
from trilane.stages.gpu.composite_painters import AvatarPainter, spans


def test_bands_are_cut_to_what_shows_by_hand() -> None:
    """40 x 20: one texel in row 3, one in row 17 of the second band, none in the last band of eight rows."""
    shown = np.zeros((40, 20), bool)
    shown[3, 4], shown[17, 9] = True, True
    expected = np.array([(4, 0, 5, 16), (9, 16, 10, 32)]) / (20, 40, 20, 40)
    np.testing.assert_allclose(spans(shown, 0), expected, rtol=1e-6)
    wider = np.array([(2, 0, 12, 16), (7, 16, 12, 32)]) / (20, 40, 20, 40)  # row 17 is two rows below the first band
    np.testing.assert_allclose(spans(shown, 2), wider, rtol=1e-6)
    assert len(spans(shown, 15)) == 3 and len(spans(shown, 14)) == 2
    assert spans(np.zeros((40, 20), bool), 3).shape == (0, 4)
    np.testing.assert_array_equal(spans(np.ones((5, 7), bool), 3), [(0, 0, 1, 1)])


@pytest.mark.parametrize("margin", [1, 2, 5])
def test_no_texel_that_shows_is_within_the_margin_of_what_is_left_out(margin: int) -> None:
    random = np.random.default_rng(margin)
    for _ in range(20):
        height, width = random.integers(8, 80, 2)
        shown = random.random((height, width)) < random.choice([0.002, 0.02, 0.3])
        drawn, cuts = np.zeros_like(shown), spans(shown, margin) * (width, height, width, height)
        for left, top, right, bottom in np.rint(cuts).astype(int):
            assert not drawn[top:bottom, left:right].any()  # twice would blend twice
            drawn[top:bottom, left:right] = True
        for row, column in np.argwhere(shown):
            near = drawn[max(row - margin, 0) : row + margin + 1, max(column - margin, 0) : column + margin + 1]
            assert near.all()


def blended(gl: Any, image: U8, rect: F64) -> Any:
    """The picture of 48 x 32 texels over noise of 60 x 90 pixels."""
    colour = gl.texture((90, 60), 4, internal_format=opengl.SRGB8_ALPHA8)
    target, painter = gl.framebuffer([colour]), AvatarPainter(gl, [(48, 32)])
    colour.write(np.random.default_rng(9).integers(0, 256, 90 * 60 * 4, dtype=np.uint8))
    painter.upload((48, 32), image.reshape(-1))
    painter.draw(target, (48, 32), tuple(rect), (0, 0, 48, 32))
    return np.frombuffer(target.read(components=4), np.uint8).astype(int)


@pytest.mark.parametrize("scale", [2.0, 0.9, 0.31, 0.08], ids=["enlarged", "as it is", "a third", "a twelfth"])
def test_the_parts_together_are_the_whole(gl: Any, monkeypatch: pytest.MonkeyPatch, scale: float) -> None:
    """A leaning bar and a dot, at many places of the pixel grid: a byte of rounding, and most pixels to the byte."""
    random = np.random.default_rng(int(10 * scale))
    image = random.integers(0, 256, (48, 32, 4), dtype=np.uint8)
    row, column = np.indices((48, 32))
    image[(np.abs(column - row / 2 - 2) > 3) & ((row - 40) ** 2 + (column - 4) ** 2 > 5)] = 0
    unlike = 0
    for _ in range(6):
        x, y = random.uniform(-0.9, 0.2, 2)
        rect = np.array([x, y, x + scale * 64 / 90, y + scale * 96 / 60])
        monkeypatch.setattr(composite_painters, "WORTH_CUTTING_PX", 0)
        parts = blended(gl, image, rect)
        monkeypatch.setattr(composite_painters, "WORTH_CUTTING_PX", 10**9)
        whole = blended(gl, image, rect)
        assert np.abs(parts - whole).max() <= 1
        unlike += np.count_nonzero(parts != whole)
    assert unlike <= 0.002 * 6 * 60 * 90 * 4
