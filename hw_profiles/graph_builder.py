"""Builds ONNX graphs that have shapes and operators but no weights.

Rule: no tensor data is ever made here, so that a network of any size is cheap to describe; a weight is a graph input
with a shape.
"""

from __future__ import annotations

from math import gcd
from typing import Any, NamedTuple

from onnx import TensorProto, helper

from trilane.unet_tables import NORM_GROUPS


class TensorRef(NamedTuple):
    """A tensor of the graph: its name and its size without the batch axis."""

    name: str
    channels: int
    height: int
    width: int


class GraphBuilder:
    """Collects nodes and the shapes of their results.

    All tensors are NCHW with batch 1. They are declared as FLOAT; how many bytes an element takes is decided by the
    chip's profile. `norm`: normalisation after each convolution: `batch` (folded: no operator), `instance`, `group`.
    """

    def __init__(self, norm: str) -> None:
        self.norm = norm
        self.nodes: list[Any] = []
        self.inputs: list[Any] = []
        self.infos: list[Any] = []
        self.twice = helper.make_tensor("twice", TensorProto.FLOAT, (4,), (1, 1, 2, 2))

    def input(self, name: str, channels: int, height: int, width: int) -> TensorRef:
        """A new input of the graph: `name`, then its size.

        `channels`, `height`, `width`: of the tensor.
        """
        self.inputs.append(value_info(name, (1, channels, height, width)))
        return TensorRef(name, channels, height, width)

    def weight(self, shape: tuple[int, ...]) -> str:
        """Name of a new weight tensor, which is a graph input without data."""
        name = f"w{len(self.inputs)}"
        self.inputs.append(value_info(name, shape))
        return name

    def op(self, kind: str, sources: list[str], shape: tuple[int, int, int], **attributes: Any) -> TensorRef:
        """Append an operator.

        `kind`: its ONNX type.
        `sources`: names of its inputs.
        `shape`: channels, height, width of its result.
        `attributes`: as ONNX names them.
        """
        out = TensorRef(f"{kind}_{len(self.nodes)}", *shape)
        self.nodes.append(helper.make_node(kind, sources, [out.name], name=out.name, **attributes))
        self.infos.append(value_info(out.name, (1, *shape)))
        return out

    def conv(
        self, x: TensorRef, out: int, kernel: int, stride: int = 1, groups: int = 1, bias: bool = False
    ) -> TensorRef:
        """Append a convolution that keeps the size, divided by its stride.

        `x`: its input.
        `out`: number of output channels.
        `kernel`: side of the kernel.
        `stride`: of both axes.
        `groups`: of channels.
        `bias`: whether it has one.
        """
        weight = self.weight((out, x.channels // groups, kernel, kernel))
        sources = [x.name, weight] + ([self.weight((out,))] if bias else [])
        shape = (out, -(-x.height // stride), -(-x.width // stride))
        return self.op(
            "Conv",
            sources,
            shape,
            kernel_shape=[kernel] * 2,
            strides=[stride] * 2,
            pads=[kernel // 2] * 4,
            group=groups,
        )

    def same(self, kind: str, x: TensorRef, *more: str, **attributes: Any) -> TensorRef:
        """Append an operator whose result has the size of `x`.

        `kind`: its ONNX type.
        `x`: its first input.
        `more`: names of its other inputs.
        `attributes`: as ONNX names them.
        """
        return self.op(kind, [x.name, *more], x[1:], **attributes)

    def normed(self, x: TensorRef) -> TensorRef:
        """`x` normalised as `norm` says."""
        if self.norm == "batch":
            return x
        scales = [self.weight((x.channels,)), self.weight((x.channels,))]
        if self.norm == "instance":
            return self.same("InstanceNormalization", x, *scales)
        return self.same("GroupNormalization", x, *scales, num_groups=gcd(NORM_GROUPS, x.channels))

    def unit(
        self, x: TensorRef, out: int, kernel: int, act: str | None = "Relu", stride: int = 1, groups: int = 1
    ) -> TensorRef:
        """Append a convolution, its normalisation and its activation.

        `x`, `out`, `kernel`, `stride`, `groups`: as in `conv`.
        `act`: ONNX operator of the activation, None for none.
        """
        y = self.normed(self.conv(x, out, kernel, stride, groups, bias=self.norm == "batch"))
        return y if act is None else self.same(act, y)

    def upsampled(self, x: TensorRef) -> TensorRef:
        """`x` at twice the size, by nearest neighbour."""
        shape = (x.channels, 2 * x.height, 2 * x.width)
        return self.op("Resize", [x.name, "", self.twice.name], shape, mode="nearest")

    def model(self, name: str, outputs: list[TensorRef]) -> Any:
        """Everything so far as an `onnx.ModelProto`, opset 21."""
        results = [value_info(out.name, (1, *out[1:])) for out in outputs]
        graph = helper.make_graph(self.nodes, name, self.inputs, results, [self.twice], value_info=self.infos)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 21)])

    def add(self, x: TensorRef, y: TensorRef) -> TensorRef:
        """The sum of two tensors of one size."""
        return self.op("Add", [x.name, y.name], x[1:])


def value_info(name: str, shape: tuple[int, ...]) -> Any:
    """The `onnx.ValueInfoProto` of a FLOAT tensor."""
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
