"""Pipeline files for tests: three whole ones, small networks that they name, and a way to write one."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

#: Find the best box, segment it, show it.
STREET = """
[run]
fps = 30
[units]
npu = { hardware = "dsp" }
[stages]
camera    = { block = "video", unit = "cpu", path = "street.mp4", size = "640x480" }
small     = { block = "prepare", unit = "cpu", in = "camera", like = "detector", fit = "letterbox" }
detector  = { onnx = "det.onnx", unit = "npu", in = "small" }
crop      = { python = "crop:best", unit = "cpu", in = { frame = "camera", boxes = "detector" }, out = { picture = "u8 256x256x3" } }
segmenter = { onnx = "seg.onnx", unit = "npu", in = "crop" }
overlay   = { block = "overlay", unit = "gpu", in = { frame = "camera", mask = "segmenter" } }
video     = { block = "encode", unit = "cpu", in = "overlay", path = "out.mp4" }
"""  # noqa: E501 - TOML has no breaks in such a table
#: Fork, join, and a slow branch that is only asked every third frame.
BRANCHES = """
[run]
fps = 30
policy = "latest"
latency_to = "composite"
[stages]
frame     = { block = "video", unit = "isp", path = "0", size = "640x480" }
depth     = { onnx = "depth.onnx", unit = "dsp", in = "frame" }
seg       = { onnx = "seg.onnx", unit = "gpu", in = "frame" }
detector  = { onnx = "det.onnx", unit = "dsp", in = "frame", every = 3 }
tracker   = { python = "track:step", unit = "cpu", in = { frame = "frame", boxes = { from = "detector", sync = "latest", max_age_ms = 250 } }, out = { boxes = "f32 32x5" }, time_ms = 4 }
composite = { block = "overlay", unit = "gpu", in = { frame = "frame", depth = "depth", mask = "seg", boxes = "tracker" } }
"""  # noqa: E501
#: Times alone, from HaX-CoNN's published files: GoogLeNet on NVIDIA Xavier, cut at layer 81.
CUT = """
[stages]
head = { unit = "gpu", time_ms = { mean = 1.1146, sd = 0.02 } }
tail = { unit = "dla", in = "head", time_ms = 1.1717 }
"""
#: A fork and a join, a unit for each stage.
DEPTH = """
[stages]
frame = { unit = "a", time_ms = 2 }
depth = { unit = "b", in = "frame", time_ms = 14 }
seg = { unit = "c", in = "frame", time_ms = 10 }
composite = { unit = "d", in = { depth = "depth", mask = "seg" }, time_ms = 3 }
"""


def network(side: int, output: str, channels: int = 8) -> onnx.ModelProto:
    """A convolution of a picture `image`, 1 x 3 x side x side floats, to `channels` channels of the same size."""
    weights = np.random.default_rng(5).normal(size=(channels, 3, 3, 3)).astype(np.float32)
    graph = helper.make_graph(
        [helper.make_node("Conv", ["image", "weights"], [output], "conv", pads=[1, 1, 1, 1])],
        "net",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, side, side])],
        [helper.make_tensor_value_info(output, TensorProto.FLOAT, [1, channels, side, side])],
        [numpy_helper.from_array(weights, "weights")],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


ADDITIONS = 60


def additions(side: int) -> onnx.ModelProto:
    """A network that adds a picture of 32 channels to itself, ADDITIONS times: all traffic, no arithmetic."""
    names = [f"t{number}" for number in range(ADDITIONS + 1)]
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, (1, 32, side, side)) for name in names]
    nodes = [helper.make_node("Add", [one, one], [other], other) for one, other in pairwise(names)]
    return helper.make_model(helper.make_graph(nodes, "g", values[:1], values[-1:], value_info=values[1:-1]))


def write_file(folder: Path, text: str, name: str = "pipeline.toml") -> Path:
    """Write a pipeline file, and the networks that STREET and BRANCHES name beside it."""
    for stem, side, output in (("det", 128, "boxes"), ("seg", 256, "mask"), ("depth", 128, "depth")):
        onnx.save(network(side, output), folder / f"{stem}.onnx")
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path
