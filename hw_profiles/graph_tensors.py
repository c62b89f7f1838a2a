"""Tensors that a file holds: whether their data is what their shape claims, and how their data is forgotten.

Rule: what is kept is small: sizes, axes and the like, from which shapes follow. Data that lies outside the file is
never opened.
"""

from __future__ import annotations

from math import prod
from pathlib import Path

from onnx import TensorProto

from trilane.unexpected_value import UnexpectedValue

MAX_TENSOR_BYTES = 1 << 30
#: Elements up to which a tensor keeps its data.
KEPT_ELEMENTS = 1024

_BITS = {
    **dict.fromkeys((TensorProto.FLOAT, TensorProto.INT32, TensorProto.UINT32), 32),
    **dict.fromkeys((TensorProto.UINT8, TensorProto.INT8, TensorProto.BOOL), 8),
    **dict.fromkeys((TensorProto.UINT16, TensorProto.INT16, TensorProto.FLOAT16, TensorProto.BFLOAT16), 16),
    **dict.fromkeys((TensorProto.INT64, TensorProto.UINT64, TensorProto.DOUBLE, TensorProto.COMPLEX64), 64),
    **dict.fromkeys((TensorProto.FLOAT8E4M3FN, TensorProto.FLOAT8E4M3FNUZ, TensorProto.FLOAT8E5M2), 8),
    **dict.fromkeys((TensorProto.FLOAT8E5M2FNUZ,), 8),
    **dict.fromkeys((TensorProto.UINT4, TensorProto.INT4, TensorProto.FLOAT4E2M1), 4),
    TensorProto.COMPLEX128: 128,
}
#: Types of which one element, or two, share an entry of the lists of numbers.
_FIELDS = ("float_data", "int32_data", "int64_data", "double_data", "uint64_data")


def type_name(kind: int) -> str:
    """Of an element, as ONNX writes it in small letters."""
    return str(TensorProto.DataType.Name(kind)).lower() if kind in TensorProto.DataType.values() else f"type {kind}"


def bytes_of(shape: tuple[int, ...], kind: int) -> int:
    """Size of a tensor. Raises UnexpectedValue when its elements are no numbers."""
    if kind not in _BITS:
        remedy = "leave the part of the graph that handles text to the program"
        raise UnexpectedValue(f"elements of type {type_name(kind)}", "numbers", remedy)
    return -(-prod(shape) * _BITS[kind] // 8)


def is_ordinary(shape: tuple[int, ...], kind: int) -> bool:
    """Whether a tensor is of numbers and not too large: what `check_size` lets pass."""
    return prod(shape) * _BITS.get(kind, 8 * MAX_TENSOR_BYTES + 1) <= 8 * MAX_TENSOR_BYTES


def check_size(shape: tuple[int, ...], kind: int, what: str) -> None:
    """Raises UnexpectedValue when a tensor is too large or its elements are no numbers.

    `shape`: of the tensor.
    `kind`: its ONNX element type.
    `what`: how the message calls it.
    """
    try:
        size = bytes_of(shape, kind)
    except UnexpectedValue as error:
        raise UnexpectedValue(f"{what} with {error.found}", error.expected, error.remedy) from None
    if size > MAX_TENSOR_BYTES:
        text = "x".join(map(str, shape))
        expected = f"at most {MAX_TENSOR_BYTES >> 30} GiB, more than any unit of a phone takes"
        raise UnexpectedValue(f"{what} of {text} {type_name(kind)}, {size / 2**30:.3g} GiB", expected)


def forget_data(tensor: TensorProto, folder: Path) -> None:
    """Check a tensor of a file, and drop its data unless it is small.

    `tensor`: is changed.
    `folder`: of the file.
    Raises UnexpectedValue when the data is not as long as the shape claims, or is kept outside the folder.
    """
    what = f"tensor {tensor.name!r}"
    shape = tuple(tensor.dims)
    if any(size < 0 for size in shape):
        raise UnexpectedValue(f"{what} of {'x'.join(map(str, shape))}", "sizes of 0 and more")
    if tensor.data_type == TensorProto.STRING:
        _forget(tensor)
        return
    check_size(shape, tensor.data_type, what)
    if tensor.data_location == TensorProto.EXTERNAL:
        _check_inside(tensor, folder)
        _forget(tensor)
        return
    _check_length(tensor, bytes_of(shape, tensor.data_type), what)
    if prod(shape) > KEPT_ELEMENTS:
        _forget(tensor)


def _check_length(tensor: TensorProto, claimed: int, what: str) -> None:
    if tensor.HasField("raw_data"):
        held, unit = len(tensor.raw_data), "bytes"
    else:
        held, unit = sum(len(getattr(tensor, field)) for field in _FIELDS), "numbers"
        claimed = _entries(tensor, claimed)
    if held != claimed:
        remedy = "copy or export it again: it may be cut short"
        raise UnexpectedValue(f"{what} with {held} {unit}", f"the {claimed} that its shape claims", remedy)


def _entries(tensor: TensorProto, size: int) -> int:
    """How many numbers the lists of a tensor of `size` bytes have: half-bytes share one, complex numbers have two."""
    bits = _BITS[tensor.data_type]
    pairs = tensor.data_type in (TensorProto.COMPLEX64, TensorProto.COMPLEX128)
    return size if bits < 8 else prod(tensor.dims) * (2 if pairs else 1)


def _check_inside(tensor: TensorProto, folder: Path) -> None:
    location = next((entry.value for entry in tensor.external_data if entry.key == "location"), "")
    try:
        inside = folder.resolve() in (folder / location).resolve().parents
    except (OSError, ValueError):
        inside = False
    if not inside:
        found = f"tensor {tensor.name!r} kept in {location!r}"
        raise UnexpectedValue(found, "data in the folder of the file", "move it there and save the file anew")


def _forget(tensor: TensorProto) -> None:
    """Leave name, type and shape."""
    bare = TensorProto(name=tensor.name, data_type=tensor.data_type, dims=tensor.dims)
    tensor.CopyFrom(bare)
