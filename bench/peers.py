"""Are Trilane's runtimes as fast as the libraries themselves, and how near are they to the machine's peak?

Rule: the libraries run as in their own introductory examples, with their default number of threads. Trilane's runtimes
and `benchmark_app` get `threads` threads. All variants run in interleaved rounds.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import onnx

from trilane import machine
from trilane.arrays import parse_shape
from trilane.bench import roofline
from trilane.bench.lib.interleaved_processes import ProcessVariant, runners
from trilane.bench.lib.networks import untrained, untrained_float
from trilane.errors import BadInputError, MissingPartError, TrilaneError
from trilane.scheduler.stats import median_interval
from trilane.stages.dsp.runtime import resolve
from trilane.unexpected_value import UnexpectedValue

ORT, OPENVINO, FP32 = "trilane ort", "trilane openvino", "onnxruntime fp32"
APP = "benchmark_app"
APP_STATS = "benchmark_report.json"
APP_TIMEOUT_S = 600
#: Ratio that is a share of a peak -> this peak in words.
PEAKS = {
    "openvino_of_roofline": "the best INT8 layer of the same runtimes, measured here (roofline.int8_gmac_s)",
    "openvino_of_instruction_peak": "the instruction set: documented multiply-accumulates a cycle x clock measured "
    "under that load x cores (roofline.int8_instruction_gmac_s)",
}


def measure(
    width: int = 64, size: str = "512x512", threads: int = 0, rounds: int = 8, seconds: int = 2
) -> dict[str, Any]:
    """Compare the speed of Trilane's runtimes with the libraries' own examples and with peaks of the machine.

    `ratios` are medians over the rounds. A key `a_over_b` is the speed of the runtime `a`, divided by the speed of the
    variant `b`. In a key with `of`, the ratio is a share of a peak.
    `ort_over_fp32`, `openvino_over_fp32`: Trilane's runtime in INT8, and ONNX Runtime in FP32 with its defaults.
    `openvino_over_benchmark_app`: Trilane's runtime, and OpenVINO's own tool on the same file.
    `openvino_of_roofline`: share of the best rate that an INT8 layer of the same runtimes reaches here.
    `openvino_of_instruction_peak`: share of the peak of the instruction set; null if this peak is unknown.

    `low`, `high`: 95 % interval of each ratio's median; with fewer than six rounds, the least and the largest ratio.
    `peaks`: the two peaks in words.
    `rows`: median time and number of runs of each variant (`way`). Each variant runs for `seconds` in each round;
    `benchmark_app` counts as one run.
    `gmac`: multiply-accumulates of the network, in 1e9.
    `roofline`: result of the bench `roofline`.
    `config`: settings of the bench.

    Raises BadInputError for a wrong size, MissingPartError without OpenVINO or PyTorch, TrilaneError if a variant's
    process fails.
    """
    for name in ("openvino", "ort"):
        resolve(name)
    threads = threads or len(machine.here.cores())
    try:
        shape = parse_shape(size)
    except UnexpectedValue as error:
        raise BadInputError.at("--size", error) from error
    fixture = untrained("resnet18", "batch", width, shape)
    with tempfile.TemporaryDirectory(prefix="trilane-peers-") as folder:
        integer, plain = Path(folder) / "integer.onnx", Path(folder) / "float.onnx"
        onnx.save(fixture.integer.model, integer)
        onnx.save(untrained_float("resnet18", "batch", width, shape), plain)
        times = _measure_rounds(_variants(integer, plain, threads), integer, threads, rounds, seconds)
    peak = roofline.measure(threads)
    return {
        **compared(times, fixture.gmac, peak["int8_gmac_s"], peak["int8_instruction_gmac_s"]),
        "peaks": PEAKS,
        "rows": [
            {"way": name, "median_ms": float(np.median(np.concatenate(of_rounds))), "runs": sum(map(len, of_rounds))}
            for name, of_rounds in times.items()
        ],
        "gmac": fixture.gmac,
        "roofline": peak,
        "config": {"width": width, "size": size, "threads": threads, "rounds": rounds, "seconds": seconds},
    }


def compared(
    times: Mapping[str, Sequence[Sequence[float]]], gmac: float, layer_gmac_s: float, instruction_gmac_s: float | None
) -> dict[str, dict[str, Any]]:
    """Return the keys `ratios`, `low` and `high` of the result of `measure`.

    `times`: milliseconds of each run, by round, by variant. `gmac`: multiply-accumulates of a run, in 1e9.
    `layer_gmac_s`: best rate of an INT8 layer, in 1e9 multiply-accumulates a second. `instruction_gmac_s`: peak of the
    instruction set in the same unit; None if unknown.
    """
    medians = {name: np.array([np.median(of_round) for of_round in of_rounds]) for name, of_rounds in times.items()}
    rate = gmac / (medians[OPENVINO] / 1e3)
    by_round = {
        "ort_over_fp32": medians[FP32] / medians[ORT],
        "openvino_over_fp32": medians[FP32] / medians[OPENVINO],
        "openvino_of_roofline": rate / layer_gmac_s,
        "openvino_of_instruction_peak": rate / instruction_gmac_s if instruction_gmac_s else None,
        "openvino_over_benchmark_app": medians[APP] / medians[OPENVINO],
    }
    known = {key: values.tolist() for key, values in by_round.items() if values is not None}
    ends = {key: median_interval(values) for key, values in known.items()}
    return {
        "ratios": {key: median(known[key]) if key in known else None for key in by_round},
        "low": {key: ends[key][0] if key in ends else None for key in by_round},
        "high": {key: ends[key][1] if key in ends else None for key in by_round},
    }


def _variants(integer: Path, plain: Path, threads: int) -> dict[str, ProcessVariant]:
    return {
        ORT: ProcessVariant("runtime", integer, "ort", threads),
        OPENVINO: ProcessVariant("runtime", integer, "openvino", threads),
        FP32: ProcessVariant("ort", plain),
        "onnxruntime int8": ProcessVariant("ort", integer),
        "openvino int8": ProcessVariant("openvino", integer),
    }


def _measure_rounds(
    variants: dict[str, ProcessVariant], integer: Path, threads: int, rounds: int, seconds: int
) -> dict[str, list[list[float]]]:
    """Return the times of all runs in ms, by round, by variant.

    For `benchmark_app`, each round has a single time, which is the median that the tool itself measures.
    """
    times: dict[str, list[list[float]]] = {name: [] for name in (*variants, APP)}
    with runners(variants) as by_name:
        for _ in range(rounds):
            for name, runner in by_name.items():
                times[name].append(runner.run_for(seconds))
            times[APP].append([_benchmark_app(integer, threads, seconds)])
    return times


def _benchmark_app(network: Path, threads: int, seconds: int) -> float:
    """Return the median latency in ms that OpenVINO's tool `benchmark_app` measures, with one request at a time.

    Raises MissingPartError if the tool is not installed, TrilaneError if it fails.
    """
    tool = machine.here.program(APP, first=Path(sys.executable).parent)
    if tool is None:
        raise MissingPartError(f"{APP} is not there", extra="openvino")
    options = ["-hint", "none", "-api", "sync", "-nthreads", str(threads), "-nstreams", "1", "-t", str(seconds)]
    report = ["-report_type", "no_counters", "-report_folder", str(network.parent), "-json_stats"]
    command = [tool, "-m", str(network), "-d", "CPU", *options, *report]
    try:
        subprocess.run(command, check=True, capture_output=True, timeout=APP_TIMEOUT_S)
        stats = json.loads((network.parent / APP_STATS).read_text())
        return float(stats["execution_results"]["latency (ms)"])
    except (OSError, subprocess.SubprocessError, ValueError, KeyError) as error:
        raise TrilaneError(f"{APP} failed: {error}") from error
