"""The inference benches on the tiny network: rounds in processes of their own, rows that add up, errors by name."""

from __future__ import annotations

import multiprocessing

import onnx
import pytest

from trilane.bench import infer, roofline
from trilane.bench.lib.interleaved_processes import ProcessVariant, runners
from trilane.errors import BadInputError, TrilaneError


@pytest.fixture
def file(tiny_quantised, tmp_path):
    path = tmp_path / "network.onnx"
    onnx.save(tiny_quantised.network.model, path)
    return path


def test_variants_run_interleaved_and_leave_no_process(file):
    with runners(
        {"ours": ProcessVariant("runtime", file, "ort", 1), "plain": ProcessVariant("ort", file, threads=1)}
    ) as by_name:
        assert {name: len(runner.run(3)) for name, runner in by_name.items()} == {"ours": 3, "plain": 3}
        assert all(runner.startup_ms > 0 for runner in by_name.values())
    assert not multiprocessing.active_children()


def test_a_variant_that_fails_says_why(tmp_path):
    with (
        pytest.raises(TrilaneError, match=r"ours.*nothing\.onnx"),
        runners({"ours": ProcessVariant("runtime", tmp_path / "nothing.onnx", "ort")}),
    ):
        pass


def test_whole_batches_are_run(file, monkeypatch):
    """That a batch's time is divided by its frames is held with times that are told: test_inference_bench.py."""
    monkeypatch.setattr(roofline, "measure", lambda _threads: {"int8_gmac_s": 100.0, "int8_instruction_gmac_s": 400.0})
    result = infer.measure(str(file), batch=(1, 8), runtime=("ort",), threads=1, seconds=0.2, period=0.1)
    one, eight = result["rows"]
    assert (one["batch"], eight["batch"]) == (1, 8) and eight["frames"] % 8 == 0
    assert all(0 < row["min_ms"] <= row["p50_ms"] <= row["max_ms"] for row in (one, eight))


def test_an_unknown_runtime_is_named():
    with pytest.raises(BadInputError, match="tpu"):
        infer.measure(runtime=("tpu",))
