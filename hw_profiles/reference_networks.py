"""The U-Nets of the reference application: their ONNX graphs and the work that they ask of a unit.

Rule: the decoder, the heads and the channel counts are the same for all; only the encoder (`reference_encoders.py`),
the normalisation, the size and the input's layout differ. Batch normalisation is folded and leaves no operator.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import prod
from typing import Any

import onnx

from trilane.errors import BadInputError
from trilane.hw_profiles.graph_builder import GraphBuilder, TensorRef
from trilane.hw_profiles.network_work import Network, Work, count_work
from trilane.hw_profiles.reference_encoders import encode
from trilane.unet_tables import DECODER, ENCODERS, HEADS, NORMS

LAYOUTS = ("packed", "split")
CHANNELS_PER_PASS = 4
MAX_SIDE = 4096


@dataclass(frozen=True)
class NetworkSpec:
    """One reference network.

    `encoder`: of ENCODERS; `norm`: of NORMS; `layout`: of LAYOUTS. `height`, `width`: in pixels, multiples of 32 up to
    MAX_SIDE. `channels`: of the rasterised texture, 1 to 16. Raises BadInputError for any other value.
    """

    encoder: str
    norm: str
    height: int
    width: int
    channels: int
    layout: str = "packed"

    def __post_init__(self) -> None:
        _require_one_of("encoder", self.encoder, ENCODERS)
        _require_one_of("norm", self.norm, NORMS)
        _require_one_of("layout", self.layout, LAYOUTS)
        for name, side in (("height", self.height), ("width", self.width)):
            if side % 32 or not 32 <= side <= MAX_SIDE:
                raise BadInputError("size", f"{name} {side}", f"a multiple of 32 from 32 to {MAX_SIDE}")
        if not 1 <= self.channels <= 16:
            raise BadInputError("channels", str(self.channels), "1 to 16")

    @property
    def pixels(self) -> int:
        return self.height * self.width


def _require_one_of(key: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise BadInputError(key, repr(value), "one of " + ", ".join(known))


def _network_input(b: GraphBuilder, spec: NetworkSpec) -> TensorRef:
    """The input as the raster stage makes it.

    `packed`: one tensor. `split`: one tensor per raster pass, joined and permuted before the first convolution.
    """
    shape = (spec.height, spec.width)
    if spec.layout == "packed":
        return b.input("input", spec.channels, *shape)
    counts = [min(CHANNELS_PER_PASS, spec.channels - c) for c in range(0, spec.channels, CHANNELS_PER_PASS)]
    passes = [b.input(f"pass{i}", count, *shape) for i, count in enumerate(counts)]
    joined = b.op("Concat", [p.name for p in passes], (spec.channels, *shape), axis=1)
    return b.same("Transpose", joined, perm=[0, 1, 2, 3])


def _decoder(b: GraphBuilder, features: list[TensorRef]) -> TensorRef:
    """Features at full size: those of the encoder from the smallest up, each joined with those of its own size."""
    x, skips = features[-1], [*reversed(features[:-1]), None]
    for width, skip in zip(DECODER, skips, strict=True):
        x = b.upsampled(x)
        if skip is not None:
            x = b.op("Concat", [x.name, skip.name], (x.channels + skip.channels, x.height, x.width), axis=1)
        x = b.unit(b.unit(x, width, 3), width, 3)
    return x


def build_network(spec: NetworkSpec) -> Any:
    """The network as an `onnx.ModelProto` (opset 21, NCHW, batch 1) whose weights are inputs named `w<n>`."""
    b = GraphBuilder(spec.norm)
    x = _network_input(b, spec)
    body = _decoder(b, encode(b, x, spec.encoder))
    heads = [b.conv(b.unit(body, DECODER[-1], 3), width, 3, bias=True) for width in HEADS]
    joined = b.op("Concat", [head.name for head in heads], (sum(HEADS), *body[2:]), axis=1)
    return b.model(f"unet-{spec.encoder}-{spec.norm}", [b.same("Sigmoid", joined)])


def parameters(model: Any) -> int:
    """Number of weights and biases of a model made by `build_network`."""
    shapes = [_shape(info) for info in model.graph.input if info.name.startswith("w")]
    return sum(prod(shape) for shape in shapes)


def _shape(info: onnx.ValueInfoProto) -> list[int]:
    return [d.dim_value for d in info.type.tensor_type.shape.dim]


def reference_network(spec: NetworkSpec) -> Network:
    """The network of `spec` with its work and the facts that reports name it by."""
    facts = {"encoder": spec.encoder, "norm": spec.norm}
    return Network(facts, spec.height, spec.width, spec.channels, spec.layout, network_work(spec))


@lru_cache(maxsize=4096)
def network_work(spec: NetworkSpec) -> Work:
    """The work of the network of `spec`."""
    return count_work(build_network(spec))
