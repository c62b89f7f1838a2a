"""The numbers of the profile `host` that depend on this machine: peak rates of each unit and speeds of the runtimes.

Rule: nothing is measured here. Every number says in its `source` what it was computed from, or on which other machine
it was measured; `measured_host.py` lays over it what was measured of this one. The units have as many cores as a run's.
"""

from __future__ import annotations

from typing import Any

from trilane import machine
from trilane.hw_profiles.host import split_cores, usable_cores

#: CPU flag -> INT8 and FP32 multiply-accumulates per cycle and core. The first flag that the machine has is used.
RATES = {
    "avx512_vnni": (128, 32),
    "avx_vnni": (64, 16),
    "avx2": (32, 16),
    "asimddp": (32, 8),
    "": (8, 4),
}
FALLBACK_GHZ = 2.5
ZEN_5 = "ResNet18 of width 64 at 512x512 on four Zen 5 cores"
ZEN_3 = "ResNet18 of width 64 at 512x512 on four Zen 3 cores, docs/networks.md"
#: CPU flag -> how many times faster each runtime is than ONNX Runtime in FP32, kind of these numbers, their source.
RUNTIMES: dict[str, tuple[dict[str, float], str, str]] = {
    "avx512_vnni": ({"openvino": 3.7, "ort": 2.2}, "measured", ZEN_5),
    "avx_vnni": ({"openvino": 3.7, "ort": 2.2}, "assumed", f"like {ZEN_5}"),
    "avx2": ({"openvino": 1.97, "ort": 1.28}, "measured", ZEN_3),
    "asimddp": ({"openvino": 1.0, "ort": 1.5}, "assumed", "OpenVINO has few INT8 kernels for ARM"),
    "": ({"openvino": 1.0, "ort": 1.0}, "assumed", "nothing is known of such a CPU"),
}


def host_tables() -> dict[str, Any]:
    """Tables that are laid over those of `host.toml`: title, peak rates of the units, speeds of the runtimes."""
    cores = len(usable_cores())
    ghz = machine.here.clock_ghz()
    known_ghz = ghz if ghz > 0 else FALLBACK_GHZ
    flags = machine.here.cpu_flags()
    flag = next(name for name in RATES if name in flags or not name)
    clock = f"{known_ghz:.1f} GHz" + ("" if ghz > 0 else " (not told, assumed)")
    split = split_cores(usable_cores())
    core = {unit: f"core {own[0]}" for unit, own in split.items()}
    return {
        "title": f"this machine: {cores} cores, {clock}, {flag or 'no vector products'}",
        "units": {
            "cpu": {**_unit(1, known_ghz, flag, clock), "core": core["cpu"]},
            "gpu": {**_unit(1, known_ghz, flag, clock), "core": core["gpu"]},
            "dsp": {
                **_unit(network_threads(), known_ghz, flag, clock),
                "core": core["dsp"],
                "threads": network_threads(),
                "runtimes": _runtimes(flag),
            },
        },
    }


def network_threads() -> int:
    """The cores whose rates the DSP unit of this profile has."""
    return max(1, len(usable_cores()) - 2)


def _runtimes(flag: str) -> dict[str, Any]:
    speeds, kind, source = RUNTIMES[flag]
    return {name: {"value": speed, "kind": kind, "source": source} for name, speed in speeds.items()}


def _unit(cores: int, ghz: float, flag: str, clock: str) -> dict[str, Any]:
    int8, fp32 = RATES[flag]
    source = f"{cores} cores x {clock} x {{}} products a cycle ({flag or 'scalar'})"

    def peak(per_cycle: int) -> dict[str, Any]:
        value = cores * ghz * per_cycle / 1e3
        return {"value": value, "kind": "assumed", "spread": 0.3, "source": source.format(per_cycle)}

    return {"peak_int8_tmac_s": peak(int8), "peak_fp16_tmac_s": peak(fp32), "peak_fp32_tmac_s": peak(fp32)}
