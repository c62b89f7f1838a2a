"""A training as a whole, on samples of plain colour: what is drawn, kept, refused, written and told."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from trilane.avatars.bundle import bundle_folder, load_bundle  # noqa: E402
from trilane.avatars.manifest import sha256_of  # noqa: E402
from trilane.errors import BadInputError  # noqa: E402
from trilane.training import train as command  # noqa: E402
from trilane.training.dataset import create_group, open_groups  # noqa: E402
from trilane.training.first_texture import used_texels  # noqa: E402
from trilane.training.subject import Person, Subject  # noqa: E402
from trilane.training.surface import body_arrays  # noqa: E402
from trilane.training.train import TrainingPlaces, train_avatar  # noqa: E402
from trilane.training.trainable_avatar import NeuralTexture  # noqa: E402
from trilane.training.training_settings import TrainingSettings, parsed_settings, read_settings  # noqa: E402
from trilane.units import AVATARS  # noqa: E402

SHAPE, SIDES = (32, 32), (64, 32)
BODY = bundle_folder("default") / "body.npz"
FACTS = {"body": "that of a capture", "frames": 9}


class Told:
    """Notes what a training says."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.terms: list[dict[str, float]] = []
        self.steps: list[tuple[int, int, float]] = []

    def say(self, line: str) -> None:
        self.lines.append(line)

    def track(self, text: str, numbers: Any, total: int) -> Any:
        self.lines.append(f"{text} {total}")
        return numbers

    def trained(self, step: int, total: int, terms: dict[str, float], loss: float) -> None:
        self.terms.append(terms)
        self.steps.append((step, total, loss))


#: Weights of the default avatar's loss.
WEIGHTS = {"composite": 0.4, "decibels": 0.03, "colour": 0.1, "edges": 0.2, "coarse": 0.2, "mask": 0.1}
WEIGHTS |= {"background": 0.05, "overlap": 0.1}


@pytest.fixture
def log(monkeypatch: pytest.MonkeyPatch) -> Any:
    """What the training asks of the parts that draw, quantise and measure, which are doubles."""
    asked: list[Any] = []
    crop = SimpleNamespace(shape=SHAPE)

    def render(_: Any) -> Any:
        asked.append("render")

    def sample(seed: Any, band: str, density: float) -> Any:
        return SimpleNamespace(crop=crop, seed=seed, band=band, density=density)

    renderer = SimpleNamespace(training_sample=sample, render=render)
    person = Person(BODY)

    def subject(folder: Path, _: int, report: Callable[[str], None]) -> Subject:
        report(f"9 frames of {folder.name}")
        return Subject(person, "shaped", renderer, opener, FACTS, None, "frames", (3,))  # type: ignore[arg-type]

    def raised(found: Subject, path: Path, seed: int, report: Any, track: Any) -> Subject:
        report("measures outlines")
        asked.append(("raise", path.name, seed, len(list(track([1, 2])))))
        return found

    def opener(offsets: Any) -> Any:
        """Stands for what opens renderers."""

    def draw(source: Any, samples: Any, folder: Path, processes: int, track: Any) -> None:
        asked.append(("draw", source.func.__name__, source.args, len(samples), processes))
        list(track([1, 2, 3]))
        group = create_group(folder, SHAPE, np.zeros(len(samples), np.int8))
        group.covered[:, 4:24, 6:28] = 1
        group.rgba[:, 4:26, 5:28] = (200, 100, 50, 255)

    part = monkeypatch.setattr
    before = torch.get_num_threads()
    part(command, "captured_subject", subject)
    part(command, "subject_with_offsets", raised)
    part(command, "write_dataset", draw)
    part(command, "SIDES", SIDES)
    part(command, "NeuralTexture", lambda start, mip_levels: NeuralTexture(start, SIDES, mip_levels))
    part(command, "body_arrays", lambda shaped: f"arrays of {shaped}")
    part(command, "first_texture", lambda *_: np.full((64, 64, 16), 0.25, np.float32))
    part(command, "write_sheet", lambda path, *_: asked.append(path.name))
    part(command, "integer_network", lambda avatar, *_: weights_of(avatar))
    part(command, "quantise_avatar", lambda _, *words: (words[0], words[1], words[3]))
    part(command, "write_float_network", lambda folder, _, groups, seed: {"frames": (folder, len(groups), seed)})
    part(command, "write_avatar", lambda *words: (words[0].mkdir(exist_ok=True), asked.append(words)))
    part(command, "load_bundle", lambda folder: f"bundle of {folder.name}")
    part(command, "frame_errors", lambda *words: asked.append(words) or "errors")
    part(command, "error_facts", lambda errors: {"psnr_db": 21.0, "of": errors})
    part(command, "write_held_out_error", lambda *words: asked.append(words))
    yield asked
    torch.set_num_threads(before)


def weights_of(avatar: Any) -> bytes:
    return b"".join(value.detach().numpy().tobytes() for value in avatar.state_dict().values())


def places(folder: Path, work: str = "work") -> TrainingPlaces:
    return TrainingPlaces(folder / "capture", folder / "mine", folder / work, "mine")


def settings(**others: Any) -> TrainingSettings:
    return parsed_settings(
        {"device": "cpu", "start": "new", "width": 4, "samples": 8, "batch": 2, "steps": 20, **others}, "a test"
    )


def test_an_ended_training_goes_on_and_makes_the_same_avatar(
    log: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Ended(Told):
        def trained(self, step: int, total: int, terms: dict[str, float], loss: float) -> None:
            super().trained(step, total, terms, loss)
            if step == 7:
                raise KeyboardInterrupt

    def avatars() -> list[bytes]:
        return [words[2][0] for words in log if isinstance(words, tuple) and words[0] == tmp_path / "mine"]

    whole = train_avatar(places(tmp_path, "whole"), settings(), Told())
    monkeypatch.setattr(command, "SAVE_S", -1.0)
    with pytest.raises(KeyboardInterrupt):
        train_avatar(places(tmp_path), settings(), Ended())
    told = Told()
    log_before = len(log)
    assert train_avatar(places(tmp_path), settings(), told)["loss"] == whole["loss"]
    assert "draw" not in [words[0] for words in log[log_before:]], "samples that are there are not drawn again"
    assert "goes on after step 6 of 20" in told.lines and told.steps[0][0] == 7
    assert len(avatars()) == 2 and avatars()[0] == avatars()[1]
    with pytest.raises(BadInputError, match="seed: found a training with 1, expected 2, as asked"):
        train_avatar(places(tmp_path), settings(seed=2), Told())


def test_the_loss_after_a_training_is_of_the_weights_that_are_written(
    log: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weights that are trained with rounding get another loss by rounding, and only the rounded ones are used."""
    judged: list[bytes] = []
    probe = command.probe_loss

    def judge(state: Any, groups: Any) -> float:
        judged.append(weights_of(state.average))
        return probe(state, groups)

    monkeypatch.setattr(command, "probe_loss", judge)
    train_avatar(places(tmp_path), settings(freeze_norms_at=0.0, bytes_from=0.2), Told())
    written = next(words[2][0] for words in log if isinstance(words, tuple) and words[0] == tmp_path / "mine")
    assert len(judged) == 2 and judged[1] == written


@pytest.mark.usefixtures("log")
@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"capture": "/there"}, "/there"),
        ({"stand_off": False}, "'stand_off': False"),
        ({"body": 64 * "0"}, f"'body': '{64 * '0'}'"),
    ],
)
def test_samples_of_another_capture_or_body_are_refused(changed: dict[str, Any], said: str, tmp_path: Path) -> None:
    there = places(tmp_path)
    there.work.mkdir()
    own = {"capture": str(there.capture.resolve()), "samples": 8, "seed": 1, "stand_off": True}
    own |= {"body": sha256_of([BODY])}
    (there.work / "samples.json").write_text(json.dumps(own | changed))
    with pytest.raises(BadInputError, match=rf"samples\.json: found .*{said}.*use another --work folder"):
        train_avatar(there, settings(), Told())


@pytest.mark.usefixtures("log")
def test_what_an_ended_draw_left_is_not_trained_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ended draw made a shape that another has not. With the same settings the draw begins again."""
    there, whole = places(tmp_path), command.write_dataset

    def ended(_source: Any, _samples: Any, folder: Path, *_: Any) -> None:
        create_group(folder, (64, 32), np.zeros(3, np.int8))
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "write_dataset", ended)
    with pytest.raises(KeyboardInterrupt):
        train_avatar(there, settings(), Told())
    monkeypatch.setattr(command, "write_dataset", whole)
    (there.work / "offsets.npz").write_bytes(b"of seed 1")
    for other in ({"samples": 9}, {"seed": 2}):
        with pytest.raises(BadInputError, match=r"samples\.json: found .*use another --work folder"):
            train_avatar(there, settings(**other), Told())
    train_avatar(there, settings(), Told())
    assert [group.shape for group in open_groups(there.work / "samples")] == [SHAPE]
    assert not list(there.work.glob(".trilane-*"))


@pytest.mark.usefixtures("log")
def test_samples_of_unknown_settings_are_refused(tmp_path: Path) -> None:
    there = places(tmp_path)
    (there.work / "samples" / "64x32").mkdir(parents=True)
    with pytest.raises(BadInputError, match=r"found samples without samples\.json, .*use another --work folder"):
        train_avatar(there, settings(), Told())


@pytest.mark.usefixtures("log")
@pytest.mark.parametrize("name", ["samples.json", "loss-before.json"])
def test_a_damaged_file_of_a_training_is_refused_by_name(name: str, tmp_path: Path) -> None:
    there = places(tmp_path)
    train_avatar(there, settings(), Told())
    (there.work / name).write_text("{0.5")
    with pytest.raises(BadInputError, match=rf"{name}: found no valid JSON .*use another --work folder"):
        train_avatar(there, settings(), Told())


def test_steps_are_counted_for_the_minutes(log: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A step of a hundredth of a minute: twelve in a ninth of one, and no less than ten."""
    monkeypatch.setattr(command, "step_seconds", lambda *_: 0.6)
    told = Told()
    assert train_avatar(places(tmp_path), settings(steps=None, minutes=0.125), told)["steps"] == 12
    assert "12 steps: about 0.1 min (0.60 s a step as just measured)" in told.lines[7]
    assert read_settings(tmp_path / "mine" / "training.toml").steps == 12
    assert train_avatar(places(tmp_path, "other"), settings(steps=None, minutes=0.001), Told())["steps"] == 10
    assert log


@pytest.mark.usefixtures("log")
@pytest.mark.parametrize(
    ("capture", "look", "said"),
    [
        (None, None, r"CAPTURE: found none, expected the folder of a capture; or settings \(--config\) with a `look`"),
        (Path("film"), "hiker", "look: found 'hiker', expected none beside a capture"),
    ],
)
def test_one_person_is_trained(capture: Path | None, look: str | None, said: str, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=said):
        train_avatar(TrainingPlaces(capture, tmp_path / "mine", tmp_path / "work", "mine"), settings(look=look), Told())


def test_an_unknown_look_is_refused_before_any_work(log: list[Any], tmp_path: Path) -> None:
    there = TrainingPlaces(None, tmp_path / "both", tmp_path / "work", "both")
    with pytest.raises(BadInputError, match="look: found 'walker', expected one of default, hiker, dancer"):
        train_avatar(there, settings(look=["default", "walker"]), Told())
    assert log == [] and not there.work.exists()


def test_several_looks_are_painted_by_one_network(
    log: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each has a folder of its own for samples and bundle, and a texture that only its own samples train."""

    def clothed(_: Path, threads: int, look: str) -> Subject:
        subject = command.captured_subject(Path(look), threads, lambda _: None)
        return replace(subject, shaped=look, facts={"look": look}, held_out=(), opener=partial(subject.opener, look))  # type: ignore[arg-type]

    def drawn(_: Any, samples: Any, folder: Path, *__: Any) -> None:
        grey = 60 if folder.parent.name == "hiker" else 200
        group = create_group(folder, SHAPE, np.zeros(len(samples), np.int8))
        group.covered[:, 4:24, 6:28] = 1
        group.rgba[:, 4:26, 5:28] = (grey, grey, grey, 255)

    monkeypatch.setattr(command, "clothed_subject", clothed)
    monkeypatch.setattr(command, "write_dataset", drawn)
    there = TrainingPlaces(None, tmp_path / "both", tmp_path / "work", "both")
    there.out.mkdir()
    train_avatar(there, settings(look=["default", "hiker"], texture="new"), Told())
    written = [words for words in log if isinstance(words, tuple) and isinstance(words[0], Path) and len(words) > 3]
    assert [words[0] for words in written] == [tmp_path / "both" / name for name in ("default", "hiker")]
    (one, *_), (other, *_) = (words[2] for words in written)
    assert one == other, "the same network"
    assert [words[2][1:] for words in written] == [("default", 0), ("hiker", 1)]
    for name in ("default", "hiker"):
        assert json.loads((tmp_path / "work" / name / "samples.json").read_text())["look"] == name


def test_texels_of_a_garment_begin_anew_and_all_others_as_they_were(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The body of `dancer` has garments, on texels that the skin of `default` does not use."""
    monkeypatch.setattr(command, "open_groups", lambda *_: [])
    monkeypatch.setattr(command, "first_texture", lambda _, __, side, channels: np.full((side, side, channels), 9.0))
    shaped = load_bundle("dancer").shaped_body()
    person = command.Trained(Subject(Person(BODY), shaped, None, None, {}, None), places(tmp_path))  # type: ignore[arg-type]
    image = command._first_image(person, 0, settings(texture="default"))
    bundle, whole = load_bundle("default"), body_arrays(shaped)
    texture, is_new = bundle.read_texture(), (image == 9.0).all(axis=2)
    skin = used_texels(body_arrays(bundle.shaped_body()), len(texture), 1)
    assert shaped.body.skin is not None
    rows = slice(shaped.body.skin[1], None)
    garments = replace(whole, faces=whole.faces[rows], uv_faces=whole.uv_faces[rows])
    of_garments = used_texels(garments, len(texture), 0) & ~skin
    assert of_garments.mean() > 0.05 and is_new[of_garments].all() and not is_new[skin].any()
    np.testing.assert_array_equal(image[~is_new], texture[~is_new])


@pytest.mark.parametrize("name", AVATARS)
def test_bundled_avatars_are_trained_further_by_the_settings_of_their_training(name: str) -> None:
    """The manifest states the same training. All avatars have its network and its settings."""
    bundle = load_bundle(name)
    asked, made = read_settings(bundle.folder / "training.toml"), bundle.manifest.provenance
    assert (asked.look, asked.start, asked.texture) == (AVATARS, "default", "look")
    assert asked.width == bundle.manifest.network.width and made["look"] == name
    assert bundle.manifest.training_command == "trilane avatar train --config training.toml"
    for key in ("samples", "steps", "batch", "seed"):
        assert getattr(asked, key) == made[key]
    network, other = (load_bundle(each).network_path.read_bytes() for each in (name, "default"))
    assert network == other
