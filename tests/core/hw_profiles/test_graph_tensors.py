"""Tensors of a graph by hand: their sizes, how much data their shape claims, and which of them keep it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from trilane.hw_profiles.graph_checks import bytes_of, check_size, forget_data, is_ordinary, type_name
from trilane.unexpected_value import UnexpectedValue

BITS = {
    4: "UINT4 INT4 FLOAT4E2M1",
    8: "UINT8 INT8 BOOL FLOAT8E4M3FN FLOAT8E4M3FNUZ FLOAT8E5M2 FLOAT8E5M2FNUZ",
    16: "UINT16 INT16 FLOAT16 BFLOAT16",
    32: "FLOAT INT32 UINT32",
    64: "INT64 UINT64 DOUBLE COMPLEX64",
    128: "COMPLEX128",
}


def test_the_bytes_of_every_type() -> None:
    """Fifteen elements; seven of half a byte are four bytes."""
    for bits, names in BITS.items():
        for name in names.split():
            kind = getattr(TensorProto, name)
            assert bytes_of((5, 3), kind) == (15 * bits + 7) // 8, name
            assert type_name(kind) == name.lower()
    assert bytes_of((7,), TensorProto.INT4) == 4
    assert type_name(999) == "type 999"
    with pytest.raises(UnexpectedValue, match="elements of type string"):
        bytes_of((1,), TensorProto.STRING)


def test_a_tensor_may_have_a_gibibyte() -> None:
    side = 1 << 14
    assert is_ordinary((side, side), TensorProto.FLOAT)
    check_size((side, side), TensorProto.FLOAT, "it")
    assert not is_ordinary((side, side + 1), TensorProto.FLOAT)
    with pytest.raises(UnexpectedValue, match=r"it of 16384x16400 float, 1 GiB.*at most 1 GiB, more than any unit"):
        check_size((side, side + 16), TensorProto.FLOAT, "it")
    assert not is_ordinary((1,), TensorProto.STRING)
    assert is_ordinary((0,), TensorProto.STRING)


def test_small_tensors_keep_their_data(tmp_path: Path) -> None:
    for count, kept in ((1024, 4096), (1025, 0)):
        tensor = numpy_helper.from_array(np.zeros(count, np.float32), "t")
        forget_data(tensor, tmp_path)
        assert (len(tensor.raw_data), list(tensor.dims), tensor.name) == (kept, [count], "t")
        assert tensor.data_type == TensorProto.FLOAT


@pytest.mark.parametrize(
    ("kind", "field", "held", "claimed"),
    [
        (TensorProto.FLOAT, "float_data", 6, 6),
        (TensorProto.FLOAT, "float_data", 5, 6),
        (TensorProto.INT8, "int32_data", 6, 6),
        (TensorProto.FLOAT16, "int32_data", 6, 6),
        (TensorProto.INT64, "int64_data", 7, 6),
        (TensorProto.DOUBLE, "double_data", 6, 6),
        (TensorProto.UINT64, "uint64_data", 6, 6),
        (TensorProto.COMPLEX64, "float_data", 12, 12),
        (TensorProto.COMPLEX128, "double_data", 6, 12),
        (TensorProto.INT4, "int32_data", 3, 3),
        (TensorProto.UINT4, "int32_data", 6, 3),
    ],
)
def test_numbers_that_a_shape_claims(kind: int, field: str, held: int, claimed: int, tmp_path: Path) -> None:
    """Six elements: half-bytes share a number, complex ones have two."""
    tensor = TensorProto(name="t", data_type=kind, dims=(2, 3))
    getattr(tensor, field).extend([0] * held)
    if held == claimed:
        forget_data(tensor, tmp_path)
        assert len(getattr(tensor, field)) == held
    else:
        with pytest.raises(UnexpectedValue, match=rf"tensor 't' with {held} numbers, expected the {claimed} that its"):
            forget_data(tensor, tmp_path)


def test_texts_and_data_beside_the_file_are_forgotten(tmp_path: Path) -> None:
    words = helper.make_tensor("words", TensorProto.STRING, (2,), [b"a", b"b"])
    forget_data(words, tmp_path)
    assert (list(words.string_data), list(words.dims)) == ([], [2])
    beside = TensorProto(name="t", data_type=TensorProto.FLOAT, dims=(2,), data_location=TensorProto.EXTERNAL)
    beside.external_data.add(key="offset", value="../..")
    beside.external_data.add(key="location", value="sub/t.bin")
    forget_data(beside, tmp_path)
    assert not beside.external_data and list(beside.dims) == [2]
