"""Pipeline files with published networks: they run, and what reaches a stage is what the network gives by itself."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import numpy_helper
from PIL import Image

pytestmark = pytest.mark.slow
FRAMES = 12
STREET = """
[run]
fps = 10
[units]
npu = { hardware = "dsp" }
[stages]
camera    = { block = "video", unit = "cpu", path = "street.mp4", size = "320x240" }
detector  = { onnx = "mobilenet_v3_small.onnx", unit = "npu", in = "small" }
segmenter = { onnx = "midas.onnx", unit = "npu", in = "crop" }
overlay   = { block = "overlay", unit = "gpu", in = { frame = "crop", depth = "segmenter" } }
video     = { block = "encode", unit = "cpu", in = "overlay", path = "out.mp4" }
[stages.small]
block = "prepare"
unit = "cpu"
in = "camera"
like = "detector"
fit = "letterbox"
mean = [0.485, 0.456, 0.406]
sd = [0.229, 0.224, 0.225]
[stages.crop]
python = "own:crop"
unit = "cpu"
in = { frame = "camera", boxes = "detector" }
out = { picture = "u8 256x256x3" }
[stages.kept]
python = "own:keep"
unit = "gpu"
in = { frame = "camera", small = "small", found = "detector", crop = "crop", depth = "segmenter" }
"""
OWN = """
import numpy as np
def crop(settings):
    return lambda frame, boxes: np.pad(frame[:, :256], ((0, 16), (0, 0), (0, 0)))
def keep(settings):
    kept = []
    def save(**arrays):
        kept.append({name: np.array(array) for name, array in arrays.items()})
        np.savez(f"kept-{len(kept)}.npz", **kept[-1])
    return save
"""


def weighted(source: Path, folder: Path) -> Path:
    """A copy of a published graph whose weights, inputs there, are random constants."""
    model, rng = onnx.load(source), np.random.default_rng(5)
    inputs = [value for value in model.graph.input if value.name == "image"]
    for value in model.graph.input:
        if value.name != "image":
            shape = [size.dim_value for size in value.type.tensor_type.shape.dim]
            spread = 1 / np.sqrt(max(np.prod(shape[1:]), 1))
            array = rng.normal(scale=spread, size=shape).astype(np.float32)
            model.graph.initializer.append(numpy_helper.from_array(array, value.name))
    del model.graph.input[:]
    model.graph.input.extend(inputs)
    onnx.save(model, folder / source.name)
    return folder / source.name


@pytest.fixture
def folder(tmp_path: Path, shared_data: Path) -> Path:
    y, x = np.mgrid[:240, :320]
    with av.open(str(tmp_path / "street.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        for number in range(30):
            waves = np.stack([x / 2 + number, y, (x + y) / 3], axis=-1)
            shown = (127 + 120 * np.sin(waves / 20)).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(shown, format="rgb24")))
        container.mux(stream.encode())
    for name in ("mobilenet_v3_small", "midas"):
        weighted(shared_data / "chips" / "networks" / f"{name}.onnx", tmp_path)
    (tmp_path / "own.py").write_text(OWN)
    return tmp_path


def run(folder: Path, text: str) -> dict[str, object]:
    (folder / "street.toml").write_text(text)
    done = subprocess.run(
        [sys.executable, "-m", "trilane", "run", "street.toml", "--frames", str(FRAMES), "--out", "run", "--json"],
        cwd=folder,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    report: dict[str, object] = json.loads(done.stdout)
    return report


def alone(path: Path, image: np.ndarray) -> np.ndarray:
    return np.asarray(
        onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"]).run(None, {"image": image})[0]
    )


def test_networks_in_a_pipeline_give_what_they_give_alone(folder: Path) -> None:
    report = run(folder, STREET)
    assert report["frames"]["presented"] == FRAMES  # type: ignore[index]
    for number in (1, FRAMES):
        kept = np.load(folder / f"kept-{number}.npz")
        boxed = np.full((224, 224, 3), 114, np.uint8)
        boxed[28:196] = Image.fromarray(kept["frame"]).resize((224, 168), Image.Resampling.BILINEAR)
        mean, sd = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
        image = ((boxed / 255 - mean) / sd).astype(np.float32).transpose(2, 0, 1)[None]
        assert kept["small"] == pytest.approx(image, abs=1e-5)
        assert kept["found"] == pytest.approx(alone(folder / "mobilenet_v3_small.onnx", image), rel=1e-3, abs=1e-4)
        crop = kept["crop"].transpose(2, 0, 1)[None].astype(np.float32) / 255
        expected = alone(folder / "midas.onnx", crop)
        assert kept["depth"] == pytest.approx(expected, rel=1e-3, abs=1e-3 * float(np.abs(expected).max()))
