"""The INT8 peak of an instruction set, worked out by hand; the loops that tell the clock, byte for byte."""

from __future__ import annotations

import threading
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from trilane import machine
from trilane.bench import peers, roofline
from trilane.bench.roofline import (
    INSTRUCTION_SETS,
    KERNELS,
    Issued,
    Kernel,
    clock_loop,
    instruction_set_of,
    measure_issued,
    rate_loop,
)

#: Multiply-accumulates a cycle of one core: bytes of a register, by registers a cycle (a third of the instructions of
#: three do the products; where AVX512-BW has one multiplier, two cycles for the two multiplications). AMX: Intel's 2048
#: operations a cycle are 1024 products and 1024 sums.
BY_HAND = {
    "AMX-INT8": (2048 / 2,),
    "AVX512-VNNI": (512 / 8, 2 * 512 / 8),
    "AVX-VNNI": (256 / 8, 2 * 256 / 8),
    "AVX512-BW": (1 * 64 / 2, 2 * 64 / 3),
    "AVX2": (32 / 2, 32),
    "NEON dot": (128 / 8, 2 * 128 / 8, 4 * 128 / 8),
}


def test_the_table_has_the_multiply_accumulates_worked_out_by_hand() -> None:
    assert {each.name for each in INSTRUCTION_SETS} == BY_HAND.keys()
    for each in INSTRUCTION_SETS:
        assert [float(each.macs * rate) for rate in each.rates] == pytest.approx(BY_HAND[each.name])
    assert all(each.source and each.flags for each in INSTRUCTION_SETS)


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        (["avx2", "avx512f", "avx512bw", "avx512_vnni", "avx_vnni", "amx_tile", "amx_int8"], "AMX-INT8"),
        (["avx2", "avx512f", "avx512bw", "avx512_vnni", "amx_int8"], "AVX512-VNNI"),  # a kernel that hides the tiles
        (["avx2", "avx_vnni"], "AVX-VNNI"),
        (["avx2", "avx512f", "avx512bw", "avx_vnni"], "AVX-VNNI"),
        (["avx2", "avx512f", "avx512bw", "asimddp"], "AVX512-BW"),
        (["avx2", "avx512f", "avx512bw"], "AVX512-BW"),
        (["fma", "avx2"], "AVX2"),
        (["asimd", "asimddp"], "NEON dot"),
    ],
)
def test_the_widest_set_of_a_core_is_its_own(flags: list[str], name: str) -> None:
    found = instruction_set_of(flags)
    assert found is not None and found.name == name


def test_a_core_of_no_known_set_has_no_peak() -> None:
    assert instruction_set_of(["sse2"]) is None
    assert list(roofline.instruction_peak(["sse2"], 1)) == ["absent"]


def test_one_512_bit_unit_is_told_from_two() -> None:
    vnni = instruction_set_of(["avx512f", "avx512_vnni"])
    assert vnni is not None
    assert (vnni.macs_a_cycle(0.97), vnni.macs_a_cycle(1.9)) == (64, 128)


def test_what_cannot_be_measured_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine.here, "architecture", lambda: "aarch64")
    assert "no loops for this architecture" in roofline.instruction_peak(["asimddp"], 1)["absent"]


def test_the_loops_are_the_bytes_of_the_assembler() -> None:
    """`1: vpdpbusd ...; [imul %rax,%rax;] dec %rdi; jnz 1b; vzeroupper; ret`, as GNU as writes it with a far jump."""
    kernel = Kernel("c4c20550c6 c4c20550ce", sequences=2, imuls=1, cycles=1)
    assert rate_loop(kernel).hex(" ", 1) == (
        "c4 c2 05 50 c6 c4 c2 05 50 ce 48 ff cf 0f 85 ed ff ff ff c5 f8 77 c3"  # 19 bytes back
    )
    assert clock_loop(kernel).hex(" ", 1) == (
        "c4 c2 05 50 c6 48 0f af c0 c4 c2 05 50 ce 48 0f af c0 48 ff cf 0f 85 e5 ff ff ff c5 f8 77 c3"  # 27
    )


@pytest.mark.parametrize("name", KERNELS)
def test_in_the_loop_that_tells_the_clock_the_chain_is_the_longer_path(name: str) -> None:
    """Each instruction takes less than the three cycles of an `imul`, at the slowest documented rate."""
    kernel = KERNELS[name]
    (row,) = [each for each in INSTRUCTION_SETS if each.name == name]
    instructions = len(kernel.body.split())
    slowest = kernel.sequences / float(min(row.rates))
    assert instructions % kernel.sequences == 0
    assert slowest < instructions * kernel.imuls * 3


def test_a_share_of_an_unknown_peak_is_none() -> None:
    """The shares themselves: test_inference_bench.py."""
    times = {peers.ORT: [[20.0]], peers.FP32: [[40.0]], peers.APP: [[10.0]], peers.OPENVINO: [[10.0]]}
    unknown = peers.compared(times, 1.0, 200.0, None)
    assert unknown["ratios"]["openvino_of_instruction_peak"] is None
    assert set(peers.PEAKS) < set(unknown["ratios"])


def test_what_cores_do_is_the_median_of_bursts_and_the_mean_of_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """On core 2 the clock's loop takes 0.5 ns for each of its cycles (2 GHz), on core 5 0.25 ns; twelve instructions a
    turn, each three cycles, and 12 a turn in 6 or 12 cycles."""
    core, kernel = threading.local(), KERNELS["AVX-VNNI"]

    class Code:
        def __init__(self, text: bytes) -> None:
            self._is_clock = {rate_loop(kernel): False, clock_loop(kernel): True}[text]

        def __enter__(self) -> Code:
            return self

        def __exit__(self, *_: object) -> None:
            """Nothing to end."""

        def ns(self, turns: int) -> float:
            cycles, cycle_ns = (6, 0.5) if core.number == 2 else (12, 0.25)
            return turns * (36 if self._is_clock else cycles) * cycle_ns

    monkeypatch.setattr(roofline, "_Code", Code)
    monkeypatch.setattr(roofline.os, "sched_setaffinity", lambda _, cores: setattr(core, "number", *cores))
    monkeypatch.setattr(machine.here, "architecture", lambda: "x86_64")
    assert measure_issued("AVX-VNNI", [2, 5]) == Issued(*(pytest.approx(value) for value in (1.5, 3.0, 3.0, 3.0)))


@pytest.mark.timeout(20)
def test_a_core_that_cannot_be_bound_stops_no_other_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    def bind(_: int, cores: set[int]) -> None:
        if cores == {5}:
            raise OSError(22, "no such core")

    monkeypatch.setattr(roofline, "_Code", lambda _: nullcontext(SimpleNamespace(ns=lambda _: 1.0)))
    monkeypatch.setattr(roofline.os, "sched_setaffinity", bind)
    monkeypatch.setattr(machine.here, "architecture", lambda: "x86_64")
    with pytest.raises(OSError, match="no such core"):
        measure_issued("AVX-VNNI", [2, 5])


@pytest.mark.parametrize(("refused", "words"), [(0, ""), (1, "the tiles of AMX are refused")])
def test_tiles_are_asked_for_where_a_set_has_them(monkeypatch: pytest.MonkeyPatch, refused: int, words: str) -> None:
    calls: list[Any] = []
    libc = SimpleNamespace(syscall=lambda *what: calls.append(what) or refused)
    monkeypatch.setattr(
        roofline.ctypes, "CDLL", lambda name, use_errno: libc if (name, use_errno) == (None, True) else None
    )
    monkeypatch.setattr(roofline, "_on_core", lambda *_: (1.0, [2.0, 4.0, 3.0]))
    monkeypatch.setattr(machine.here, "architecture", lambda: "x86_64")
    if refused:
        with pytest.raises(OSError, match=words):
            measure_issued("AMX-INT8", [0])
    else:
        assert measure_issued("AMX-INT8", [0]) == Issued(1.0, 3.0, 2.0, 4.0)
    assert calls == [(158, 0x1023, 18)]
    measure_issued("AVX2", [0])
    assert len(calls) == 1


@pytest.mark.skipif(machine.here.architecture() != "x86_64", reason="the loops are machine code of x86")
def test_a_loop_runs_as_often_as_it_is_told() -> None:
    """Machine code by hand: `imul` alone is on every x86-64 core. Three cycles of at most 10 GHz each."""
    kernel = roofline.Kernel("480fafc0", sequences=1, imuls=1, cycles=3, after="")
    with roofline._Code(roofline.clock_loop(kernel)) as code:
        assert code.ns(200_000) > 200_000 * 2 * 3 / 10
    assert code._memory.closed
