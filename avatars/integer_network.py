"""The integer network that an avatar's file holds and a runtime loads.

Rule: a static graph with bytes at both ends; its layers run in integers, except those that it names itself.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field

import onnx
from onnx import TensorProto

from trilane.errors import BadInputError

#: Metadata key of the file: a JSON list of the names of layers that were left in float on purpose.
FLOAT_LAYERS_KEY = "trilane.float_layers"
MAX_SIDE = 4096
MAX_BATCH = 64
MAX_CHANNELS = 64
#: Operators that take most of the time and must run in integers.
LAYERS = ("Conv", "ConvTranspose", "Gemm")


@dataclass(frozen=True)
class Affine:
    """How a tensor's bytes stand for real numbers: `real = (q - zero_point) * scale`, q in 0..255."""

    scale: float
    zero_point: int


@dataclass(frozen=True)
class IntegerNetwork:
    """What a runtime loads: `model`, a static integer graph with bytes at its ends, and `where` it was read from."""

    where: str
    model: onnx.ModelProto = field(repr=False)

    @property
    def float_layers(self) -> frozenset[str]:
        """Names of the layers that may run in float: those the network's metadata lists.

        Raises BadInputError when the metadata is not a JSON list.
        """
        texts = [prop.value for prop in self.model.metadata_props if prop.key == FLOAT_LAYERS_KEY]
        try:
            return frozenset(str(name) for text in texts for name in json.loads(text))
        except (ValueError, TypeError, RecursionError) as error:
            raise BadInputError(self.where, f"{FLOAT_LAYERS_KEY} {texts}", "a JSON list of names") from error

    @property
    def digest(self) -> str:
        """SHA-256 of the network, hexadecimal."""
        return hashlib.sha256(self.model.SerializeToString(deterministic=True)).hexdigest()


@dataclass(frozen=True)
class NetworkFile(IntegerNetwork):
    """A checked network. `shape` (N, H, W, C): of its uint8 input; its output is (N, H, W, 4) uint8.

    `input`, `output`: scale and zero point of the bytes.
    """

    shape: tuple[int, int, int, int]
    input: Affine
    output: Affine

    @property
    def channels(self) -> int:
        return self.shape[3]


def node_name(node: onnx.NodeProto) -> str:
    """The node's name; without one, its operator and the tensor it outputs."""
    return node.name or f"{node.op_type} that makes {next(iter(node.output), 'nothing')}"


def constants_of(model: onnx.ModelProto) -> Mapping[str, TensorProto]:
    """Constant tensors of the graph by name: initializers and the outputs of Constant nodes."""
    constants = {tensor.name: tensor for tensor in model.graph.initializer}
    for node in model.graph.node:
        if node.op_type == "Constant":
            constants.update((node.output[0], a.t) for a in node.attribute if a.name == "value")
    return constants


def check_integer_layers(network: IntegerNetwork) -> None:
    """Raises BadInputError naming the layers whose inputs are not dequantised integers; `float_layers` are allowed."""
    makers = {out: node for node in network.model.graph.node for out in node.output}
    float_layers = []
    for node in network.model.graph.node:
        if node.op_type in LAYERS and node_name(node) not in network.float_layers:
            sources = [_beyond_transposes(makers, name) for name in node.input[:2]]
            if any(source is None or source.op_type != "DequantizeLinear" for source in sources):
                float_layers.append(node_name(node))
    if float_layers:
        raise BadInputError(
            network.where, f"layers left in float: {', '.join(float_layers)}", "integer layers", "quantise them"
        )


def _beyond_transposes(makers: Mapping[str, onnx.NodeProto], name: str) -> onnx.NodeProto | None:
    node = makers.get(name)
    while node is not None and node.op_type == "Transpose":
        node = makers.get(node.input[0])
    return node
