"""Training by steps: repeats to the bit, goes on to the bit after it was ended anywhere, and says what it is given."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from trilane.errors import BadInputError  # noqa: E402
from trilane.training import dataset, step_loop  # noqa: E402
from trilane.training.dataset import U16, ShapeGroup, batches, create_group, open_groups  # noqa: E402
from trilane.training.network import UNet, add_activation_noise  # noqa: E402
from trilane.training.objective import drawn_behind, loss_terms, total_loss  # noqa: E402
from trilane.training.step_loop import (  # noqa: E402
    TrainingState,
    first_state,
    load_state,
    save_state,
    step_seconds,
    steps,
)
from trilane.training.train import resumed_settings  # noqa: E402
from trilane.training.trainable_avatar import (  # noqa: E402
    NeuralTexture,
    TrainableAvatar,
    load_batch,
)
from trilane.training.training_settings import TrainingSettings, parsed_settings, read_settings, settings_text  # noqa: E402

SMALL, LARGE = (32, 32), (64, 32)
COUNT = 7
#: How often an epoch has a sample of each band.
REPEATS = (1, 2, 1, 1, 1)
#: Steps 0 to 2 are of small samples alone, and from step 5 on batch statistics stay.
VALUES: dict[str, Any] = {
    "device": "cpu",
    "samples": 9,
    "batch": 2,
    "seed": 5,
    "small_until": 0.4,
    "freeze_norms_at": 0.6,
}


def settings(**others: Any) -> TrainingSettings:
    return parsed_settings(VALUES | others, "a test")


def avatar(width: int = 4) -> TrainableAvatar:
    torch.manual_seed(0)
    start = np.random.default_rng(1).uniform(-0.5, 0.5, (64, 64, 4)).astype(np.float32)
    return TrainableAvatar(UNet(width=width, channels=4), NeuralTexture(start, sides=(64, 32)))


@pytest.fixture(autouse=True)
def one_thread() -> Any:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[ShapeGroup]:
    """Five samples of a small shape and four of a large one."""
    monkeypatch.setattr(dataset, "SMALL_PIXELS", math.prod(LARGE))
    rng = np.random.default_rng(0)
    for shape, count in ((SMALL, 5), (LARGE, 4)):
        group = create_group(tmp_path / "data", shape, (np.arange(count) % 2).astype(np.int8))
        group.uv[:] = rng.integers(0, U16, group.uv.shape)
        group.covered[:, 4:24, 6:28] = 1
        group.rgba[:, 4:26, 5:28] = (200, 100, 50, 255)
    return open_groups(tmp_path / "data")


def trained(groups: list[ShapeGroup], until: int, **others: Any) -> TrainingState:
    """The state after `until` of seven steps."""
    asked = settings(**others)
    state = first_state(avatar(), asked)
    go(state, groups, asked, until)
    return state


def go(state: TrainingState, groups: list[ShapeGroup], asked: TrainingSettings, until: int) -> None:
    going = steps(state, groups, asked, COUNT)
    while state.step < until:
        next(going)


def bits(state: TrainingState) -> dict[str, bytes]:
    return {name: value.detach().contiguous().numpy().tobytes() for name, value in state.tensors().items()}


def of_two(network_seed: int = 0) -> TrainableAvatar:
    """Two persons with textures of their own and one network."""
    torch.manual_seed(network_seed)
    rng = np.random.default_rng(1)
    images = [rng.uniform(-0.5, 0.5, (64, 64, 4)).astype(np.float32) for _ in range(2)]
    return TrainableAvatar(UNet(width=4, channels=4), *(NeuralTexture(image, sides=(64, 32)) for image in images))


def test_a_persons_samples_train_the_network_and_only_the_persons_texture(groups: list[ShapeGroup]) -> None:
    asked, made = settings(weight_decay=0.0), of_two()
    before = {name: value.clone() for name, value in made.state_dict().items()}
    state = first_state(made, asked)
    go(state, [replace(group, person=1) for group in groups], asked, 3)
    after = made.state_dict()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert not any(name.startswith("textures.0") for name in changed)
    assert any(name.startswith("textures.1") for name in changed) and any("network" in name for name in changed)
    uv, covered, _ = load_batch(groups[0], np.array([0]))
    made.eval()
    alone = TrainableAvatar(made.network, made.textures[1])  # type: ignore[arg-type]
    assert torch.equal(made(uv, covered, 1), alone.eval()(uv, covered))
    assert not torch.equal(made(uv, covered, 0), made(uv, covered, 1))


def test_a_network_that_is_kept_stays_the_same_to_the_bit(groups: list[ShapeGroup]) -> None:
    """Its weights and the statistics of its norms; the texture is trained all the same."""
    asked = settings(start="default", keep_network=True, weight_decay=0.1)
    made = avatar()
    made.network.requires_grad_(False)
    before = {name: value.clone() for name, value in made.state_dict().items()}
    go(first_state(made, asked), groups, asked, 3)
    changed = {name for name, value in made.state_dict().items() if not torch.equal(before[name], value)}
    assert changed and all(name.startswith("textures.0") for name in changed)


def test_a_batch_is_in_shares(groups: list[ShapeGroup]) -> None:
    group = groups[0]
    uv, covered, target = load_batch(group, np.array([3, 1]))
    np.testing.assert_allclose(uv, group.uv[[3, 1]] / 65535, atol=1e-7)
    assert covered.dtype == torch.bool and (covered.numpy() == (group.covered[[3, 1]] == 1)).all()
    np.testing.assert_allclose(target, group.rgba[[3, 1]].transpose(0, 3, 1, 2) / 255, atol=1e-7)


def trained_again(made: TrainableAvatar, groups: list[ShapeGroup]) -> list[dict[str, float]]:
    """Do seven steps in float64 as `VALUES` asks for them, written out again, and return the terms of each.

    `made`: avatar in float64, which is changed in place.
    """
    add_activation_noise(made.network, 1.0)
    made.network.to(memory_format=torch.channels_last)
    streams = [
        batches(some, 2, np.random.default_rng((5, 2, phase)), REPEATS)
        for phase, some in enumerate((groups[:1], groups))
    ]
    kernels = [p for p in made.network.parameters() if p.ndim > 1]
    vectors = [p for p in made.network.parameters() if p.ndim == 1]
    parts = ((kernels, 1.5e-3, 1e-3), (vectors, 1.5e-3, 0.0), (list(made.textures.parameters()), 4e-4, 1e-3))
    optimisers = [torch.optim.AdamW(ps, lr=1.0, betas=(0.9, 0.99), weight_decay=decay) for ps, _, decay in parts]
    found = []
    for step in range(COUNT):
        share = step / COUNT
        torch.manual_seed(step * 2**31 + 5)
        made.train()
        if share > 0.6:
            for module in made.modules():
                if isinstance(module, torch.nn.BatchNorm2d):
                    module.train(False)
        uv, covered, target = exact_batch(*next(streams[0 if share < 0.4 else 1]))
        terms = loss_terms(made(uv, covered), target, drawn_behind(target))
        made.zero_grad()
        total_loss(terms).backward()
        length = math.sqrt(sum(float(p.grad.double().square().sum()) for p in made.parameters()))
        for p in made.parameters():
            p.grad *= min(1.0, 1.0 / (length + 1e-6))
        falls = 0.01 + 0.99 * (1 + math.cos(math.pi * (share - 0.02) / 0.98)) / 2
        for optimiser, (_, rate, _) in zip(optimisers, parts, strict=True):
            optimiser.param_groups[0]["lr"] = rate * (0.02 if step == 0 else falls)
            optimiser.step()
        found.append({name: float(term.detach()) for name, term in terms.items()})
    return found


def exact_batch(*arguments: Any) -> tuple[Any, Any, Any]:
    uv, covered, target = load_batch(*arguments)
    return uv.double(), covered, target.double()


def test_a_training_does_what_the_loop_written_out_again_does(
    groups: list[ShapeGroup], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In float64: Adam divides by a gradient's size, so in float32 a rounding moves some weights by a whole step."""
    monkeypatch.setattr(step_loop, "load_batch", exact_batch)
    asked = settings(batches={"repeats": REPEATS})
    state = first_state(avatar().double(), asked)
    terms = list(steps(state, groups, asked, COUNT))
    again = avatar().double()
    wanted = trained_again(again, groups)
    for one, other in zip(terms, wanted, strict=True):
        assert one == pytest.approx(other, rel=1e-6)
    start, alike = avatar().double().state_dict(), again.state_dict()
    for name, found in state.avatar.state_dict().items():
        way = float((alike[name] - start[name]).double().abs().mean())
        off = float((found - alike[name]).double().abs().mean())
        assert off <= 1e-4 * way, f"{name}: moved by {way}, {off} from where it should be"
        assert way > 0 or name.endswith("num_batches_tracked"), name


def test_the_same_seed_gives_the_same_bits(groups: list[ShapeGroup]) -> None:
    first = bits(trained(groups, COUNT))
    torch.manual_seed(99)
    torch.rand(5)
    assert bits(trained(groups, COUNT)) == first
    assert bits(trained(groups, COUNT, seed=6)) != first


@pytest.mark.parametrize(
    ("ended", "others"),
    [
        (2, {}),
        (3, {"masked_texture": True}),
        (5, {}),
        (6, {}),
        (3, {"loss": "thesis", "width": 4}),
        (2, {"precision": "bfloat16"}),
    ],
    ids=str,
)
def test_a_training_that_was_ended_goes_on_to_the_bit(
    groups: list[ShapeGroup], tmp_path: Path, ended: int, others: dict[str, Any]
) -> None:
    """In each part: before and after other samples are used and statistics stay. With discriminators too."""
    whole = bits(trained(groups, COUNT, **others))
    before = trained(groups, ended, **others)
    save_state(before, tmp_path / "state.npz")
    after = first_state(avatar(), settings(**others))
    load_state(after, tmp_path / "state.npz")
    assert bits(after) == bits(before) and after.step == ended
    go(after, groups, settings(**others), COUNT)
    assert bits(after) == whole
    assert any(name.startswith("judges.") for name in whole) == ("loss" in others)


def test_the_network_is_computed_in_the_precision_that_is_asked_for(groups: list[ShapeGroup]) -> None:
    """bfloat16 rounds by up to 2**-9, in each of some twenty convolutions; weights and average stay float32."""
    losses = {}
    for precision in ("float32", "bfloat16"):
        asked = settings(precision=precision)
        state = first_state(avatar(), asked)
        losses[precision] = next(steps(state, groups, asked, COUNT))["composite"]
        assert {value.dtype for value in state.avatar.parameters()} == {torch.float32}
        assert state.average.precision == "float32"
    assert losses["float32"] != losses["bfloat16"] == pytest.approx(losses["float32"], rel=2**-5)


def test_a_masked_texture_is_kept_where_no_sample_shows_it(groups: list[ShapeGroup]) -> None:
    """Plain AdamW lets it decay; the coarser scale is seen everywhere."""
    begun = avatar().textures[0].scales[0].detach()
    plain, masked = (trained(groups, 3, masked_texture=each).avatar.textures[0].scales[0] for each in (False, True))
    assert bool((plain != begun).all()) and 0.05 < float((masked == begun).float().mean()) < 0.95


def test_the_average_is_the_last_weights_where_few_steps_were_done(groups: list[ShapeGroup]) -> None:
    """A tenth of seven steps is less than one; of a time constant of all steps it is their plain mean."""
    state = trained(groups, 3)
    for one, other in zip(state.average.parameters(), state.avatar.parameters(), strict=True):
        assert torch.equal(one, other)
    asked, weights = settings(average_share=1.0), list[np.ndarray]()
    state = first_state(avatar(), asked)
    for _ in steps(state, groups, asked, 4):
        weights.append(next(state.avatar.parameters()).detach().numpy().copy())
    np.testing.assert_allclose(next(state.average.parameters()).detach(), np.mean(weights, axis=0), atol=1e-6)


def test_a_step_is_measured_on_a_copy(groups: list[ShapeGroup]) -> None:
    made = avatar()
    before = {name: value.clone() for name, value in made.state_dict().items()}
    assert step_seconds(made, groups, settings()) > 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(step_loop, "_measured", lambda *words: 2.0 if words[-1] < words[2].small_until else 10.0)
        assert [step_seconds(made, groups, settings(small_until=share)) for share in (0.0, 0.25, 1.0)] == [10, 8, 2]
    assert all(torch.equal(value, before[name]) for name, value in made.state_dict().items())


def test_steps_that_round_are_measured_with_rounding(groups: list[ShapeGroup], monkeypatch: pytest.MonkeyPatch) -> None:
    """A step takes 1 s, a step that rounds takes 3 s, and half of the steps round: (1 + 3) / 2."""
    now, paint = [0.0], step_loop.add_gradients

    def took(avatar: TrainableAvatar, *words: Any) -> dict[str, float]:
        assert avatar.grid is not None
        now[0] += 3.0 if avatar.grid.active else 1.0
        return paint(avatar, *words)

    monkeypatch.setattr(step_loop, "add_gradients", took)
    monkeypatch.setattr(step_loop.time, "monotonic", lambda: now[0])
    asked = settings(bytes_from=0.5, freeze_norms_at=0.5)
    assert step_seconds(avatar(), groups, asked) == 2.0


def test_a_state_of_another_training_is_refused(groups: list[ShapeGroup], tmp_path: Path) -> None:
    save_state(trained(groups, 1), tmp_path / "state.npz")
    other = first_state(avatar(width=8), settings())
    with pytest.raises(BadInputError, match=r"state\.npz: found .*expected the state of this training; remove it"):
        load_state(other, tmp_path / "state.npz")
    (tmp_path / "state.npz").write_bytes((tmp_path / "state.npz").read_bytes()[:1000])
    with pytest.raises(BadInputError, match="expected the state of this training"):
        load_state(first_state(avatar(), settings()), tmp_path / "state.npz")
    (tmp_path / "state.npz").write_bytes(b"")
    np.save(tmp_path / "lone.npy", np.zeros(3))
    for name in ("state.npz", "lone.npy"):
        with pytest.raises(BadInputError, match="expected the state of this training"):
            load_state(first_state(avatar(), settings()), tmp_path / name)


def test_a_new_network_with_little_time_takes_many_cheap_steps(tmp_path: Path) -> None:
    def rates(**values: Any) -> tuple[float, ...]:
        asked = parsed_settings(values, "a test")
        return asked.batch, asked.small_until, asked.network_rate, asked.texture_rate

    short = (2, 0.8, 5e-3, 1e-3)
    assert rates(start="new", minutes=4.9) == rates(start="new", minutes=1, loss="thesis") == short
    assert rates(start="new", minutes=1, batch=4, network_rate=0.25) == (4, 0.8, 0.25, 1e-3)
    assert rates(start="new", minutes=5) == rates(start="new") == rates(start="new", minutes=1, steps=900)
    assert rates(start="new") == (4, 0.12, 1.5e-3, 4e-4) and rates(minutes=1) == (4, 0.0, 1.5e-3, 4e-4)
    asked = parsed_settings({"start": "new", "minutes": 1}, "a test").model_copy(update={"steps": 40})
    (tmp_path / "training.toml").write_text(settings_text(asked))
    assert read_settings(tmp_path / "training.toml") == asked
    with pytest.raises(BadInputError, match="minutes: found '1', expected"):
        parsed_settings({"start": "new", "minutes": "1"}, "a test")
    with pytest.raises(BadInputError, match="optimiser: found 3, expected"):
        parsed_settings({"loss": "thesis", "optimiser": 3}, "a test")


def test_a_training_goes_on_only_as_it_was_begun(tmp_path: Path) -> None:
    path = tmp_path / "training.toml"
    assert resumed_settings(path, settings()) == settings()
    path.write_text(settings_text(settings(steps=50)))
    assert resumed_settings(path, settings()).steps == 50, "steps that were counted by time stay"
    with pytest.raises(
        BadInputError, match=r"training\.toml: batch: found a training with 2, expected 3, as asked; use"
    ):
        resumed_settings(path, settings(batch=3))
    with pytest.raises(BadInputError, match="steps: found a training with 50, expected 51"):
        resumed_settings(path, settings(steps=51))


#: Prints how many pages the kernel clears for four tensors of 16 MB that are made and freed ten times, in a large heap.
FREED = """
import resource, torch
from trilane.training.step_loop import keep_freed_memory
keep_freed_memory()
for count in (10, 10):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(count):
        tensors = [torch.empty(4_000_000).fill_(1.0) for _ in range(4)]
        del tensors
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the options are those of glibc")
def test_memory_that_a_step_frees_is_there_for_the_next() -> None:
    """Without the options, each of the ten rounds takes new pages of 4 KiB: four tensors have 15,625."""
    done = subprocess.run([sys.executable, "-c", FREED], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 15_625
