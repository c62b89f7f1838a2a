"""The avatars of the package are solid, and a validation sees what is done to one: transparent, shifted, tinted, other.

Views are of a seed that no training and no validation in a manifest uses. A picture is changed on its way from the
network; what the figures must become follows from the pictures by formulas, not from figures that were seen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnxruntime")
pytest.importorskip("skimage")

from trilane.arrays import U8
from trilane.avatars.bundle import Bundle, load_bundle
from trilane.avatars.manifest import Validation
from trilane.training import clothing, validate
from trilane.training.sample_renderer import SampleRenderer
from trilane.training.validate import Evaluated, ValidationPlan, integer_painter, open_renderer
from trilane.units import AVATARS

PLAN = ValidationPlan(seeds=(90_210,), per_band=2)
#: Share of the inside that may let more than a tenth of the background through.
SOLID_SHARE = 0.005


@dataclass(frozen=True)
class Validated:
    """A validation and the views that it is of."""

    figures: Validation
    views: list[Evaluated]

    def error(self, view: int, kind: str) -> float:
        """Root of the mean square in the box of `view`, before the background `kind`."""
        return float(10 ** (-self.views[view].errors["ort"].by_background[kind] / 20))


Change = Callable[[U8], U8]


@pytest.fixture(scope="module")
def opened(gl: Any) -> dict[str, tuple[Bundle, SampleRenderer]]:  # noqa: ARG001 - skips where no context can be made
    """Each avatar with its renderer, whose obscurance is coarse: a third of the time, and a few bytes of shade."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clothing, "EMITTERS", 600)
        bundles = [load_bundle(name) for name in AVATARS]
        return {bundle.manifest.name: (bundle, open_renderer(bundle, 1)) for bundle in bundles}


@pytest.fixture(scope="module")
def validated(opened: dict[str, tuple[Bundle, SampleRenderer]]) -> Callable[..., Validated]:
    """Validates an avatar whose pictures go through a change; each once."""
    known: dict[Any, Validated] = {}

    def run(name: str, change: Change | None = None, texture: str | None = None) -> Validated:
        key = (name, change, texture)
        if key not in known:
            bundle, renderer = opened[name]
            renderer.ctx.__enter__()
            known[key] = _validated(_with_texture(bundle, texture), renderer, change)
        return known[key]

    return run


def _with_texture(bundle: Bundle, name: str | None) -> Bundle:
    """`bundle`, with the texture of the avatar `name`, as if the file were exchanged."""
    if name is None:
        return bundle
    texture = load_bundle(name).texture_path
    return replace(bundle, manifest=bundle.manifest.model_copy(update={"texture": str(texture)}))


def _validated(bundle: Bundle, renderer: SampleRenderer, change: Change | None) -> Validated:
    views: list[Evaluated] = []

    def painter(*words: Any) -> Any:
        paint = integer_painter(*words)
        return paint if change is None else lambda sample, uv: change(paint(sample, uv))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(validate, "integer_painter", painter)
        figures = validate.validate(bundle, PLAN, renderer, look=lambda _, view: views.append(view))
    return Validated(figures, views)


def transparent(picture: U8) -> U8:
    """Seven tenths of its alpha."""
    changed = picture.copy()
    changed[..., 3] = np.round(changed[..., 3] * 0.7)
    return changed


def shifted(picture: U8) -> U8:
    """Two pixels to the right."""
    return np.roll(picture, 2, axis=1)


def tinted(picture: U8) -> U8:
    """Red is 40 of 255 more, or as much as there is."""
    changed = picture.copy()
    changed[..., 0] = np.minimum(changed[..., 0].astype(int) + 40, 255)
    return changed


@pytest.mark.parametrize("name", AVATARS)
def test_an_avatar_of_the_package_is_solid(validated: Any, name: str) -> None:
    integer = validated(name).figures.integer
    assert integer.samples == 8
    assert integer.see_through <= SOLID_SHARE
    assert integer.alpha_inside < 0.01 and integer.alpha_outside < 0.001


@pytest.mark.parametrize("name", AVATARS)
def test_a_transparent_avatar_is_found(validated: Any, name: str) -> None:
    """Inside, where alpha should be 1, 1 - alpha becomes 0.3 + 0.7 (1 - alpha), to half a step of 255.

    Before black the picture loses 0.3 of itself, before white it gains 0.3 of what it is short of white: together 0.3
    of its alpha, so that the two new errors are at least that, less the two old ones (triangle inequality).
    """
    before, after = validated(name), validated(name, transparent)
    old, new = before.figures.integer, after.figures.integer
    assert new.alpha_inside == pytest.approx(0.3 + 0.7 * old.alpha_inside, abs=0.5 / 255 + 1e-4)
    assert new.see_through == 1.0
    for view, sample in enumerate(before.views):
        mask = sample.truth[..., 3] >= 128
        rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        alpha = sample.pictures["ort"][rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1, 3] / 255
        least = 0.3 * np.sqrt((alpha**2).mean()) - sum(before.error(view, kind) for kind in ("black", "white"))
        assert sum(after.error(view, kind) for kind in ("black", "white")) >= least - 0.01
    assert after.figures.psnr_db_by_background["black"] < before.figures.psnr_db_by_background["black"] - 6
    assert new.iou == pytest.approx(old.iou, abs=0.02), "a mask that asks for half of alpha sees next to nothing"


def test_a_shifted_avatar_is_found_at_its_edge(validated: Any) -> None:
    """Two columns of every row of the box change hands: at least 2 / (its width) of the mask, twice, less the rest."""
    before, after = validated("default"), validated("default", shifted)
    for old, new in zip(before.views, after.views, strict=True):
        mask = old.truth[..., 3] >= 128
        widest = int(mask.sum(axis=1).max())
        lost = 2 / widest
        assert new.errors["ort"].iou < (1 - lost) / (1 + lost) + (1 - old.errors["ort"].iou)
    assert after.figures.integer.alpha_edge > before.figures.integer.alpha_edge + 0.05
    assert after.figures.integer.psnr_db < before.figures.integer.psnr_db - 3


def test_a_tinted_avatar_is_found_and_its_alpha_is_not(validated: Any) -> None:
    """Of the person alone a third of the squares is 40 of 255, less the old error: 20.8 dB, so less than 23."""
    before, after = validated("default").figures.integer, validated("default", tinted).figures.integer
    assert after.body_psnr_db < 23 < before.body_psnr_db
    for key in ("see_through", "alpha_inside", "alpha_edge", "alpha_outside", "iou"):
        assert getattr(after, key) == getattr(before, key)


def test_an_exchanged_texture_is_found(validated: Any) -> None:
    """The network of all three people paints another person's clothes on this body."""
    before, after = validated("default"), validated("default", texture="hiker")
    assert after.figures.integer.psnr_db < before.figures.integer.psnr_db - 6
    assert after.figures.digests.texture != before.figures.digests.texture
    assert after.figures.digests.network == before.figures.digests.network
