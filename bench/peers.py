"""Are Trilane's runtimes as fast as the libraries themselves, and how far from what the machine can do?

Rule: the libraries are run as their first examples run them; ours on as many threads; all take turns.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from trilane.bench import roofline
from trilane.bench.lib.interleaved import Way, runners
from trilane.bench.lib.networks import untrained, untrained_float
from trilane.errors import BadInputError, MissingPartError, TrilaneError
from trilane.shapes import parse_shape
from trilane.stages.dsp.runtime import resolve
from trilane.unexpected import UnexpectedValue

APP = "benchmark_app"
APP_STATS = "benchmark_report.json"
APP_TIMEOUT_S = 600


def measure(
    width: int = 64, size: str = "512x512", threads: int = 0, turns: int = 8, seconds: int = 2
) -> dict[str, Any]:
    """Ratios of speed (1 is equal, more is faster than what stands after `over`), from medians; `rows` beside.

    `ratios.ort_over_fp32`, `ratios.openvino_over_fp32`: ours in INT8 over ONNX Runtime in FP32 with its defaults.
    `ratios.openvino_of_roofline`: share of the INT8 peak measured here. `ratios.openvino_over_benchmark_app`: ours
    over OpenVINO's own tool on the same file. Each way runs for `seconds` in each turn.
    Raises MissingPartError without OpenVINO or PyTorch.
    """
    for name in ("openvino", "ort"):
        resolve(name)
    threads = threads or len(os.sched_getaffinity(0))
    try:
        shape = parse_shape(size)
    except UnexpectedValue as error:
        raise BadInputError.at("--size", error) from error
    subject = untrained("resnet18", "batch", width, shape)
    with tempfile.TemporaryDirectory(prefix="trilane-peers-") as name:
        folder = Path(name)
        integer, plain = folder / "integer.onnx", folder / "float.onnx"
        onnx.save(subject.integer.model, integer)
        onnx.save(untrained_float("resnet18", "batch", width, shape), plain)
        ways = {
            "trilane ort": Way("runtime", integer, "ort", threads),
            "trilane openvino": Way("runtime", integer, "openvino", threads),
            "onnxruntime fp32": Way("ort", plain),
            "onnxruntime int8": Way("ort", integer),
            "openvino int8": Way("openvino", integer),
        }
        times, app = _take(ways, folder, threads, turns, seconds)
    peak = roofline.measure(threads)
    medians = {key: float(np.median(taken)) for key, taken in times.items()} | {APP: float(np.median(app))}
    ours = medians["trilane openvino"]
    return {
        "ratios": {
            "ort_over_fp32": medians["onnxruntime fp32"] / medians["trilane ort"],
            "openvino_over_fp32": medians["onnxruntime fp32"] / ours,
            "openvino_of_roofline": subject.gmac / (ours / 1e3) / peak["int8_gmac_s"],
            "openvino_over_benchmark_app": medians[APP] / ours,
        },
        "rows": [{"way": key, "median_ms": value, "runs": len(times.get(key, app))} for key, value in medians.items()],
        "gmac": subject.gmac,
        "roofline": peak,
        "config": {"width": width, "size": size, "threads": threads, "turns": turns, "seconds": seconds},
    }


def _take(
    ways: dict[str, Way], folder: Path, threads: int, turns: int, seconds: int
) -> tuple[dict[str, list[float]], list[float]]:
    """Milliseconds of each way, and the medians that `benchmark_app` printed, one in each turn."""
    times: dict[str, list[float]] = {key: [] for key in ways}
    app: list[float] = []
    with runners(ways) as found:
        for _ in range(turns):
            for key, runner in found.items():
                times[key] += runner.run_for(seconds)
            app.append(_benchmark_app(ways["openvino int8"].network, folder, threads, seconds))
    return times, app


def _benchmark_app(network: Path, folder: Path, threads: int, seconds: int) -> float:
    """Median latency in milliseconds by OpenVINO's tool: one request at a time."""
    tool = shutil.which(APP, path=f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}")
    if tool is None:
        raise MissingPartError(f"{APP} is not there", extra="openvino")
    options = ["-hint", "none", "-api", "sync", "-nthreads", str(threads), "-nstreams", "1", "-t", str(seconds)]
    report = ["-report_type", "no_counters", "-report_folder", str(folder), "-json_stats"]
    command = [tool, "-m", str(network), "-d", "CPU", *options, *report]
    try:
        subprocess.run(command, check=True, capture_output=True, timeout=APP_TIMEOUT_S)
        stats = json.loads((folder / APP_STATS).read_text())
        return float(stats["execution_results"]["latency (ms)"])
    except (OSError, subprocess.SubprocessError, ValueError, KeyError) as error:
        raise TrilaneError(f"{APP} failed: {error}") from error
