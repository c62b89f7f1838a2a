"""`trilane avatar validate`, `quantise`, `calibrations`: what they ask of the parts that work, and what they print."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
from PIL import Image

import trilane.training
from support.small_inputs import validated
from trilane.apps.cli import avatar_network, avatar_train
from trilane.apps.experiments import calibrated_network
from trilane.apps.run import asked_run
from trilane.avatars.bundle import load_bundle, write_manifest
from trilane.avatars.manifest import Validation, sha256_of
from trilane.stages.dsp import runtime
from trilane.training.quantising import calibration_table, noise_model, quantise

Command = Callable[..., tuple[str, str]]


@pytest.fixture
def files(tmp_path: Path, tiny_float: onnx.ModelProto, tiny_frames: list[Any]) -> Path:
    onnx.save(tiny_float, tmp_path / "float.onnx")
    np.save(tmp_path / "frames.npy", np.stack(tiny_frames).astype(np.float64))
    return tmp_path


class Quantising:
    """In place of what quantises: notes what it is asked."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, network: Any) -> None:
        self.asked: list[Any] = []
        self.result = SimpleNamespace(network=network, facts={"method": "told"})
        monkeypatch.setattr(quantise, "equalised", lambda model: ("equalised", type(model).__name__))
        monkeypatch.setattr(quantise, "quantise", self._quantise)
        monkeypatch.setattr(noise_model, "layer_report", self._layers)

    def _quantise(self, model: Any, frames: Any, *settings: Any) -> Any:
        kind = model if isinstance(model, tuple) else type(model).__name__
        self.asked.append((kind, len(frames), frames[0].dtype, frames[0].shape, *settings))
        return self.result

    def _layers(self, model: Any, result: Any, frame: Any) -> Any:
        self.asked.append((type(model).__name__, result is self.result, float(frame.sum())))
        return [{"name": "stem", "sqnr_db": 20.5}]


def test_quantise_asks_for_what_the_options_say(
    monkeypatch: pytest.MonkeyPatch, files: Path, tiny_quantised: Any, tiny_frames: list[Any], command: Command
) -> None:
    double, out = Quantising(monkeypatch, tiny_quantised.network), files / "q.onnx"
    words = ("avatar", "quantise", files / "float.onnx", "--frames", files / "frames.npy", "--out", out)
    printed = json.loads(command(*words, "--json")[0])
    frame = (np.float32, (64, 64, 5))
    assert double.asked == [("ModelProto", 6, *frame, "minmax", True, [])]
    assert (printed["file"], printed["sha256"]) == (str(out), tiny_quantised.network.digest)
    assert printed["quantisation"] == {"method": "told", "equalised": False}
    assert "layers" not in printed
    assert out.read_bytes() == tiny_quantised.network.model.SerializeToString()
    double.asked.clear()
    more = ("--method", "entropy", "--count", 4, "--full-range", "--equalise", "--keep-float", "a", "--keep-float", "b")
    printed = json.loads(command(*words, *more, "--report", files / "r.json", "--json")[0])
    assert double.asked == [
        (("equalised", "ModelProto"), 4, *frame, "entropy", False, ["a", "b"]),
        ("ModelProto", True, float(tiny_frames[-1].sum())),
    ]
    assert printed["quantisation"] == {"method": "told", "equalised": True}
    assert printed["layers"] == [{"name": "stem", "sqnr_db": 20.5}]
    text = '{\n "layers": [\n  {\n   "name": "stem",\n   "sqnr_db": 20.5\n  }\n ]\n}\n'
    assert (files / "r.json").read_text() == text
    assert "quantisation.equalised False" in " ".join(command(*words)[0].split())


def test_quantise_refuses_word_by_word(files: Path, command: Command) -> None:
    source = files / "float.onnx"
    words = ("avatar", "quantise", source, "--frames", files / "frames.npy", "--out")
    _, err = command(*words, files / "new" / ".." / "float.onnx", code=2)
    found = f"error: --out: found {files}/new/../float.onnx, expected another file than the float network\n"
    assert err == found
    for count, expected in ((0, "greater than or equal to 1"), (1001, "less than or equal to 1000")):
        _, err = command(*words, files / "q.onnx", "--count", count, code=2)
        assert err == f"error: --count: found '{count}', expected {expected}\n"
    np.save(files / "frames.npy", np.zeros((2, 3, 4), np.float32))
    _, err = command(*words, files / "q.onnx", code=2)
    expected = "expected floats (N, H, W, C), N at least 1"
    assert err == f"error: {files}/frames.npy: found float32 of shape (2, 3, 4), {expected}\n"
    (files / "frames.npy").unlink()
    _, err = command(*words, files / "q.onnx", code=2)
    assert err == f"error: {files}/frames.npy: found no such file, expected frames (N, H, W, C)\n"
    assert not (files / "q.onnx").exists()


def test_no_more_frames_than_a_thousand_are_read(tmp_path: Path) -> None:
    np.save(tmp_path / "f.npy", np.arange(1002.0).reshape(-1, 1, 1, 1))
    frames = avatar_network._frames(tmp_path / "f.npy")
    assert (len(frames), frames[-1].dtype, frames[-1].item()) == (1000, np.float32, 999.0)


CALIBRATED = [
    {"method": "minmax", "count": 5, "psnr_db": 31.4159, "mean": 1.2345, "largest": 17.0},
    {"method": "entropy", "count": 10, "psnr_db": 29.0, "mean": 2.0, "largest": 99.6},
]


def test_calibrations_are_a_table(
    monkeypatch: pytest.MonkeyPatch, files: Path, command: Command, check_printed: Callable[..., None]
) -> None:
    asked = []

    def table(model: Any, frames: list[Any], methods: list[str], *, held_out: int) -> Any:
        asked.append((type(model).__name__, len(frames), methods, held_out))
        return iter(CALIBRATED)

    monkeypatch.setattr(calibration_table, "calibration_table", table)
    words = ("avatar", "calibrations", files / "float.onnx", "--frames", files / "frames.npy")
    check_printed("avatar-calibrations", command(*words)[0])
    document = json.loads(command(*words, "--method", "minmax", "--json")[0])
    line = "minmax on 5 frames: 31.42 dB, 0.00 dB below the best; within 0.1 dB the fewest frames win"
    assert document == {"rows": CALIBRATED, "recommendation": line, "sources": {"rows": "measured in this run"}}
    assert asked == [("ModelProto", 6, ["minmax", "percentile", "entropy"], 5), ("ModelProto", 6, ["minmax"], 5)]


def test_an_avatar_brings_its_network_and_views(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: Command
) -> None:
    asked: list[Any] = []
    drawn = lambda *words: asked.append(words) or ("model", ["frames"])  # noqa: E731
    monkeypatch.setattr(calibrated_network, "drawn_material", drawn)
    table = lambda *words, **named: asked.append((words, named)) or iter(CALIBRATED)  # noqa: E731
    monkeypatch.setattr(calibration_table, "calibration_table", table)
    plots: list[Any] = []
    monkeypatch.setattr(calibration_table, "plot_calibrations", lambda *words: plots.append(words))
    words = ("avatar", "calibrations", "--avatar", "default", "--method", "minmax", "--json")
    pytest.importorskip("matplotlib")
    document = json.loads(command(*words, "--plot", tmp_path / "c.png")[0])
    assert asked == [("default", 100, 24), (("model", ["frames"], ["minmax"]), {"held_out": 24})]
    assert plots == [(CALIBRATED, document["recommendation"], tmp_path / "c.png")]
    for bad in (("float.onnx",), ("--avatar", "default", "--frames", "f.npy"), ()):
        assert (
            "a float network and its --frames, or --avatar alone" in command("avatar", "calibrations", *bad, code=2)[1]
        )
    done = len(asked)
    assert "one of .png, .svg, .pdf" in command(*words, "--plot", tmp_path / "c.bmp", code=2)[1]
    assert "a place that can be written" in command(*words, "--plot", tmp_path / "none" / "c.png", code=2)[1]
    assert len(asked) == done


class Work:
    """In place of `trilane.training.validate`: three samples a seed, each with another error on each runtime."""

    SEEDS = (11, 12)
    BUILTIN_HELD_OUT = "builtin:told"

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.asked: list[Any] = []
        self.plan: Any = None
        names = ("SEEDS", "BUILTIN_HELD_OUT", "open_renderer", "validate", "revalidate", "worst_sheet")
        fake = ModuleType("trilane.training.validate")
        fake.__dict__.update({name: getattr(self, name) for name in names})
        fake.__dict__.update({"ValidationPlan": self._make_plan, "FloatNetwork": lambda *said: ("float", *said)})
        monkeypatch.setattr(trilane.training, "validate", fake, raising=False)
        monkeypatch.setitem(sys.modules, "trilane.training.validate", fake)
        painter = ModuleType("trainable_avatar")
        painter.__dict__["float_painter_of"] = lambda bundle, weights: ("painter", bundle.manifest.name, weights.name)
        monkeypatch.setitem(sys.modules, "trilane.training.trainable_avatar", painter)
        monkeypatch.setattr(asked_run, "made_facts", lambda words: {"revision": f"r{len(words)}", "modified": True})

    def _make_plan(self, **values: Any) -> Any:
        self.plan = SimpleNamespace(threads=7, **values)
        return self.plan

    def open_renderer(self, bundle: Any, threads: int) -> Any:
        self.asked.append(("renderer", bundle.manifest.name, threads))
        return "a renderer"

    def validate(self, bundle: Any, plan: Any, renderer: Any, beside: Any, look: Any) -> Any:
        self.asked.append((bundle.manifest.name, plan is self.plan, renderer, beside))
        for seed in plan.seeds:
            for number, psnr_db in enumerate((30.0 + seed, 20.0 + seed, 25.0)):
                errors = {name: SimpleNamespace(psnr_db=-psnr_db) for name in plan.runtimes[1:]}
                errors[plan.runtimes[0]] = SimpleNamespace(psnr_db=psnr_db)
                look(seed, SimpleNamespace(of=(seed, number), errors=errors))
        return "the validation"

    def revalidate(self, bundle: Any, validation: str) -> Any:
        assert validation == "the validation"
        return load_bundle(bundle.folder)

    def worst_sheet(self, samples: list[Any], painters: Any) -> Any:
        self.asked.append(([sample.of for sample in samples], painters))
        return np.full((2, 3, 3), 9, np.uint8)


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> Work:
    monkeypatch.setattr(runtime, "installed", lambda: ("qnn", "openvino", "ort"))
    monkeypatch.setattr(runtime, "resolve", lambda name: f"resolved {name}")
    return Work(monkeypatch)


def test_validate_without_options(work: Work, tiny_bundle: Path, command: Command) -> None:
    printed = json.loads(command("avatar", "validate", tiny_bundle, "--json")[0])
    assert printed == {"name": "tiny", "validation": None}
    assert vars(work.plan) == {
        "threads": 7,
        "held_out": ("builtin:told",),
        "seeds": (11, 12),
        "per_band": 24,
        "runtimes": ("resolved ort", "resolved openvino"),
        "size": "256",
        "revision": "r0",
        "modified": True,
    }
    assert work.asked == [("renderer", "tiny", 7), ("tiny", True, "a renderer", None)]
    assert "name tiny" in " ".join(command("avatar", "validate", tiny_bundle)[0].split())


@pytest.mark.usefixtures("work")
def test_bands_are_a_table(tiny_bundle: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the integer network, each figure at its place; what nobody measured is a dash."""
    by_band = {"full_body": 31.456, "face": 28.1}
    figures = {"psnr_db_by_band": by_band, "iou": 0.9, "ssim": 0.9, "iou_by_band": {"full_body": 0.98765}}
    own = figures | {"body_psnr_db_by_band": {"full_body": 27.5, "face": 26.0}, "see_through_by_band": {"face": 0.0234}}
    told = {**figures, "date": date(2026, 1, 2), "runtime": "ort", "integer": own, "psnr_loss_db": {"face": 0.07}}
    bundle = load_bundle(tiny_bundle)
    manifest = bundle.manifest.model_copy(update={"validation": Validation.model_validate(told)})
    work_module = sys.modules["trilane.training.validate"]
    monkeypatch.setattr(work_module, "revalidate", lambda *_: replace(bundle, manifest=manifest))
    lines = command("avatar", "validate", tiny_bundle)[0].splitlines()
    rows = [[cell.strip() for cell in re.split("[│┃]", line)[1:-1]] for line in lines if re.match("[│┃]", line)]
    assert rows == [
        ["band", "PSNR, dB", "of the person alone", "alpha < 0.9 inside, %", "mask IoU", "lost by quantising, dB"],
        ["full body", "31.46", "27.50", "-", "0.9877", "-"],
        ["face", "28.10", "26.00", "2.34", "-", "0.07"],
    ]
    assert any("validation of 2026-01-02" in line for line in lines)


def test_validate_with_every_option(work: Work, tiny_bundle: Path, tmp_path: Path, command: Command) -> None:
    """What is given twice is done once; the sheet has the worst view of each seed, on the first runtime."""
    (tmp_path / "w.npz").write_bytes(b"weights")
    command(
        *("avatar", "validate", tiny_bundle, "--held-out", "a", "--held-out", "b", "--seed", 3, "--seed", 6),
        *("--seed", 3, "--per-band", 2, "--runtime", "qnn", "--runtime", "ort", "--runtime", "qnn", "--size", "64x32"),
        *("--float-network", tmp_path / "w.npz", "--sheet", tmp_path / "sheet.png", "--json"),
    )
    plan = vars(work.plan)
    assert (plan["held_out"], plan["seeds"], plan["per_band"]) == (("a", "b"), (3, 6), 2)
    assert (plan["runtimes"], plan["size"]) == (("resolved qnn", "resolved ort"), "64x32")
    name = f"w.npz, sha256 {sha256_of([tmp_path / 'w.npz'])}"
    assert work.asked[1][3] == ("float", name, ("painter", "tiny", "w.npz"))
    assert work.asked[2] == ([(3, 1), (6, 2)], ("resolved qnn",))
    with Image.open(tmp_path / "sheet.png") as picture:
        assert (picture.size, picture.getpixel((0, 0))) == ((3, 2), (9, 9, 9))


def test_sizes_are_added_to_figures_that_are_the_avatars_own(
    work: Work, tiny_bundle: Path, tmp_path: Path, command: Command
) -> None:
    """Measured for an avatar that was validated as it is, and for no other; nothing else is validated anew."""
    own = shutil.copytree(tiny_bundle, tmp_path / "own")
    words = ("avatar", "validate", own, "--sizes", "--json")
    module = sys.modules["trilane.training.validate"]
    module.__dict__["measure_sizes"] = lambda bundle, plan, renderer, look: (
        bundle.manifest.name,
        plan is work.plan,
        renderer,
        look() or "looked",
    )
    added: list[Any] = []
    module.__dict__["with_sizes"] = lambda before, by_size: added.append((before, by_size)) or "the validation"
    refused = command(*words, code=2)[1]
    assert "no validation" in refused and f"`trilane avatar validate {own}` comes first" in refused
    write_manifest(own, validated(load_bundle(own)))
    printed = json.loads(command(*words)[0])
    assert printed["validation"]["ssim"] == 0.8642
    assert added == [(load_bundle(own).manifest.validation, ("tiny", True, "a renderer", "looked"))]
    assert work.asked == [("renderer", "tiny", 7)]
    text = (own / "manifest.json").read_text()
    (own / "manifest.json").write_text(text.replace("0.8642", "0.8643"))
    assert "comes first" in command(*words, code=2)[1]
    assert len(added) == 1


def test_runtimes_that_are_not_installed_are_left_out(
    work: Work, monkeypatch: pytest.MonkeyPatch, tiny_bundle: Path, command: Command
) -> None:
    monkeypatch.setattr(runtime, "installed", lambda: ("ort",))
    command("avatar", "validate", tiny_bundle)
    assert work.plan.runtimes == ("resolved ort",)


def test_what_validate_refuses(
    work: Work, monkeypatch: pytest.MonkeyPatch, tiny_bundle: Path, command: Command
) -> None:
    words = ("avatar", "validate", tiny_bundle)
    assert command(*words, "--size", "100", code=2)[1].startswith("error: --size: found ")
    for option, value, expected in (
        ("--seed", -1, "greater than or equal to 0"),
        ("--per-band", 0, "greater than or equal to 1"),
        ("--per-band", 1001, "less than or equal to 1000"),
    ):
        assert command(*words, option, value, code=2)[1] == f"error: {option}: found '{value}', expected {expected}\n"
    assert work.plan is None
    for name, said in (("trainable_avatar", "the float network needs"), ("validate", "validating needs")):
        monkeypatch.setitem(sys.modules, f"trilane.training.{name}", None)
        monkeypatch.delattr(trilane.training, name, raising=False)
        _, err = command(*words, "--float-network", "w.npz", code=3)
        assert err.startswith(f"error: {said} trilane.training.{name}; install it with: ")
        assert ("[metrics]" in err) == (name == "validate") and ("[train]" in err) == (name != "validate")


@pytest.mark.usefixtures("work")
def test_a_bar_counts_the_views_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, tiny_bundle: Path, command: Command
) -> None:
    """Two seeds with as many views of each of the bands; six of them are shown."""
    import io

    from rich.console import Console

    from trilane.avatars.manifest import BANDS

    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=100)
    monkeypatch.setattr(avatar_train, "stderr_console", lambda: console)
    command("avatar", "validate", tiny_bundle, "--per-band", 1)
    share = 6 / (2 * 1 * len(BANDS))
    assert "validating" in screen.getvalue() and f"{100 * share:.0f}%" in screen.getvalue()
