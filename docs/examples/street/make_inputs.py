"""Writes what street.toml needs and you would bring yourself: a video and two small networks."""

import av
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

PICTURES, WIDTH, HEIGHT = 90, 320, 240


def video(path):
    """Write a yellow ball that rolls over a grey street."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    with av.open(path, "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for number in range(PICTURES):
            picture = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
            picture[(x - 40 - 2.6 * number) ** 2 + (y - 120 - 60 * np.sin(number / 15)) ** 2 < 20**2] = [240, 220, 30]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def network(path, side, channels, weights, bias):
    """Write a network of one convolution, which tells yellow (much red, little blue) from grey."""
    values = {"weights": np.array(weights, np.float32), "bias": np.array(bias, np.float32)}
    pads = [values["weights"].shape[2] // 2] * 4
    graph = helper.make_graph(
        [helper.make_node("Conv", ["image", "weights", "bias"], ["found"], pads=pads)],
        "network",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, side, side])],
        [helper.make_tensor_value_info("found", TensorProto.FLOAT, [1, channels, side, side])],
        [numpy_helper.from_array(value, name) for name, value in values.items()],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)


if __name__ == "__main__":
    video("street.mp4")
    yellow = np.array([1.0, 0.0, -1.0])[None, :, None, None]
    network("detector.onnx", 64, 1, np.broadcast_to(yellow / 81, (1, 3, 9, 9)), [0.0])
    network("segmenter.onnx", 128, 2, np.concatenate([0 * yellow, yellow]), [0.3, 0.0])
