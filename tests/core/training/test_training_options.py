"""Options of a training by steps: each changes what it is for, by hand or a second implementation, and is resumed."""

from __future__ import annotations

import math
import tomllib
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from trilane.errors import BadInputError  # noqa: E402
from trilane.training import dataset, objective, step_loop  # noqa: E402
from trilane.training.dataset import (  # noqa: E402
    U16,
    ShapeGroup,
    batch_stream,
    create_group,
    is_whole,
    open_groups,
    phases,
    zoom,
)
from trilane.training.network import (  # noqa: E402
    NORMS,
    UNet,
    add_dropout,
)
from trilane.training.objective import Objective  # noqa: E402
from trilane.training.step_loop import (  # noqa: E402
    TrainingState,
    add_gradients,
    clip_gradients,
    first_state,
    load_state,
    optimiser_of,
    save_state,
    steps,
)
from trilane.training.trainable_avatar import NeuralTexture, TrainableAvatar, load_batch  # noqa: E402
from trilane.training.training_settings import (  # noqa: E402
    OptimiserOptions,
    TrainingSettings,
    parsed_settings,
    settings_text,
)

COUNT = 4
FAR, FULL_BODY, FACE = 0, 1, 3
SHAPES = ((64, 32), (64, 64))
#: Texels that one pixel moves on, of a texture of 64: the zooms of the four samples of each shape.
TEXEL_STEPS = (0.25, 0.27, 1.0, 0.5)
BANDS = (FACE, FACE, FAR, FULL_BODY)
#: What changes the first step of a training.
CHANGES: dict[str, dict[str, Any]] = {
    "group norm": {"norm": "group"},
    "no norm": {"norm": "none"},
    "norm of gradients": {"optimiser": {"clip_norm": 0.1}},
    "share of samples": {"batches": {"sample_share": 0.3}},
    "texture noise": {"regularisation": {"texture_noise": 0.1}},
    "input noise": {"regularisation": {"input_noise": 0.1}},
    "dropout": {"regularisation": {"dropout": 0.2}},
}
MANY: list[dict[str, Any]] = [
    {
        "optimiser": {"kind": "adam", "texture_momentum": 0.0, "clip_value": 0.01},
        "masked_texture": True,
        "batches": {"full_body_statistics": True, "same_zoom": True, "sample_share": 0.9},
        "regularisation": {"texture_noise": 0.1, "dropout": 0.1},
    },
    {"freeze_norms_at": 0.2, "bytes_from": 0.4, "noise_steps": 0.0},
    {
        "norm": "instance",
        "mip_levels": 2,
        "optimiser": {"batches_per_step": 2, "momentum": 0.5},
        "batches": {"full_body_from": 0.7},
        "regularisation": {"input_noise": 0.1},
    },
]


def settings(**others: Any) -> TrainingSettings:
    usual = {"start": "new", "samples": 8, "batch": 2, "seed": 5, "small_until": 0.0, "freeze_norms_at": 1.0}
    return parsed_settings({"device": "cpu"} | usual | others, "a test")


def avatar(norm: str = "batch", mip_levels: int = 0) -> TrainableAvatar:
    torch.manual_seed(0)
    start = np.random.default_rng(1).uniform(-0.5, 0.5, (64, 64, 4)).astype(np.float32)
    return TrainableAvatar(UNet(norm=norm, width=4, channels=4), NeuralTexture(start, (64, 32), mip_levels))


@pytest.fixture(autouse=True)
def one_thread() -> Any:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def groups(tmp_path: Path) -> list[ShapeGroup]:
    """Four samples of each of two shapes, in which u grows by a known step from pixel to pixel."""
    rng = np.random.default_rng(0)
    for shape in SHAPES:
        group = create_group(tmp_path / "data", shape, np.array(BANDS, np.int8))
        for number, step in enumerate(TEXEL_STEPS):
            group.uv[number, ..., 0] = np.round(np.arange(shape[1]) * step / 64 * U16)
            group.uv[number, ..., 1] = rng.integers(0, U16, (shape[0], 1))
        group.covered[:, 4:24, 6:28] = 1
        group.rgba[:, 4:26, 5:28] = rng.integers(0, 255, (4, 1, 1, 4))
        group.rgba[..., 3] = 255 * group.covered
    return open_groups(tmp_path / "data")


def trained(groups: list[ShapeGroup], until: int, asked: TrainingSettings) -> TrainingState:
    state = first_state(avatar(asked.norm, asked.mip_levels), asked)
    go(state, groups, asked, until)
    return state


def go(state: TrainingState, groups: list[ShapeGroup], asked: TrainingSettings, until: int) -> None:
    going = steps(state, groups, asked, COUNT)
    while state.step < until:
        next(going)


def bits(state: TrainingState) -> dict[str, bytes]:
    return {name: value.detach().contiguous().numpy().tobytes() for name, value in state.tensors().items()}


def test_each_option_changes_the_training(groups: list[ShapeGroup]) -> None:
    usual = bits(trained(groups, 1, settings()))["average.textures.0.scales.0"]
    assert bits(trained(groups, 1, settings()))["average.textures.0.scales.0"] == usual
    for name, change in CHANGES.items():
        assert bits(trained(groups, 1, settings(**change)))["average.textures.0.scales.0"] != usual, name


@pytest.mark.parametrize("change", MANY)
def test_a_training_with_options_is_resumed_to_the_bit(
    groups: list[ShapeGroup], tmp_path: Path, change: dict[str, Any]
) -> None:
    asked = settings(**change)
    whole = bits(trained(groups, COUNT, asked))
    save_state(trained(groups, 3, asked), tmp_path / "state.npz")
    after = first_state(avatar(asked.norm, asked.mip_levels), asked)
    load_state(after, tmp_path / "state.npz")
    go(after, groups, asked, COUNT)
    assert bits(after) == whole


def test_bytes_begin_after_their_share_of_the_steps(groups: list[ShapeGroup]) -> None:
    """Of four steps those after more than 40 %; the grid is measured once, and an average is not rounded."""
    asked = settings(freeze_norms_at=0.2, bytes_from=0.4)
    state, painted = first_state(avatar(), asked), list[int]()
    grid = state.avatar.grid
    assert grid is not None and state.average.grid is None and first_state(avatar(), settings()).avatar.grid is None
    paint = grid.painted
    grid.painted = lambda *words: painted.append(state.step) or paint(*words)  # type: ignore[func-returns-value]
    grids = [grid.ends.clone() for _ in steps(state, groups, asked, COUNT)]
    assert painted == [2, 3]
    assert not grids[1].any() and grids[2].any() and torch.equal(grids[2], grids[3])


def test_options_are_written_and_read_again() -> None:
    for change in [*CHANGES.values(), *MANY]:
        asked = settings(**change)
        assert parsed_settings(tomllib.loads(settings_text(asked)), "a file") == asked


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"optimiser": {"king": "adam"}},
            "optimiser.king: found an unknown key, expected one of kind, momentum.*'kind'",
        ),
        ({"batches": {"sample_share": 0}}, "batches.sample_share: found 0, expected greater than 0"),
        ({"vgg": "abc"}, r"vgg: found 'abc', expected String should match pattern '\^\[0-9a-f\]\{64\}\$'"),
        ({"batches": {"repeats": 3}}, "batches.repeats: found 3, expected a list"),
        ({"norm": "layer"}, "norm: found 'layer', expected 'batch', 'instance', 'group' or 'none'"),
        (
            {"norm": "group", "start": "default"},
            'norm: found group, expected batch of a trained network; or start = "new"',
        ),
        (
            {"norm": "group", "bytes_from": 0.9},
            "bytes_from: found 0.9, expected 1 with a norm that is not folded into the weights; or norm = ",
        ),
        (
            {"freeze_norms_at": 0.6, "bytes_from": 0.5},
            "bytes_from: found 0.5, expected no less than freeze_norms_at: .*; or a lower freeze_norms_at",
        ),
        (
            {"look": ["default", "hiker"], "batches": {"look_repeats": [1, 2, 3]}},
            r"batches.look_repeats: found \(1, 2, 3\), expected one number for each look; or none",
        ),
    ],
)
def test_wrong_options_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(BadInputError, match=f"a test: {words}"):
        settings(**values)


# The optimiser


def adam_by_hand(start: Any, gradients: list[Any], row: dict[str, Any]) -> np.ndarray:
    """Adam (Kingma and Ba 2015, algorithm 1) and AdamW (Loshchilov and Hutter 2019, algorithm 2) in NumPy."""
    value = start.detach().double().numpy().copy()
    first, second = np.zeros_like(value), np.zeros_like(value)
    for number, each in enumerate(gradients, 1):
        seen = each != 0 if row["masked"] else np.ones_like(value, bool)
        gradient = each + (row["decay"] * value if row["kind"] == "adam" else 0)
        new_first = row["beta"] * first + (1 - row["beta"]) * gradient
        new_second = row["beta2"] * second + (1 - row["beta2"]) * gradient**2
        decayed = value * (1 - row["rate"] * row["decay"]) if row["kind"] == "adamw" else value
        size = np.sqrt(new_second / (1 - row["beta2"] ** number)) + 1e-8
        moved = decayed - row["rate"] * new_first / (1 - row["beta"] ** number) / size
        first, second = np.where(seen, new_first, first), np.where(seen, new_second, second)
        value = np.where(seen, moved, value)
    return value


@pytest.mark.parametrize("kind", ["adam", "adamw"])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("momentum", "texture_momentum"), [(0.9, 0.0), (0.0, 0.8)])
def test_the_optimiser_is_its_formula(kind: Any, masked: bool, momentum: float, texture_momentum: float) -> None:
    made = avatar()
    options = {"kind": kind, "momentum": momentum, "texture_momentum": texture_momentum, "second_momentum": 0.95}
    rates = {"network_rate": 0.02, "texture_rate": 0.03, "weight_decay": 0.1}
    optimiser = optimiser_of(made, settings(**rates, masked_texture=masked, optimiser=options))
    rng = np.random.default_rng(2)
    network = {"rate": 0.02, "beta": momentum, "masked": False}
    rows = (
        (made.network.colour[3].weight, network | {"decay": 0.1}),
        (made.network.colour[3].bias, network | {"decay": 0.0}),
        (made.textures[0].scales[1], {"rate": 0.03, "decay": 0.1, "beta": texture_momentum, "masked": masked}),
    )
    wanted = []
    gradients = [
        [rng.normal(0, 1, tuple(p.shape)) * (rng.random(tuple(p.shape)) < 0.7) for _ in range(3)] for p, _ in rows
    ]
    for (parameter, row), each in zip(rows, gradients, strict=True):
        wanted.append(adam_by_hand(parameter, each, row | {"kind": kind, "beta2": 0.95}))
    for number in range(3):
        for (parameter, _), each in zip(rows, gradients, strict=True):
            parameter.grad = torch.from_numpy(each[number].astype(np.float32))
        optimiser.step()
    for (parameter, _), each in zip(rows, wanted, strict=True):
        np.testing.assert_allclose(parameter.detach(), each, atol=2e-6)


def test_gradients_are_clipped_by_value_and_then_by_norm() -> None:
    """(6, -8, 1) has the norm 10.05; cut to 4 it is (4, -4, 1), of the norm 5.745."""
    layer = torch.nn.Linear(3, 1, bias=False)

    def clipped(**options: float) -> Any:
        layer.weight.grad = torch.tensor([[6.0, -8.0, 1.0]])
        clip_gradients(layer, OptimiserOptions(**options))  # type: ignore[arg-type]
        return layer.weight.grad[0].numpy()

    np.testing.assert_allclose(clipped(clip_norm=0), [6, -8, 1])
    np.testing.assert_allclose(clipped(clip_norm=0, clip_value=4), [4, -4, 1])
    np.testing.assert_allclose(clipped(clip_norm=2), np.array([6, -8, 1]) * 2 / math.sqrt(101), atol=1e-5)
    np.testing.assert_allclose(clipped(clip_norm=2, clip_value=4), np.array([4, -4, 1]) * 2 / math.sqrt(33), atol=1e-5)
    np.testing.assert_allclose(clipped(clip_norm=100), [6, -8, 1])


def test_a_step_of_several_batches_goes_by_their_mean_gradient(
    groups: list[ShapeGroup], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Plain descent with statistics that stay, so that the gradients of the batches do not depend on each other.

    All stand before black: a background is drawn for each sample of each step.
    """
    monkeypatch.setattr(objective, "drawn_behind", lambda target: torch.zeros_like(target[:, :3]))
    asked = settings(
        freeze_norms_at=0.0, noise_steps=0.0, optimiser={"batches_per_step": 3, "clip_norm": 0.0}, network_rate=1.0
    )
    monkeypatch.setattr(step_loop, "rate_share", lambda _: 1.0)
    monkeypatch.setattr(
        step_loop, "optimiser_of", lambda a, *_: torch.optim.SGD([{"params": [p]} for p in a.network.parameters()][:3])
    )
    state = first_state(avatar(), asked)
    state.step = 1
    before = avatar()
    stream = batch_stream(groups, asked, COUNT, 1)
    batches = [next(stream) for _ in range(3)]
    before.eval()
    terms = [add_gradients(before, load_batch(*each), Objective(asked.loss.by_name()), 1 / 3) for each in batches]
    found = next(steps(state, groups, asked, COUNT))
    assert found["decibels"] == pytest.approx(np.mean([each["decibels"] for each in terms]), rel=1e-5)
    wanted = next(before.network.parameters())
    np.testing.assert_allclose(
        next(state.avatar.network.parameters()).detach(), (wanted - wanted.grad).detach(), atol=1e-4
    )


# Which samples


def drawn(groups: list[ShapeGroup], count: int = 12, **options: Any) -> list[Any]:
    return list(batch_stream(groups, settings(batches=options), count))


def test_a_look_s_samples_occur_as_often_as_its_repeats_say(groups: list[ShapeGroup]) -> None:
    """Four samples of the first person once, and of the second three times: 16 in an epoch of batches of one."""
    people = [replace(group, person=number) for number, group in enumerate(groups)]
    asked = settings(look=["default", "hiker"], batch=1, batches={"look_repeats": [1, 3]})
    shown = Counter(group.person for group, _ in batch_stream(people, asked, 16))
    assert shown == {0: 4, 1: 12}


def test_a_share_of_the_samples_is_used_again_and_again(groups: list[ShapeGroup]) -> None:
    used = {(group.shape, int(number)) for group, index in drawn(groups, sample_share=0.3) for number in index}
    assert sorted(shape for shape, _ in used) == [(64, 32)] * 2 + [(64, 64)] * 2, "0.3 of four, rounded up"
    assert len({(group.shape, int(number)) for group, index in drawn(groups) for number in index}) == 8


def test_zoom_is_measured_and_told_apart(groups: list[ShapeGroup]) -> None:
    """A step of t texels of 64 is 64 / t pixels a side; 0.25 and 0.27 are a tenth of an octave apart."""
    for group in groups:
        np.testing.assert_allclose(zoom(group), 64 / np.array(TEXEL_STEPS), rtol=2e-3)
    pairs = {tuple(sorted(map(int, index))) for _, index in drawn(groups, same_zoom=True)}
    assert pairs == {(0, 1), (2,), (3,)}
    assert any(set(index) - {0, 1} and set(index) & {0, 1} for _, index in drawn(groups))


def test_only_whole_bodies_are_read_at_last(groups: list[ShapeGroup]) -> None:
    """Of ten steps from the seventh on; before that half of all samples are faces."""
    whole = [is_whole(each) for each in drawn(groups, 10, full_body_from=0.6)]
    assert all(whole[6:]) and not all(whole[:6])
    of_whole = [phase.first for phase in phases(groups, settings(batches={"full_body_from": 0.6}), 10)]
    assert of_whole == [0, 0, 6]
    with pytest.raises(BadInputError, match=r"samples: found none that shows a whole body.*draw more samples"):
        drawn([_faces(groups[0])], full_body_from=0.6)
    assert drawn([_faces(groups[0])], full_body_from=1.0)


def test_small_samples_end_where_whole_bodies_begin(groups: list[ShapeGroup], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "SMALL_PIXELS", 64 * 64)
    asked = settings(small_until=0.8, batches={"full_body_from": 0.5})
    found = list(batch_stream(groups, asked, 10))
    assert len(found) == 10 and all(group.shape == (64, 32) for group, _ in found[:5])
    assert all(is_whole(each) for each in found[5:]) and (64, 64) in [group.shape for group, _ in found[5:]]


def _faces(group: ShapeGroup) -> ShapeGroup:
    return ShapeGroup(group.shape, group.uv, group.covered, group.rgba, np.full(len(group), FACE, np.int8))


def test_batches_go_on_in_every_phase_where_they_were(groups: list[ShapeGroup]) -> None:
    asked = settings(small_until=0.3, batches={"full_body_from": 0.7}, optimiser={"batches_per_step": 2})
    whole = list(batch_stream(groups, asked, 10))
    assert len(whole) == 20
    for step in (1, 3, 5, 8):
        rest = list(batch_stream(groups, asked, 10, step))
        assert [(g.shape, i.tolist()) for g, i in rest] == [(g.shape, i.tolist()) for g, i in whole[2 * step :]]


def test_statistics_are_those_of_whole_bodies(groups: list[ShapeGroup], monkeypatch: pytest.MonkeyPatch) -> None:
    """Other batches use them, and leave them as they are; without the option every batch changes them."""
    for option in (True, False):
        asked = settings(batches={"full_body_statistics": option})
        state = first_state(avatar(), asked)
        seen: list[bool] = []
        stream = batch_stream(groups, asked, 8)
        monkeypatch.setattr(step_loop, "batch_stream", lambda *_, stream=stream: stream)
        counter = state.avatar.network.colour[1].num_batches_tracked
        going, batches = steps(state, groups, asked, 8), list(batch_stream(groups, asked, 8))
        for batch in batches:
            before = int(counter)
            next(going)
            seen.append(int(counter) > before)
            whole = {bool(each) for each in np.isin(batch[0].band[batch[1]], (FAR, FULL_BODY))}
            assert len(whole) == 1 or not option
        assert seen == [is_whole(each) if option else True for each in batches] and any(seen)
        assert not option or not all(seen)


# Noise, dropout, norms


class Same(torch.nn.Module):  # type: ignore[misc]
    def forward(self, x: Any) -> Any:
        return x


def test_noise_is_on_texels_or_on_the_whole_input_and_in_training_alone() -> None:
    """65,536 numbers of one deviation: theirs is known to 0.3 %, so 2 % are seven times that."""
    made = TrainableAvatar(UNet(width=4, channels=4), NeuralTexture(np.zeros((64, 64, 4), np.float32), sides=(64,)))
    made.network = Same()
    middles = (np.arange(64) + 0.5) / 64
    uv = torch.from_numpy(np.stack(np.meshgrid(middles, middles), axis=-1)[None].repeat(4, 0).astype(np.float32))
    covered = torch.zeros(4, 64, 64, dtype=torch.bool)
    covered[:, :, :32] = True
    torch.manual_seed(3)
    for texture, everywhere in ((0.1, 0.0), (0.0, 0.2)):
        made.texture_noise, made.input_noise = texture, everywhere
        x = made.train()(uv, covered).detach().numpy()
        shown, empty = x[..., :32], x[..., 32:]
        assert shown.std() == pytest.approx(max(texture, everywhere), rel=0.02)
        assert empty.std() == pytest.approx(everywhere, rel=0.02, abs=1e-9)
        assert (np.abs(shown[0] - shown[1]).max() < 1e-6) == bool(texture), "texels are the same in all pictures"
        assert not made.eval()(uv, covered).any()


def test_dropout_takes_whole_channels_after_each_level() -> None:
    network = UNet(width=4, channels=4)
    levels = [network.encoder.stem, *network.encoder.stages, *network.levels]
    plain: list[Any] = []
    dropped: list[Any] = []
    hooks = [
        level.register_forward_hook(lambda _m, _i, output: plain.append(output.detach().clone())) for level in levels
    ]
    add_dropout(network, 0.25)
    for level in levels:
        level.register_forward_hook(lambda _m, _i, output: dropped.append(output.detach().clone()))
    x = torch.randn(16, 4, 64, 64)
    torch.manual_seed(1)
    with torch.no_grad():
        network.train()(x)
    gone = total = 0
    for before, after in zip(plain, dropped, strict=True):
        ratio = after.flatten(2).sum(2) / before.flatten(2).sum(2).clamp(min=1e-9)
        alive = before.flatten(2).sum(2) > 1e-6
        off = (after.flatten(2) == 0).all(2) & alive
        np.testing.assert_allclose(ratio[alive & ~off], 1 / 0.75, rtol=1e-4)
        gone, total = gone + int(off.sum()), total + int(alive.sum())
    assert len(plain) == 10 and total > 300
    assert abs(gone / total - 0.25) < 5 * math.sqrt(0.25 * 0.75 / total)
    for each in hooks:
        each.remove()
    with torch.no_grad():
        dropped.clear()
        wanted = UNet(width=4, channels=4)
        wanted.load_state_dict(network.state_dict())
        assert torch.equal(network.eval()(x), wanted.eval()(x))


def test_no_norm_is_a_scale_and_a_shift() -> None:
    norm = NORMS["none"](3)
    with torch.no_grad():
        norm.weight[:], norm.bias[:] = torch.tensor([1.0, -2.0, 0.5]), torch.tensor([0.0, 1.0, 3.0])
    x = 10 + 5 * torch.randn(4, 3, 8, 8, generator=torch.Generator().manual_seed(2))
    wanted = x * torch.tensor([1.0, -2.0, 0.5])[:, None, None] + torch.tensor([0.0, 1.0, 3.0])[:, None, None]
    for made in (norm.train(), norm.eval()):
        np.testing.assert_allclose(made(x).detach(), wanted, atol=3e-4)
    assert not norm.running_mean.any() and bool((norm.running_var == 1).all())
