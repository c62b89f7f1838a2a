"""Reads the plain values and arrays of a Python pickle without executing anything in it.

Rule: only None, numbers, text, bytes, lists, tuples, dicts and NumPy arrays of numbers are built. Nothing else is
imported, called or built. `pickletools` splits the file into operations. Only the operations in the tables below are
executed. Any other object in the file becomes a `Foreign`, which only holds the object's name. Any other operation ends
the reading.

The size of a file limits the memory that it can use. Text and bytes are pieces of the file. An array is a view of bytes
whose number must match its shape. The number of operations is limited. Keys of dicts are text, whose hash a file cannot
predict. Integer keys become text, and other keys are left out. Values may contain themselves, so a search in them must
limit its depth.

The format: https://docs.python.org/3/library/pickle.html, `pickletools`, PEP 3154 and PEP 574. What NumPy writes:
`numpy.ndarray.__reduce__`, `__setstate__` and `numpy.dtype.__setstate__`.
"""

from __future__ import annotations

import math
import pickletools
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.files import ARRAYS
from trilane.unexpected_value import UnexpectedValue

MAX_BYTES = 256 << 20
MAX_OPERATIONS = 2_000_000
MAX_INDEX = 1 << 32
MAX_NAME = 200
MAX_SIDES = 32
#: Names of numeric dtypes as NumPy writes them: byte order, kind, and number of bytes.
_NUMBERS = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248])")
_ORDERS = ("<", ">", "|", "=")


@dataclass(frozen=True)
class Foreign:
    """An object that is not built. `name`: name of its class or function, module first."""

    name: str


@dataclass
class StoredArray:
    """An array of the file.

    `values`: the array, or a list of the items of an array of objects; None until the state is read.
    """

    values: NDArray[Any] | list[Any] | None = None


@dataclass
class _Kind:
    """A `numpy.dtype`. `code`: name such as `f8`, "" if it is not a plain number. `order`: byte order."""

    code: str
    order: str = "|"

    def dtype(self) -> np.dtype[Any]:
        name = self.code if self.order == "|" else self.order + self.code.lstrip("".join(_ORDERS))
        if not _NUMBERS.fullmatch(name):
            raise UnexpectedValue(f"an array of {printable(self.code) or 'a structured type'}", "numbers", ARRAYS)
        return np.dtype(name)


#: A mark on the stack, above which a run of values begins.
_MARK = object()


@dataclass
class _Reader:
    """The state of reading.

    `stack`, `memo`: as the format defines them.
    `encoded`: text and its bytes, by the `id` of a text that stands for bytes.
    `paired`: number of (key, value) pairs from which dicts were built.
    """

    stack: list[Any] = field(default_factory=list)
    memo: dict[int, Any] = field(default_factory=dict)
    encoded: dict[int, tuple[str, bytes]] = field(default_factory=dict)
    paired: int = 0

    def since_mark(self) -> list[Any]:
        """Remove the values above the last mark, and the mark, from the stack. Return the values."""
        values: list[Any] = []
        while (value := self.stack.pop()) is not _MARK:
            values.append(value)
        return values[::-1]

    def bytes_of(self, raw: Any) -> bytes:
        """Return `raw` as bytes. Python 2 and the protocols 0 to 2 write bytes as a text, one character for each byte.

        The same text object always gives the same bytes object.
        """
        if isinstance(raw, str):
            known = self.encoded.get(id(raw))
            if known is None:
                known = self.encoded[id(raw)] = (raw, raw.encode("latin-1"))
            return known[1]
        return bytes(wanted(raw, bytes, "bytes"))


def values_of(data: bytes) -> Any:
    """Return the content of the pickle `data`; its arrays are StoredArray.

    Raises UnexpectedValue when the pickle is damaged or too large, or has an operation that plain values do not need.
    """
    if len(data) > MAX_BYTES:
        raise UnexpectedValue(f"{len(data)} bytes", f"at most {MAX_BYTES}", ARRAYS)
    try:
        with warnings.catch_warnings(action="ignore", category=DeprecationWarning):  # of escapes in text of protocol 0
            return _run(data)
    except (ValueError, OverflowError, IndexError, KeyError, TypeError, RecursionError) as error:
        if isinstance(error, UnexpectedValue):
            raise
        found = f"no readable pickle ({printable(str(error))})"
        raise UnexpectedValue(found, "the arrays of a motion", ARRAYS) from error


def _run(data: bytes) -> Any:
    """Return the value that the operations of `data` make. Raises UnexpectedValue, and Python's own errors."""
    reader = _Reader()
    for count, (operation, value, _) in enumerate(pickletools.genops(data)):
        if operation.name == "STOP":
            return reader.stack.pop()
        if count >= MAX_OPERATIONS:
            raise UnexpectedValue(f"more than {MAX_OPERATIONS} values", "arrays of numbers", ARRAYS)
        operate = _OPERATIONS.get(operation.name)
        if operate is None:
            expected = "a pickle of numbers, text, lists, dicts and arrays"
            raise UnexpectedValue(f"the operation {operation.name}", expected, ARRAYS)
        operate(reader, value)
    raise UnexpectedValue("no readable pickle (it has no end)", "the arrays of a motion", ARRAYS)


def printable(text: str) -> str:
    """Return `text` in ASCII, cut to MAX_NAME letters, so that every console can show it."""
    return ascii(text[:MAX_NAME])[1:-1]


def wanted(value: Any, kind: type, what: str) -> Any:
    """Return `value` if its type is `kind`, otherwise raise TypeError. `what`: expected value in words."""
    if type(value) is not kind:
        found = "nothing" if value is None else type(value).__name__
        raise TypeError(f"{found} in place of {what}")
    return value


# --- operations ---


def _push(reader: _Reader, value: Any) -> None:
    reader.stack.append(value)


def _make(make: Callable[[], Any]) -> Callable[[_Reader, Any], None]:
    return lambda reader, _value: reader.stack.append(make())


def _tuple_of(count: int) -> Callable[[_Reader, Any], None]:
    def tuple_of(reader: _Reader, _value: Any) -> None:
        reader.stack[-count:] = [tuple(reader.stack[-count:])]

    return tuple_of


def _gather(make: Callable[[list[Any]], Any]) -> Callable[[_Reader, Any], None]:
    return lambda reader, _value: reader.stack.append(make(reader.since_mark()))


def _extend(reader: _Reader, items: list[Any]) -> None:
    if not isinstance(reader.stack[-1], Foreign):
        wanted(reader.stack[-1], list, "a list").extend(items)


def _set_item(reader: _Reader, _value: Any) -> None:
    value, key = reader.stack.pop(), reader.stack.pop()
    _update(reader, [key, value])


def _update(reader: _Reader, items: list[Any]) -> None:
    if not isinstance(reader.stack[-1], Foreign):
        wanted(reader.stack[-1], dict, "a dict").update(_dict_of(items))


def _dict_of(items: list[Any]) -> dict[str, Any]:
    """Return a dict of `items`, alternating keys and values. Integer keys become text; other keys are left out."""
    keys = ((str(key) if type(key) is int and abs(key) < 1 << 64 else key) for key in items[::2])
    return {key: value for key, value in zip(keys, items[1::2], strict=True) if type(key) is str}


def _put(reader: _Reader, value: Any) -> None:
    if not 0 <= value < MAX_INDEX:
        raise ValueError("an index of a value that no file needs")
    reader.memo[value] = reader.stack[-1]


def _global(reader: _Reader, value: Any) -> None:
    module, _, name = value.partition(" ")
    reader.stack.append(_named(module, name))


def _stack_global(reader: _Reader, _value: Any) -> None:
    name, module = reader.stack.pop(), reader.stack.pop()
    reader.stack.append(_named(wanted(module, str, "a module's name"), wanted(name, str, "a name")))


def _named(module: str, name: str) -> Foreign:
    if len(module) + len(name) > MAX_NAME:
        raise ValueError("a name that no class has")
    if module.partition(".")[0] == "joblib":
        raise UnexpectedValue("a file of joblib, which mixes arrays into the pickle", "a plain pickle", ARRAYS)
    return Foreign(f"{module.replace('numpy.core.', 'numpy._core.', 1)}.{name}")


def _reduce(reader: _Reader, _value: Any) -> None:
    arguments = wanted(reader.stack.pop(), tuple, "arguments")
    called = reader.stack.pop()
    name = called.name if isinstance(called, Foreign) else ""
    build = _BUILDERS.get(name)
    reader.stack.append(Foreign(name) if build is None else build(reader, arguments))


def _new_object(reader: _Reader, _value: Any) -> None:
    reader.stack.pop()
    reader.stack.append(wanted(reader.stack.pop(), Foreign, "a class"))


def _build(reader: _Reader, _value: Any) -> None:
    state = reader.stack.pop()
    target = reader.stack[-1]
    if isinstance(target, StoredArray):
        target.values = _array(reader, *wanted(state, tuple, "an array's state")[-4:])
    elif isinstance(target, _Kind):
        _, order, *structured = wanted(state, tuple, "a type's state")[:5]
        target.order = order if order in _ORDERS else ""
        target.code = target.code if structured == [None, None, None] else ""
    elif not isinstance(target, Foreign):
        raise TypeError("a state for a plain value")


# --- what NumPy and the standard library have built ---


def _array(reader: _Reader, shape: Any, kind: Any, fortran: Any, raw: Any) -> NDArray[Any] | list[Any]:
    """Return the array that NumPy stored as `shape`, dtype `kind`, order `fortran` and bytes `raw`.

    For an array of objects, `raw` is the list of items, and the result is this list.
    Raises ValueError unless `raw` has exactly the bytes that `shape` and `kind` require.
    """
    sides = wanted(shape, tuple, "a shape")
    if len(sides) > MAX_SIDES or any(type(side) is not int or side < 0 for side in sides):
        raise ValueError("a shape that none can have")
    kind = wanted(kind, _Kind, "a type")
    if kind.code.startswith("O"):
        return wanted(raw, list, "objects")  # type: ignore[no-any-return]
    dtype, data = kind.dtype(), reader.bytes_of(raw)
    if math.prod(sides) * dtype.itemsize != len(data):
        raise ValueError(f"{len(data)} bytes for an array of shape {sides}")
    return np.frombuffer(data, dtype).reshape(sides, order="F" if fortran else "C")


def _blank_array(_reader: _Reader, arguments: tuple[Any, ...]) -> Any:
    kind = arguments[0]
    return StoredArray() if kind == Foreign("numpy.ndarray") else wanted(kind, Foreign, "a class")


def _kind(_reader: _Reader, arguments: tuple[Any, ...]) -> _Kind:
    code = wanted(arguments[0], str, "the name of a type")
    if len(code) > MAX_NAME:
        raise ValueError("a type that no array has")
    return _Kind(code)


def _scalar(reader: _Reader, arguments: tuple[Any, ...]) -> StoredArray:
    kind, raw = arguments
    return StoredArray(_array(reader, (), kind, False, raw))


def _from_buffer(reader: _Reader, arguments: tuple[Any, ...]) -> StoredArray:
    raw, kind, shape, order = arguments
    return StoredArray(_array(reader, shape, kind, order == "F", raw))


def _encoded(reader: _Reader, arguments: tuple[Any, ...]) -> bytes:
    text, encoding = arguments
    if encoding not in ("latin1", "latin-1"):
        raise ValueError("bytes in an unknown encoding")
    return reader.bytes_of(wanted(text, str, "text"))


def _no_bytes(_reader: _Reader, arguments: tuple[Any, ...]) -> bytes:
    """Return empty bytes, for the call `bytes()` that older protocols write."""
    if arguments:
        raise ValueError("bytes of something")
    return b""


def _dict(reader: _Reader, arguments: tuple[Any, ...]) -> dict[str, Any]:
    pairs = arguments[0] if arguments and type(arguments[0]) is list else []
    reader.paired += len(pairs)
    if reader.paired > MAX_OPERATIONS:
        raise ValueError("the same items in many dicts")
    return _dict_of([item for pair in pairs for item in pair[:2]])


_BUILDERS: dict[str, Callable[[_Reader, tuple[Any, ...]], Any]] = {
    "numpy._core.multiarray._reconstruct": _blank_array,
    "numpy._core.multiarray.scalar": _scalar,
    "numpy._core.numeric._frombuffer": _from_buffer,
    "numpy.dtype": _kind,
    "_codecs.encode": _encoded,
    "builtins.bytes": _no_bytes,
    "__builtin__.bytes": _no_bytes,
    "collections.OrderedDict": _dict,
    "collections.defaultdict": _dict,
    "copyreg._reconstructor": lambda _reader, arguments: wanted(arguments[0], Foreign, "a class"),
    "copy_reg._reconstructor": lambda _reader, arguments: wanted(arguments[0], Foreign, "a class"),
}

_OPERATIONS: dict[str, Callable[[_Reader, Any], object]] = {
    **dict.fromkeys(("PROTO", "FRAME"), lambda _reader, _value: None),
    **dict.fromkeys(("INT", "LONG", "BININT", "BININT1", "BININT2", "LONG1", "LONG4", "FLOAT", "BINFLOAT"), _push),
    **dict.fromkeys(("STRING", "BINSTRING", "SHORT_BINSTRING"), _push),
    **dict.fromkeys(("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"), _push),
    **dict.fromkeys(
        ("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
        lambda reader, value: reader.stack.append(bytes(value)),
    ),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT"), _put),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), lambda reader, value: reader.stack.append(reader.memo[value])),
    "MEMOIZE": lambda reader, _value: _put(reader, len(reader.memo)),
    "NONE": _make(lambda: None),
    "NEWTRUE": _make(lambda: True),
    "NEWFALSE": _make(lambda: False),
    "MARK": _make(lambda: _MARK),
    "EMPTY_LIST": _make(list),
    "EMPTY_DICT": _make(dict),
    "EMPTY_TUPLE": _make(tuple),
    "LIST": _gather(list),
    "TUPLE": _gather(tuple),
    "DICT": _gather(_dict_of),
    "TUPLE1": _tuple_of(1),
    "TUPLE2": _tuple_of(2),
    "TUPLE3": _tuple_of(3),
    "APPEND": lambda reader, _value: _extend(reader, [reader.stack.pop()]),
    "APPENDS": lambda reader, _value: _extend(reader, reader.since_mark()),
    "SETITEM": _set_item,
    "SETITEMS": lambda reader, _value: _update(reader, reader.since_mark()),
    "POP": lambda reader, _value: reader.stack.pop(),
    "POP_MARK": lambda reader, _value: reader.since_mark(),
    "GLOBAL": _global,
    "STACK_GLOBAL": _stack_global,
    "REDUCE": _reduce,
    "NEWOBJ": _new_object,
    "BUILD": _build,
}
