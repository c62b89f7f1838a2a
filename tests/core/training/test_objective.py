"""Discriminators: what each sees, their errors in bits, what they change and what they leave."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from skimage.metrics import structural_similarity

torch = pytest.importorskip("torch")
pytest.importorskip("skimage")

from trilane.errors import BadInputError, MissingPartError  # noqa: E402
from trilane.training import objective  # noqa: E402
from trilane.training.objective import (  # noqa: E402  # noqa: E402
    JUDGES,
    WEIGHTS,
    Adversary,
    Judgement,
    Objective,
    bits,
    composite,
    drawn_behind,
    loss_terms,
    ms_ssim,
    read_vgg16,
    total_loss,
)
from trilane.training.train import with_vgg  # noqa: E402
from trilane.training.training_settings import parsed_settings  # noqa: E402

#: What stands behind both.
BEHIND = torch.from_numpy(np.random.default_rng(9).random((2, 3, 32, 24), np.float32))


def pictures(seed: int = 0) -> tuple[Any, Any]:
    """An output and a target (2, 4, 32, 24) of random numbers."""
    rng = np.random.default_rng(seed)
    output, target = rng.uniform(0, 1, (2, 2, 4, 32, 24)).astype(np.float32)
    return torch.from_numpy(output), torch.from_numpy(target)


def adversary(**others: Any) -> Adversary:
    return Adversary(**({"width": 4, "rate": 1e-3, "seed": 1} | others))


def weights(of: Adversary) -> list[bytes]:
    return [value.detach().numpy().tobytes() for value in of.discriminators.parameters()]


def test_errors_are_binary_cross_entropy_in_bits() -> None:
    """A quarter, and 3/4, in place of each truth: 2 bits, and log2(4/3)."""
    score = torch.full((3,), math.log(0.25 / 0.75))
    assert float(bits(score, true=True)) == pytest.approx(2)
    assert float(bits(score, true=False)) == pytest.approx(math.log2(4 / 3))
    assert float(bits(torch.zeros(2), true=True)) == 1 == float(bits(torch.zeros(2), true=False))


def test_three_see_the_picture_before_a_background_and_its_mask_at_three_sizes() -> None:
    mine, (output, _) = adversary(), pictures()
    seen: list[Any] = []
    for judge in mine.discriminators:
        judge.register_forward_hook(lambda _, given, found: seen.append((given[0], found)))
    mine.terms(output, output, BEHIND)
    image, behind = output.numpy(), BEHIND.numpy()
    over = np.concatenate([image[:, :3] * image[:, 3:] + behind * (1 - image[:, 3:]), image[:, 3:]], axis=1)
    for (given, judged), shrunk in zip(seen[:3], (1, 2, 4), strict=True):
        means = over.reshape(2, 4, 32 // shrunk, shrunk, 24 // shrunk, shrunk).mean(axis=(3, 5))
        np.testing.assert_allclose(given.detach(), means, atol=1e-6)
        assert [each.shape[1] for each in judged.features] == [4, 8, 16, 32] and judged.score.shape == (2,)
        sides = [each.shape[2] for each in judged.features]
        assert sides == [max(1, 32 // shrunk // part) for part in (2, 4, 8, 16)]


def test_terms_are_means_over_the_three(monkeypatch: pytest.MonkeyPatch) -> None:
    """Odds of 1/4, 1/2 and 3/4 for what is painted; features differ by 1 and 3, 0 and 0, 2 and 6."""
    odds, gaps = (0.25, 0.5, 0.75), ((1.0, 3.0), (0.0, 0.0), (2.0, 6.0))
    painted = [
        Judgement([torch.full((1, 2), gap) for gap in gap_pair], torch.tensor([math.log(p / (1 - p))]))
        for p, gap_pair in zip(odds, gaps, strict=True)
    ]
    true = [Judgement([torch.zeros(1, 2), torch.zeros(1, 2)], torch.zeros(1)) for _ in odds]
    mine, answers = adversary(), iter([painted, true])
    monkeypatch.setattr(mine, "_judged", lambda *_: next(answers))
    terms = mine.terms(*pictures(), BEHIND)
    assert float(terms["adversarial"]) == pytest.approx((2 + 1 + math.log2(4 / 3)) / 3)
    assert float(terms["features"]) == pytest.approx(2)


def test_the_avatars_loss_leaves_the_discriminators_and_theirs_leaves_the_avatar() -> None:
    mine, (output, target) = adversary(), pictures()
    before = weights(mine)
    terms = mine.terms(output.requires_grad_(), target, BEHIND)
    (terms["adversarial"] + terms["features"]).backward()
    assert float(output.grad.abs().sum()) > 0 and weights(mine) == before
    assert all(value.grad is None for value in mine.discriminators.parameters())
    output.grad = None
    mine.learn(output, target, BEHIND)
    assert output.grad is None and all(now != then for now, then in zip(weights(mine), before, strict=True))


def test_they_learn_to_tell_painted_pictures_from_true_ones() -> None:
    """Bright ones from dark ones; for the avatar that makes it dearer. At first they nearly guess."""
    mine, dark = adversary(rate=3e-3), torch.full((2, 4, 16, 16), 0.2)
    bright, black = torch.full((2, 4, 16, 16), 0.9), torch.zeros(2, 3, 16, 16)
    cheap = float(mine.terms(dark, bright, black)["adversarial"].detach())
    errors = [mine.learn(dark, bright, black) for _ in range(60)]
    assert errors[0] == pytest.approx(1, abs=0.2) and errors[-1] < 0.5
    assert float(mine.terms(dark, bright, black)["adversarial"].detach()) > cheap + 0.5


def test_first_weights_are_the_seeds_and_no_other_random_numbers_change() -> None:
    torch.manual_seed(3)
    wanted = torch.rand(2)
    torch.manual_seed(3)
    first = weights(adversary())
    assert torch.equal(torch.rand(2), wanted)
    assert weights(adversary()) == first != weights(adversary(seed=2))


def test_they_are_among_the_terms_of_an_objective_that_has_them() -> None:
    output, target = pictures()
    with_one = Objective(WEIGHTS | {"adversarial": 2.0, "features": 3.0}, None, adversary())
    torch.manual_seed(4)
    terms = with_one.terms(output, target)
    torch.manual_seed(4)
    plain = Objective().terms(output, target)
    assert terms.keys() - plain.keys() == {"adversarial", "features"}
    extra = 2 * terms["adversarial"] + 3 * terms["features"]
    assert float(with_one.total(terms)) == pytest.approx(float(Objective().total(plain) + extra))
    assert with_one.learn(output, target).keys() == {JUDGES} and Objective().learn(output, target) == {}


# The perceptual loss: VGG-16's features beside a second implementation in NumPy, and what its file is refused for.

#: Of torchvision's VGG-16, by its documentation: places of the convolutions among the layers, and their channels.
PLACES = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
CHANNELS = (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
LAST_OF_BLOCK = (2, 7, 14, 21, 28)
#: Twenty times narrower ones, which are quick.
NARROW = ((2, 3), (2, 4), (3, 4), (3, 5), (3, 5))


@pytest.fixture
def state(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Random weights of a narrow VGG-16, by torchvision's names, and some of the classifier."""
    monkeypatch.setattr(objective, "BLOCKS", NARROW)
    rng, before, found = np.random.default_rng(4), 3, dict[str, Any]()
    channels = [width for count, width in NARROW for _ in range(count)]
    for place, width in zip(PLACES, channels, strict=True):
        found[f"features.{place}.weight"] = torch.from_numpy(rng.normal(0, 0.4, (width, before, 3, 3))).float()
        found[f"features.{place}.bias"] = torch.from_numpy(rng.normal(0, 0.1, width)).float()
        before = width
    return found | {"classifier.0.weight": torch.zeros(2, 2)}


@pytest.fixture
def file(state: dict[str, Any], tmp_path: Path) -> Path:
    torch.save(state, tmp_path / "vgg16.pth")
    return tmp_path / "vgg16.pth"


def convolved(x: NDArray[np.float64], weight: NDArray[np.float64], bias: NDArray[np.float64]) -> NDArray[np.float64]:
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(1, 2))
    return np.einsum("chwij,ocij->ohw", windows, weight) + bias[:, None, None]


def by_numpy(picture: NDArray[np.float64], state: dict[str, Any]) -> list[NDArray[np.float64]]:
    """The features of `picture` (3, h, w), each pixel's scaled to length 1."""
    x = (picture - np.array([0.485, 0.456, 0.406])[:, None, None]) / np.array([0.229, 0.224, 0.225])[:, None, None]
    found = []
    for place in PLACES:
        kernel, bias = (state[f"features.{place}.{name}"].double().numpy() for name in ("weight", "bias"))
        x = np.maximum(convolved(x, kernel, bias), 0)
        if place in LAST_OF_BLOCK:
            found.append(x / np.maximum(np.sqrt((x**2).sum(axis=0)), 1e-10))
            x = x.reshape(len(x), x.shape[1] // 2, 2, x.shape[2] // 2, 2).max(axis=(2, 4))
    return found


def test_the_distance_is_its_formula(file: Path, state: dict[str, Any]) -> None:
    rng = np.random.default_rng(0)
    one, other = rng.uniform(0, 1, (2, 2, 3, 32, 32))
    wanted = [
        sum(((a - b) ** 2).sum(axis=0).mean() for a, b in zip(by_numpy(p, state), by_numpy(q, state), strict=True))
        for p, q in zip(one, other, strict=True)
    ]
    network = read_vgg16(file)
    found = network.distance(torch.from_numpy(one).float(), torch.from_numpy(other).float())
    np.testing.assert_allclose(found, wanted, rtol=1e-4)
    assert float(network.distance(torch.ones(1, 3, 16, 16), torch.ones(1, 3, 16, 16))) == 0


def test_the_table_is_torchvisions_vgg16() -> None:
    sizes = {name: tuple(value.shape) for name, value in objective.Vgg16().state_dict().items()}
    before = (3, *CHANNELS[:-1])
    wanted = {f"features.{k}.weight": (c, b, 3, 3) for k, c, b in zip(PLACES, CHANNELS, before, strict=True)}
    assert sizes == wanted | {f"features.{place}.bias": (c,) for place, c in zip(PLACES, CHANNELS, strict=True)}


def test_safetensors_are_read_too(file: Path, state: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    save_file = pytest.importorskip("safetensors.torch").save_file
    safe = file.with_suffix(".safetensors")
    save_file(state, safe)
    picture = torch.rand(1, 3, 16, 16)
    for one, other in zip(read_vgg16(file)(picture), read_vgg16(safe)(picture), strict=True):
        assert torch.equal(one, other)
    safe.write_bytes(b"nothing of the kind")
    with pytest.raises(BadInputError, match=r"vgg16\.safetensors: .*expected weights of VGG-16 by"):
        read_vgg16(safe)
    monkeypatch.setitem(__import__("sys").modules, "safetensors", None)
    with pytest.raises(MissingPartError, match="install safetensors"):
        read_vgg16(safe)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda state: state.pop("features.5.bias"), "found no tensor features.5.bias, expected weights of VGG-16"),
        (
            lambda state: state.update({"features.0.weight": torch.zeros(3, 1, 3, 3)}),
            r"features.0.weight: found \(3, 1, 3, 3\), expected \(3, 3, 3, 3\) of VGG-16",
        ),
        (lambda state: state["features.28.bias"].fill_(np.nan), "features.28.bias: found numbers that are not finite"),
        (lambda state: state.update({"features.0.bias": Path("x")}), "expected weights of VGG-16"),
    ],
    ids=["missing", "size", "nan", "code"],
)
def test_other_files_are_refused(state: dict[str, Any], tmp_path: Path, change: Any, words: str) -> None:
    change(state)
    torch.save(state, tmp_path / "vgg.pth")
    with pytest.raises(BadInputError, match=words):
        read_vgg16(tmp_path / "vgg.pth")


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "vgg.pth").write_bytes(b"PNG, perhaps")
    for path in (tmp_path / "vgg.pth", tmp_path / "none.pth"):
        with pytest.raises(BadInputError, match=rf"{path.name}: .*expected weights of VGG-16"):
            read_vgg16(path)


def test_it_is_by_vgg_where_given_and_else_by_ms_ssim(file: Path) -> None:
    rng = np.random.default_rng(2)
    output, target = (torch.from_numpy(rng.uniform(0, 1, (2, 4, 32, 32))).float() for _ in range(2))
    weights, vgg = WEIGHTS | {"perceptual": 20.0}, read_vgg16(file)

    def terms(*of: Any) -> Any:
        torch.manual_seed(4)
        return Objective(*of).terms(output, target)

    torch.manual_seed(4)
    behind = drawn_behind(target)
    over = composite(output, behind), composite(target, behind)
    assert "perceptual" not in terms(WEIGHTS, vgg)
    by_vgg, without = (terms(weights, each)["perceptual"] for each in (vgg, None))
    assert float(by_vgg) == pytest.approx(float(vgg.distance(*over).mean()), rel=1e-6)
    assert float(without) == pytest.approx(1 - float(ms_ssim(*over).mean()), rel=1e-6)
    Objective(weights, vgg).terms(output.requires_grad_(), target)["perceptual"].backward()
    assert float(output.grad.abs().sum()) > 0 and all(value.grad is None for value in vgg.parameters())


def test_settings_have_the_digest_of_the_weights(tmp_path: Path) -> None:
    file, thesis = tmp_path / "vgg.pth", parsed_settings({"loss": "thesis"}, "")
    file.write_bytes(b"abc")
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-2, B.1
    chosen = with_vgg(thesis, file)
    assert chosen.vgg == digest and with_vgg(chosen, file) == chosen and with_vgg(thesis, None) == thesis
    with pytest.raises(BadInputError, match=f"found no file of weights, expected that with SHA-256 {digest}; give it"):
        with_vgg(chosen, None)
    with pytest.raises(BadInputError, match="--vgg: found a loss without `perceptual`"):
        with_vgg(parsed_settings({}, ""), file)
    file.write_bytes(b"abd")
    with pytest.raises(BadInputError, match=rf"vgg.pth: found SHA-256 .*expected that of the settings, {digest}"):
        with_vgg(chosen, file)


# MS-SSIM beside a second implementation in NumPy, its closed forms, and its place in the loss.

#: Weights of the paper, of which those that fit are scaled to a sum of 1.
PAPER = np.array([0.0448, 0.2856, 0.3001, 0.2363, 0.1333])


def pair(shape: tuple[int, int], seed: int = 0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two pictures (h,w,3) in 0..1 that are alike: smooth noise, and the same with other noise."""
    rng = np.random.default_rng(seed)
    one = gaussian_filter(rng.uniform(0, 1, (*shape, 3)), (3, 3, 0))
    one = (one - one.min()) / (one.max() - one.min())
    return one, np.clip(one * 0.9 + rng.normal(0, 0.05, one.shape), 0, 1)


def found(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    as_tensors = (torch.from_numpy(each.transpose(2, 0, 1).copy())[None] for each in (one, other))
    return float(ms_ssim(*as_tensors))


def inner(picture: NDArray[np.float64]) -> NDArray[np.float64]:
    """Under a Gaussian of 11 x 11, without the margin in which it reaches out of the picture."""
    blurred = gaussian_filter(picture, (1.5, 1.5, 0), radius=(5, 5, 0))
    return np.asarray(blurred[5:-5, 5:-5])


def similarity_by_numpy(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    scales = [scale for scale in range(5) if min(one.shape[:2]) // 2**scale >= 11]
    product = 1.0
    for scale in scales:
        m, n = inner(one), inner(other)
        vm, vn, cov = inner(one * one) - m * m, inner(other * other) - n * n, inner(one * other) - m * n
        factor = (2 * cov + 0.0009) / (vm + vn + 0.0009)
        if scale == scales[-1]:
            factor = factor * (2 * m * n + 0.0001) / (m * m + n * n + 0.0001)
        product *= float(factor.mean()) ** (PAPER[scale] / PAPER[scales].sum())
        h, w = (side // 2 for side in one.shape[:2])
        one, other = (each[: 2 * h, : 2 * w].reshape(h, 2, w, 2, 3).mean(axis=(1, 3)) for each in (one, other))
    return product


@pytest.mark.parametrize("shape", [(192, 180), (97, 60), (30, 12)], ids=["five scales", "three, odd sides", "one"])
def test_it_is_what_a_second_implementation_finds(shape: tuple[int, int]) -> None:
    one, other = pair(shape)
    value = found(one, other)
    assert value == pytest.approx(similarity_by_numpy(one, other), abs=1e-9) and 0.3 < value < 0.999


def test_one_scale_is_ssim_of_scikit_image() -> None:
    one, other = pair((21, 20))
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    _, whole = structural_similarity(one, other, channel_axis=2, full=True, **settings)
    assert found(one, other) == pytest.approx(whole[5:-5, 5:-5].mean(), abs=1e-6)


def test_plain_pictures_differ_by_luminance_alone() -> None:
    """Contrast and structure of two plain pictures are 1; luminance counts at the last of five scales."""
    one, other = np.full((200, 200, 3), 0.8), np.full((200, 200, 3), 0.2)
    luminance = (2 * 0.8 * 0.2 + 1e-4) / (0.8**2 + 0.2**2 + 1e-4)
    assert found(one, other) == pytest.approx(luminance ** (0.1333 / PAPER.sum()), abs=1e-9)
    assert found(one, one) == pytest.approx(1, abs=1e-12)


def test_it_is_a_term_of_the_loss_only_where_it_has_a_weight() -> None:
    rng = np.random.default_rng(2)
    output, target = (torch.from_numpy(rng.uniform(0.1, 0.9, (2, 4, 32, 32))) for _ in range(2))
    behind = torch.from_numpy(rng.uniform(0, 1, (2, 3, 32, 32)))
    plain, weights = loss_terms(output, target, behind), dict.fromkeys(WEIGHTS, 0.0) | {"structure": 20.0}
    terms = loss_terms(output.requires_grad_(), target, behind, weights)
    assert set(plain) == set(WEIGHTS) and set(terms) == set(WEIGHTS) | {"structure"}
    total = total_loss(terms, weights)
    over = [each[:, :3] * each[:, 3:] + behind * (1 - each[:, 3:]) for each in (output.detach(), target)]
    value = np.mean([similarity_by_numpy(*(each[k].permute(1, 2, 0).numpy() for each in over)) for k in range(2)])
    assert float(total.detach()) == pytest.approx(20 * (1 - value), rel=1e-6)
    total.backward()
    assert bool(torch.isfinite(output.grad).all()) and float(output.grad.abs().sum()) > 0
