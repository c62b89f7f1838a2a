"""Pictures of the clothed body through the GPU stage: clothes of several colours, where the body is."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")

from trilane.avatars.bundle import bundle_folder
from trilane.body.body import load_body
from trilane.training import clothing
from trilane.training.clothing import LOOKS
from trilane.training.random_views import BANDS, random_pose
from trilane.training.sample_renderer import SampleRenderer


@pytest.mark.parametrize("band", BANDS)
def test_a_person_covers_the_uv_image_and_more(renderer, band):
    sample = renderer.plan((7, 1), random_pose, band, "128")
    uv, rgba = renderer.render(sample)
    body, person = uv[..., 2] > 0, rgba[..., 3] > 128
    assert uv.shape[:2] == rgba.shape[:2] == sample.crop.shape
    assert np.isfinite(uv).all() and uv[..., :2].min() >= 0 and uv[..., :2].max() <= 1
    assert (body & person).sum() > 0.9 * body.sum()
    assert person.sum() > body.sum()
    assert (rgba[~person & (rgba[..., 3] == 0)] == 0).all()


@pytest.mark.parametrize(("view", "seed"), [("full_body", 2), ("full_body", 5), ("face", 3), ("upper_body", 4)])
def test_the_paint_is_as_it_was(renderer, golden, view, seed):
    """Of the body at rest: shirt, trousers, skin, eyes, hair and shoes. On another driver the mean may differ by one
    of 255, and one pixel of fifty by more than 8: along the edges, where a centre falls on the other side."""
    _, rgba = renderer.render(renderer.plan((7, seed), lambda _: np.zeros((55, 3)), view, "256"))
    over_black = (rgba[..., :3] * (rgba[..., 3:] / 255)).round().astype(np.uint8)
    golden(f"clothes-{view}-{seed}", over_black, 1.0, 0.02)


@pytest.fixture(scope="module", params=["hiker", "dancer"])
def other(gl, request):  # noqa: ARG001 - where no context can be made, `gl` skips the test
    """The name of another look, and its renderer. Its obscurance is coarse, which takes a third of the time."""
    look = LOOKS[request.param]
    body = load_body(bundle_folder("default") / "body.npz").shape(look.betas)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clothing, "EMITTERS", 600)
        return request.param, SampleRenderer(body, threads=2, look=look)


@pytest.mark.parametrize(("view", "seed"), [("full_body", 2), ("face", 3)])
def test_the_other_looks_are_as_they_were(other, golden, view, seed):
    """One is shorter, in jacket and shorts, with hair to the jaw; one is taller, in blouse and skirt, with long hair.
    The bounds are the default look's."""
    name, renderer = other
    renderer.ctx.__enter__()
    _, rgba = renderer.render(renderer.plan((7, seed), lambda _: np.zeros((55, 3)), view, "256"))
    over_black = (rgba[..., :3] * (rgba[..., 3:] / 255)).round().astype(np.uint8)
    golden(f"{name}-{view}-{seed}", over_black, 1.0, 0.02)
