"""Reads an avatar's network from its ONNX file.

Rule: no file outside the network's folder is opened, and nothing larger than `MAX_BYTES` is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import onnx
from google.protobuf.message import DecodeError
from onnx import TensorProto, external_data_helper

from trilane.avatars.integer_network import NetworkFile
from trilane.avatars.network_checks import check_network
from trilane.errors import BadInputError, reason
from trilane.files import require_file, signature_of

MAX_BYTES = 512 << 20
EXPECTED = "an ONNX network"


def read_network(path: Path) -> NetworkFile:
    """Read and check an ONNX file. Raises BadInputError that names the file, the node and the remedy."""
    return check_network(parse_network(path), str(path))


def parse_network(path: Path) -> onnx.ModelProto:
    """The ONNX model in the file, of any kind, with external data read in. Raises BadInputError when unreadable."""
    model = _parse(path)
    _load_external(model, path)
    return model


def network_files(path: Path) -> list[Path]:
    """The ONNX file itself, then every file beside it that holds tensors of it. Raises BadInputError."""
    kept = {_external_file(tensor, path) for tensor in _external_tensors(_parse(path))}
    return [path, *sorted(kept)]


def _parse(path: Path) -> onnx.ModelProto:
    try:
        size = require_file(path, EXPECTED)
        if size > MAX_BYTES:
            raise BadInputError(path, f"a file of {size} bytes", f"an ONNX network of 1 to {MAX_BYTES} bytes")
        if (other := signature_of(path)) is not None:
            raise BadInputError(path, other.name, EXPECTED)
        model = onnx.load_model_from_string(path.read_bytes())
    except OSError as error:
        raise BadInputError.of_os_error(path, error, "a readable ONNX file") from error
    except DecodeError as error:
        raise BadInputError(
            path, "bytes that do not parse", "an ONNX file", "copy it again: it may be cut short"
        ) from error
    if not model.graph.node or not any(entry.domain in ("", "ai.onnx") for entry in model.opset_import):
        raise BadInputError(
            path, "no nodes or no operator set", "an ONNX network", "copy it again: it may be cut short"
        )
    return model


def _load_external(model: onnx.ModelProto, path: Path) -> None:
    for tensor in _external_tensors(model):
        file = _external_file(tensor, path)
        try:
            external_data_helper.load_external_data_for_tensor(tensor, str(path.parent.resolve()))
        except (OSError, ValueError, onnx.checker.ValidationError) as error:
            raise BadInputError(path, f"tensor {tensor.name!r} in {file}: {reason(error)}", "readable data") from error
        tensor.data_location = TensorProto.DEFAULT
        del tensor.external_data[:]


def _external_file(tensor: TensorProto, path: Path) -> Path:
    """The file that holds the data of `tensor`, of the network in `path`. Raises BadInputError when it may not be."""
    folder = path.parent.resolve()
    entry = {pair.key: pair.value for pair in tensor.external_data}
    file: Path = (folder / entry.get("location", "")).resolve()
    if folder not in file.parents:
        raise BadInputError(path, f"tensor {tensor.name!r} kept in {file}", f"data inside {folder}", "move it there")
    if not file.is_file() or file.stat().st_size > MAX_BYTES:
        raise BadInputError(path, f"tensor {tensor.name!r} kept in {file}", "a file of the network's folder")
    return file


def _external_tensors(model: onnx.ModelProto) -> list[TensorProto]:
    return [tensor for tensor in _tensors(model) if tensor.data_location == TensorProto.EXTERNAL]


def _tensors(model: onnx.ModelProto) -> Iterator[TensorProto]:
    yield from model.graph.initializer
    for node in model.graph.node:
        for attribute in node.attribute:
            if attribute.HasField("t"):
                yield attribute.t
            yield from attribute.tensors
