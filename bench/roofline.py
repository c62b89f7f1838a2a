"""What are the highest rates of this machine's cores, in INT8, in FP32, and from memory?

Rule: there are two peaks for INT8, and each figure names the peak that it means. The first is the best rate that the
installed runtimes reach on this machine, on layers that suit them. The second is the peak of the instruction set. It is
the product of the documented multiply-accumulates a cycle, the clock under INT8 load, and the number of cores.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import tempfile
import threading
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from trilane import machine
from trilane.bench.lib.interleaved_processes import KINDS, ProcessVariant, runners
from trilane.errors import reason
from trilane.scheduler.stats import median_interval
from trilane.stages.dsp.runtime import installed
from trilane.stages.machine_facts import cpu_facts

#: Layers (side, channels, kernel) whose weights stay in cache and whose channels fill the registers.
INT8_LAYERS = ((32, 256, 3), (64, 128, 3), (64, 512, 1))
LAYERS = 4
RUNS, ROUNDS = 4, 6
MATRIX = 1536
COPY_BYTES = 128 << 20


def measure(threads: int = 0) -> dict[str, Any]:
    """Measure the best rates of this machine with `threads` threads; 0: one for each core that this process may use.

    Rates are in 1e9 multiply-accumulates a second.
    `threads`: number of threads.
    `int8_gmac_s`: rate of the best INT8 layer of the runtimes.
    `int8_instruction_gmac_s`: peak of the instruction set; null if unknown.
    `layer_of_instruction`: `int8_gmac_s` divided by this peak; null if unknown.
    `fp32_gmac_s`: rate of an FP32 matrix product.
    `memory_gb_s`: bytes that one thread reads and writes, in 1e9 bytes a second.
    `instructions`: derivation of the instruction set's peak, or `absent` with the reason.
    `rows`: rate of each INT8 layer that was tried.
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
    """Return the INT8 peak of the widest instruction set that the processor has.

    `flags`: flags of the processor. `threads`: largest number of cores that count.
    Keys of the result: `set`, `sequence`, `source`: name and fields of the `InstructionSet`. `macs_a_cycle`:
    multiply-accumulates a cycle of one core, as documented. `issued_macs_a_cycle`: the same, measured with a loop
    without memory accesses. `clock_ghz`, `clock_low_ghz`, `clock_high_ghz`: clock under this load, with its 95 %
    interval. `cores`: number of cores. `gmac_s`: macs_a_cycle x clock x cores, in 1e9 a second. If the peak is unknown,
    the only key is `absent`, with the reason.
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
        "gmac_s": macs * issued.clock_ghz * len(cores),
    }


def _int8_rows(threads: int) -> list[dict[str, Any]]:
    names = [name for name in installed() if name in KINDS]
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
    """Return the rate of one thread, in 1e9 bytes a second read and written, by a copy larger than the caches."""
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
    """Return a network of `LAYERS` quantised convolutions in sequence, from and to (1, side, side, channels) uint8."""
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


# The INT8 peak of a core by its instruction set: multiply-accumulates of an instruction, times instructions a cycle.
#
# Rule: the number of multiply-accumulates in an instruction follows from its definition; the number of instructions a
# cycle is documented. If cores with the same set differ, the measurement shows which documented rate this core has.
#
# Two loops measure the cores. They run in turn, in short bursts, on all cores at once; the median of the bursts counts.
# The first loop only issues the set's instructions. The second loop has dependent `imul` after each of them. An `imul`
# takes three cycles on every x86-64 core since Intel's Nehalem and AMD's Zen (uops.info IMUL_R64_R64). The chain of
# `imul` takes longer than the other instructions. Therefore the time of the second loop shows the clock under this
# load. No performance counter is needed, because virtual machines have none. The loops are machine code, because a
# compiler may be missing. The bytes are the output of GNU as for the instructions in the comments.


@dataclass(frozen=True)
class InstructionSet:
    """An instruction set with INT8 multiply-accumulates.

    `name`: name of the set. `flags`: flags of /proc/cpuinfo that every core with the set has.
    `sequence`: instruction that multiplies and accumulates, or the few instructions that do so together.
    `macs`: INT8 multiply-accumulates of one `sequence`.
    `rates`: documented numbers of sequences a cycle; kinds of cores differ.
    `source`: source of `macs` and `rates`.
    """

    name: str
    flags: tuple[str, ...]
    sequence: str
    macs: int
    rates: tuple[Fraction, ...]
    source: str

    def macs_a_cycle(self, measured: float) -> float:
        """Return the documented multiply-accumulates a cycle of a core.

        `measured`: measured sequences a cycle, which select the nearest of `rates`.
        """
        return float(self.macs * min(self.rates, key=lambda rate: abs(float(rate) - measured)))


ONE, TWO, FOUR = Fraction(1), Fraction(2), Fraction(4)
#: From the widest to the narrowest. The first set whose flags a core has counts.
INSTRUCTION_SETS = (
    InstructionSet(
        "AMX-INT8",
        ("amx_tile", "amx_int8"),
        "tdpbusd: a 16 x 64 by 64 x 16 tile product",
        16 * 16 * 64,
        (Fraction(1, 16),),
        "Intel 64 Optimization Reference Manual, chapter on AMX: TDP* issues every 16 cycles, 2048 operations a cycle",
    ),
    InstructionSet(
        "AVX512-VNNI",
        ("avx512f", "avx512_vnni"),
        "vpdpbusd zmm: 16 sums of 4 products",
        16 * 4,
        (ONE, TWO),
        "uops.info VPDPBUSD_ZMM: two a cycle on Xeons with two 512-bit units and Zen 5, one on others and Zen 4",
    ),
    InstructionSet(
        "AVX-VNNI",
        ("avx2", "avx_vnni"),
        "vpdpbusd ymm: 8 sums of 4 products",
        8 * 4,
        (ONE, TWO),
        "uops.info VPDPBUSD_YMM (VEX): two a cycle on Alder Lake's P-cores and Zen 5, one on E-cores",
    ),
    InstructionSet(
        "AVX512-BW",
        ("avx512f", "avx512bw"),
        "vpmaddubsw, vpmaddwd, vpaddd zmm: 16 sums of 4 products",
        16 * 4,
        (Fraction(1, 2), Fraction(2, 3)),
        "uops.info: three on ports 0 and 5 of Xeons with two 512-bit units; on others both products on 0, the sum on 5",
    ),
    InstructionSet(
        "AVX2",
        ("avx2",),
        "vpmaddubsw, vpmaddwd, vpaddd ymm: 8 sums of 4 products",
        8 * 4,
        (Fraction(1, 2), ONE),
        "uops.info VPMADDUBSW_YMM, VPMADDWD_YMM: on ports 0 and 1 from Skylake and Zen on, on port 0 alone on Haswell",
    ),
    InstructionSet(
        "NEON dot",
        ("asimddp",),
        "sdot: 4 sums of 4 products",
        4 * 4,
        (ONE, TWO, FOUR),
        "Arm's Software Optimization Guides: two a cycle on Cortex-A76 and Neoverse N1, four on Neoverse V1",
    ),
)


def instruction_set_of(flags: Iterable[str]) -> InstructionSet | None:
    """Return the widest set in `INSTRUCTION_SETS` that a core with these `flags` has; None if it has no such set."""
    found = {*flags}
    return next((each for each in INSTRUCTION_SETS if found.issuperset(each.flags)), None)


IMUL, IMUL_CYCLES = bytes.fromhex("480fafc0"), 3  # imul %rax,%rax
DEC, JNZ, RET = bytes.fromhex("48ffcf"), bytes.fromhex("0f85"), b"\xc3"  # dec %rdi; jnz; ret
VZEROUPPER = "c5f877"
BURST_CYCLES, BURSTS = 1_000_000, 60
SYS_ARCH_PRCTL, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA = 158, 0x1023, 18
#: Tile configuration of AMX: palette 1, eight tiles of 16 rows of 64 bytes.
TILE_CONFIG = bytes([1, *[0] * 15, *[64, 0] * 8, *[0] * 16, *[16] * 8, *[0] * 8])


@dataclass(frozen=True)
class Kernel:
    """The machine code of a loop with the instructions of one instruction set.

    `body`: code of independent sequences, in hexadecimal, instructions separated by spaces.
    `sequences`: number of sequences in the body.
    `imuls`: number of `imul` after each instruction, in the loop that measures the clock. These `imul` together take
    longer than the instruction.
    `cycles`: least number of cycles that the body takes. A burst has BURST_CYCLES / `cycles` turns of the loop.
    `before`, `after`: code before and after the loop, in hexadecimal.
    """

    body: str
    sequences: int
    imuls: int
    cycles: int
    before: str = ""
    after: str = VZEROUPPER


#: Name of an instruction set -> its loop, for x86-64.
KERNELS = {
    "AMX-INT8": Kernel(
        "c4e2415ec6 c4e2415ece c4e2415ed6 c4e2415ede",  # tdpbusd %tmm7,%tmm6,%tmm0 to %tmm3
        sequences=4,
        imuls=8,
        cycles=64,
        # ldtilecfg (%rsi); tilezero %tmm0 to %tmm7
        before="c4e2784906 c4e27b49c0 c4e27b49c8 c4e27b49d0 c4e27b49d8 c4e27b49e0 c4e27b49e8 c4e27b49f0 c4e27b49f8",
        after="c4e27849c0",  # tilerelease
    ),
    "AVX512-VNNI": Kernel(  # vpdpbusd %zmm30,%zmm31,%zmm0 to %zmm11
        "6292054050c6 6292054050ce 6292054050d6 6292054050de 6292054050e6 6292054050ee "
        "6292054050f6 6292054050fe 6212054050c6 6212054050ce 6212054050d6 6212054050de",
        sequences=12,
        imuls=1,
        cycles=6,
    ),
    "AVX-VNNI": Kernel(  # {vex} vpdpbusd %ymm14,%ymm15,%ymm0 to %ymm11
        "c4c20550c6 c4c20550ce c4c20550d6 c4c20550de c4c20550e6 c4c20550ee "
        "c4c20550f6 c4c20550fe c4420550c6 c4420550ce c4420550d6 c4420550de",
        sequences=12,
        imuls=1,
        cycles=6,
    ),
    "AVX512-BW": Kernel(  # vpmaddubsw %zmm30,%zmm31,%zmmB; vpmaddwd %zmm29,%zmmB,%zmmB; vpaddd %zmmB,%zmmA,%zmmA
        "6212054004e6 62111d48f5e5 62d17d48fec4 6212054004ee 62111548f5ed 62d17548fecd "
        "6212054004f6 62110d48f5f5 62d16d48fed6 6212054004fe 62110548f5fd 62d16548fedf",
        sequences=4,
        imuls=1,
        cycles=6,
    ),
    "AVX2": Kernel(  # vpmaddubsw %ymm14,%ymm15,%ymmB; vpmaddwd %ymm13,%ymmB,%ymmB; vpaddd %ymmB,%ymmA,%ymmA
        "c4c20504f6 c4c14df5f5 c5fdfec6 c4c20504fe c4c145f5fd c5f5fecf c4420504c6 c4413df5c5 c4c16dfed0 "
        "c4420504ce c44135f5cd c4c165fed9 c4420504d6 c4412df5d5 c4c15dfee2 c4420504de c44125f5dd c4c155feeb",
        sequences=6,
        imuls=1,
        cycles=6,
    ),
}


@dataclass(frozen=True)
class Issued:
    """Measured rates, as means over the cores.

    `rate`: sequences (see `InstructionSet`) that one core issues in a cycle. `clock_ghz`: clock. `clock_low_ghz`,
    `clock_high_ghz`: 95 % interval of the clock.
    """

    rate: float
    clock_ghz: float
    clock_low_ghz: float
    clock_high_ghz: float


def rate_loop(kernel: Kernel) -> bytes:
    """Return the machine code of a function that runs the body of `kernel` in a loop.

    The arguments of the function are the number of turns (%rdi) and the tile configuration (%rsi).
    """
    return _loop(kernel, bytes.fromhex(kernel.body))


def clock_loop(kernel: Kernel) -> bytes:
    """Return the machine code of the same function as `rate_loop`, but with `imul` after each instruction."""
    return _loop(kernel, b"".join(bytes.fromhex(each) + IMUL * kernel.imuls for each in kernel.body.split()))


def _loop(kernel: Kernel, body: bytes) -> bytes:
    back = -(len(body) + len(DEC) + len(JNZ) + 4)
    turn = body + DEC + JNZ + back.to_bytes(4, "little", signed=True)
    return bytes.fromhex(kernel.before) + turn + bytes.fromhex(kernel.after) + RET


def measure_issued(name: str, cores: Sequence[int]) -> Issued:
    """Measure the clock of all `cores`, and how many sequences they issue in a cycle, while all of them work.

    A sequence is a few instructions (see `InstructionSet`).
    `name`: name in `KERNELS` of an instruction set that this processor has. `cores`: numbers of the cores.
    Raises OSError for an architecture other than x86-64, and if Linux refuses executable memory or the tiles of AMX.
    """
    if machine.here.architecture() != "x86_64":
        raise OSError("there are no loops for this architecture")
    kernel = KERNELS[name]
    if kernel.before:  # the tile registers of AMX
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.syscall(SYS_ARCH_PRCTL, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA):
            raise OSError(ctypes.get_errno(), "the tiles of AMX are refused")
    together = threading.Barrier(len(cores))
    with ThreadPoolExecutor(len(cores)) as pool:
        measured = list(pool.map(lambda core: _on_core(core, kernel, together), cores))
    rates = [rate for rate, _ in measured]
    clocks = [median(clock) for _, clock in measured]
    ends = [median_interval(clock) for _, clock in measured]
    return Issued(fmean(rates), fmean(clocks), fmean(low for low, _ in ends), fmean(high for _, high in ends))


def _on_core(core: int, kernel: Kernel, together: threading.Barrier) -> tuple[float, list[float]]:
    """Return (sequences that a core issues in a cycle, clock of the core in each burst in GHz).

    The call binds the calling thread to the core. Therefore the thread must end afterwards.
    """
    together.wait()  # before anything that may fail, so that no other thread waits for ever
    os.sched_setaffinity(0, {core})
    turns = BURST_CYCLES // kernel.cycles
    chain = turns * len(kernel.body.split()) * kernel.imuls * IMUL_CYCLES
    with _Code(rate_loop(kernel)) as issue, _Code(clock_loop(kernel)) as tell_clock:
        rates, clocks = [], []
        for _ in range(BURSTS):
            rates.append(turns * kernel.sequences / issue.ns(turns))
            clocks.append(chain / tell_clock.ns(turns))
    return median(rates) / median(clocks), clocks


class _Code:
    """A function of machine code in executable memory. The constructor raises OSError if Linux refuses such memory."""

    def __init__(self, code: bytes) -> None:
        self._memory = mmap.mmap(-1, len(code), prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
        self._memory.write(code)
        self._first = ctypes.c_char.from_buffer(self._memory)
        self._call = ctypes.CFUNCTYPE(None, ctypes.c_uint64, ctypes.c_char_p)(ctypes.addressof(self._first))

    def __enter__(self) -> _Code:
        return self

    def __exit__(self, *_: object) -> None:
        del self._call, self._first
        self._memory.close()

    def ns(self, turns: int) -> int:
        """Run `turns` turns of the loop, and return the CPU time of this thread for them, ns."""
        begin = time.thread_time_ns()
        self._call(turns, TILE_CONFIG)
        return time.thread_time_ns() - begin
