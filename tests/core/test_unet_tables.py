"""The encoders' tables against what is published of the networks: parameters, multiply-accumulates, activations."""

from __future__ import annotations

from collections import Counter

import pytest

from trilane.hw_profiles.reference_networks import GraphBuilder, encode
from trilane.unet_tables import (
    MOBILE_ENCODERS,
    MobileEncoder,
    squeeze_channels,
)

SIDE = 224  # pixels, for which the work is published


def conv(kernel: int, c_in: int, c_out: int, side: int, groups: int = 1) -> tuple[int, int]:
    """Parameters of a convolution with its batch norm, and multiply-accumulates on `side` x `side` pixels."""
    weights = kernel * kernel * c_in // groups * c_out
    return weights + 2 * c_out, weights * side * side


def work_of(encoder: MobileEncoder, last: int) -> tuple[int, int]:
    """Parameters and multiply-accumulates up to a last 1x1 convolution of `last` channels, by the papers' blocks."""
    side, channels = SIDE // 2, encoder.stem
    parts = [conv(3, 3, channels, side)]
    for row in encoder.rows:
        if row.expanded != channels:
            parts.append(conv(1, channels, row.expanded, side))
        side //= row.stride
        parts.append(conv(row.kernel, row.expanded, row.expanded, side, row.expanded))
        if row.squeeze:
            inner = squeeze_channels(row.expanded)
            parts.append((2 * row.expanded * inner + row.expanded + inner, 2 * row.expanded * inner))
        parts.append(conv(1, row.expanded, row.channels, side))
        channels = row.channels
    parts.append(conv(1, channels, last, side))
    assert side == SIDE // 32
    return sum(part[0] for part in parts), sum(part[1] for part in parts)


#: Of the published network: channels of its last layer, its parameters and those of its classifier, and million
#: multiply-accumulates (of the whole network: the papers' Table 4, Table 3, and the table of EfficientNet-Lite).
PUBLISHED = {
    "mobilenetv2": (1280, 3_504_872, 1_281_000, 300),
    "mobilenetv3": (960, 5_483_032, 960 * 1280 + 1280 + 1_281_000, 219),
    "efficientnet-lite0": (1280, 4_652_008, 1_281_000, 407),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_parameters_and_work_are_the_published_ones(name: str) -> None:
    last, parameters, classifier, mega_macs = PUBLISHED[name]
    own, macs = work_of(MOBILE_ENCODERS[name], last)
    assert own == parameters - classifier
    assert (macs + classifier) / 1e6 == pytest.approx(mega_macs, rel=0.06)


def test_activations_and_squeezes_are_the_published_ones() -> None:
    """MobileNetV3 large: ReLU in the first six blocks; squeeze-and-excitation in blocks 4 to 6 and 11 to 15."""
    third = MOBILE_ENCODERS["mobilenetv3"]
    assert [row.activation for row in third.rows] == ["relu"] * 6 + ["hardswish"] * 9
    assert [number for number, row in enumerate(third.rows, 1) if row.squeeze] == [4, 5, 6, 11, 12, 13, 14, 15]
    assert (third.activation, third.stem, third.last) == ("hardswish", 16, 960)
    for name, last in (("mobilenetv2", 1280), ("efficientnet-lite0", 512)):
        encoder = MOBILE_ENCODERS[name]
        assert {encoder.activation, *(row.activation for row in encoder.rows)} == {"relu6"}
        assert (encoder.stem, encoder.last, any(row.squeeze for row in encoder.rows)) == (32, last, False)


def test_strides_of_the_blocks() -> None:
    strides = {
        "mobilenetv2": [2, 4, 7, 14],
        "mobilenetv3": [2, 4, 7, 13],
        "efficientnet-lite0": [2, 4, 6, 12],
    }
    for name, places in strides.items():
        rows = MOBILE_ENCODERS[name].rows
        assert [number for number, row in enumerate(rows, 1) if row.stride == 2] == places
        assert {row.stride for row in rows} == {1, 2}


def test_squeezed_channels_are_multiples_of_8_near_a_quarter() -> None:
    """72 / 4 = 18 is nearest to 16, which is less than 90 % of it; 120 / 4 = 30 to 32; 16 / 4 = 4 is raised to 8."""
    assert [squeeze_channels(count) for count in (16, 72, 120, 480, 672, 960)] == [8, 24, 32, 120, 168, 240]


@pytest.mark.parametrize(
    ("name", "kinds"),
    [
        # 17 blocks of three convolutions, the first of two; each but the last of a block has its activation
        ("mobilenetv2", {"Conv": 1 + 2 + 16 * 3 + 1, "Clip": 1 + 1 + 16 * 2 + 1, "Add": 10}),
        ("efficientnet-lite0", {"Conv": 1 + 2 + 15 * 3 + 1, "Clip": 1 + 1 + 15 * 2 + 1, "Add": 9}),
        # the paper's Table 1: six blocks with ReLU, nine with hard swish; eight squeeze, each with a ReLU
        (
            "mobilenetv3",
            {
                "Conv": 1 + 2 + 14 * 3 + 8 * 2 + 1,
                "Relu": 1 + 5 * 2 + 8,
                "HardSwish": 1 + 9 * 2 + 1,
                "Add": 10,
                **dict.fromkeys(("GlobalAveragePool", "HardSigmoid", "Mul"), 8),
            },
        ),
        # the stem, eight blocks of two and a shortcut where a stage changes the channels
        ("resnet18", {"Conv": 1 + 8 * 2 + 3, "Relu": 1 + 8 * 2, "MaxPool": 1, "Add": 8}),
    ],
)
def test_an_encoders_operators_are_those_of_its_paper(name: str, kinds: dict[str, int]) -> None:
    """And each is named by its result, so that it can be told from the others."""
    builder = GraphBuilder("batch")
    features = encode(builder, builder.input("x", 3, 64, 64), name)
    assert Counter(node.op_type for node in builder.nodes) == kinds
    assert [node.name for node in builder.nodes] == [node.output[0] for node in builder.nodes]
    assert len({node.name for node in builder.nodes}) == len(builder.nodes)
    assert [(each.height, each.width) for each in features] == [(64 >> k, 64 >> k) for k in range(1, 6)]
