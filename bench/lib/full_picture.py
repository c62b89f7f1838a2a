"""Pictures by the plan `full`, in which everything is modelled, and true pictures. Other plans are compared with both.

Rule: the plan `full` is a second, slow implementation, which shares little code with the stages. The body has every
weight and every blend shape in float64. A tensor pixel is the unrounded mean of SAMPLES x SAMPLES reads of the neural
texture. Each avatar has a tensor of its own, whose size is near the size that its network was trained for. The tensor
lies on the picture's grid: a pixel of the tensor covers a square of pixels of the picture, or the other way round. The
network is in FP32. Its picture is blended in linear light, in float64, over the run's own background.

A true picture shows the clothed body itself, drawn like a training sample. An avatar's network was trained to paint
this picture. Therefore the true picture shows how good every plan is, including `full`. Only bundled avatars have true
pictures. Clothes are put on the skin, not on an avatar's offsets, because the offsets are these clothes already.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from math import isqrt
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from onnx import helper, numpy_helper

from trilane import machine
from trilane.arrays import BUCKET_STEP, F32, F64, U8, Shape
from trilane.avatars.bundle import Bundle, bundle_folder
from trilane.avatars.manifest import sha256_of
from trilane.avatars.network_file import NetworkFile, constants_of, reshaped
from trilane.bench.lib import float_raster
from trilane.bench.lib.cast import Cast, CastView, RasterLayer, blended, enlarged, grown, premultiplied, shrunk
from trilane.body.body import Body
from trilane.body.joints import JOINTS, rodrigues
from trilane.errors import MissingPartError
from trilane.scene.crop import crop_projection
from trilane.stages.avatar_assets import AvatarData
from trilane.stages.gpu.skinned_mesh import MeshArrays, avatar_mesh
from trilane.training.clothing import clothing_layers, find_landmarks, look_of
from trilane.training.sample_renderer import ClothedBody
from trilane.training.surface import body_arrays
from trilane.units import AVATARS

#: Number of points along each side of a tensor pixel at which the neural texture is read.
SAMPLES = 4
#: Number of samples of the clothed body along each side of a pixel.
CLOTHED_SAMPLES = 4


class FullBody:
    """The body in float64 with every blend shape and skin weight, computed joint by joint as SMPL-X defines it.

    `rest` (V,3): vertices at rest, metres.
    `joints` (55,3): places of the joints at rest, metres.
    """

    def __init__(self, body: Body, betas: Sequence[float] = (), expression: Sequence[float] = ()) -> None:
        """Give `body` its shape. `betas`, `expression`: coefficients of blend shapes; missing coefficients are 0."""
        self._body = body
        self._weights = body.weights.astype(np.float64)
        self.rest = body.v_template.astype(np.float64)
        for directions, values in ((body.shape_dirs, betas), (body.expression_dirs, expression)):
            self.rest = self.rest + directions[:, :, : len(values)].astype(np.float64) @ np.array(values, np.float64)
        self.joints = body.j_regressor.astype(np.float64) @ self.rest
        if body.offsets is not None:
            self.rest = self.rest + body.offsets

    def vertices(self, pose: F64, translation: F64, world: F64) -> F64:
        """Return the vertices (V,3) of the posed body in the world, metres.

        `pose`: rotation of each joint as axis-angle (55,3), radians.
        `translation`: translation (3,) of the root in body space, metres.
        `world`: matrix (4,4) from body space to the world.
        """
        turns = rodrigues(np.asarray(pose, np.float64).reshape(JOINTS, 3))
        rest = self.rest
        if self._body.posedirs is not None:
            rest = rest + self._body.posedirs.astype(np.float64) @ (turns[1:] - np.eye(3)).reshape(-1)
        placed = self._placed(turns, np.asarray(translation, np.float64), np.asarray(world, np.float64))
        moved = np.einsum("vj,jab->vab", self._weights, placed)
        return np.asarray(np.einsum("vab,vb->va", moved[:, :, :3], rest) + moved[:, :, 3])

    def _placed(self, turns: F64, translation: F64, world: F64) -> F64:
        """Return the matrices (55,3,4) of the joints from the body at rest to the world.

        `turns`: rotation matrices (55,3,3) of the joints.
        """
        placed: dict[int, F64] = {}

        def place(joint: int) -> F64:
            """Return the matrix (4,4) of `joint`: matrix of its parent @ shift to the joint @ turn @ shift back."""
            if joint not in placed:
                parent = int(self._body.parents[joint])
                above = world @ _shift(translation) if parent < 0 else place(parent)
                turn = np.eye(4)
                turn[:3, :3] = turns[joint]
                at = self.joints[joint]
                placed[joint] = above @ _shift(at) @ turn @ _shift(-at)
            return placed[joint]

        return np.stack([place(joint)[:3] for joint in range(JOINTS)])


def _shift(by: F64) -> F64:
    matrix = np.eye(4)
    matrix[:3, 3] = by
    return matrix


@dataclass(frozen=True)
class _Avatar:
    """The parts of an avatar that the plan `full` draws with. `area`: pixels of its network's tensor in training."""

    body: FullBody
    mesh: MeshArrays
    texture: F32
    paint: Paint
    area: int
    network: str


class FullPictures:
    """Makes pictures of the avatars in `cast` by the plan `full`."""

    def __init__(self, cast: Cast) -> None:
        """Load the networks. Raises BadInputError for an unreadable file, MissingPartError if PyTorch is lacking."""
        self._cast = cast
        self._avatars = {folder: _avatar(data) for folder, data in cast.avatars.items()}

    @property
    def networks(self) -> list[str]:
        """The source of each network that paints avatars, in words, sorted."""
        return sorted({avatar.network for avatar in self._avatars.values()})

    def frame(self, number: int, background: U8) -> U8:
        """Return the picture (h,w,3) uint8 sRGB of frame `number` by the plan `full`.

        `background`: picture (h,w,3) uint8 sRGB of the same frame without avatars.
        """
        return blended(background, [self._layer(seen) for seen in self._cast.seen(number)])

    def _layer(self, seen: CastView) -> RasterLayer:
        avatar = self._avatars[seen.folder]
        times = fineness(seen.box.shape, avatar.area)
        box = grown(seen.box, BUCKET_STEP * times.denominator)
        height, width = (int(side * times) for side in box.shape)
        vertices = avatar.body.vertices(seen.pose, seen.translation, seen.world)
        clip = crop_projection(seen.projection, box.within(seen.box)) @ seen.view
        tensor = supersampled(vertices, avatar.mesh, clip, (height, width), avatar.texture)
        painted = premultiplied(avatar.paint(tensor))
        return RasterLayer(box, seen.depth, enlarged(shrunk(painted, times.numerator), times.denominator))


def fineness(shape: Shape, area: int) -> Fraction:
    """Return the density of an avatar's tensor, which is a whole number or 1 divided by a whole number.

    The density is the number of tensor pixels per picture pixel, along a side. It brings the number of the tensor's
    pixels as near to `area` as possible, measured as a ratio.
    `shape`: (height, width) of the avatar's box in the picture. `area`: wanted number of the tensor's pixels.
    """
    own = shape[0] * shape[1]
    larger, smaller = max(own, area), min(own, area)
    times = isqrt(larger // smaller)
    # If the root is above the geometric mean of the whole numbers around it, the larger number is nearer, as a ratio.
    times += larger > smaller * times * (times + 1)
    return Fraction(times) if area > own else Fraction(1, times)


def _avatar(data: AvatarData) -> _Avatar:
    manifest, body = data.bundle.manifest, data.shaped.body
    paint, network = float_network(data.bundle)
    _, height, width, _ = data.network.shape
    full = FullBody(body, manifest.betas, manifest.expression)
    return _Avatar(full, avatar_mesh(data.shaped), data.texture, paint, height * width, network)


def supersampled(vertices: F64, mesh: MeshArrays, clip: F64, shape: Shape, texture: F32, samples: int = SAMPLES) -> F64:
    """Return the tensor of a body in real numbers, (h,w,C) float64.

    A pixel is the mean of `samples` x `samples` bilinear reads of the texture. Reads outside of the mesh are 0.

    `vertices`: vertices (V,3) of the body in the world, metres.
    `mesh`: triangles and texture coordinates of the body.
    `clip`: matrix projection of the tensor @ view, (4,4).
    `shape`: (height, width) of the tensor.
    `texture`: neural texture (H,W,C).
    `samples`: number of reads along each side of a pixel.
    """
    fine = (shape[0] * samples, shape[1] * samples)
    image = float_raster.rasterise(vertices[mesh.source], mesh.triangles, mesh.uv, clip, fine, mesh.closed)
    neural = texture.astype(np.float64)
    tensor = np.zeros((*shape, texture.shape[2]))
    for row in np.flatnonzero(image.coverage.reshape(shape[0], -1).any(axis=1)):
        band = np.s_[row * samples : (row + 1) * samples]
        covered = image.coverage[band]
        reads = np.zeros((*covered.shape, texture.shape[2]))
        reads[covered] = float_raster.sample(neural, image.uv[band][covered])
        tensor[row] = shrunk(reads, samples)[0]
    return tensor


class TruePictures:
    """Makes true pictures of bundled avatars, which show the clothed bodies that the avatars were trained on."""

    def __init__(self, cast: Cast, ctx: Any) -> None:
        """Prepare the clothed bodies. `cast`: scene that only has bundled avatars. `ctx`: OpenGL context in use."""
        self._cast = cast
        self._clothed = {folder: _clothed(data, ctx) for folder, data in cast.avatars.items()}

    def frame(self, number: int, background: U8) -> U8:
        """Return the true picture (h,w,3) uint8 sRGB of frame `number`.

        `background`: picture (h,w,3) uint8 sRGB of the same frame without avatars.
        """
        return blended(background, self.layers(number))

    def layers(self, number: int) -> list[RasterLayer]:
        """Return a layer for each visible avatar in frame `number`. The layers' pixels are pixels of the picture."""
        layers = []
        for seen in self._cast.seen(number):
            rgba = self._clothed[seen.folder].render(seen.joints, seen.view, seen.projection, seen.box.shape) / 255.0
            layers.append(RasterLayer(seen.box, seen.depth, premultiplied(rgba)))
        return layers


def true_pictures(cast: Cast, ctx: Any) -> TruePictures | None:
    """Return an object that makes true pictures of `cast`; None if an avatar of `cast` is not bundled.

    `ctx`: OpenGL context in use.
    """
    is_known = set(cast.avatars) <= {bundle_folder(name).absolute() for name in AVATARS}
    return TruePictures(cast, ctx) if is_known else None


def _clothed(data: AvatarData, ctx: Any) -> ClothedBody:
    arrays, look = body_arrays(data.shaped.bare()), look_of(data.bundle.manifest.provenance)
    landmarks = find_landmarks(arrays.vertices, arrays.joints, arrays.weights)
    return ClothedBody(ctx, clothing_layers(arrays, landmarks, look), landmarks, CLOTHED_SAMPLES, look)


# The FP32 network of an avatar, with which the plan `full` paints.
#
# Rule: results name the source of the network. If the avatar's manifest names the float network that the avatar was
# quantised from, by its digest, and the file is in WEIGHTS, this network is used. Otherwise the integer network runs
# with its weights in float32, without rounding between its layers, and `full` has the error of quantised weights too.

#: Folder in which Trilane keeps the weights of float networks.
WEIGHTS = Path(__file__).resolve().parents[2] / "training"
IN, OUT = "real_tensor", "real_rgba"
#: A function from real numbers (h,w,C) float64 to (h,w,4) float32: straight colour (sRGB) and alpha in 0..1.
Paint = Callable[[F64], F32]


def float_network(bundle: Bundle) -> tuple[Paint, str]:
    """Return (FP32 network of `bundle` as a function, source of the network in words).

    Raises BadInputError if a file cannot be read, MissingPartError if the network needs PyTorch, which is absent.
    """
    weights = require_float_network(bundle)
    if weights is None:
        source = "the integer network's weights in FP32, nothing rounded between layers"
        return dequantised(bundle.read_network()), source
    return trained(bundle, weights), f"the FP32 network it was quantised from, {weights.name}"


def require_float_network(bundle: Bundle) -> Path | None:
    """Return the result of `float_weights`. Raises MissingPartError if the file exists, but PyTorch is absent."""
    weights = float_weights(bundle)
    if weights is not None and not machine.here.has_package("torch"):
        raise MissingPartError("the FP32 network needs torch", extra="train")
    return weights


def float_weights(bundle: Bundle) -> Path | None:
    """Return the file of the float network that `bundle` was quantised from; None if this file is not in WEIGHTS.

    The bundle's manifest must name the file with its digest: in the entry of `trilane avatar validate --float-network`,
    or among the facts about quantising.
    """
    validation = bundle.manifest.validation
    validated = ((validation.model_extra or {}) if validation is not None else {}).get("float", {}).get("network", "")
    said = validated or bundle.manifest.quantisation.get("float_network", "")
    name, _, digest = str(said).partition(", sha256 ")
    path = WEIGHTS / Path(name).name
    return path if path.is_file() and sha256_of([path]) == digest else None


def weights_name(weights: Path) -> str:
    """Return the name and the digest of a float network's file, as they stand in a manifest: `NAME, sha256 DIGEST`."""
    return f"{weights.name}, sha256 {sha256_of([weights])}"


def trained(bundle: Bundle, weights: Path) -> Paint:
    """Return the float network of `bundle` as a function. `weights`: file of the weights that training saved.

    Raises BadInputError if the file does not fit the bundle, ImportError without PyTorch.
    """
    import torch

    from trilane.training.trainable_avatar import float_network_of

    network = float_network_of(bundle, weights).eval()

    def paint(tensor: F64) -> F32:
        planes = torch.from_numpy(np.ascontiguousarray(tensor.transpose(2, 0, 1), np.float32))[None]
        with torch.no_grad():
            rgba: F32 = network(planes)[0].permute(1, 2, 0).numpy()
        return rgba

    return paint


def dequantised(network: NetworkFile) -> Paint:
    """Return a function that runs `network` without rounding (`unrounded`), by ONNX Runtime in FP32."""
    return _painted(lambda *shape: unrounded(reshaped(network, *shape)), None)


def as_written(network: NetworkFile) -> Paint:
    """Return a function that runs the integer network as its file defines it, with every rounding to bytes.

    The function is the reference of the runtimes. ONNX Runtime computes node by node, in FP32, without optimisation.
    The input may have any real numbers, also numbers that no byte represents.
    """
    settings = onnxruntime.SessionOptions()
    settings.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    settings.intra_op_num_threads = 1
    paint = _painted(lambda *shape: from_real(reshaped(network, *shape)), settings)
    return lambda tensor: np.asarray(paint(tensor) / np.float32(255))


def _painted(model_of: Callable[..., onnx.ModelProto], settings: onnxruntime.SessionOptions | None) -> Paint:
    """Return a function that runs a network on real numbers by ONNX Runtime.

    `model_of`: function of a tensor's height and width. It returns the network's model with the input `IN`.
    `settings`: settings of the sessions; None for ONNX Runtime's defaults.
    """
    session_of = cache(
        lambda *shape: onnxruntime.InferenceSession(
            model_of(*shape).SerializeToString(), settings, providers=["CPUExecutionProvider"]
        )
    )

    def paint(tensor: F64) -> F32:
        rgba: F32 = session_of(*tensor.shape[:2]).run(None, {IN: tensor.astype(np.float32)[None]})[0][0]
        return rgba

    return paint


def from_real(network: NetworkFile) -> onnx.ModelProto:
    """Return a model of `network` with an input of real numbers in place of bytes: `IN`, (N,H,W,C) float32."""
    model = onnx.ModelProto()
    model.CopyFrom(network.model)
    graph = model.graph
    (entry,) = graph.input
    for node in graph.node:
        if entry.name in node.input:
            node.CopyFrom(helper.make_node("Identity", [IN], node.output, name=node.name))
    entry.name = IN
    entry.type.tensor_type.elem_type = onnx.TensorProto.FLOAT
    _keep_what_is_read(graph)
    return model


def unrounded(network: NetworkFile) -> onnx.ModelProto:
    """Return a model of `network` without rounding. Input: `IN` (N,H,W,C) float32. Output: `OUT` (N,H,W,4) float32.

    Tensors that `network` rounds to bytes are still clipped to the range of these bytes. Clipping at 0 matters, because
    it replaces the network's rectifiers. Weights and biases are the real numbers that the integers represent.
    """
    model = onnx.ModelProto()
    model.CopyFrom(network.model)
    graph = model.graph
    constants = constants_of(model)
    rounded = {node.output[0]: node for node in graph.node if node.op_type == "QuantizeLinear"}
    nodes, ends = [], {graph.input[0].name: IN, graph.output[0].name: OUT}
    for node in graph.node:
        if node.op_type == "QuantizeLinear":
            low, high = _range(node, constants)
            limits = [numpy_helper.from_array(np.float32(x), f"{node.output[0]} {x}") for x in (low, high)]
            graph.initializer.extend(limits)
            nodes.append(helper.make_node("Clip", [node.input[0], *(x.name for x in limits)], node.output))
        elif node.op_type == "DequantizeLinear" and (node.input[0] in rounded or node.input[0] == graph.input[0].name):
            nodes.append(helper.make_node("Identity", node.input[:1], node.output))
        else:
            nodes.append(node)
    for node in nodes:
        node.input[:] = [ends.get(name, name) for name in node.input]
        node.output[:] = [ends.get(name, name) for name in node.output]
    del graph.node[:], graph.value_info[:]
    graph.node.extend(nodes)
    _keep_what_is_read(graph)
    for value in (graph.input[0], graph.output[0]):
        value.name = ends[value.name]
        value.type.tensor_type.elem_type = onnx.TensorProto.FLOAT
    return model


def _keep_what_is_read(graph: onnx.GraphProto) -> None:
    """Remove the constants that no node of `graph` reads."""
    read = {name for node in graph.node for name in node.input}
    kept = [tensor for tensor in graph.initializer if tensor.name in read]
    del graph.initializer[:]
    graph.initializer.extend(kept)


def _range(node: onnx.NodeProto, constants: Mapping[str, onnx.TensorProto]) -> tuple[float, float]:
    """Return (least, largest) of the real numbers that the output bytes of `node`, a QuantizeLinear, can represent."""
    scale = float(numpy_helper.to_array(constants[node.input[1]]).item())
    zero = numpy_helper.to_array(constants[node.input[2]])
    limits = np.iinfo(zero.dtype)
    return (limits.min - int(zero.item())) * scale, (limits.max - int(zero.item())) * scale
