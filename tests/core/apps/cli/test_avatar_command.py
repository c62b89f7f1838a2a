"""`trilane avatar`: what it prints and writes of real networks and avatars, and what it refuses."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from PIL import Image
from rich.console import Console

from support.small_inputs import validated
from trilane.apps.avatar_files import bundle_facts
from trilane.apps.cli.avatar_train import _band_table
from trilane.avatars.bundle import load_bundle, write_manifest
from trilane.avatars.manifest import BANDS, Validation
from trilane.avatars.network_file import read_network, reshaped
from trilane.avatars.network_split import cuts, split
from trilane.hw_profiles.network_work import graph_facts
from trilane.training.quantising.quantise import equalised, quantise

Command = Callable[..., tuple[str, str]]
Call = Callable[..., Any]


@pytest.fixture
def call(command: Command) -> Call:
    """The JSON document of `trilane avatar ARGUMENTS`."""
    return lambda *arguments: json.loads(command("avatar", *arguments, "--json")[0])


@pytest.fixture
def refusal(command: Command) -> Callable[..., str]:
    """The sentence with which `trilane avatar ARGUMENTS` refuses."""
    return lambda *arguments, code=2: command("avatar", *arguments, code=code)[1].removeprefix("error: ")


@pytest.fixture
def files(tmp_path: Path, tiny_float: onnx.ModelProto, tiny_frames: list[Any]) -> Path:
    onnx.save(tiny_float, tmp_path / "float.onnx")
    np.save(tmp_path / "frames.npy", np.stack(tiny_frames).astype(np.float64))
    return tmp_path


def test_inspect_says_what_the_files_hold(tiny_bundle: Path, call: Call, command: Command) -> None:
    bundle = load_bundle(tiny_bundle)
    network = bundle.read_network()
    facts = call("inspect", tiny_bundle)
    assert facts == json.loads(json.dumps(bundle_facts(bundle)))
    assert facts["files"] == {
        key: {"name": name, "bytes": (tiny_bundle / name).stat().st_size}
        for key, name in (("body", "body.npz"), ("texture", "texture.npz"), ("network", "network.onnx"))
    }
    about = {"shape": [1, 64, 64, 5], "sha256": network.digest, **graph_facts(network.model)}
    assert facts["network"] == json.loads(bundle.manifest.network.model_dump_json()) | about
    assert (facts["quantisation"]["method"], facts["validation"]) == ("minmax", None)
    assert "network.shape [1, 64, 64, 5]" in " ".join(command("avatar", "inspect", tiny_bundle)[0].split())
    hiker = load_bundle("hiker")
    assert hiker.offsets_path is not None
    offsets = {"name": "offsets.npz", "bytes": hiker.offsets_path.stat().st_size}
    assert bundle_facts(hiker)["files"]["offsets"] == offsets


@pytest.mark.parametrize(("key", "value", "named"), [("body", "texture.npz", "v_template"), ("betas", [1e9], "betas")])
def test_inspect_refuses_what_a_run_would(
    tiny_bundle: Path, tmp_path: Path, key: str, value: Any, named: str, refusal: Callable[..., str]
) -> None:
    broken = shutil.copytree(tiny_bundle, tmp_path / "broken")
    manifest = json.loads((broken / "manifest.json").read_text())
    (broken / "manifest.json").write_text(json.dumps(manifest | {key: value}))
    assert named in refusal("inspect", broken)


def test_quantise_writes_a_network_and_a_report(files: Path, call: Call) -> None:
    options = ("--frames", files / "frames.npy", "--out", files / "q.onnx", "--report", files / "report.json")
    facts = call("quantise", files / "float.onnx", *options, "--count", 3)
    assert facts["quantisation"]["calibration_frames"] == 3
    assert read_network(files / "q.onnx").digest == facts["sha256"]
    layers = json.loads((files / "report.json").read_text())["layers"]
    assert {row["name"] for row in layers} == {"stem", "deep", "level", "head"}
    assert 10 < layers[0]["sqnr_db"] <= layers[-1]["sqnr_db"] < 80


def test_quantise_does_what_the_options_say(
    files: Path, tiny_float: onnx.ModelProto, tiny_frames: list[Any], call: Call
) -> None:
    """By the first name of the command, which is not listed and still works."""
    words = ("quantize", files / "float.onnx", "--frames", files / "frames.npy", "--out", files / "q.onnx")
    options = ("--method", "percentile", "--count", 4, "--full-range", "--equalise", "--keep-float", "head")
    wanted = quantise(equalised(tiny_float), tiny_frames[:4], "percentile", False, ["head"])
    assert call(*words, *options)["sha256"] == wanted.network.digest
    assert call(*words)["sha256"] == quantise(tiny_float, tiny_frames, "minmax", True, []).network.digest


@pytest.mark.parametrize(
    "frames", [None, np.zeros((2, 64, 64)), np.zeros((2, 64, 64, 5), np.uint8), np.zeros((0, 1, 1, 1))]
)
def test_wrong_frames_are_refused(files: Path, frames: Any, refusal: Callable[..., str]) -> None:
    (files / "frames.npy").unlink()
    if frames is not None:
        np.save(files / "frames.npy", frames)
    words = ("quantise", files / "float.onnx", "--frames", files / "frames.npy", "--out", files / "q.onnx")
    assert refusal(*words).startswith(f"{files}/frames.npy: found ")
    assert not (files / "q.onnx").exists()


def test_calibrations_are_compared_on_frames_that_none_was_calibrated_on(
    files: Path, tiny_frames: list[Any], call: Call, command: Command
) -> None:
    np.save(files / "many.npy", np.stack([*tiny_frames] * 6)[:16])
    words = ("calibrations", files / "float.onnx", "--frames", files / "many.npy", "--method", "minmax")
    document = call(*words)
    assert [(row["method"], row["count"]) for row in document["rows"]] == [("minmax", 5), ("minmax", 10)]
    for row in document["rows"]:
        assert 30 < row["psnr_db"] < 80
        assert 0 < row["mean"] < 8 <= row["largest"] <= 255
    out, _ = command("avatar", *words)
    assert f"{document['rows'][1]['psnr_db']:.2f}" in out
    assert f"recommended: {document['recommendation']}" in out


def test_equalised_networks_compute_the_same(tiny_float: onnx.ModelProto, tiny_frames: list[Any]) -> None:
    onnxruntime.set_default_logger_severity(3)
    feed = {"tensor": np.ascontiguousarray(tiny_frames[0].transpose(2, 0, 1)[None])}
    sessions = [
        onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
        for model in (tiny_float, equalised(tiny_float))
    ]
    first, second = (session.run(None, feed)[0] for session in sessions)
    assert first == pytest.approx(second, abs=1e-5)


def test_network_exports_the_published_size(tmp_path: Path, call: Call) -> None:
    pytest.importorskip("torch")
    facts = call("network", "--width", 64, "--size", "64x64", "--out", tmp_path / "n.onnx")
    assert facts["parameters"] == 14576772
    assert onnx.load(tmp_path / "n.onnx").graph.input[0].name == "tensor"


def test_parts_are_written_in_their_order(tiny_bundle: Path, tmp_path: Path, call: Call, command: Command) -> None:
    whole = reshaped(load_bundle(tiny_bundle).read_network(), 64, 32)
    known = list(cuts(whole))
    first, second = [cut.at for cut in known][:2]
    listed = [{"at": cut.at, "tensors": len(cut.crossing), "bytes": cut.bytes} for cut in known]
    assert call("split", tiny_bundle, "--size", "64x32") == {"cuts": listed}
    assert first in command("avatar", "split", tiny_bundle)[0]
    for place in ("new/parts", "new/parts", "more"):
        folder = tmp_path / place
        printed = call("split", tiny_bundle, "--at", first, "--at", second, "--out", folder, "--size", "64x32")
        written = [folder / f"part-{number}.onnx" for number in (1, 2, 3)]
        assert printed == {"parts": [str(file) for file in written], "at": [first, second]}
        parts = [part.model.SerializeToString() for part in split(whole, [first, second])]
        assert [file.read_bytes() for file in written] == parts
    (tmp_path / "file").touch()
    _, err = command("avatar", "split", tiny_bundle, "--at", first, "--out", tmp_path / "file", code=2)
    assert err == f"error: {tmp_path}/file: found file exists, expected a folder that can be written\n"


WRONG = {
    "no file": (("inspect", "nowhere"), "nowhere"),
    "size": (("network", "--size", "65x64", "--out", "x.onnx"), "--size: found "),
    "float network": (("quantise", "missing.onnx", "--frames", "f.npy", "--out", "q.onnx"), "missing.onnx"),
    "format": (("export", "default", "--out", "x.onnx"), "avatar export: found no format, expected --qnn"),
    "the float network itself": (
        ("quantise", "float.onnx", "--frames", "frames.npy", "--out", "new/../float.onnx"),
        "--out: found new/../float.onnx, expected another file than the float network",
    ),
    "no folder": (("quantise", "float.onnx", "--frames", "frames.npy", "--out", "none/q.onnx"), "none"),
    "no frame": (
        ("quantise", "float.onnx", "--frames", "frames.npy", "--out", "q.onnx", "--count", "0"),
        "--count: found '0', expected greater than or equal to 1",
    ),
    "too few frames": (
        ("calibrations", "float.onnx", "--frames", "few.npy"),
        "found 9 of them, expected at least 10",
    ),
    "a network alone": (("calibrations", "float.onnx"), "a float network and its --frames, or --avatar alone"),
    "an avatar and frames": (
        ("calibrations", "--avatar", "default", "--frames", "f.npy"),
        "a float network and its --frames, or --avatar alone",
    ),
    "kind of plot": (("calibrations", "--avatar", "default", "--plot", "c.bmp"), "one of .png, .svg, .pdf"),
    "place of the plot": (
        ("calibrations", "--avatar", "default", "--plot", "none/c.png"),
        "a place that can be written",
    ),
    "size of a cut": (("split", "default", "--size", "wide"), "--size: found 'wide"),
    "a cut without a place": (("split", "default", "--at", "x"), "found --at without --out, expected both, or neither"),
    "a place without a cut": (
        ("split", "default", "--out", "p"),
        "found --out without --at, expected both, or neither",
    ),
    "size to validate": (("validate", "default", "--size", "100"), "--size: found "),
    "seed": (("validate", "default", "--seed", "-1"), "--seed: found '-1', expected greater than or equal to 0"),
    "seed of weights": (
        ("network", "--out", "n.onnx", "--seed", str(2**32)),
        "--seed: found '4294967296', expected less than or equal to 4294967295",
    ),
    "views": (("validate", "default", "--per-band", "1001"), "found '1001', expected less than or equal to 1000"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_usage_is_named(
    files: Path, monkeypatch: pytest.MonkeyPatch, case: str, refusal: Callable[..., str]
) -> None:
    arguments, message = WRONG[case]
    if "--plot" in arguments:
        pytest.importorskip("matplotlib")
    monkeypatch.chdir(files)
    np.save("few.npy", np.zeros((9, 64, 64, 5), np.float32))
    before = {file: file.read_bytes() for file in files.iterdir()}
    assert message in refusal(*arguments)
    assert {file: file.read_bytes() for file in files.iterdir()} == before


@pytest.mark.parametrize(
    ("missing", "arguments", "said", "extra"),
    [
        ("torch", ("network", "--out", "n.onnx"), "exporting a network needs PyTorch", "[train]"),
        ("trilane.training.validate", ("validate", "default"), "validating needs ", "[metrics]"),
    ],
)
def test_a_missing_part_is_named_with_its_extra(
    missing: str,
    arguments: tuple[str, ...],
    said: str,
    extra: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    refusal: Callable[..., str],
) -> None:
    import trilane.training

    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.delattr(trilane.training, "validate", raising=False)
    error = refusal(*arguments, code=3)
    assert error.startswith(said) and extra in error
    assert list(tmp_path.iterdir()) == []


def test_a_context_binary_is_written(tiny_bundle: Path, tmp_path: Path, call: Call) -> None:
    pytest.importorskip("onnxruntime_qnn")
    facts = call("export", tiny_bundle, "--qnn", "--soc", "sm8350", "--out", tmp_path / "ctx.onnx")
    assert facts["bytes"] > 1000
    assert [node.op_type for node in onnx.load(tmp_path / "ctx.onnx").graph.node] == ["EPContext"]


def test_bands_are_a_table() -> None:
    """The integer network's figures, each at its place; what nobody measured is a dash."""
    by_band = {"full_body": 31.456, "face": 28.1}
    figures = {"psnr_db_by_band": by_band, "iou": 0.9, "ssim": 0.9, "iou_by_band": {"full_body": 0.98765}}
    own = figures | {"body_psnr_db_by_band": {"full_body": 27.5, "face": 26.0}, "see_through_by_band": {"face": 0.0234}}
    told = {**figures, "date": date(2026, 1, 2), "runtime": "ort", "integer": own, "psnr_loss_db": {"face": 0.07}}
    console = Console(width=200)
    with console.capture() as screen:
        console.print(_band_table(Validation.model_validate(told)))
    lines = screen.get().splitlines()
    rows = [[cell.strip() for cell in re.split("[│┃]", line)[1:-1]] for line in lines if re.match("[│┃]", line)]
    assert rows == [
        ["band", "PSNR, dB", "of the person alone", "alpha < 0.9 inside, %", "mask IoU", "lost by quantising, dB"],
        ["full body", "31.46", "27.50", "-", "0.9877", "-"],
        ["face", "28.10", "26.00", "2.34", "-", "0.07"],
    ]
    assert any("validation of 2026-01-02" in line for line in lines)


def test_validate_writes_what_it_prints_and_sizes_beside_it(
    drawable_bundle: Path, tmp_path: Path, call: Call, command: Command
) -> None:
    """A view of each band, of an avatar whose pictures mean nothing."""
    pytest.importorskip("skimage")
    from trilane.training.validate import PICTURE_SIDES, TENSOR_SIDES

    own = shutil.copytree(drawable_bundle, tmp_path / "own")
    views = ("validate", own, "--seed", 1, "--per-band", 1, "--runtime", "ort", "--size", "64x64")
    printed = call(*views, "--sheet", tmp_path / "sheet.png")["validation"]
    written = load_bundle(own).manifest.validation
    assert written is not None and written.by_size is None and written.runtime == "ort"
    assert printed["psnr_db_by_band"] == written.psnr_db_by_band
    assert set(written.psnr_db_by_band) == set(BANDS) and all(0 < db < 100 for db in written.psnr_db_by_band.values())
    with Image.open(tmp_path / "sheet.png") as sheet:
        assert np.asarray(sheet).std() > 3
    out, _ = command("avatar", *views, "--sizes")
    assert f"{written.psnr_db_by_band['face']:.2f}" in out
    added = load_bundle(own).manifest.validation
    assert added is not None and added.by_size is not None and added.by_size.psnr_db_by_picture is not None
    table = added.by_size.psnr_db_by_picture
    assert list(table) == [*PICTURE_SIDES] and {tuple(row) for row in table.values()} == {TENSOR_SIDES}
    assert "384²" in out and f"{table[384][320]:.1f}" in out
    assert added.psnr_db_by_band == written.psnr_db_by_band


def test_sizes_are_added_to_an_avatar_that_was_validated_as_it_is_alone(
    tiny_bundle: Path, tmp_path: Path, refusal: Callable[..., str]
) -> None:
    pytest.importorskip("skimage")
    own = shutil.copytree(tiny_bundle, tmp_path / "own")
    refused = refusal("validate", own, "--sizes")
    assert "no validation" in refused and f"`trilane avatar validate {own}` comes first" in refused
    write_manifest(own, validated(load_bundle(own)))
    text = (own / "manifest.json").read_text()
    (own / "manifest.json").write_text(text.replace("0.8642", "0.8643"))
    assert "comes first" in refusal("validate", own, "--sizes")
