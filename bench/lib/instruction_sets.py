"""The INT8 peak of a core by its instruction set: multiply-accumulates of an instruction, by instructions a cycle.

Rule: how many multiply-accumulates an instruction does is its definition; how many of them a cycle takes is documented,
and where cores with one set differ, what was measured says which of the documented rates this core has.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction


@dataclass(frozen=True)
class InstructionSet:
    """One row.

    `flags`: of /proc/cpuinfo, all of which a core with it has.
    `macs`: INT8 multiply-accumulates of one `sequence`, an instruction or the few that stand for one.
    `rates`: sequences a cycle that cores with it are documented to reach.
    `source`: of both.
    """

    name: str
    flags: tuple[str, ...]
    sequence: str
    macs: int
    rates: tuple[Fraction, ...]
    source: str

    def rate_nearest(self, measured: float) -> Fraction:
        """Which of the documented rates a core has on which `measured` sequences a cycle were issued."""
        return min(self.rates, key=lambda rate: abs(float(rate) - measured))

    def macs_a_cycle(self, measured: float) -> float:
        """Of a core on which `measured` sequences a cycle were issued."""
        return float(self.macs * self.rate_nearest(measured))


ONE, TWO, FOUR = Fraction(1), Fraction(2), Fraction(4)
#: From the widest to the narrowest: the first whose flags a core has is its own.
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
    """The widest that a core with these `flags` has, or None for one that is not in the table."""
    found = {*flags}
    return next((each for each in INSTRUCTION_SETS if found.issuperset(each.flags)), None)


def peak_gmac_s(macs_a_cycle: float, clock_ghz: float, cores: int) -> float:
    """1e9 multiply-accumulates a second: those of a cycle, by the cycles of all cores."""
    return macs_a_cycle * clock_ghz * cores
