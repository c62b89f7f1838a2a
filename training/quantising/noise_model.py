"""Predicts how far an integer network's picture is from the float network's, without running integers.

Rule: the float network is computed with an error at every place where the integer network rounds or clips. A stored
tensor is one that the integer network holds as bytes. The rounding error of each stored tensor and each weight is
uniform, up to half a step to either side. docs/networks.md has the derivation.

Sources: for the uniform rounding error, Widrow & Kollar 2008, "Quantization Noise", chapter 4; for the prediction
interval, Hahn & Meeker 1991, "Statistical Intervals", section 4.2.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from trilane.arrays import F32, U8
from trilane.avatars.network_file import LAYERS, NetworkFile
from trilane.errors import BadInputError
from trilane.stages.dsp.ort import ERRORS_ONLY, PROVIDER
from trilane.training.quantising.calibration import MOVES, SHARING
from trilane.training.quantising.quantise import Quantised

#: Number of pictures with random rounding errors from which the bound is computed.
DRAWS = 16
#: Student's t with `DRAWS` - 1 degrees of freedom exceeds this value with the probability 0.001.
STUDENT_T = 3.7328
PICTURE = 255
#: Operators whose output consists of multiples of a step if their inputs do.
KEEPS_STEPS = (*SHARING, "Relu", "Identity")
#: Largest byte of a stored tensor: unsigned, 0 to 255.
TOP = 255


@dataclass(frozen=True)
class NoiseModel:
    """A float network that rounds and clips where the integer network does.

    `model`: model whose first input has the bytes of the integer network's input. Its other inputs are the constants
    and `offsets`.
    `constants`: (float value, largest error of each element) of each constant, by the constant's name.
    `offsets`: names of the inputs that shift the steps of a stored tensor, by a random number from -½ to ½ steps.
    """

    model: onnx.ModelProto = field(repr=False)
    constants: Mapping[str, tuple[F32, NDArray[np.float64]]]
    offsets: tuple[str, ...]

    @cached_property
    def _runner(self) -> Any:
        return session(self.model)

    def pictures(self, tensor: U8, draws: int, seed: int) -> Iterator[F32]:
        """Yield pictures (N, H, W, 4), in 0..255, with random errors.

        `tensor`: input bytes (N, H, W, C). `draws`: number of pictures. `seed`: seed of the errors.
        """
        rng = np.random.default_rng(seed)
        source = self.model.graph.input[0].name
        for _ in range(draws):
            feeds: dict[str, Any] = {source: tensor}
            for name, (value, half) in self.constants.items():
                feeds[name] = (value + half * rng.uniform(-1, 1, value.shape)).astype(np.float32)
            for name in self.offsets:
                feeds[name] = np.asarray(rng.uniform(-0.5, 0.5), np.float32)
            yield PICTURE * self._runner.run(None, feeds)[0]


def float_picture(model: onnx.ModelProto, quantised: Quantised, tensor: U8) -> F32:
    """Return the float network's picture (N, H, W, 4), in 0..255.

    `model`: float network.
    `quantised`: integer network, whose scale and zero point turn bytes into real numbers.
    `tensor`: input bytes (N, H, W, C).
    """
    encoding = quantised.network.input
    real = (tensor.astype(np.float32) - encoding.zero_point) * np.float32(encoding.scale)
    runner = session(model)
    nchw = np.ascontiguousarray(real.transpose(0, 3, 1, 2))
    picture: F32 = PICTURE * runner.run(None, {runner.get_inputs()[0].name: nchw})[0].transpose(0, 2, 3, 1)
    return picture


def predicted_bound(model: NoiseModel, wanted: F32, tensor: U8, seed: int = 0) -> tuple[float, float]:
    """Return (expected mean absolute error of the picture, bound of this error), in steps of 1/255.

    The error of a further draw exceeds the bound with the probability 0.001: bound = m + t s sqrt(1 + 1/n). Here m is
    the mean and s the standard deviation of n = `DRAWS` draws, and t = `STUDENT_T`.

    `wanted`: float network's picture (N, H, W, 4), in 0..255.
    `tensor`: input bytes (N, H, W, C).
    `seed`: seed of the draws.
    """
    errors = [float(np.abs(picture - wanted).mean()) for picture in model.pictures(tensor, DRAWS, seed)]
    mean = float(np.mean(errors))
    return mean, mean + STUDENT_T * float(np.std(errors, ddof=1)) * math.sqrt(1 + 1 / DRAWS)


def noise_model(quantised: Quantised) -> NoiseModel:
    """Return the noise model of an integer network. Raises BadInputError if a constant has no float value."""
    graph = NoiseGraph(quantised)
    for node in quantised.network.model.graph.node:
        graph.take(node)
    return graph.finished()


class NoiseGraph:
    """Builds the graph of a noise model, node by node, with the steps and ranges of the integer network."""

    def __init__(self, quantised: Quantised) -> None:
        self.source = quantised.network.model.graph
        self.values = {tensor.name: numpy_helper.to_array(tensor) for tensor in self.source.initializer}
        self.floats = quantised.float_constants
        #: If all runtimes round alike, weights and biases use only every second multiple of their scale.
        self.multiples = 2 if quantised.facts["rounds_alike"] else 1
        self.makers = {name: node for node in self.source.node for name in node.output}
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, tuple[F32, NDArray[np.float64]]] = {}
        self.offsets: list[str] = []
        self.limits: list[onnx.TensorProto] = []

    def take(self, node: onnx.NodeProto) -> None:
        """Add the float counterpart of `node`, a node of the integer network."""
        if node.op_type == "QuantizeLinear":
            self.store(node)
        elif node.op_type == "DequantizeLinear" and node.input[0] in self.values:
            # An input of the noise model, so that each draw can change it.
            self.constants[node.output[0]] = self.constant(node)
        elif node.op_type == "DequantizeLinear" and node.input[0] != self.source.input[0].name:
            self.nodes.append(helper.make_node("Identity", [node.input[0]], list(node.output)))
        else:
            self.nodes.append(node)

    def constant(self, node: onnx.NodeProto) -> tuple[F32, NDArray[np.float64]]:
        """Return (float value of the constant that `node` dequantises, largest error of each element)."""
        stored, scale = self.values[node.input[0]], np.asarray(self.values[node.input[1]], np.float64)
        axis = next((attribute.i for attribute in node.attribute if attribute.name == "axis"), 1)
        if scale.ndim and stored.ndim:
            scale = scale.reshape([-1 if side == axis else 1 for side in range(stored.ndim)])
        exact_value = self.float_value(node.input[0], stored.shape)
        half = np.broadcast_to(scale * self.multiples / 2, stored.shape)
        # A float value of exactly 0 is stored without error, except in a bias of odd multiples.
        exact = (exact_value == 0) & (stored == 0)
        # In such a bias its error is always `half`. A uniform error sqrt(3) times as wide has the same variance.
        farthest = (exact_value == 0) & (stored != 0)
        return exact_value, np.where(exact, 0.0, np.where(farthest, 3**0.5, 1.0) * half)

    def float_value(self, stored: str, shape: tuple[int, ...]) -> F32:
        """Return the float value of the integer constant named `stored`. Raises BadInputError if it has none.

        If several layers read a bias, ONNX Runtime copies it, and appends a number to the name of each further copy.

        `shape`: shape that the value must have.
        """
        name = stored.removesuffix("_quantized")
        originals = [known for known in self.floats if name.startswith(known) and f"0{name[len(known) :]}".isdigit()]
        value = self.floats[max(originals, key=len)] if originals else None
        if value is None or value.shape != shape:
            raise BadInputError("noise model", f"constant {name!r}", "a constant of the float network")
        return value.astype(np.float32)

    def store(self, node: onnx.NodeProto) -> None:
        """Add nodes that clip the tensor that `node` stores, and that round it if it may lie between the steps."""
        x, y = node.input[0], node.output[0]
        lowest, highest, step = self.bytes_of(node)
        low, high = self._limit(f"{y}.low", lowest), self._limit(f"{y}.high", highest)
        rounds = not self.is_multiple(x, step)
        clipped = f"{y}.clipped" if rounds else y
        self.nodes.append(helper.make_node("Clip", [x, low, high], [clipped]))
        if rounds:
            self._round(x, y, step, (low, high))

    def bytes_of(self, node: onnx.NodeProto) -> tuple[float, float, float]:
        """Return (value of byte 0, value of byte 255, step) of the tensor that `node` stores, all as real numbers."""
        step, zero = float(self.values[node.input[1]]), int(self.values[node.input[2]])
        return -zero * step, (TOP - zero) * step, step

    def _round(self, x: str, y: str, step: float, ends: tuple[str, str]) -> None:
        """Add nodes for `y` = (round(`x` / step + offset) - offset) step, which has an error of at most ½ step.

        A value that is exactly 0, or at an end of the range or beyond, is only clipped.
        """
        step_name, none = self._limit(f"{y}.step", step), self._limit(f"{y}.none", 0.0)
        offset = f"{y}.offset"
        self.offsets.append(offset)
        steps: tuple[tuple[str, list[str], str], ...] = (
            ("Div", [x, step_name], "steps"),
            ("Add", [f"{y}.steps", offset], "moved"),
            ("Round", [f"{y}.moved"], "rounded"),
            ("Sub", [f"{y}.rounded", offset], "back"),
            ("Mul", [f"{y}.back", step_name], "real"),
            ("Greater", [x, ends[0]], "above"),
            ("Less", [x, ends[1]], "below"),
            ("And", [f"{y}.above", f"{y}.below"], "inside"),
            ("Equal", [x, none], "zero"),
            ("Not", [f"{y}.zero"], "other"),
            ("And", [f"{y}.inside", f"{y}.other"], "rounds"),
        )
        self.nodes.extend(helper.make_node(kind, inputs, [f"{y}.{output}"]) for kind, inputs, output in steps)
        self.nodes.append(helper.make_node("Where", [f"{y}.rounds", f"{y}.real", f"{y}.clipped"], [y]))

    def _limit(self, name: str, value: float) -> str:
        self.limits.append(numpy_helper.from_array(np.asarray(value, np.float32), name))
        return name

    def is_multiple(self, name: str, step: float) -> bool:
        """Return whether all values of tensor `name` are already multiples of `step`."""
        maker = self.makers.get(name)
        if maker is None:
            return False
        if maker.op_type == "DequantizeLinear":
            return float(np.ravel(self.values[maker.input[1]])[0]) == step
        if maker.op_type not in KEEPS_STEPS:
            return False
        data = maker.input if maker.op_type in ("Concat", "Add") else maker.input[:1]
        return all(self.is_multiple(source, step) for source in data)

    def finished(self) -> NoiseModel:
        """Return the noise model of the nodes that were taken."""
        inputs = [
            *(helper.make_tensor_value_info(n, TensorProto.FLOAT, v.shape) for n, (v, _) in self.constants.items()),
            *(helper.make_tensor_value_info(name, TensorProto.FLOAT, []) for name in self.offsets),
        ]
        used = {name for node in self.nodes for name in node.input}
        kept = [copy.deepcopy(tensor) for tensor in self.source.initializer if tensor.name in used]
        source, target = self.source.input[0], self.source.output[0]
        output = helper.make_tensor_value_info(target.name, TensorProto.FLOAT, None)
        graph = helper.make_graph(self.nodes, "noise", [source, *inputs], [output], [*kept, *self.limits])
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        return NoiseModel(model, self.constants, tuple(self.offsets))


def session(model: onnx.ModelProto) -> Any:
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = ERRORS_ONLY
    settings.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(model.SerializeToString(), settings, providers=[PROVIDER])


# The noise model of an ideal quantiser, whose steps follow from the float network and the input, not from the real
# quantiser.
#
# Rule: only two facts are taken from the integer network: the places where it rounds, and whether its steps are powers
# of two. The range of a stored tensor covers the tensor's float values on this input, and has 255 steps. The weights of
# an output channel have `LARGEST_WEIGHT` steps to either side of 0; biases are exact. If steps are powers of two, each
# step is `POWER_OF_TWO` times as wide: rounding up to a power of two widens a step by at most this factor, and even
# multiples widen the steps of weights by this factor. The steps of the picture are 1/255.

#: Greatest ratio between a step that was rounded up to a power of two and the step itself.
POWER_OF_TWO = 2
BYTE_TOP, INT16_TOP = 255, 2**15 - 1
#: AVX2 without VNNI adds two products of a byte and a weight in 16 bits and saturates (Intel's manual, VPMADDUBSW). A
#: bundle gives the same picture on every CPU, so no quantiser may use larger weights.
LARGEST_WEIGHT = INT16_TOP // (2 * BYTE_TOP)
#: Operators that copy values from their input to their output.
MOVES_VALUES = (*MOVES, "Relu", "Identity")
Range = tuple[float, float]


def ideal_noise_model(model: onnx.ModelProto, quantised: Quantised, tensor: U8) -> NoiseModel:
    """Return the noise model with the steps of an ideal quantiser.

    `model`: float network from which `quantised` was made.
    `tensor`: input bytes (N, H, W, C), whose ranges the steps must cover.

    Raises BadInputError as `noise_model` does.
    """
    graph = _IdealGraph(quantised, float_ranges(model, quantised, tensor))
    for node in quantised.network.model.graph.node:
        graph.take(node)
    return graph.finished()


def float_ranges(model: onnx.ModelProto, quantised: Quantised, tensor: U8) -> dict[str, Range]:
    """Return (low, high) of each stored tensor's float values for an input; 0 is included.

    The keys are the names of the stored tensors, which are outputs of QuantizeLinear nodes.

    `model`: float network from which `quantised` was made. `tensor`: input bytes (N, H, W, C).
    """
    graph = _FloatGraph(model, quantised)
    for node in quantised.network.model.graph.node:
        graph.take(node)
    plain = graph.finished()
    plain.model.graph.output.extend(onnx.ValueInfoProto(name=name) for name in graph.stored)
    feeds = {name: value for name, (value, _) in plain.constants.items()}
    values = session(plain.model).run(graph.stored, {plain.model.graph.input[0].name: tensor, **feeds})
    return {
        name: (min(float(value.min()), 0.0), max(float(value.max()), 0.0))
        for name, value in zip(graph.stored, values, strict=True)
    }


class _FloatGraph(NoiseGraph):
    """Builds a float network that rounds nothing, and collects the names of the tensors that would be stored.

    The integer network has no Relu, because the range of a rectified tensor begins at 0. This network has no ranges, so
    it needs a Relu wherever the float network `model` has one.
    """

    def __init__(self, model: onnx.ModelProto, quantised: Quantised) -> None:
        super().__init__(quantised)
        self.rectified = {node.output[0] for node in model.graph.node if node.op_type == "Relu"}
        self.stored: list[str] = []

    def store(self, node: onnx.NodeProto) -> None:
        self.stored.append(node.output[0])
        kind = "Relu" if node.input[0] in self.rectified else "Identity"
        self.nodes.append(onnx.helper.make_node(kind, [node.input[0]], [node.output[0]]))


class _IdealGraph(NoiseGraph):
    """Builds a noise model with the steps of an ideal quantiser."""

    def __init__(self, quantised: Quantised, ranges: dict[str, Range]) -> None:
        super().__init__(quantised)
        self.ranges = ranges
        self.widened = POWER_OF_TWO if quantised.facts["rounds_alike"] else 1

    def constant(self, node: onnx.NodeProto) -> tuple[F32, NDArray[np.float64]]:
        stored = self.values[node.input[0]]
        value = self.float_value(node.input[0], stored.shape)
        if stored.dtype == np.int32:
            return value, np.zeros(value.shape)
        others = tuple(range(1, value.ndim)) if value.ndim > 1 else None
        step = np.abs(value).max(axis=others, keepdims=True).astype(np.float64) / LARGEST_WEIGHT
        return value, np.where(value == 0, 0.0, self.widened * step / 2)

    def bytes_of(self, node: onnx.NodeProto) -> tuple[float, float, float]:
        if self.makers[self.source.output[0].name].input[0] == node.output[0]:
            return 0.0, 1.0, 1 / PICTURE
        low, high = self.ranges[node.output[0]]
        step = self.widened * max(high - low, float(np.finfo(np.float32).tiny)) / TOP
        return self.widened * low, self.widened * high, step

    def is_multiple(self, name: str, step: float) -> bool:
        """Return whether tensor `name` is a copy of a stored tensor, so that its values are multiples of a step.

        Joined and added tensors have steps of their own.
        """
        maker = self.makers.get(name)
        if maker is None or maker.op_type == "DequantizeLinear":
            return maker is not None
        return maker.op_type in MOVES_VALUES and self.is_multiple(maker.input[0], step)


# The noise that quantisation adds to each layer: its signal-to-noise ratio (SQNR) on one real frame.
#
# Rule: both networks read the same input bytes, so the rounding of the input does not count as a layer's noise.

#: Greatest SQNR that is reported. A layer without error has an infinite SQNR, which JSON cannot express.
MAX_DB = 200.0


def layer_report(model: onnx.ModelProto, quantised: Quantised, frame: NDArray[np.float32]) -> list[dict[str, Any]]:
    """Return a row (`name`, `op_type`, `sqnr_db`) for each layer that both networks have, the lowest SQNR first.

    SQNR = 10 log10(sum x² / sum (x - q)²). Here x is the layer's output after its activation in the float network, and
    q is the same output as the integer network stores it.

    `model`: float network with an input of (1, C, H, W). `frame`: real input (H, W, C).
    """
    network = quantised.network
    tensor = np.clip(np.round(frame / network.input.scale) + network.input.zero_point, 0, 255).astype(np.uint8)
    real = ((tensor.astype(np.float32) - network.input.zero_point) * np.float32(network.input.scale)).transpose(2, 0, 1)
    known = {name for node in model.graph.node for name in node.output}
    stored = {name: made for name, made in _stored(network).items() if made[1] in known}
    exact = _outputs(model, np.ascontiguousarray(real[None]), [name for _, name in stored.values()])
    rounded = _outputs(network.model, tensor[None], list(stored))
    rows = []
    for dequantised, (node, name) in stored.items():
        sqnr = _sqnr_db(exact[name], rounded[dequantised])
        rows.append({"name": node.name, "op_type": node.op_type, "sqnr_db": sqnr})
    return sorted(rows, key=lambda row: row["sqnr_db"])


def _stored(network: NetworkFile) -> dict[str, tuple[onnx.NodeProto, str]]:
    """Return (layer, name of its output in the float network) of each layer, by the name of its dequantised output."""
    graph = network.model.graph
    quantisers = {node.input[0]: node for node in graph.node if node.op_type == "QuantizeLinear"}
    readers = {node.input[0]: node for node in graph.node if node.op_type == "DequantizeLinear"}
    layers = {}
    for node in graph.node:
        quantiser = quantisers.get(node.output[0])
        if node.op_type in LAYERS and quantiser is not None and quantiser.output[0] in readers:
            layers[readers[quantiser.output[0]].output[0]] = (node, node.output[0])
    return layers


def _outputs(model: onnx.ModelProto, feed: NDArray[Any], names: list[str]) -> dict[str, NDArray[np.float32]]:
    opened = copy.deepcopy(model)
    del opened.graph.output[:]
    opened.graph.output.extend(helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in names)
    settings = onnxruntime.SessionOptions()
    settings.log_severity_level = ERRORS_ONLY
    session = onnxruntime.InferenceSession(opened.SerializeToString(), settings, providers=[PROVIDER])
    values = session.run(names, {session.get_inputs()[0].name: feed})
    return dict(zip(names, values, strict=True))


def _sqnr_db(exact: NDArray[np.float32], rounded: NDArray[np.float32]) -> float:
    signal = float(np.square(exact, dtype=np.float64).sum())
    noise = float(np.square(exact.astype(np.float64) - rounded).sum())
    if signal == 0 or noise == 0:
        return MAX_DB if noise == 0 else -MAX_DB
    return max(-MAX_DB, min(MAX_DB, 10 * math.log10(signal / noise)))
