"""Bundles with one part exchanged. Rule: what was exchanged passes every check of a bundle, and runs."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto


def _shuffle_texture(folder: Path) -> None:
    with np.load(folder / "texture.npz") as arrays:
        content = dict(arrays)
    texture = content["texture"]
    order = np.random.default_rng(0).permutation(texture.shape[0] * texture.shape[1])
    content["texture"] = texture.reshape(-1, texture.shape[2])[order].reshape(texture.shape)
    np.savez_compressed(folder / "texture.npz", **content)


def _exchange_network(folder: Path) -> None:
    """Other weights in one layer, with the scales and zero points of the ends as they were."""
    model = onnx.load(folder / "network.onnx")
    weights = max(
        (tensor for tensor in model.graph.initializer if tensor.data_type in (TensorProto.INT8, TensorProto.UINT8)),
        key=lambda tensor: len(tensor.raw_data),
    )
    weights.raw_data = weights.raw_data[::-1]
    onnx.save(model, folder / "network.onnx")


def _exchange_body(folder: Path) -> None:
    with np.load(folder / "body.npz") as arrays:
        content = dict(arrays)
    content["v_template"] = content["v_template"] * np.float32(1.05)
    np.savez_compressed(folder / "body.npz", **content)


def _change_constants(folder: Path) -> None:
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"betas": [0.5]}))


#: Part, as `digests` has it, to what exchanges it in a folder.
SPOILT: dict[str, Callable[[Path], None]] = {
    "texture": _shuffle_texture,
    "network": _exchange_network,
    "body": _exchange_body,
    "constants": _change_constants,
}


def spoil(folder: Path, part: str) -> None:
    """Exchange `part` of the bundle in `folder`."""
    SPOILT[part](folder)


def numbers_in(text: str) -> list[str]:
    """Every decimal number in `text`, as it is written."""
    return re.findall(r"\d+\.\d+", text)
