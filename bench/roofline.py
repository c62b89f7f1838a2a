"""What is the most this machine's cores can do, in INT8, in FP32, and from memory?

Rule: there are two peaks for INT8, and each figure names its own. The first is the best rate that any layer of the
installed runtimes reached here, on layers that suit them. The second is what the instruction set allows: the documented
multiply-accumulates of a cycle, times the clock measured under that load, times the number of cores.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from trilane import machine
from trilane.bench.lib.instruction_sets import instruction_set_of, measure_issued, peak_gmac_s
from trilane.bench.lib.interleaved_processes import ProcessVariant, runners
from trilane.errors import reason
from trilane.stages.dsp.runtime import installed
from trilane.stages.machine_facts import cpu_facts

#: Layers (side, channels, kernel) whose weights stay in cache and whose channels fill the registers.
INT8_LAYERS = ((32, 256, 3), (64, 128, 3), (64, 512, 1))
LAYERS = 4
RUNS, ROUNDS = 4, 6
MATRIX = 1536
COPY_BYTES = 128 << 20


def measure(threads: int = 0) -> dict[str, Any]:
    """Best rates with `threads` threads; 0: one for each core that this process may use.

    Keys: `int8_gmac_s` and `fp32_gmac_s`: rate of the best layer of the runtimes, in 1e9 multiply-accumulates a second;
    `int8_instruction_gmac_s`: peak of the instruction set, null where it is not known; `layer_of_instruction`:
    `int8_gmac_s` over this peak; `memory_gb_s`: 1e9 bytes a second, read and written by one thread; `instructions`: how
    the peak of the instruction set follows, or why it is not known; `rows`: the rate of each INT8 layer that was tried.
    """
    threads = threads or len(machine.here.cores())
    rows = _int8_rows(threads)
    best = max(row["gmac_s"] for row in rows)
    instructions = instruction_peak(cpu_facts()["flags"], threads)
    peak = instructions.get("gmac_s")
    return {
        "threads": threads,
        "int8_gmac_s": best,
        "int8_instruction_gmac_s": peak,
        "layer_of_instruction": best / peak if peak else None,
        "fp32_gmac_s": _best_fp32(threads),
        "memory_gb_s": _memory_gb_s(),
        "instructions": instructions,
        "rows": rows,
    }


def instruction_peak(flags: Sequence[str], threads: int) -> dict[str, Any]:
    """Return the INT8 peak of the widest instruction set that `flags` name, on as many cores as `threads` can use.

    `set`, `sequence`, `source`: entries of the table in lib/instruction_sets.py. `macs_a_cycle`: documented value for
    one core. `issued_macs_a_cycle`: value that a loop of registers alone reached. `clock_ghz`: clock under that load,
    with its 95 % interval. `cores`: number of cores. `gmac_s`: macs_a_cycle x clock x cores. `absent`: why there is
    none; it stands alone.
    """
    widest = instruction_set_of(flags)
    if widest is None:
        return {"absent": "the table of instruction sets has none of this CPU's"}
    cores = list(machine.here.cores()[:threads])
    try:
        issued = measure_issued(widest.name, cores)
    except OSError as error:
        return {"absent": f"{widest.name}: the clock cannot be measured: {reason(error)}"}
    macs = widest.macs_a_cycle(issued.rate)
    return {
        "set": widest.name,
        "sequence": widest.sequence,
        "source": widest.source,
        "macs_a_cycle": macs,
        "issued_macs_a_cycle": widest.macs * issued.rate,
        "clock_ghz": issued.clock_ghz,
        "clock_low_ghz": issued.clock_low_ghz,
        "clock_high_ghz": issued.clock_high_ghz,
        "cores": len(cores),
        "gmac_s": peak_gmac_s(macs, issued.clock_ghz, len(cores)),
    }


def _int8_rows(threads: int) -> list[dict[str, Any]]:
    names = [name for name in installed() if name != "qnn"]
    with tempfile.TemporaryDirectory(prefix="trilane-roofline-") as folder:
        variants, work = {}, {}
        for side, channels, kernel in INT8_LAYERS:
            path = Path(folder) / f"{side}-{channels}-{kernel}.onnx"
            onnx.save(_layers(side, channels, kernel), path)
            for name in names:
                key = f"{name} {side}x{side}x{channels} {kernel}x{kernel}"
                variants[key] = ProcessVariant(name, path, threads=threads)
                work[key] = LAYERS * (side * channels * kernel) ** 2
        return [{"kernel": key, "gmac_s": work[key] / 1e6 / ms} for key, ms in _best_ms(variants).items()]


def _best_fp32(threads: int) -> float:
    with tempfile.TemporaryDirectory(prefix="trilane-roofline-") as folder:
        path = Path(folder) / "product.onnx"
        onnx.save(_product(), path)
        return MATRIX**3 / 1e6 / _best_ms({"fp32": ProcessVariant("ort", path, threads=threads)})["fp32"]


def _best_ms(variants: dict[str, ProcessVariant]) -> dict[str, float]:
    with runners(variants) as by_name:
        best = dict.fromkeys(variants, float("inf"))
        for _ in range(ROUNDS):
            for key, runner in by_name.items():
                best[key] = min(best[key], *runner.run(RUNS))
    return best


def _memory_gb_s() -> float:
    """Return the memory rate of one thread in 1e9 bytes a second, read and written by a copy larger than the caches."""
    source, target = np.ones(COPY_BYTES // 8), np.empty(COPY_BYTES // 8)
    best = float("inf")
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        np.copyto(target, source)
        best = min(best, time.perf_counter() - begin)
    return 2 * COPY_BYTES / 1e9 / best


def _product() -> onnx.ModelProto:
    weights = np.random.default_rng(0).normal(size=(MATRIX, MATRIX)).astype(np.float32)
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [MATRIX, MATRIX]) for name in ("x", "y")]
    node = helper.make_node("MatMul", ["x", "w"], ["y"])
    return _model([node], ends, [numpy_helper.from_array(weights, "w")])


def _layers(side: int, channels: int, kernel: int) -> onnx.ModelProto:
    """Return `LAYERS` quantised convolutions in a row, NHWC bytes in and out."""
    rng = np.random.default_rng(0)
    shape = (channels, channels, kernel, kernel)
    constants = {
        "scale": np.float32(0.05),
        "zero": np.uint8(0),
        "w": rng.integers(-63, 64, shape).astype(np.int8),
        "w_scale": np.full(channels, 0.05 / (channels * kernel**2) ** 0.5, np.float32),
        "w_zero": np.zeros(channels, np.int8),
    }
    tensors = [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()]
    nodes = [
        helper.make_node("DequantizeLinear", ["x", "scale", "zero"], ["nhwc"]),
        helper.make_node("Transpose", ["nhwc"], ["real0"], perm=[0, 3, 1, 2]),
        helper.make_node("DequantizeLinear", ["w", "w_scale", "w_zero"], ["w_real"], axis=0),
    ]
    for i in range(LAYERS):
        nodes += [
            helper.make_node("Conv", [f"real{i}", "w_real"], [f"conv{i}"], pads=[kernel // 2] * 4),
            helper.make_node("QuantizeLinear", [f"conv{i}", "scale", "zero"], [f"bytes{i}"]),
            helper.make_node("DequantizeLinear", [f"bytes{i}", "scale", "zero"], [f"real{i + 1}"]),
        ]
    nodes[-1] = helper.make_node("Transpose", [f"bytes{LAYERS - 1}"], ["y"], perm=[0, 2, 3, 1])
    ends = [helper.make_tensor_value_info(n, TensorProto.UINT8, [1, side, side, channels]) for n in ("x", "y")]
    return _model(nodes, ends, tensors)


def _model(nodes: list[Any], ends: list[Any], tensors: list[Any]) -> onnx.ModelProto:
    graph = helper.make_graph(nodes, "roofline", ends[:1], ends[1:], tensors)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
