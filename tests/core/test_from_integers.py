"""A float network from an avatar's integers: it paints what they paint, also when it is trained on."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnxruntime")

from pathlib import Path  # noqa: E402

from trilane.avatars.bundle import Bundle, load_bundle  # noqa: E402
from trilane.avatars.network_file import reshaped  # noqa: E402
from trilane.errors import BadInputError  # noqa: E402
from trilane.stages.dsp.runtime import RuntimeOptions, load_runtime  # noqa: E402
from trilane.training.sample_files import U16, ShapeGroup, create_group  # noqa: E402
from trilane.training.trainable_avatar import network_of  # noqa: E402

SHAPE = (64, 96)


@pytest.fixture
def groups(tmp_path: Path) -> list[ShapeGroup]:
    """Samples whose texels change slowly over the picture."""
    group = create_group(tmp_path / "data", SHAPE, np.zeros(16, np.int8))
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]] / 400
    for number, start in enumerate(np.random.default_rng(3).uniform(0, 0.75, (16, 2))):
        group.uv[number] = np.round((np.dstack((columns, rows)) + start) * U16)
    group.covered[:, 4:60, 8:88] = 1
    return [group]


@pytest.mark.parametrize("name", ["default", "hiker"])
def test_it_paints_what_the_integers_paint(name: str, groups: list[ShapeGroup]) -> None:
    """But for the rounding of activations: up to 52 roundings, of half a step of 255 each, add up to some steps."""
    bundle = load_bundle(name)
    network, integers = network_of(bundle, groups, 1), bundle.read_network()
    rng = np.random.default_rng(5)
    coarse = rng.integers(40, 88, (1, 4, 6, 16)).astype(np.uint8)
    tensor = np.ascontiguousarray(coarse.repeat(16, axis=1).repeat(16, axis=2))
    painted = np.empty((1, *SHAPE, 4), np.uint8)
    session = load_runtime("ort").load(reshaped(integers, *SHAPE), RuntimeOptions(threads=1))
    session.bind([tensor], [painted]).run()
    real = (tensor.astype(np.float32) - integers.input.zero_point) * integers.input.scale
    with torch.no_grad():
        picture = network(torch.from_numpy(real).permute(0, 3, 1, 2)).permute(0, 2, 3, 1).numpy() * 255
    assert np.abs(picture - painted).mean() < 3
    assert np.corrcoef(picture.ravel(), painted.ravel())[0, 1] > 0.99


def test_its_norms_have_the_statistics_of_the_samples(groups: list[ShapeGroup]) -> None:
    """In training mode a batch of them changes the picture little; norms that only add would not survive it."""
    bundle = load_bundle("hiker")
    network = network_of(bundle, groups, 1)
    stem = network.encoder.stem[1]
    assert float((stem.weight.detach() - torch.sqrt(stem.running_var + stem.eps)).abs().max()) < 1e-6
    from trilane.training.batch_choice import load_batch
    from trilane.training.trainable_avatar import read_texture

    texture = torch.from_numpy(bundle.read_texture()).permute(2, 0, 1)[None]
    uv, covered, _ = load_batch(groups[0], np.arange(16))
    x = read_texture(texture, uv, covered)
    with torch.no_grad():
        still, moving = network.eval()(x), network.train()(x)
    assert float((still - moving).abs().mean()) < 0.03


def test_an_avatar_of_another_network_is_refused(tiny_bundle: Path, groups: list[ShapeGroup]) -> None:
    bundle: Bundle = load_bundle(tiny_bundle)
    with pytest.raises(BadInputError, match=r"no convolution encoder\.stem\.0"):
        network_of(bundle, groups, 1)
