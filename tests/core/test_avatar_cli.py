"""`trilane avatar`: what it prints and writes, and what it refuses."""

from __future__ import annotations

import json
import shutil

import numpy as np
import onnx
import pytest
from typer.testing import CliRunner

from trilane.apps.cli.avatar import app
from trilane.avatars.network_file import read_network
from trilane.errors import BadInputError
from trilane.training.quantising.quantise import equalised

runner = CliRunner()


def call(*arguments):
    """The JSON document of one command; an error is raised as it is."""
    result = runner.invoke(app, [*map(str, arguments), "--json"])
    if result.exception is not None:
        raise result.exception
    return json.loads(result.stdout)


@pytest.fixture
def files(tmp_path, tiny_float, tiny_frames):
    onnx.save(tiny_float, tmp_path / "float.onnx")
    np.save(tmp_path / "frames.npy", np.stack(tiny_frames))
    return tmp_path


def test_inspect_says_what_the_manifest_says(tiny_bundle):
    facts = call("inspect", tiny_bundle)
    assert facts["network"]["channels"] == 5 and facts["network"]["shape"] == [1, 64, 64, 5]
    assert facts["network"]["parameters"] > 0 and facts["quantisation"]["method"] == "minmax"
    assert facts["validation"] is None


@pytest.mark.parametrize(("key", "value", "named"), [("body", "texture.npz", "v_template"), ("betas", [1e9], "betas")])
def test_inspect_refuses_what_a_run_would(tiny_bundle, tmp_path, key, value, named):
    broken = tmp_path / "broken"
    shutil.copytree(tiny_bundle, broken)
    manifest = json.loads((broken / "manifest.json").read_text())
    (broken / "manifest.json").write_text(json.dumps(manifest | {key: value}))
    with pytest.raises(BadInputError, match=named):
        call("inspect", broken)


def test_inspect_prints_a_table(tiny_bundle):
    result = runner.invoke(app, ["inspect", str(tiny_bundle)])
    assert result.exit_code == 0 and "network.width" in result.stdout


def test_quantise_writes_a_network_and_a_report(files):
    options = ("--frames", files / "frames.npy", "--out", files / "q.onnx", "--report", files / "report.json")
    facts = call("quantise", files / "float.onnx", *options, "--count", 3)
    assert facts["quantisation"]["calibration_frames"] == 3
    assert read_network(files / "q.onnx").digest == facts["sha256"]
    layers = json.loads((files / "report.json").read_text())["layers"]
    assert {row["name"] for row in layers} == {"stem", "deep", "level", "head"}
    assert 10 < layers[0]["sqnr_db"] <= layers[-1]["sqnr_db"] < 80


def test_the_first_name_of_quantise_still_works_and_is_not_listed(files):
    facts = call("quantize", files / "float.onnx", "--frames", files / "frames.npy", "--out", files / "q.onnx")
    assert read_network(files / "q.onnx").digest == facts["sha256"]
    listed = runner.invoke(app, ["--help"]).stdout
    assert "quantise" in listed and "quantize" not in listed


def test_quantise_does_not_write_over_the_float_network(files):
    before = (files / "float.onnx").read_bytes()
    with pytest.raises(BadInputError, match="another file than the float network"):
        call("quantise", files / "float.onnx", "--frames", files / "frames.npy", "--out", files / "float.onnx")
    assert (files / "float.onnx").read_bytes() == before


def test_calibrations_are_compared_on_frames_that_none_was_calibrated_on(files, tiny_frames):
    np.save(files / "many.npy", np.stack([*tiny_frames] * 6)[:16])
    rows = call("calibrations", files / "float.onnx", "--frames", files / "many.npy", "--method", "minmax")["rows"]
    assert [(row["method"], row["count"]) for row in rows] == [("minmax", 5), ("minmax", 10)]
    for row in rows:
        assert 30 < row["psnr_db"] < 80
        assert 0 < row["mean"] < 8 <= row["largest"] <= 255


def test_too_few_frames_to_compare_are_refused(files):
    np.save(files / "few.npy", np.zeros((9, 64, 64, 5), np.float32))
    with pytest.raises(BadInputError, match="found 9 of them, expected at least 10"):
        call("calibrations", files / "float.onnx", "--frames", files / "few.npy")


def test_equalised_networks_compute_the_same(tiny_float, tiny_frames):
    import onnxruntime

    onnxruntime.set_default_logger_severity(3)
    feed = {"tensor": np.ascontiguousarray(tiny_frames[0].transpose(2, 0, 1)[None])}
    sessions = [
        onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
        for model in (tiny_float, equalised(tiny_float))
    ]
    first, second = (session.run(None, feed)[0] for session in sessions)
    assert first == pytest.approx(second, abs=1e-5)


def test_network_exports_the_published_size(tmp_path):
    pytest.importorskip("torch")
    facts = call("network", "--width", 64, "--size", "64x64", "--out", tmp_path / "n.onnx")
    assert facts["parameters"] == 14576772
    assert onnx.load(tmp_path / "n.onnx").graph.input[0].name == "tensor"


WRONG = {
    "no file": (["inspect", "nowhere"], "nowhere"),
    "size": (["network", "--size", "65x64", "--out", "x.onnx"], "--size"),
    "float network": (["quantise", "missing.onnx", "--frames", "f.npy", "--out", "q.onnx"], r"missing\.onnx"),
    "format": (["export", "default", "--out", "x.onnx"], "--qnn"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_usage_is_named(tmp_path, monkeypatch, case):
    monkeypatch.chdir(tmp_path)
    arguments, message = WRONG[case]
    with pytest.raises(BadInputError, match=message):
        call(*arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("frames", [np.zeros((2, 64, 64)), np.zeros((2, 64, 64, 5), np.uint8), np.zeros((0, 1, 1, 1))])
def test_wrong_frames_are_refused(files, frames):
    np.save(files / "frames.npy", frames)
    with pytest.raises(BadInputError, match=r"frames\.npy"):
        call("quantise", files / "float.onnx", "--frames", files / "frames.npy", "--out", files / "q.onnx")


def test_an_unwritable_output_is_named(files):
    with pytest.raises(BadInputError, match="no_folder"):
        call(
            *("quantise", files / "float.onnx", "--frames", files / "frames.npy"),
            *("--out", files / "no_folder" / "q.onnx"),
        )


def test_a_context_binary_is_written(tiny_bundle, tmp_path):
    pytest.importorskip("onnxruntime_qnn")
    facts = call("export", tiny_bundle, "--qnn", "--soc", "sm8350", "--out", tmp_path / "ctx.onnx")
    assert facts["bytes"] > 1000
    assert [node.op_type for node in onnx.load(tmp_path / "ctx.onnx").graph.node] == ["EPContext"]
