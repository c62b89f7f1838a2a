"""Changes to files: bytes, words of a text, nodes of a JSON document, arrays of an archive, parts of a network.

Rule: a change is a pure function of the content and of a `random.Random`, so that a number finds it again.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import re
import warnings
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

#: Words that numbers are exchanged for.
WORDS = (
    *("nan", "inf", "-inf", "-1", "0", "-0.0", "1e309", "1e-320", "99999999999999999999", "1" * 400, "9" * 5000, "1_0"),
    *("", "--", "1,5", "True", "null", "[" * 5000, "{", '"', "#", "\0", "é", "١٢", "1e5", "-1e5", "2147483648", "1e18"),
)
NODES: tuple[Any, ...] = (None, True, -1, 0, 1e308, float("nan"), float("inf"), "", "x", [], {}, [[]], {"a": 1}, 10**30)
DTYPES = ("f2", "f4", ">f8", "i1", "u8", "?", "c16", "S3", "U2", "M8[s]", "O", "i4,f8", "V4")
VALUES = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e30, 1e308, 5e-324, 63.0, 100.0, 2.0**31)
NUMBER = re.compile(rb"[-+]?\d[\d.eE+-]*")


def mutated(content: bytes, ending: str, random: Random, others: tuple[bytes, ...] = ()) -> bytes:
    """`content` of a file with `ending`, after one to three changes. `others`: contents from which pieces may come."""
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        content = random.choice(CHANGES.get(ending, (change_bytes,)))(content, random)
        if others and random.random() < 0.05:
            content = _spliced(content, random.choice(others), random)
    return content


def change_bytes(content: bytes, random: Random) -> bytes:
    """Cut off, turned, deleted, doubled, exchanged or inserted bytes."""
    if not content:
        return bytes([random.randrange(256)])
    start = random.randrange(len(content))
    stop = min(len(content), start + random.choice((1, 1, 2, 4, 16, 256)))
    piece = content[start:stop]
    new = random.choice(
        (
            content[:start],
            content[:start] + bytes(byte ^ (1 << random.randrange(8)) for byte in piece) + content[stop:],
            content[:start] + random.randbytes(len(piece)) + content[stop:],
            content[:start] + bytes([random.choice((0, 255))]) * len(piece) + content[stop:],
            content[:start] + content[stop:],
            content[:stop] + piece * random.choice((1, 2, 50)) + content[stop:],
            content[:start] + random.randbytes(random.choice((1, 8, 64))) + content[start:],
        )
    )
    return new


def _spliced(content: bytes, other: bytes, random: Random) -> bytes:
    cut = random.randrange(len(content) + 1)
    begin = random.randrange(len(other) + 1)
    return content[:cut] + other[begin : begin + random.choice((8, 100, 10_000))]


def change_number(content: bytes, random: Random) -> bytes:
    """A number of a text becomes another word, in one place or from one place on."""
    found = list(NUMBER.finditer(content[:1_000_000]))
    if not found:
        return change_bytes(content, random)
    word = random.choice(WORDS).encode()
    first = random.randrange(len(found))
    chosen = found[first : first + random.choice((1, 1, 1, 3, 1000))]
    pieces, end = [], 0
    for match in chosen:
        pieces += [content[end : match.start()], word]
        end = match.end()
    return b"".join(pieces) + content[end:]


def change_lines(content: bytes, random: Random) -> bytes:
    """Lines of a text are left out, doubled, exchanged, joined, or their columns are exchanged."""
    lines = content.splitlines()
    if len(lines) < 2:
        return change_bytes(content, random)
    i, j = random.randrange(len(lines)), random.randrange(len(lines))
    kind = random.randrange(6)
    if kind == 0:
        del lines[i : i + random.choice((1, 1, 3))]
    elif kind == 1:
        lines[i:i] = lines[j : j + 5] * random.choice((1, 100))
    elif kind == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif kind == 3:
        lines[i : i + 2] = [b" ".join(lines[i : i + 2])]
    else:
        lines = _columns_exchanged(lines, random, everywhere=kind == 4)
    return random.choice((b"\n", b"\n", b"\r\n", b"\r")).join(lines)


def _columns_exchanged(lines: list[bytes], random: Random, everywhere: bool) -> list[bytes]:
    a, b, only = random.randrange(14), random.randrange(14), random.randrange(len(lines))
    new = []
    for number, line in enumerate(lines):
        words = line.split()
        if max(a, b) < len(words) and (everywhere or number == only):
            words[a], words[b] = words[b], words[a]
            line = b" ".join(words)
        new.append(line)
    return new


def change_encoding(content: bytes, random: Random) -> bytes:
    """The same text in another encoding."""
    text = content.decode("utf-8", errors="replace")
    return text.encode(random.choice(("utf-16", "utf-16-le", "utf-32", "utf-8-sig", "utf-7")))


def change_json(content: bytes, random: Random) -> bytes:
    """A node of a document becomes another one, is left out, doubled or nested deeply."""
    try:
        document = json.loads(content)
    except (ValueError, RecursionError):
        return change_bytes(content, random)
    places = list(_places(document))
    if not places:
        return change_bytes(content, random)
    holder, key = random.choice(places)
    kind = random.randrange(5)
    if kind == 0 and isinstance(holder, dict):
        del holder[key]
    elif kind == 1 and isinstance(holder, list):
        holder[key:key] = [holder[key]] * random.choice((1, 3))
    elif kind == 2:
        return json.dumps(document).replace(json.dumps(holder[key]), "[" * 100_000, 1).encode()
    else:
        holder[key] = random.choice(NODES)
    return json.dumps(document).encode()


def _places(node: Any) -> list[tuple[Any, Any]]:
    """Every (holder, key or index) in a document."""
    found: list[tuple[Any, Any]] = []
    waiting = [node]
    while waiting and len(found) < 5000:
        holder = waiting.pop()
        keys = list(holder) if isinstance(holder, dict) else range(len(holder)) if isinstance(holder, list) else ()
        for key in keys:
            found.append((holder, key))
            waiting.append(holder[key])
    return found


def change_array(content: bytes, random: Random) -> bytes:
    """The array of a `.npy` file with another type, shape or values."""
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception:  # whatever NumPy raises of a file that was changed before
        return change_bytes(content, random)
    return _saved(_other_array(array, random))


def change_arrays(content: bytes, random: Random) -> bytes:
    """An array of a `.npz` file with another type, shape or values, or left out, renamed, or a new one."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = dict(archive)
    except Exception:  # whatever NumPy raises of a file that was changed before
        return change_bytes(content, random)
    if not arrays:
        return change_bytes(content, random)
    name = random.choice(sorted(arrays))
    kind = random.randrange(8)
    if kind == 0:
        del arrays[name]
    elif kind == 1:
        arrays[random.choice(sorted(arrays))] = arrays[name]
    elif kind == 2:
        arrays[random.choice(("poses", "trans", "betas", "x", "global_orient", "fps"))] = arrays[name]
    else:
        arrays[name] = _other_array(arrays[name], random)
    file = io.BytesIO()
    with warnings.catch_warnings(action="ignore"):
        save: Any = random.choice((np.savez, np.savez_compressed))
        save(file, **arrays)
    return file.getvalue()


def change_pickle(_content: bytes, random: Random) -> bytes:
    """The pickle of a dict of which an array is another one, by any protocol; it may hold what no motion has."""
    arrays: dict[str, Any] = {"smpl_poses": np.zeros((4, 72)), "smpl_trans": np.ones((4, 3)), "smpl_scaling": [90.0]}
    name = random.choice(sorted(arrays))
    other = _other_array(np.asarray(arrays[name]), random)
    arrays[name] = random.choice((other, other, *NODES, {"poses": other}, [other], {1, 2}, print, os.getcwd))
    return pickle.dumps(arrays, protocol=random.randrange(pickle.HIGHEST_PROTOCOL + 1))


def _saved(array: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def _other_array(array: NDArray[Any], random: Random) -> NDArray[Any]:
    if array.dtype.kind not in "fiub":
        return array
    kind = random.randrange(3)
    with np.errstate(all="ignore"):
        if kind == 0:
            return _of_type(array, random.choice(DTYPES))
        if kind == 1:
            return _of_shape(array, random)
        values = array.astype(np.float64).ravel()
        if values.size:
            first = random.randrange(values.size)
            values[first : first + random.choice((1, 1, 10, values.size))] = random.choice(VALUES)
        return values.reshape(array.shape).astype(array.dtype if random.random() < 0.5 else np.float64)


def _of_type(array: NDArray[Any], dtype: str) -> NDArray[Any]:
    with warnings.catch_warnings(action="ignore"):
        try:
            return array.astype(dtype)
        except (TypeError, ValueError):
            return np.zeros(array.shape, dtype)


def _of_shape(array: NDArray[Any], random: Random) -> NDArray[Any]:
    flat, array = array.ravel(), np.atleast_1d(array)
    return random.choice(
        (
            array.T,
            flat,
            array[None],
            array[..., None],
            array[:0],
            array[..., :-1],
            array[:1],
            np.concatenate([flat, flat])[: flat.size + 1],
            np.zeros((0,)),
            np.array(1.0),
            np.zeros((2,) * random.choice((4, 20))) if random.random() < 0.5 else np.zeros((3, 0, 3)),
        )
    )


def change_network(content: bytes, random: Random) -> bytes:
    """A network without one of its nodes or tensors, or with other names, types, shapes or numbers."""
    try:
        model = onnx.load_model_from_string(content)
    except (DecodeError, ValueError):
        return change_bytes(content, random)
    graph = model.graph
    for listed in random.sample((graph.node, graph.initializer, graph.input, graph.output), 4):
        if listed:
            entry = random.choice(list(listed))
            break
    else:
        return change_bytes(content, random)
    kind = random.randrange(5)
    if kind == 0:
        listed.remove(entry)
    elif kind == 1:
        listed.append(entry)
    elif kind == 2:
        entry.name = random.choice(("", "bytes", "rgba", "w1", "é" * 3))
    else:
        part = entry.SerializeToString()
        return content.replace(part, change_bytes(part, random), 1)
    return bytes(model.SerializeToString())


_TEXT = (change_bytes, change_number, change_number, change_lines, change_lines, change_encoding)
#: Ending of a file -> what is done to it.
CHANGES: dict[str, tuple[Callable[[bytes, Random], bytes], ...]] = {
    **dict.fromkeys((".bvh", ".txt", ".csv", ".toml"), _TEXT),
    ".json": (*_TEXT, change_json, change_json, change_json),
    ".npy": (change_bytes, change_array, change_array),
    ".npz": (change_bytes, change_arrays, change_arrays, change_arrays),
    ".onnx": (change_bytes, change_bytes, change_network),
    ".pkl": (change_bytes, change_pickle),
}
