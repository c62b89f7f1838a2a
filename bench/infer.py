"""How long does a network take on each runtime, run continuously on random inputs?

Rule: Trilane's runtimes and ONNX Runtime in FP32 run in turn on the same cores, for one period each. Each has a process
of its own.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from trilane import machine
from trilane.arrays import parse_shape
from trilane.avatars.bundle import load_bundle
from trilane.avatars.network_file import read_network
from trilane.bench import roofline
from trilane.bench.lib.interleaved_processes import ProcessVariant, runners
from trilane.bench.lib.networks import ENCODER, NORM, WIDTH, NetworkFixture, fixture_of_file, untrained, untrained_float
from trilane.errors import BadInputError
from trilane.stages.dsp.runtime import resolve
from trilane.unexpected_value import UnexpectedValue

FP32 = "ort fp32"
SIZE = "256x256"
CACHE = "XDG_CACHE_HOME"


def measure(
    network: str = "",
    encoder: tuple[str, ...] = (ENCODER,),
    norm: tuple[str, ...] = (NORM,),
    width: int = WIDTH,
    size: tuple[str, ...] = (SIZE,),
    batch: tuple[int, ...] = (1,),
    runtime: tuple[str, ...] = ("ort", "openvino"),
    threads: int = 0,
    spin: bool = False,
    seconds: float = 5.0,
    period: float = 1.0,
) -> dict[str, Any]:
    """Measure how long each network takes on each runtime. Times are for one frame.

    `rows` has a row for each network and runtime. A row has the network's settings, and:
    `parameters`: number of parameters.
    `gmac`: multiply-accumulates of a frame, in 1e9.
    `runtime`, `batch`: name of the runtime, and number of frames that it infers at once; always 1 for ONNX Runtime in
    FP32.
    `startup_cold_ms`, `startup_warm_ms`: time to import libraries and load the network, with an empty and with a filled
    cache.
    `frames`: number of inferred frames.
    `min_ms`, `mean_ms`, `p50_ms`, `p90_ms`, `p99_ms`, `max_ms`: times over all periods.
    `periods`: least, mean and largest time of each period.
    `temperature_c`: temperature of the machine's sensor at the end; null if it cannot be read.

    Rows of INT8 networks also have:
    `int8_over_fp32`: speed divided by the speed of ONNX Runtime in FP32; null if there is no float network.
    `share_of_roofline`: rate divided by the rate of the runtimes' best INT8 layer.
    `share_of_instruction_peak`: rate divided by the peak of the instruction set; null if this peak is unknown.

    Further keys:
    `roofline`: result of the bench `roofline`, which measures both peaks before the networks run.
    `config`: settings of the bench.

    Raises BadInputError for an option out of range, or a network or avatar that cannot be read. Raises MissingPartError
    if a library is not installed, and TrilaneError if a process fails.
    """
    threads = threads or len(machine.here.cores())
    if not 0 < period <= seconds:
        raise BadInputError("--period", f"{period:g}", f"more than 0, at most --seconds {seconds:g}")
    if network and ([*encoder], [*norm], width, [*size]) != ([ENCODER], [NORM], WIDTH, [SIZE]):
        raise BadInputError("--network", network, "no --encoder, --norm, --width or --size with it")
    names = [resolve(name) for name in runtime]
    peak = roofline.measure(threads)
    rows: list[dict[str, Any]] = []
    for fixture, plain in _fixtures(network, encoder, norm, width, size, batch):
        with tempfile.TemporaryDirectory(prefix="trilane-bench-") as folder:
            variants = _variants(Path(folder), fixture, plain, names, threads, spin)
            with _cache(Path(folder) / "cache"):
                measured = _measure_periods(variants, seconds, period)
        rows += _rows(fixture, measured, peak)
    return {"rows": rows, "roofline": peak, "config": {"threads": threads, "spin": spin, "seconds": seconds}}


def _fixtures(
    network: str,
    encoder: tuple[str, ...],
    norm: tuple[str, ...],
    width: int,
    size: tuple[str, ...],
    batch: tuple[int, ...],
) -> Iterator[tuple[NetworkFixture, onnx.ModelProto | None]]:
    """Yield (integer network, float network) for each combination of settings. An unknown float network is None.

    Raises BadInputError for a wrong size, or a network that cannot be read.
    """
    if network:
        file = read_network(Path(network)) if network.endswith(".onnx") else load_bundle(network).read_network()
        for frames in batch:
            yield fixture_of_file(file, frames), None
        return
    for one_encoder, one_norm, text, frames in product(encoder, norm, size, batch):
        try:
            shape = parse_shape(text)
        except UnexpectedValue as error:
            raise BadInputError.at("--size", error) from error
        settings = (one_encoder, one_norm, width, shape)
        yield untrained(*settings, batch=frames), untrained_float(*settings)


def _variants(
    folder: Path, fixture: NetworkFixture, plain: onnx.ModelProto | None, names: list[str], threads: int, spin: bool
) -> dict[str, ProcessVariant]:
    integer = folder / "integer.onnx"
    onnx.save(fixture.integer.model, integer)
    variants = {name: ProcessVariant("runtime", integer, name, threads, spin) for name in names}
    if plain is not None:
        onnx.save(plain, folder / "float.onnx")
        variants[FP32] = ProcessVariant("ort", folder / "float.onnx", threads=threads)
    return variants


@contextmanager
def _cache(folder: Path) -> Iterator[None]:
    """Make `folder` the cache for compiled networks of all processes that are started inside the `with` block."""
    before = os.environ.get(CACHE)
    os.environ[CACHE] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ[CACHE]
        else:
            os.environ[CACHE] = before


def _measure_periods(variants: dict[str, ProcessVariant], seconds: float, period: float) -> dict[str, dict[str, Any]]:
    """Return the measured times of each variant, by name, in ms.

    Their keys are `startup_cold_ms`, `startup_warm_ms` and `periods`, which has a list of times for each period.
    """
    with runners(variants) as by_name:
        cold = {name: runner.startup_ms for name, runner in by_name.items()}
    with runners(variants) as by_name:
        measured: dict[str, dict[str, Any]] = {
            name: {"startup_cold_ms": cold[name], "startup_warm_ms": runner.startup_ms, "periods": []}
            for name, runner in by_name.items()
        }
        for _ in range(round(seconds / period)):
            for name, runner in by_name.items():
                measured[name]["periods"].append(runner.run_for(period))
    return measured


def _rows(fixture: NetworkFixture, measured: dict[str, dict[str, Any]], peak: dict[str, Any]) -> list[dict[str, Any]]:
    batches = {name: 1 if name == FP32 else fixture.integer.shape[0] for name in measured}
    periods = {
        name: [np.divide(times, batches[name]) for times in facts["periods"]] for name, facts in measured.items()
    }
    medians = {name: float(np.median(np.concatenate(times))) for name, times in periods.items()}
    rows = []
    for name, facts in measured.items():
        times = np.concatenate(periods[name])
        row = {
            **fixture.label,
            "parameters": fixture.parameters,
            "gmac": fixture.gmac,
            "runtime": name,
            "batch": batches[name],
            "startup_cold_ms": facts["startup_cold_ms"],
            "startup_warm_ms": facts["startup_warm_ms"],
            "frames": len(times) * batches[name],
            **{f"p{q}_ms": float(np.percentile(times, q)) for q in (50, 90, 99)},
            **{f"{key}_ms": float(pick(times)) for key, pick in (("min", np.min), ("mean", np.mean), ("max", np.max))},
            "periods": [
                {"min_ms": float(p.min()), "mean_ms": float(p.mean()), "max_ms": float(p.max())} for p in periods[name]
            ],
            "temperature_c": machine.here.sensor_c(),
        }
        if name != FP32:
            rate, allowed = fixture.gmac / (medians[name] / 1e3), peak["int8_instruction_gmac_s"]
            row["share_of_roofline"] = rate / peak["int8_gmac_s"]
            row["share_of_instruction_peak"] = rate / allowed if allowed else None
            row["int8_over_fp32"] = medians[FP32] / medians[name] if FP32 in medians else None
        rows.append(row)
    return rows
