"""What is believed of tensor engines before any latency is looked at: the priors of `fit_engines.py`.

Rule: data only. Each value stands with its relative spread (standard deviation of its logarithm); 1 is "within a factor
of 2.7 or so". A latency that says otherwise outweighs it.
"""

from __future__ import annotations

from typing import NamedTuple

from trilane.hw_profiles.schema import EngineName


class Prior(NamedTuple):
    """A number and its relative spread."""

    value: float
    spread: float


#: Terms whose factor is 1 by definition: those that the six rates are counted in.
UNITS_OF_RATES = ("convolution", "moved", "spill", "weights", "operator", "job")
#: How much dearer a term is than a plain convolution's, in INT8. Depthwise products are the vector unit's; strides
#: break the blocks in which activations lie; bilinear interpolation reads four elements; bytes cannot be divided.
FACTORS: dict[str, Prior] = {
    "grouped": Prior(1, 0.7),
    "first": Prior(1, 0.7),
    "depthwise": Prior(10, 1),
    "stride": Prior(1, 0.7),
    "depthwise_stride": Prior(100, 1),
    "dilation": Prior(1, 0.7),
    "moved_depthwise": Prior(1, 0.7),
    "pool": Prior(1, 0.7),
    "reduction": Prior(1, 0.7),
    "bilinear": Prior(5, 1),
    "nearest": Prior(1, 0.7),
    "concat": Prior(0.3, 1),
    "constant": Prior(1, 0.3),
    "divide": Prior(40, 1),
    "elementwise": Prior(1, 0.7),
    "batch_norm": Prior(10, 0.7),
    "normalisation": Prior(10, 1),
    "shuffle": Prior(10, 1),
    "depth_to_space": Prior(1, 0.7),
    "activation": Prior(1, 0.7),
    "leaky": Prior(1, 0.7),
    "swish": Prior(2, 0.7),
    "clip": Prior(1, 0.7),
    "pad": Prior(0.5, 1),
    "other": Prior(2, 1),
    "input": Prior(2, 1),
    "output": Prior(10, 1),
}
#: In FP16 a lone batch normalisation is one multiplication and addition, not several passes with new scales.
FP16_FACTORS = {**FACTORS, "batch_norm": Prior(2, 0.7)}
#: The six rates of the 8 Gen 2 in INT8: half of the 26 to 35 TOPS that are claimed; a vector unit's 200 GB/s; half and
#: two thirds of 67 GB/s of memory; and what a call over FastRPC costs.
RATES: dict[str, float] = {
    "arithmetic_tmac_s": 17,
    "activation_gb_s": 200,
    "spill_gb_s": 30,
    "weight_gb_s": 40,
    "operator_us": 1,
    "job_us": 80,
}
#: In FP16 a quarter of the products; bytes are counted as bytes, and fixed costs are a little larger.
FP16_OVER_INT8 = {"arithmetic_tmac_s": 0.25, "operator_us": 1.5, "job_us": 1.5}
RATE_SPREAD = 0.5
#: How many times slower than the 8 Gen 2 a chip is thought to be, by claimed TOPS and memory.
SLOWER = {"qcs6490": 4, "sa8295p": 1.8, "8gen1": 1.7, "8gen2": 1, "8gen3": 0.75, "8elite": 0.6, "xelite": 1}
#: Activations that the engine holds, in MB: the VTCM of its generation.
ON_CHIP_MB = {"v66": 4, "v68": 4, "v69": 4, "v73": 8, "v75": 8, "v79": 8, "v81": 8}
#: A chip of which only a few anchors are known is the one before it, so many times faster in everything but for this
#: spread: the step from one generation to the next among the others.
STEP = Prior(1.25, 0.15)


def rate_prior(engine: EngineName, chip: str, key: str) -> Prior:
    """The prior of the rate `key` of `chip`. Costs grow where rates fall."""
    value = RATES[key] * (FP16_OVER_INT8.get(key, 1) if engine.startswith("fp16") else 1)
    slower = SLOWER.get(chip, 1)
    return Prior(value * slower if key in ("operator_us", "job_us") else value / slower, RATE_SPREAD)


def factor_prior(engine: EngineName, term: str) -> Prior:
    """The prior of a term's factor."""
    if term in UNITS_OF_RATES:
        return Prior(1, 1e-6)
    return (FP16_FACTORS if engine.startswith("fp16") else FACTORS)[term]
