"""The steps of the fit: which numbers of a profile are free, and which measured columns they are fitted to.

Rule: data only. Each step starts from the numbers that the steps before it have fitted.
"""

from __future__ import annotations

from typing import NamedTuple

from trilane.units import UnitName

#: Keys of a profile that are multiplied by one factor.
Keys = tuple[str, ...]


class Step(NamedTuple):
    """One step of the fit.

    `columns`: measured ones that it fits. `free`: groups of keys that are multiplied by one factor each. `noise`:
    relative error of a measurement.
    """

    name: str
    columns: tuple[str, ...]
    free: tuple[Keys, ...]
    noise: float


def _efficiency(unit: str, *names: str) -> Keys:
    return tuple(f"units.{unit}.efficiency.{name}" for name in names)


def _engine(name: str) -> Keys:
    return (f"units.dsp.engines.int8_tflite.{name}",)


STEPS = (
    Step(
        "network on the DSP",
        ("bench_dsp_ms",),
        (
            _engine("rates.arithmetic_tmac_s"),
            _engine("rates.spill_gb_s"),
            _engine("factors.normalisation"),
            ("units.dsp.input_ns_per_element",),
            ("units.dsp.permute_fixed_ms",),
            ("units.dsp.fallback_ns_per_element",),
        ),
        0.04,
    ),
    Step(
        "network on the GPU",
        ("bench_gpu_ms",),
        (
            _efficiency("gpu", "convolution", "pointwise"),
            _efficiency("gpu", "depthwise_traffic", "pointwise_traffic"),
            _efficiency("gpu", "normalisation"),
            _efficiency("gpu", "permute"),
            ("units.gpu.input_ns_per_element",),
            ("units.gpu.permute_fixed_ms",),
        ),
        0.12,
    ),
    Step(
        "application",
        ("app_dsp_ms", "app_gpu_ms"),
        (
            ("application.readback_ns_per_byte",),
            ("application.handover_ms",),
            ("memory.application_use_fraction",),
        ),
        0.1,
    ),
)
#: Measured column -> the unit that runs the network.
UNIT_OF_COLUMN: dict[str, UnitName] = {
    "bench_dsp_ms": "dsp",
    "bench_gpu_ms": "gpu",
    "app_dsp_ms": "dsp",
    "app_gpu_ms": "gpu",
}
