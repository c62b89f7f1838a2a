"""Learnt smaller levels of a texture: how they are read, by hand, and how they are stored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilane.avatars.bundle import bundle_folder, check_levels, load_bundle, pack_levels, split_levels, write_bundle
from trilane.errors import BadInputError

torch = pytest.importorskip("torch")
pytest.importorskip("onnxruntime")

from trilane.avatars.bundle import (  # noqa: E402
    Bundle,
)
from trilane.avatars.network_file import reshaped  # noqa: E402
from trilane.stages.dsp.runtime import RuntimeOptions, load_runtime  # noqa: E402
from trilane.training.dataset import U16, ShapeGroup, create_group  # noqa: E402
from trilane.training.trainable_avatar import (  # noqa: E402
    NeuralTexture,
    level_of_detail,
    levels_of,
    network_of,
    read_levels,
    read_texture,
)

SIDE = 64


def plane(step_u: float, step_v: float, shape: tuple[int, int] = (6, 8)) -> tuple[Any, Any]:
    """u grows by `step_u` texels from column to column, v by `step_v` from row to row; all is covered."""
    rows, columns = np.indices(shape)
    uv = np.stack([3.5 + columns * step_u, 3.5 + rows * step_v], axis=-1)[None] / SIDE
    return torch.from_numpy(uv.astype(np.float32)), torch.ones((1, *shape), dtype=torch.bool)


def images(count: int) -> list[Any]:
    rng = np.random.default_rng(4)
    return [rng.normal(0, 1, (SIDE >> k, SIDE >> k, 3)).astype(np.float32) for k in range(count)]


def tensors(levels: list[Any]) -> list[Any]:
    return [torch.from_numpy(level.transpose(2, 0, 1).copy())[None] for level in levels]


@pytest.mark.parametrize(("steps", "wanted"), [((4, 1), 2.0), ((0.5, 3), np.log2(3)), ((0.1, 0.9), 0.0), ((0, 0), 0.0)])
def test_the_level_is_the_logarithm_of_the_longer_step(steps: tuple[float, float], wanted: float) -> None:
    found = level_of_detail(*plane(*steps), SIDE)
    assert found.shape == (1, 6, 8)
    np.testing.assert_allclose(found, wanted, atol=1e-4)


def test_a_seam_and_an_edge_do_not_count() -> None:
    """Columns from the fifth on lie elsewhere in the texture; the last is not covered, and a pixel alone is at 0."""
    uv, covered = plane(2, 2)
    uv[:, :, 4:] = (uv[:, :, 4:] + 0.4) % 1.0
    covered[:, :, 7] = False
    np.testing.assert_allclose(level_of_detail(uv, covered, SIDE)[:, :, :7], 1.0, atol=1e-4)
    covered[:] = False
    covered[0, 2, 2] = True
    assert float(level_of_detail(uv, covered, SIDE)[0, 2, 2]) == 0


@pytest.mark.parametrize(("step", "shares"), [(1, (1, 0, 0)), (3, (1 - np.log2(1.5), np.log2(1.5), 0)), (9, (0, 0, 1))])
def test_levels_are_mixed_by_the_level_of_detail(step: float, shares: tuple[float, ...]) -> None:
    """A step of 3 texels is level 1.585; beyond the smallest level nothing is smaller."""
    shares = shares if step != 3 else (0.0, 1 - np.log2(1.5), np.log2(1.5))
    levels, (uv, covered) = tensors(images(3)), plane(step, step)
    covered[:, 5] = False
    wanted = sum(share * read_texture(level, uv, covered) for share, level in zip(shares, levels, strict=True))
    np.testing.assert_allclose(read_levels(levels, uv, covered), wanted, atol=1e-4)
    assert torch.equal(read_levels(levels[:1], uv, covered), read_texture(levels[0], uv, covered))
    assert not read_levels(levels, uv, covered)[:, :, 5].any()


def test_smaller_levels_begin_as_means_and_are_learnt_apart() -> None:
    start = np.random.default_rng(1).uniform(-0.5, 0.5, (SIDE, SIDE, 2)).astype(np.float32)
    made = NeuralTexture(start, sides=(64, 32), mip_levels=2)
    full, half, quarter = (level.detach()[0].permute(1, 2, 0).numpy() for level in made.levels())
    np.testing.assert_allclose(full, start, atol=1e-6)
    np.testing.assert_allclose(half, start.reshape(32, 2, 32, 2, 2).mean(axis=(1, 3)), atol=1e-6)
    np.testing.assert_allclose(quarter, start.reshape(16, 4, 16, 4, 2).mean(axis=(1, 3)), atol=1e-6)
    uv, covered = plane(2, 2)
    read_levels(made.levels(), uv, covered).sum().backward()
    assert float(made.mips[0].grad.abs().sum()) > 1 and float(made.scales[0].grad.abs().sum()) < 1e-3
    with torch.no_grad():
        made.mips[0][:] = 3.0
    assert float(made.levels()[1].detach().max()) == 1.0
    assert len(NeuralTexture(start, sides=(64,)).levels()) == 1


def test_levels_are_packed_and_split_again() -> None:
    levels = images(4)[1:]
    packed = pack_levels(levels)
    assert packed.shape == (32, 32 + 16 + 8, 3)
    for one, other in zip(split_levels(packed, SIDE), levels, strict=True):
        np.testing.assert_array_equal(one, other)
    assert split_levels(None, SIDE) == []
    check_levels(packed, images(1)[0], "a test")


@pytest.mark.parametrize(
    "wrong",
    [np.zeros((32, 33, 3), np.float32), np.zeros((16, 32, 3), np.float32), np.zeros((32, 32, 3), np.int8), np.zeros(3)],
)
def test_what_are_no_levels_is_refused(wrong: Any) -> None:
    with pytest.raises(BadInputError, match=r"a test: found levels of shape .*expected \(32, 32 to 62, 3\), float32"):
        check_levels(wrong, images(1)[0], "a test")


def test_a_bundle_keeps_its_levels(tiny_bundle: Path, tiny_quantised: Any, tmp_path: Path) -> None:
    bundle = load_bundle(tiny_bundle)
    assert bundle.read_levels() is None and len(levels_of(bundle)) == 1
    rng = np.random.default_rng(2)
    texture, half = (rng.integers(-127, 127, (side, side, 5)).astype(np.int8) for side in (64, 32))
    scale = np.linspace(0.1, 0.5, 5).astype(np.float32)
    body = bundle_folder("default") / "body.npz"
    network = tiny_quantised.network
    write_bundle(tmp_path / "made", bundle.manifest, body, texture, network, scale, levels=pack_levels([half]))
    made = load_bundle(tmp_path / "made")
    np.testing.assert_allclose(made.read_levels(), half * scale, rtol=1e-6)
    first, second = levels_of(made)
    np.testing.assert_allclose(second[0].permute(1, 2, 0), half * scale, rtol=1e-6)
    np.testing.assert_allclose(first[0].permute(1, 2, 0), texture * scale, rtol=1e-6)
    with pytest.raises(BadInputError, match=r"texture\.npz: found levels of shape \(32, 16, 5\)"):
        write_bundle(tmp_path / "bad", bundle.manifest, body, texture, network, scale, levels=half[:, :16])


# A float network from an avatar's integers: it paints what they paint, also when it is trained on.

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
    from trilane.training.trainable_avatar import load_batch, read_texture

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
