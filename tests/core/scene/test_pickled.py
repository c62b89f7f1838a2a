"""Pickles read without running them: what Python and NumPy write comes back; nothing that a file wants done is done."""

from __future__ import annotations

import collections
import io
import pickle
import struct
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilane.scene.motion import pickled
from trilane.scene.motion.pickled import Foreign, StoredArray, values_of
from trilane.scene.motion.stored import array_of, tables_in
from trilane.unexpected_value import UnexpectedValue

ARRAYS = {
    "double": np.arange(6.0).reshape(2, 3),
    "single": np.arange(3, dtype=np.float32),
    "half": np.array([0.5, -2], dtype=np.float16),
    "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "turned": np.arange(6.0).reshape(2, 3).T,
    "big": np.arange(4, dtype=">i4"),
    "bytes": np.array([0, 255], dtype=np.uint8),
    "flags": np.array([True, False]),
    "one": np.array(5, dtype=np.int64),
    "none": np.zeros((0, 3)),
}


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_what_is_written_comes_back(protocol: int) -> None:
    again = values_of(pickle.dumps(ARRAYS, protocol))
    assert set(again) == set(ARRAYS)
    for name, array in ARRAYS.items():
        found = array_of(again[name])
        assert found is not None and found.dtype == array.dtype
        assert np.array_equal(found, array)
    values = {"a": [1, 2.5, "x", None, True, (3, b"y")], "n": -(2**70), "o": collections.OrderedDict(k=1)}
    assert values_of(pickle.dumps(values, protocol)) == {**values, "o": {"k": 1}}


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_numbers_of_numpy_are_arrays_of_one(protocol: int) -> None:
    again = array_of(values_of(pickle.dumps(np.float32(2.5), protocol)))
    assert again is not None and (again.shape, again.item()) == ((), 2.5)


def test_what_python_2_wrote() -> None:
    """Its text is bytes; this is protocol 2 of `{'a': numpy.array([1., 2.])}` from Python 2 and NumPy 1."""
    raw = np.array([1.0, 2.0]).tobytes()
    data = (
        b"\x80\x02}q\x00U\x01acnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        b"(K\x01K\x02\x85cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
        b"\x89U" + bytes([len(raw)]) + raw + b"tbs."
    )
    assert pickle.loads(data, encoding="latin1")["a"].tolist() == [1, 2]  # noqa: S301 - the test's own
    array = array_of(values_of(data)["a"])
    assert array is not None and array.tolist() == [1, 2]


def test_keys_are_text() -> None:
    """Numbers become text; a key of anything else is left out with its value."""
    assert values_of(pickle.dumps({0: "a", -5: "b", (1, 2): "c", "d": "e", 2**64: "f"})) == {
        "0": "a",
        "-5": "b",
        "d": "e",
    }


# --- what is not built ---


class Doer:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


class Ordinary:
    def __init__(self) -> None:
        self.inside = 1


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_nothing_is_run_or_built_and_the_rest_is_read(tmp_path: Path, protocol: int) -> None:
    made = tmp_path / "made"
    again = values_of(pickle.dumps({"do": Doer(made), "own": Ordinary(), "a": np.ones(2)}, protocol))
    assert not made.exists()
    assert isinstance(again["do"], Foreign)
    assert again["own"] == Foreign(f"{__name__}.Ordinary")
    array = array_of(again["a"])
    assert array is not None and array.tolist() == [1, 1]
    pickle.loads(pickle.dumps(Doer(made), protocol))  # noqa: S301 - shows that it would have been made
    assert made.exists()


def test_arrays_of_objects_and_their_kind() -> None:
    table = {"poses": np.zeros((2, 72))}
    again = values_of(pickle.dumps(np.array(table, dtype=object)))
    assert isinstance(again, StoredArray)
    assert [name for name, _ in tables_in(again)] == [""]
    assert array_of(again) is None
    structured = values_of_error(pickle.dumps(np.zeros(2, dtype=[("a", "f8")])))
    assert "structured" in structured
    assert "an array of c16" in values_of_error(pickle.dumps(np.zeros(2, dtype=complex)))
    assert "an array of U3" in values_of_error(pickle.dumps(np.array(["abc"])))


def values_of_error(data: bytes) -> str:
    with pytest.raises(UnexpectedValue) as raised:
        values_of(data)
    return str(raised.value)


# --- attacks ---


def array_state(shape: bytes, raw: bytes) -> bytes:
    """A pickle of an array whose state has this pickled shape and these bytes."""
    make = b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
    kind = b"cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R"
    return make + b"(K\x01" + shape + kind + b"\x89" + b"T" + struct.pack("<i", len(raw)) + raw + b"tb."


BAD = {
    "a shape beyond its bytes": array_state(b"\x8a\x05\0\0\0\0\x01\x85", b"12345678"),
    "a shape below zero": array_state(b"J\xff\xff\xff\xff\x85", b"12345678"),
    "a shape of text": array_state(b"U\x01a\x85", b"12345678"),
    "33 sides": array_state(b"(" + b"K\x01" * 33 + b"t", b"12345678"),
    "bytes beyond the file": b"\x80\x04\x8e" + struct.pack("<Q", 1 << 60) + b"x.",
    "text beyond the file": b"\x80\x04\x8d" + struct.pack("<Q", 1 << 60) + b"x.",
    "an int beyond the file": b"\x80\x02\x8b\xff\xff\xff\x7f1.",
    "digits without end": b"L" + b"9" * 5000 + b"L\n.",
    "a place far off in the memo": b"Np" + b"9" * 12 + b"\n.",
    "a place that was not filled": b"h\x05.",
    "an empty stack": b"0.",
    "no mark": b"t.",
    "no end": b"N",
    "nothing": b"",
    "an argument that is no tuple": b"cos\nsystem\nU\x01aR.",
    "a state for a number": b"K\x01Nb.",
    "items for a number": b"K\x01K\x02a.",
    "a key without a value": b"}(K\x01u.",
    "a name without end": b"c" + b"a" * 300 + b"\nb\n.",
    "a persistent id": b"Pa\n.",
    "an instance": b"(ios\nsystem\n.",
    "an extension": b"\x82\x01.",
    "joblib's": b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n.",
    "text": b"not a pickle",
    "surrogates": b"\x80\x02X\x03\0\0\0\xed\xa0\x80c\xed\n\n.",
    "bytes in an encoding": b"c_codecs\nencode\n(U\x01aU\x05utf16tR.",
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_pickle_is_refused_in_one_sentence(case: str) -> None:
    sentence = values_of_error(BAD[case])
    assert "\n" not in sentence and len(sentence) < 500
    sentence.encode("ascii")


def repeated(head: bytes, each: bytes, times: int) -> bytes:
    return b"\x80\x02" + head + each * times + b"N."


@pytest.fixture
def memory() -> Iterator[None]:
    tracemalloc.start()
    yield
    tracemalloc.stop()


@pytest.mark.usefixtures("memory")
def test_a_value_that_is_used_again_costs_nothing_again() -> None:
    """A megabyte of text that is made bytes, an array, a name or a dict 500 times; each would be 500 MB of copies."""
    text = b"a" * (1 << 20)
    held = b"X" + struct.pack("<i", len(text)) + text + b"q\x02"
    numbers = b"](" + b"K\x01" * 1000 + b"eq\x02"
    kind = b"cnumpy\ndtype\nU\x02u1K\x00K\x01\x87Rq\x03"
    make = b"cnumpy.core.multiarray\n_reconstruct\nq\x04cnumpy\nndarray\nq\x05"
    objects = b"cnumpy\ndtype\nU\x01OK\x00K\x01\x87Rq\x03"
    blank = b"h\x04h\x05K\x00\x85U\x01b\x87R"
    for data in (
        repeated(b"c_codecs\nencode\nq\x01" + held, b"h\x01h\x02U\x06latin1\x86R", 500),
        repeated(held + kind + make, blank + b"(K\x01J\0\0\x10\0\x85h\x03\x89h\x02tb", 500),
        repeated(numbers + objects + make, blank + b"(K\x01M\xe8\x03\x85h\x03\x89h\x02tb", 5000),
    ):
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        assert values_of(data) is None
        assert tracemalloc.get_traced_memory()[1] - before < 20e6


def test_the_same_items_in_many_dicts_and_too_many_values_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = b"](" + b"U\x01aK\x01\x86" * 100 + b"eq\x02"
    data = repeated(b"ccollections\nOrderedDict\nq\x01" + pairs, b"h\x01h\x02\x85R", 50)
    assert values_of(data) is None
    monkeypatch.setattr(pickled, "MAX_OPERATIONS", 4999)
    assert "the same items in many dicts" in values_of_error(data)
    monkeypatch.setattr(pickled, "MAX_OPERATIONS", 10)
    assert values_of(pickle.dumps([1, 2, 3], 2)) == [1, 2, 3]
    assert "more than 10 values" in values_of_error(pickle.dumps([1] * 20, 2))
    monkeypatch.setattr(pickled, "MAX_BYTES", 20)
    assert "at most 20" in values_of_error(pickle.dumps("x" * 20))


def test_values_that_hold_themselves_and_doubled_lists_are_searched_in_no_time() -> None:
    """`a` holds itself; the list is doubled 60 times, so it has 2**60 ends."""
    own: dict[str, Any] = {"poses": np.zeros((1, 72))}
    own["own"] = own
    doubled: Any = own
    for _ in range(60):
        doubled = [doubled, doubled]
    again = values_of(pickle.dumps({"own": own, "doubled": doubled}))
    assert [name for name, _ in tables_in(again)] == ["", "own"]
    assert array_of(again["doubled"]) is None


def test_depth_is_no_recursion() -> None:
    deep = values_of(b"]" * 100_000 + b"a" * 99_999 + b".")
    assert isinstance(deep, list)
    assert list(tables_in(deep)) == []


@given(st.binary(max_size=80), st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=8))
@settings(max_examples=150)
def test_damaged_pickles_are_read_or_refused(tail: bytes, changes: list[tuple[int, int]]) -> None:
    file = io.BytesIO()
    pickle.dump({"poses": np.zeros((1, 2)), "k": [1, ("a", None)], "o": collections.OrderedDict(a=1)}, file, 2)
    content = bytearray(file.getvalue())
    for place, value in changes:
        content[place % len(content)] = value
    for data in (bytes(content), tail, bytes(content[: len(tail)]) + tail):
        try:
            list(tables_in(values_of(data)))
        except UnexpectedValue:
            continue
