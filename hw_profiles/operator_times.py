"""How long a unit takes for each operator of a network and for the whole job: a roofline, and fixed costs around it.

Rule: a pure function of a network's counts and of the numbers of a `Unit`; no measured time is looked up anywhere.

time = job + operators * dispatch + input elements * conversion + weights / bandwidth
       + sum over operators of max(arithmetic, traffic) + operators that fall back to the CPU

Sources: the roofline is that of Williams, Waterman and Patterson (2009). The units share the memory: the bandwidth of
one is what the others leave over, as in Gables (Hill and Reddi, 2019). Matrix engines work on whole blocks of
channels, so channel counts are rounded up to the unit's block before they are multiplied.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.hw_profiles.network_work import Work
from trilane.hw_profiles.operator_kinds import ARITHMETIC, CLASSES, TRAFFIC
from trilane.hw_profiles.schema import Memory, Unit

TRAFFIC_KEYS = tuple(f"{kind}_traffic" for kind in ARITHMETIC) + TRAFFIC


@dataclass(frozen=True)
class Machine:
    """A unit as plain numbers. Rates are per second, times in seconds.

    `arithmetic`: multiply-accumulates per second of each of CLASSES, infinite for those without products. `traffic`:
    bytes per second of each of CLASSES. `stream`: bytes of weights per second. `element_bytes`: of one element.
    `block`: channel counts are rounded up to a multiple of it. `job`: fixed time of a job; `operator`: of an operator;
    `input`: of an element of the network's input; `permute`: of a picture in several tensors. `fallback`: types of the
    ONNX operators that run on the CPU; `fallback_job`: fixed time of each; `fallback_element`: of an element of its
    result.
    """

    arithmetic: NDArray[np.float64]
    traffic: NDArray[np.float64]
    stream: float
    element_bytes: int
    block: float
    job: float
    operator: float
    input: float
    permute: float
    fallback: frozenset[str]
    fallback_job: float
    fallback_element: float


@dataclass(frozen=True)
class JobTime:
    """Milliseconds of one job by part: `fixed`, `input`, `weights`, `fallback` and the operator classes.

    On a tensor engine `arithmetic`, `activation` and `spill` in place of the classes, `unsure`: the relative error
    that its numbers leave, and `unlike`: how unlike the network is to `like`, the nearest one of those that they were
    fitted to, 0 to 1.
    """

    parts: Mapping[str, float]
    unsure: float | None = None
    unlike: float = 1.0
    like: str = ""

    @property
    def total_ms(self) -> float:
        return sum(self.parts.values())


def machine_of(unit: Unit, memory: Memory, clock_fraction: float = 1.0, contended: bool = False) -> Machine:
    """The numbers of a unit, all of them slower where it was measured to be.

    `unit`: from a profile.
    `memory`: of the same profile.
    `clock_fraction`: of its highest clock.
    `contended`: whether the rest of the application uses the memory at the same time.
    """
    use = memory.application_use_fraction.or_else(0.0) if contended else 0.0
    bandwidth = memory.bandwidth_gb_s.or_else(10.0) * 1e9 * (1 - use)
    efficiency = unit.efficiency
    arithmetic = [getattr(efficiency, kind).or_else(0.1) * unit.peak_mac_s * clock_fraction for kind in ARITHMETIC]
    traffic = np.array([getattr(efficiency, key).or_else(0.1) for key in TRAFFIC_KEYS]) * bandwidth / unit.slower
    return Machine(
        arithmetic=np.array(arithmetic + [np.inf] * len(TRAFFIC)) / unit.slower,
        traffic=traffic,
        stream=float(traffic[CLASSES.index("convolution")]),
        element_bytes=unit.element_bytes,
        block=unit.channel_block.or_else(1.0),
        job=unit.slower * unit.job_fixed_ms.or_else(0.0) / 1e3,
        operator=unit.slower * unit.operator_fixed_us.or_else(0.0) / 1e6,
        input=unit.slower * unit.input_ns_per_element.or_else(0.0) / 1e9,
        permute=unit.slower * unit.permute_fixed_ms.or_else(0.0) / 1e3,
        fallback=frozenset(unit.fallback),
        fallback_job=unit.slower * unit.fallback_fixed_ms.or_else(0.0) / 1e3,
        fallback_element=unit.slower * unit.fallback_ns_per_element.or_else(0.0) / 1e9,
    )


def job_time(work: Work, machine: Machine, batch: int = 1) -> JobTime:
    """Time of one job of `batch` frames. The fixed costs and the weights count once per job."""
    classes, counts = work.classes, work.table
    on_cpu = np.array([o.op_type in machine.fallback for o in work.operators], dtype=bool)
    seconds = np.where(on_cpu, 0.0, _operator_seconds(counts, classes, machine))
    parts = {
        "fixed": machine.job + machine.operator * len(classes) + machine.permute * (work.input_tensors > 1),
        "input": batch * work.input_elements * machine.input,
        "weights": work.weights * machine.element_bytes / machine.stream,
        "fallback": float(on_cpu.sum()) * machine.fallback_job
        + batch * float(counts[on_cpu, 4].sum()) * machine.fallback_element,
    }
    by_class = batch * np.bincount(classes, weights=seconds, minlength=len(CLASSES))
    parts |= dict(zip(CLASSES, by_class.tolist(), strict=True))
    return JobTime({name: 1e3 * value for name, value in parts.items()})


def _operator_seconds(counts: NDArray[np.float64], classes: NDArray[np.int64], machine: Machine) -> NDArray[np.float64]:
    """Seconds of each operator (operators,): the larger of its arithmetic and its traffic."""
    macs, moved, c_in, c_out = counts[:, 0], counts[:, 1], counts[:, 2], counts[:, 3]
    padded = macs * _padding_factor(c_in, machine.block) * _padding_factor(c_out, machine.block)
    arithmetic = np.where(classes == CLASSES.index("depthwise"), macs, padded) / machine.arithmetic[classes]
    traffic = moved * machine.element_bytes / machine.traffic[classes]
    larger: NDArray[np.float64] = np.maximum(arithmetic, traffic)
    return larger


def _padding_factor(channels: NDArray[np.float64], block: float) -> NDArray[np.float64]:
    """Channels rounded up to whole blocks, over `channels`; 1 for an operator without products."""
    known = np.maximum(channels, 1.0)
    return np.ceil(known / block) * block / known
