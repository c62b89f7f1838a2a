"""The training loop beside one that is written out again, and its main process with workers that are doubles."""

from __future__ import annotations

import contextlib
import copy
import math
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from trilane.errors import BadInputError  # noqa: E402
from trilane.training import training_loop  # noqa: E402
from trilane.training.activation_noise import add_activation_noise  # noqa: E402
from trilane.training.losses import drawn_behind, loss_terms, total_loss  # noqa: E402
from trilane.training.network import UNet  # noqa: E402
from trilane.training.neural_texture import NeuralTexture  # noqa: E402
from trilane.training.sample_files import U16, batches, create_group, open_groups  # noqa: E402
from trilane.training.trainable_avatar import TrainableAvatar  # noqa: E402
from trilane.training.training_loop import FitConfig, fit, load_batch  # noqa: E402
from trilane.training.weights_file import load_avatar, load_network, save_avatar  # noqa: E402

SMALL, LARGE = (32, 32), (64, 32)
#: When each step begins, as a share of the budget; at the last one there is none left.
SHARES = (0.0, 0.01, 0.05, 0.3, 0.7, 0.9, 1.0)
CONFIG = FitConfig(minutes=2.0, workers=2, batch=2, seed=5, small_until=0.05, repeats=(1, 2, 1, 1, 1), threads=1)


def avatar() -> TrainableAvatar:
    torch.manual_seed(0)
    start = np.random.default_rng(1).uniform(-0.5, 0.5, (64, 64, 4)).astype(np.float32)
    return TrainableAvatar(NeuralTexture(start, sides=(64, 32)), UNet(width=4, channels=4))


@pytest.fixture
def data(tmp_path, monkeypatch):
    """Five samples of a small shape and four of a large one."""
    monkeypatch.setattr(training_loop, "SMALL_PIXELS", math.prod(LARGE))
    rng = np.random.default_rng(0)
    for shape, count in ((SMALL, 5), (LARGE, 4)):
        group = create_group(tmp_path / "data", shape, (np.arange(count) % 2).astype(np.int8))
        group.uv[:] = rng.integers(0, U16, group.uv.shape)
        group.covered[:, 4:24, 6:28] = 1
        group.rgba[:, 4:26, 5:28] = (200, 100, 50, 255)
    return tmp_path / "data"


@pytest.fixture
def clock(monkeypatch):
    """Readings of the clock, seconds after 1000, one after another."""

    def reads(seconds):
        left = iter(seconds)
        monkeypatch.setattr(training_loop, "time", SimpleNamespace(time=lambda: 1000.0 + next(left)))

    return reads


def test_half_size_tensors_have_fewer_than_160_x_160_pixels():
    assert training_loop.SMALL_PIXELS == 25600


def test_a_batch_is_in_shares(data):
    group = open_groups(data)[0]
    uv, covered, target = load_batch(group, np.array([3, 1]))
    np.testing.assert_allclose(uv, group.uv[[3, 1]] / 65535, atol=1e-7)
    assert covered.dtype == torch.bool and (covered.numpy() == (group.covered[[3, 1]] == 1)).all()
    np.testing.assert_allclose(target, group.rgba[[3, 1]].transpose(0, 3, 1, 2) / 255, atol=1e-7)


def trained_again(made, data, number, jitter=0.0):
    """What a worker does with `CONFIG` at the times `SHARES`: its weights' sum, and its smoothed terms.

    `jitter`: of the gradients, relative.
    """
    torch.manual_seed(5 + number)
    shared, mine = made, copy.deepcopy(made)
    add_activation_noise(mine.network, 1.0)
    mine.network.to(memory_format=torch.channels_last)
    small, large = open_groups(data)
    streams = [
        batches(groups, 2, np.random.default_rng((5, number, k)), (1, 2, 1, 1, 1))
        for k, groups in enumerate(([small], [small, large]))
    ]
    kernels = [p for p in mine.network.parameters() if p.ndim > 1]
    vectors = [p for p in mine.network.parameters() if p.ndim == 1]
    texture = list(mine.texture.parameters())
    rates = {"kernels": 1.5e-3, "vectors": 1.5e-3, "texture": 4e-4}
    parts = {"kernels": (kernels, 1e-3), "vectors": (vectors, 0.0), "texture": (texture, 1e-3)}
    optimisers = {
        name: torch.optim.AdamW(parameters, lr=1.0, betas=(0.9, 0.99), weight_decay=decay)
        for name, (parameters, decay) in parts.items()
    }
    smoothed = np.zeros(8)
    before = {name: value.clone() for name, value in mine.state_dict().items()}
    for step, share in enumerate(SHARES[:-1]):
        falls = 0.01 + 0.99 * (1 + math.cos(math.pi * (share - 0.02) / 0.98)) / 2
        mine.train()
        if share > 0.6:
            for module in mine.modules():
                if isinstance(module, torch.nn.BatchNorm2d):
                    module.train(False)
        group, index = next(streams[0 if share < 0.05 else 1])
        uv, covered, target = load_batch(group, index)
        terms = loss_terms(mine(uv, covered), target, drawn_behind(target))
        mine.zero_grad()
        total_loss(terms).backward()
        length = math.sqrt(sum(float(p.grad.double().square().sum()) for p in mine.parameters()))
        for p in mine.parameters():
            p.grad *= min(1.0, 1.0 / (length + 1e-6))
            p.grad *= 1 + jitter * torch.randn(p.shape, generator=torch.Generator().manual_seed(step))
        for name, optimiser in optimisers.items():
            rising = {0.0: 0.02, 0.01: 0.5}
            optimiser.param_groups[0]["lr"] = rates[name] * rising.get(share, falls)
            optimiser.step()
        smoothed += 0.3 * (np.array([float(term.detach()) for term in terms.values()]) - smoothed)
        if step == 3:
            exchanged(mine, before, shared)
    return shared, smoothed


def exchanged(mine, before, shared):
    """Three quarters of the change, since two workers share 1.5 of it; statistics become the mean."""
    weights = dict(mine.named_parameters())
    with torch.no_grad():
        for name, value in mine.state_dict().items():
            other = shared.state_dict()[name]
            if name in weights:
                other += 0.75 * (value - before[name])
                value.copy_(other)
            elif value.dtype.is_floating_point:
                other.copy_((other + value) / 2)
                value.copy_(other)


def worked(made, data, config=CONFIG, number=1):
    """The shared weights after one worker, run in this process, and the steps and terms that it counted."""
    steps, terms = SimpleNamespace(value=0), torch.zeros(16)
    training_loop._worker(number, made, data, config, 1000.0, steps, terms, contextlib.nullcontext())
    return made, steps.value, terms.numpy()


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one.state_dict().values(), other.state_dict().values(), strict=True))


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_a_worker_does_what_the_loop_written_out_again_does(data, clock):
    """To a twentieth of the way, or ten times what rounding does: Adam divides by a gradient's size, so where that is
    next to nothing a rounding moves a weight by a whole step."""
    clock(120 * share for share in SHARES)
    shared, steps, terms = worked(avatar(), data)
    again, smoothed = trained_again(avatar(), data, 1)
    rounded, _ = trained_again(avatar(), data, 1, jitter=2.0**-22)
    assert steps == 6
    np.testing.assert_allclose(terms[:8], smoothed, rtol=1e-3)
    assert not terms[8:].any()
    start = avatar().state_dict()
    for (name, found), wanted, other in zip(
        shared.state_dict().items(), again.state_dict().values(), rounded.state_dict().values(), strict=True
    ):
        way = float((wanted - start[name]).double().abs().mean())
        off, rounding = (float((one - wanted).double().abs().mean()) for one in (found, other))
        assert off <= max(5e-2 * way, 10 * rounding), f"{name}: moved by {way}, {off} from where it should be"
        assert way > 0 or name.endswith("num_batches_tracked"), name


def test_a_worker_alone_shares_its_whole_change_and_ends_after_its_steps(data, clock):
    clock([30.0] * 4)
    seen = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training_loop, "_exchange", lambda *_, **__: seen.append(_[3]))
        _, steps, _ = worked(avatar(), data, FitConfig(minutes=2.0, workers=1, batch=2, max_steps=4))
    assert (steps, seen) == (4, [1.0])


def test_a_worker_ends_when_its_parent_has(data, clock, monkeypatch):
    clock([0.0] * 9)
    parents = iter([7, 7, 7, 1])
    monkeypatch.setattr(training_loop.os, "getppid", lambda: next(parents))
    _, steps, _ = worked(avatar(), data)
    assert steps == 2


def test_terms_are_smoothed_slowly_after_fifty_steps(data, clock):
    clock([0.0])
    terms = torch.full((16,), 100.0)
    training_loop._worker(
        0, avatar(), data, FitConfig(2.0, batch=2, max_steps=1), 1000.0, SimpleNamespace(value=50), terms,
        contextlib.nullcontext(),
    )  # fmt: skip
    assert terms[:8].min() > 97.5 and terms[:8].max() < 99, "2 % of the way to terms of -2 to 30"


class Pool:
    """Ends at the fourth look; between two looks the shared weights grow by 1."""

    def __init__(self, shared, steps, terms):
        self.shared, self.steps, self.terms, self.looks = shared, steps, terms, []

    def join(self, timeout):
        self.looks.append(timeout)
        if len(self.looks) > 3:
            return True
        with torch.no_grad():
            for parameter in self.shared.parameters():
                parameter += 1.0
        self.terms[:] = torch.arange(16) / 8
        self.steps.value = 10 * (len(self.looks) - 1)
        return False


def test_the_main_process_averages_reports_and_keeps(monkeypatch, clock, tmp_path):
    """Looks after 20, 40 and 120 of 240 s. At the first nothing was learnt; the average's age is a fifth of the time,
    but at least 4 s and at most the 10 s that are asked for: it keeps exp(-4/8) and then exp(-4/10) of itself."""
    pools, spawned = [], []

    def spawn(worker, work, nprocs, join):
        spawned.append((worker, work, nprocs, join))
        pools.append(Pool(work[0], work[4], work[5]))
        return pools[0]

    methods = []

    def get_context(method):
        methods.append(method)
        return SimpleNamespace(Value=lambda kind, value: SimpleNamespace(kind=kind, value=value), Lock=lambda: "lock")

    monkeypatch.setattr(training_loop, "tmp", SimpleNamespace(spawn=spawn, get_context=get_context))
    clock([0, 20, 40, 40, 120, 120])
    config = FitConfig(minutes=4.0, workers=3, average_s=10.0, report_s=40.0, checkpoint_s=100.0)
    made, lines, kept = avatar(), [], []
    start = float(made.state_dict()["network.mask.3.bias"])
    average, steps = fit(made, tmp_path, config, lines.append, lambda now, at: kept.append((now, at)))
    assert steps == 20 and pools[0].looks == [4.0] * 4 and methods == ["spawn", "spawn"]
    worker, work, count, joined = spawned[0]
    assert (worker, count, joined) == (training_loop._worker, 3, False)
    assert work[0] is made and work[1:4] == (tmp_path, config, 1000.0)
    assert (work[4].kind, work[6]) == ("q", "lock")
    assert tuple(work[5].shape) == (16,)
    names = ("composite", "decibels", "colour", "edges", "coarse", "mask", "background", "overlap")
    text = " ".join(f"{name} {number / 8:.4f}" for number, name in enumerate(names))
    assert lines == [f" 16.7% step 10 {text}", f" 50.0% step 20 {text}"]
    assert kept == [(average, 20)]
    assert not average.training and average is not made
    first = start + (1 - math.exp(-4 / 8)) * 2
    wanted = first + (1 - math.exp(-4 / 10)) * (start + 3 - first)
    assert float(average.state_dict()["network.mask.3.bias"]) == pytest.approx(wanted, abs=1e-5)


def test_settings_of_a_training_that_names_none():
    assert FitConfig(minutes=1.0) == FitConfig(
        1.0, 3, 1, 4, 0, 1.5e-3, 4e-4, 1e-3, 0.12, 0.6, 60.0, (1, 1, 1, 1, 1), 1.0, 30.0, 180.0, 10_000_000, "float32"
    )


def kept_weights(path, **changes):
    """A file of weights, changed: None takes one out."""
    arrays = {name: value.numpy() for name, value in avatar().state_dict().items()} | changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def test_weights_without_steps_have_none_and_counters_may_be_missing(tmp_path):
    counter = "network.mask.1.num_batches_tracked"
    made, steps = load_avatar(avatar(), kept_weights(tmp_path / "a.npz", **{counter: None}))
    assert steps == 0
    assert same(made, avatar())


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"network.mask.3.bias": None}, "no network.mask.3.bias"),
        ({"another": np.zeros(1)}, "also another"),
    ],
)
def test_weights_that_are_not_all_there_are_refused(tmp_path, changes, found):
    path = kept_weights(tmp_path / "a.npz", **changes)
    with pytest.raises(BadInputError) as caught:
        load_avatar(avatar(), path)
    assert str(caught.value) == f"{path}: found {found}, expected weights that this network's training saved"


def test_a_network_is_read_from_an_avatars_weights_and_nothing_else_is(tmp_path):
    save_avatar(avatar(), 3, tmp_path / "a.npz")
    made = load_network(UNet(width=4, channels=4), tmp_path / "a.npz")
    assert same(made, avatar().network)
    (tmp_path / "b.npz").write_text("no archive")
    with pytest.raises(BadInputError, match=r"b\.npz: found .*, expected weights that this network's training saved"):
        load_network(UNet(width=4, channels=4), tmp_path / "b.npz")
