"""A training as a whole, on samples of plain colour: what is drawn, kept, refused, written and told."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("scipy")
pytest.importorskip("skimage")

from trilane.avatars.bundle import load_bundle  # noqa: E402
from trilane.errors import BadInputError  # noqa: E402
from trilane.training import train as command  # noqa: E402
from trilane.training.network import UNet  # noqa: E402
from trilane.training.sample_files import create_group  # noqa: E402
from trilane.training.subject import Person, Subject  # noqa: E402
from trilane.training.train import Places, train_avatar  # noqa: E402
from trilane.training.trainable_avatar import NeuralTexture  # noqa: E402
from trilane.training.training_settings import TrainingSettings, parsed_settings, read_settings  # noqa: E402

SHAPE, SIDES = (32, 32), (64, 32)
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

    def sample(seed: Any, band: str, size: str) -> Any:
        return SimpleNamespace(crop=crop, seed=seed, band=band, size=size)

    renderer = SimpleNamespace(training_sample=sample, render=render)
    person = Person(Path("body.npz"))

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
    part(command, "quantise_avatar", lambda avatar, *words: (weights_of(avatar), words[0], words[2]))
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


def places(folder: Path, work: str = "work") -> Places:
    return Places(folder / "capture", folder / "mine", folder / work, "mine")


def settings(**others: Any) -> TrainingSettings:
    return parsed_settings(
        {"device": "cpu", "start": "new", "width": 4, "samples": 8, "batch": 2, "steps": 20, **others}, "a test"
    )


def told_before(folder: Path) -> float:
    return float(json.loads((folder / "work" / "loss-before.json").read_text()))


def test_every_part_gets_what_is_its(log: list[Any], tmp_path: Path) -> None:
    told = Told()
    facts = train_avatar(places(tmp_path), settings(), told)
    assert log.pop(0) == ("raise", "offsets.npz", 1, 2)
    assert log[:4] == ["render"] * 4 and log[4] == ("draw", "opener", (None,), 8, 1)
    assert log[5:7] == ["step-0000010.png", "step-0000020.png"]
    folder, person, (_, shaped, seed), width, provenance, names = log[7]
    assert (folder, person, shaped, seed, width) == (tmp_path / "mine", Person(Path("body.npz")), "shaped", 1, 4)
    assert provenance == {"samples": 8, "steps": 20, "batch": 2, "seed": 1, "texture_sides": list(SIDES), **FACTS}
    command = "trilane avatar train capture --config training.toml"
    assert names == {"name": "mine", "training_command": command}
    assert log[8:] == [("bundle of mine", "frames", (3,), 1), ("bundle of mine", {"psnr_db": 21.0, "of": "errors"})]
    assert read_settings(tmp_path / "mine" / "training.toml") == settings()
    said = ["trains on 1 thread of the CPU", "9 frames of capture", "measures outlines", "measuring outlines 2"]
    assert told.lines[:5] == [*said, "choosing views 8"]
    assert "0 MB on the disk (by 4 that were drawn)" in told.lines[5] and told.lines[6] == "drawing views 3"
    assert told.lines[7].startswith("20 steps: about 0.") and told.lines[7].endswith(" MB of memory")
    losses = [loss for _, _, loss in told.steps]
    assert [step[:2] for step in told.steps] == [(step, 20) for step in range(1, 21)] and losses[-1] < losses[0]
    assert losses == [pytest.approx(sum(WEIGHTS[name] * terms[name] for name in terms)) for terms in told.terms]
    assert facts["loss"] == {"before": told_before(tmp_path), "after": pytest.approx(losses[-1], rel=0.5)}
    assert facts["loss"]["after"] < facts["loss"]["before"]
    assert (facts["steps"], facts["sheets"]) == (20, str(tmp_path / "work" / "sheets"))
    assert facts["frames"] == (tmp_path / "work", 1, 1)


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


@pytest.mark.usefixtures("log")
@pytest.mark.parametrize(
    ("changed", "said"), [({"capture": "/there"}, "/there"), ({"stand_off": False}, "'stand_off': False")]
)
def test_samples_of_another_capture_or_body_are_refused(changed: dict[str, Any], said: str, tmp_path: Path) -> None:
    there = places(tmp_path)
    there.work.mkdir()
    own = {"capture": str(there.capture.resolve()), "samples": 8, "seed": 1, "stand_off": True}
    (there.work / "samples.json").write_text(json.dumps(own | changed))
    with pytest.raises(BadInputError, match=rf"samples\.json: found .*{said}.*use another --work folder"):
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


def clothed(folder: Path) -> Places:
    return Places(None, folder / "mine", folder / "work", "mine")


@pytest.fixture
def clothed_body(log: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """The default body in a look, whose renderer, planner and truth are doubles."""

    def clothed(body: Path, threads: int, look: str) -> Subject:
        log.append(("clothe", body.parts[-2:], threads, look))
        crop = SimpleNamespace(shape=SHAPE)
        renderer = SimpleNamespace(
            training_sample=lambda *_: SimpleNamespace(crop=crop), render=lambda _: log.append("render")
        )
        return Subject(Person(body), "shaped", renderer, SimpleNamespace, {"look": look}, "truth")  # type: ignore[arg-type]

    def draw(_: Any, samples: Any, folder: Path, *__: Any) -> None:
        group = create_group(folder, SHAPE, np.zeros(len(samples), np.int8))
        group.covered[:] = 1

    monkeypatch.setattr(command, "clothed_subject", clothed)
    monkeypatch.setattr(command, "write_dataset", draw)


@pytest.mark.usefixtures("clothed_body")
def test_the_default_body_in_a_look_needs_no_capture(log: list[Any], tmp_path: Path) -> None:
    told = Told()
    facts = train_avatar(clothed(tmp_path), settings(look="hiker", steps=10, threads=2), told)
    assert log[0] == ("clothe", ("default", "body.npz"), 2, "hiker")
    _, _, _, _, provenance, names = next(words for words in log if isinstance(words, tuple) and len(words) == 6)
    assert provenance["look"] == "hiker" and provenance["steps"] == 10
    assert names["training_command"] == "trilane avatar train --config training.toml"
    assert json.loads((tmp_path / "work" / "samples.json").read_text())["look"] == "hiker"
    assert "held_out_error" not in facts and facts["sheets"] is None
    measure = f"trilane avatar validate {tmp_path / 'mine'} --float-network {tmp_path / 'work' / 'network.npz'}"
    assert told.lines[-1].endswith(measure)


@pytest.mark.usefixtures("clothed_body")
def test_training_starts_from_network_and_texture_of_an_avatar(
    log: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the state is there, only shapes matter, and neither is read."""
    network = UNet(width=4, channels=16, input_skip=True)
    texture = np.full((64, 64, 16), 0.125, np.float32)
    begun: list[Any] = []
    first = command.first_state

    def first_state(avatar: Any, *words: Any) -> Any:
        begun.append((avatar.network, float(avatar.texture.image().detach().mean())))
        return first(avatar, *words)

    def network_of(bundle: Any, groups: Any, seed: int) -> UNet:
        log.append(("network", bundle, len(groups), seed))
        return network

    monkeypatch.setattr(command, "first_state", first_state)
    monkeypatch.setattr(command, "network_of", network_of)
    monkeypatch.setattr(command, "load_bundle", lambda name: SimpleNamespace(name=name, read_texture=lambda: texture))
    asked = settings(look="hiker", start="hiker", texture="default", steps=10)
    train_avatar(clothed(tmp_path), asked, Told())
    calls = [words for words in log if isinstance(words, tuple) and words[0] == "network"]
    assert [(bundle.name, groups, seed) for _, bundle, groups, seed in calls] == [("hiker", 1, 1)]
    assert begun[0][0] is network and begun[0][1] == pytest.approx(0.125)
    train_avatar(clothed(tmp_path), asked, Told())
    assert len([words for words in log if isinstance(words, tuple) and words[0] == "network"]) == 1


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
        train_avatar(Places(capture, tmp_path / "mine", tmp_path / "work", "mine"), settings(look=look), Told())


@pytest.mark.parametrize("name", ["default", "hiker"])
def test_a_bundled_avatar_is_trained_further_by_its_settings(name: str) -> None:
    """They are those of the command in its manifest, which trained it on one thread."""
    bundle = load_bundle(name)
    asked, command_line = read_settings(bundle.folder / "training.toml"), bundle.manifest.training_command
    assert (asked.look, asked.start, asked.texture) == (name, name, name)
    assert (asked.width, asked.threads) == (bundle.manifest.network.width, 1)
    for key in ("samples", "batch", "seed", "precision"):
        assert f"--{key} {getattr(asked, key)} " in f"{command_line} "
    assert f"--bytes-from {asked.bytes_from}" in command_line
