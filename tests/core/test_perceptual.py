"""The perceptual loss: VGG-16's features beside a second implementation in NumPy, and what its file is refused for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

torch = pytest.importorskip("torch")
pytest.importorskip("skimage")

from trilane.errors import BadInputError, MissingPartError  # noqa: E402
from trilane.training import objective  # noqa: E402
from trilane.training.objective import (  # noqa: E402
    WEIGHTS,
    Objective,
    composite,
    drawn_behind,
    ms_ssim,
    read_vgg16,
)
from trilane.training.train import with_vgg  # noqa: E402
from trilane.training.training_settings import parsed_settings  # noqa: E402

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
    with pytest.raises(BadInputError, match="--vgg: found a loss without `objective`"):
        with_vgg(parsed_settings({}, ""), file)
    file.write_bytes(b"abd")
    with pytest.raises(BadInputError, match=rf"vgg.pth: found SHA-256 .*expected that of the settings, {digest}"):
        with_vgg(chosen, file)
