"""A training set on disk: the same seed gives the same bytes, in whichever process they are drawn."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

pytest.importorskip("torch")

from trilane.avatars.bundle import bundle_folder
from trilane.training.dataset import U16, clothed_source, open_groups, plan_training, write_dataset

BODY = bundle_folder("default") / "body.npz"


def test_a_seed_gives_the_same_bytes_in_any_process(renderer, tmp_path):
    samples = plan_training(renderer, 2, seed=9)
    again = plan_training(renderer, 2, seed=9)
    assert all(
        np.array_equal(a.pose, b.pose) and a.crop.shape == b.crop.shape for a, b in zip(samples, again, strict=True)
    )
    write_dataset(partial(clothed_source, BODY, "default", None), samples, tmp_path, processes=1)
    groups = {group.shape: group for group in open_groups(tmp_path)}
    uv, rgba = renderer.render(samples[0])
    stored = groups[samples[0].crop.shape]
    assert np.array_equal(stored.rgba[0], rgba)
    assert np.array_equal(stored.uv[0], np.round(uv[..., :2] * U16).astype(np.uint16))
