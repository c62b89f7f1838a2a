"""The training command, part by part: which part gets what, from which weights it starts, and what it writes down."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

torch = pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from trilane.avatars.bundle import bundle_folder  # noqa: E402
from trilane.errors import BadInputError  # noqa: E402
from trilane.training import neural_texture  # noqa: E402
from trilane.training import train as command  # noqa: E402
from trilane.training.network import UNet  # noqa: E402
from trilane.training.neural_texture import NeuralTexture  # noqa: E402
from trilane.training.subject import Person, Subject  # noqa: E402
from trilane.training.train import TrainConfig, command_of, main, train  # noqa: E402
from trilane.training.trainable_avatar import TrainableAvatar  # noqa: E402
from trilane.training.training_loop import FitConfig  # noqa: E402
from trilane.training.validate import ValidationPlan  # noqa: E402
from trilane.training.weights_file import load_avatar, load_network, save_avatar, save_network  # noqa: E402

#: Of the textures here; a trained one has 512 texels along each side.
SIDES, SIDE, CHANNELS = (64, 32), 64, 16
CLOTHED = {"body": "the default body, clothed by somebody"}


def avatar(seed: int) -> TrainableAvatar:
    torch.manual_seed(seed)
    texture = np.full((SIDE, SIDE, CHANNELS), 0.25 * seed, np.float32)
    return TrainableAvatar(NeuralTexture(texture, SIDES), UNet(width=4, channels=CHANNELS, input_skip=True))


def same(one: torch.nn.Module, other: torch.nn.Module) -> bool:
    pairs = zip(one.state_dict().values(), other.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


def opener(offsets):
    """Stands for what opens renderers of a subject."""


def grey(made: TrainableAvatar) -> float:
    """The mean of its texture."""
    return float(made.texture.image().detach().mean())


@pytest.fixture(autouse=True)
def small_and_set_back(monkeypatch):
    """Textures are small, and PyTorch's threads, which the command sets for its process, are set back."""
    before = torch.get_num_threads()
    monkeypatch.setattr(command, "SIDES", SIDES)
    monkeypatch.setattr(command, "NeuralTexture", lambda start: NeuralTexture(start, SIDES))
    yield
    torch.set_num_threads(before)


@pytest.fixture
def config(tmp_path):
    (tmp_path / "work").mkdir()
    return TrainConfig(
        body=tmp_path / "body.npz", out=tmp_path / "out", name="nobody", work=tmp_path / "work",
        sheet=tmp_path / "sheet.png", minutes=3.0, samples=6, per_band=5, width=4,
        workers=2, threads=7, batch=9, seed=11,
    )  # fmt: skip


@pytest.fixture
def calls(monkeypatch):
    """What the command asks of every other part, in order; the parts answer with their names."""
    log = []

    def part(name, answer=None):
        def asked(*args, **options):
            log.append((name, *args, *options.items()))
            return answer(*args) if callable(answer) else answer

        monkeypatch.setattr(command, name, asked)

    part("clothed_subject", lambda body, *_: Subject(Person(body), "shaped", "renderer", opener, CLOTHED, "renderer"))
    part("subject_with_offsets", lambda subject, *_: subject)
    part("plan_training", "planned")
    part("write_dataset")
    part("open_groups", "groups")
    part("body_arrays", "arrays")
    part("first_texture", np.full((SIDE, SIDE, CHANNELS), 0.5, np.float32))
    part("quantise_avatar", "quantised")
    part("write_avatar")
    part("load_bundle", lambda folder: f"bundle in {folder}")
    part("float_painter", "paint")
    part("comparison_sheet", np.full((3, 4, 3), 7, np.uint8))
    part("revalidate")

    def fit(made, data, settings, report, checkpoint):
        log.append(("fit", data, settings))
        report("half way")
        checkpoint(made, 5)
        return made, 8

    def validate(*args):
        log.append(("validate", *args[:-1]))
        for seed, sample in ((1, "a"), (2, "b"), (1, "c")):
            args[-1](seed, sample)
        return SimpleNamespace(model_dump_json=lambda: "the figures")

    monkeypatch.setattr(command, "fit", fit)
    monkeypatch.setattr(command, "validate", validate)
    return log


def test_every_part_gets_what_is_its(config, calls, tmp_path):
    lines = []
    assert train(config, lines.append) == config.out
    assert (torch.initial_seed(), torch.get_num_threads()) == (11, 2)
    work, said = tmp_path / "work", {call[0]: call[1:] for call in calls}
    assert [call[0] for call in calls] == [
        *(
            "clothed_subject",
            "subject_with_offsets",
            "plan_training",
            "write_dataset",
            "body_arrays",
            "open_groups",
            "first_texture",
        ),
        *("fit", "open_groups", "quantise_avatar", "write_avatar", "load_bundle", "float_painter", "validate"),
        *("revalidate", "comparison_sheet"),
    ]
    assert said["clothed_subject"] == (config.body, 2, "default")
    assert said["plan_training"] == ("renderer", 6, 11)
    assert said["subject_with_offsets"][1:] == (work / "offsets.npz", 11, lines.append)
    source, *others = said["write_dataset"]
    assert (source.func, source.args) == (opener, (None,))
    assert tuple(others) == ("planned", work / "training", 2)
    assert said["open_groups"] == (work / "training",)
    assert said["first_texture"] == ("arrays", "groups", SIDE, CHANNELS)
    assert said["fit"] == (work / "training", FitConfig(minutes=3.0, workers=2, threads=7, batch=9, seed=11))
    made, *rest = said["quantise_avatar"]
    assert rest == ["shaped", "groups", 11, None]
    assert said["write_avatar"] == (
        config.out,
        Person(config.body),
        "quantised",
        4,
        {
            **CLOTHED,
            "samples": 6,
            "steps": 8,
            "batch": 9,
            "seed": 11,
            "held_out_motions": ["builtin:walk-wave-turn"],
            "texture_sides": [64, 32],
        },
        {"name": "nobody", "training_command": command_of(config)},
    )
    assert said["float_painter"][0] is made.network
    assert torch.equal(said["float_painter"][1], made.texture.image().detach())
    bundle, plan, renderer, network = said["validate"]
    assert (bundle, renderer, network.name, network.paint) == (
        f"bundle in {config.out}", "renderer", "the trained weights", "paint",
    )  # fmt: skip
    assert plan == ValidationPlan(("builtin:walk-wave-turn",), (1, 2, 3, 4, 5, 6, 7, 8), 5, ("ort",), "256", 2)
    assert said["revalidate"][0] == bundle
    assert said["comparison_sheet"] == (["a", "c"], ("float", "ort")), "the sheet is of the first seed"
    with Image.open(config.sheet) as image:
        assert (np.asarray(image) == np.full((3, 4, 3), 7)).all()
    assert json.loads((work / "dataset.json").read_text()) == {"samples": 6, "seed": 11}
    assert lines == [
        f"rendering 6 samples into {work / 'training'}",
        "half way",
        "quantising and evaluating",
        "the figures",
    ]
    for file, steps in (("checkpoint.npz", 5), ("final.npz", 8)):
        kept, found = load_avatar(avatar(3), work / file)
        assert same(kept, made) and found == steps
    kept = load_network(UNet(width=4, channels=CHANNELS, input_skip=True), work / "network.npz")
    assert all(
        torch.allclose(a.float(), b.float(), atol=1e-3)
        for a, b in zip(kept.state_dict().values(), made.network.state_dict().values(), strict=True)
    )
    assert grey(made) == pytest.approx(0.5)


@pytest.mark.usefixtures("calls")
def test_the_network_begins_at_the_seed(config):
    first, again, other = (command._starting_point("shaped", one)[0] for one in seeded(config, (11, 11, 12)))
    assert same(first, again) and not same(first, other)


def seeded(config, seeds):
    for seed in seeds:
        torch.manual_seed(seed)
        yield replace(config, seed=seed)


def test_a_training_set_is_rendered_once_and_another_is_refused(config, calls):
    subject = Subject(Person(config.body), "shaped", "renderer", opener, CLOTHED)
    command._render_training_set(subject, config, lambda _: None)
    command._render_training_set(subject, config, lambda _: pytest.fail("rendered again"))
    assert [call[0] for call in calls] == ["plan_training", "write_dataset"]
    with pytest.raises(BadInputError) as caught:
        command._render_training_set(subject, replace(config, samples=7), lambda _: None)
    assert str(caught.value) == (
        f"{config.work / 'dataset.json'}: found {{'samples': 6, 'seed': 11}}, "
        "expected {'samples': 7, 'seed': 11}; use another --work folder"
    )


def test_a_capture_is_another_source_and_is_measured_on_its_own_frames(config, calls, monkeypatch, tmp_path):
    """What is known of the person goes into the bundle; figures of the synthetic person are not measured on it."""
    person = Person(tmp_path / "b.npz", (0.5,), (1.0, 2.0))
    asked = []

    def captured(*words):
        asked.append(words[:2])
        words[2]("9 frames of 10")
        facts = {"body": "that of a capture"}
        return Subject(person, "their shape", "their renderer", opener, facts, None, "their frames", (3, 13))

    monkeypatch.setattr(command, "frame_errors", lambda *words: asked.append(words) or "errors")
    monkeypatch.setattr(command, "error_facts", lambda errors: {"psnr_db": 20.0} if errors == "errors" else None)
    monkeypatch.setattr(command, "write_held_out_error", lambda *words: asked.append(words))
    monkeypatch.setattr(command, "captured_subject", captured)
    lines, folder = [], tmp_path / "mine"
    one = replace(config, capture=folder)
    train(one, lines.append)
    said = {call[0]: call[1:] for call in calls}
    bundle, figures = f"bundle in {config.out}", {"psnr_db": 20.0}
    assert asked == [(folder, 2), (bundle, "their frames", (3, 13), 2), (bundle, figures)]
    assert (lines[0], json.loads(lines[-1])) == ("9 frames of 10", {"held_out_error": figures})
    assert said["plan_training"][0] == "their renderer" and said["write_dataset"][0].func is opener
    assert said["write_avatar"][1] is person and said["write_avatar"][4]["body"] == "that of a capture"
    assert not {"validate", "revalidate", "clothed_subject"} & set(said)
    assert command_of(one).endswith(
        "--capture mine --precision float32 --bytes-from 1.0"
    ) and "--capture" not in command_of(config)
    assert json.loads((config.work / "dataset.json").read_text())["capture"] == str(folder)
    with pytest.raises(BadInputError, match="use another --work folder"):
        train(config, lines.append)
    with pytest.raises(BadInputError, match="none beside --capture"):
        train(replace(one, look="hiker"), lines.append)


def test_the_look_is_that_of_the_person_and_of_the_samples(config, calls):
    """A work folder has the samples of one look."""
    train(replace(config, look="hiker"), lambda _: None)
    assert next(call for call in calls if call[0] == "clothed_subject") == ("clothed_subject", config.body, 2, "hiker")
    assert json.loads((config.work / "dataset.json").read_text())["look"] == "hiker"
    with pytest.raises(BadInputError, match="use another --work folder"):
        train(config, lambda _: None)


def test_no_sheet_is_drawn_when_none_is_asked_for(config, calls):
    train(replace(config, sheet=None), lambda _: None)
    assert "comparison_sheet" not in [call[0] for call in calls] and not config.sheet.exists()


SHARED = {"minutes": 3.0, "workers": 2, "threads": 7, "batch": 9}
LOWER = {"network_rate": 1e-3, "texture_rate": 3e-4, "small_until": 0.0, "freeze_norms_at": 0.1}


@pytest.mark.usefixtures("calls")
def test_training_goes_on_from_weights_at_a_lower_rate(config, tmp_path):
    save_avatar(avatar(1), 40, tmp_path / "kept.npz")
    resumed = replace(config, resume=tmp_path / "kept.npz")
    start, steps, settings = command._starting_point("shaped", resumed)
    assert same(start, avatar(1)) and steps == 40
    assert settings == FitConfig(**SHARED, **LOWER, repeats=(2, 1, 2, 3, 1), seed=13), "no worker repeats its samples"
    _, steps = command._trained("shaped", resumed, lambda _: None)
    assert steps == 48
    assert [int(np.load(config.work / name)["steps"]) for name in ("checkpoint.npz", "final.npz")] == [45, 48]


@pytest.mark.usefixtures("calls")
def test_a_known_network_learns_a_new_texture_or_one_that_is_trained(config, monkeypatch, tmp_path):
    save_network(avatar(1), tmp_path / "network.npz")
    known = replace(config, network=tmp_path / "network.npz")
    start, steps, settings = command._starting_point("shaped", known)
    assert steps == 0 and settings == FitConfig(
        **SHARED, small_until=0.0, freeze_norms_at=0.3, repeats=(2, 1, 2, 3, 1), seed=11
    )
    wanted = load_network(UNet(width=4, channels=CHANNELS, input_skip=True), tmp_path / "network.npz")
    assert same(start.network, wanted)
    assert grey(start) == pytest.approx(0.5)
    texture = np.full((SIDE, SIDE, CHANNELS), -0.5, np.float32)
    bundle = SimpleNamespace(read_texture=lambda: texture)
    monkeypatch.setattr(command, "load_bundle", {"somebody": bundle}.__getitem__)
    start, steps, settings = command._starting_point("shaped", replace(known, texture="somebody"))
    assert steps == 0 and settings == FitConfig(**SHARED, **LOWER, repeats=(2, 1, 2, 3, 1), seed=11)
    assert same(start.network, wanted)
    assert grey(start) == pytest.approx(-0.5)


@pytest.mark.parametrize("shape", [(32, SIDE, CHANNELS), (SIDE, 32, CHANNELS), (SIDE, SIDE, 8)])
def test_a_texture_of_another_shape_is_refused(config, monkeypatch, shape):
    bundle = SimpleNamespace(read_texture=lambda: np.zeros(shape, np.float32))
    monkeypatch.setattr(command, "load_bundle", lambda _: bundle)
    with pytest.raises(BadInputError) as caught:
        command._first_texture("shaped", replace(config, texture="somebody"))
    assert str(caught.value) == f"--texture: found shape {shape}, expected (64, 64, 16)"


def test_a_trained_texture_has_five_scales_of_512_texels_and_less():
    assert neural_texture.SIDES == (512, 256, 128, 64, 32)
    texture = neural_texture.NeuralTexture(np.zeros((512, 512, 1), np.float32))
    assert [tuple(scale.shape) for scale in texture.scales] == [(1, 1, side, side) for side in neural_texture.SIDES]


def test_weights_are_used_as_they_are(config, calls, tmp_path):
    save_avatar(avatar(2), 77, tmp_path / "kept.npz")
    made, steps = command._trained("shaped", replace(config, weights=tmp_path / "kept.npz"), lambda _: None)
    assert same(made, avatar(2)) and steps == 77 and not made.training
    assert not calls and not list(config.work.iterdir())


EVERY = [
    *("--body", "d/b.npz", "--out", "d/o", "--name", "a b", "--work", "d/w", "--sheet", "d/s.png", "--minutes", "2.5"),
    *("--samples", "7", "--per-band", "6", "--held-out", "d/jump.bvh", "--held-out", "builtin:idle", "--width", "8"),
    *("--workers", "2", "--threads", "4", "--batch", "3", "--seed", "5", "--weights", "d/f.npz"),
    *("--resume", "d/r.npz", "--network", "d/n.npz", "--texture", "somebody", "--look", "hiker"),
]
ALL = TrainConfig(
    Path("d/b.npz"), Path("d/o"), "a b", Path("d/w"), Path("d/s.png"), 2.5, 7, 6, ("d/jump.bvh", "builtin:idle"), 8, 2,
    4, 3, 5, Path("d/f.npz"), Path("d/r.npz"), Path("d/n.npz"), "somebody", None, "hiker",
)  # fmt: skip
USUAL = TrainConfig(
    bundle_folder("default") / "body.npz", Path("avatar"), "default", Path("avatar-work"), None, 60.0, 4000, 24,
    ("builtin:walk-wave-turn",), 16, 3, 1, 4, 1, None, None, None, None, None, None,
)  # fmt: skip


@pytest.mark.parametrize(("words", "wanted"), [(EVERY, ALL), ([], USUAL)], ids=["every option", "none"])
def test_options_are_the_configuration(monkeypatch, capsys, words, wanted):
    asked = []

    def trained(config, report):
        asked.append(config)
        report("a line")
        return Path("d/o")

    monkeypatch.setattr(command, "train", trained)
    assert main(words) == 0
    assert asked == [wanted]
    out, err = capsys.readouterr()
    assert (out, err) == ("d/o\n", "      0 s  a line\n")


def test_the_process_s_own_words_are_read_when_none_are_given(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["train", "--seed", "9", "--name", "x"])
    monkeypatch.setattr(command, "train", lambda config, _: Path(f"{config.name}{config.seed}"))
    assert main() == 0 and capsys.readouterr().out == "x9\n"


def test_the_command_is_written_without_folders():
    assert command_of(ALL) == (
        "python -m trilane.training.train --name 'a b' --minutes 2.5 --samples 7 --per-band 6 --held-out jump.bvh "
        "--held-out builtin:idle --width 8 --workers 2 --threads 4 --batch 3 --seed 5 --weights f.npz --resume r.npz "
        "--network n.npz --texture somebody --look hiker --precision float32 --bytes-from 1.0"
    )


def test_the_help_names_every_default(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "usage: python -m trilane.training.train" in text
    for words in ("motion for validation (default builtin:walk-wave-turn)", "(4000)", "(avatar-work)", "(None)"):
        assert words in text
