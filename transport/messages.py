"""What units and scheduler say to each other. Rule: a fixed list of messages with typed fields; anything else is
refused, and never pickle.

On the wire: a byte that names the message, its integers of 64 bits, and then, as msgpack, the one field that is none
and not empty.
Whoever waits for a message has cold caches; what is all integers is read there in half the time that msgpack takes.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple, get_origin, get_type_hints

import msgpack

MAX_BYTES = 4096  # a pipe takes no more at once (PIPE_BUF of pipe(7))
MAX_TEXT = 2000  # bytes of UTF-8


class MessageError(ValueError):
    """Bytes that are not one of the messages."""


class RunJob(NamedTuple):
    """To a unit: do one of its stages, counted as UnitSpec has them, for one frame."""

    id: int
    stage: int
    frame: int
    slot_in: int
    slot_out: int
    epoch: int


class Isolate(NamedTuple):
    """To a unit: do this job and answer with its duration; nothing is noted of the frame."""

    stage: int
    frame: int
    slot_in: int
    slot_out: int


class Ping(NamedTuple):
    """To a unit that has nothing to do: say that you are alive."""


class Close(NamedTuple):
    """To a unit: complete the files, release everything and end."""


class Ready(NamedTuple):
    """From a unit: its stages are built and its slots are bound."""

    pid: int


class Done(NamedTuple):
    """From a unit: a job ended. Times in ns of CLOCK_MONOTONIC; `figures` are the stage's own."""

    id: int
    t_begin_ns: int
    t_end_ns: int
    t_sampled_ns: int
    figures: dict[str, float]


class Duration(NamedTuple):
    """From a unit: the answer to Isolate, in ns."""

    value: int


class Failed(NamedTuple):
    """From a unit: a stage raised. `id`: of the job, or one of the marks below. `message`: at most MAX_TEXT."""

    id: int
    exit_code: int
    message: str


class Alive(NamedTuple):
    """From a unit: the answer to Ping."""


class Closed(NamedTuple):
    """From a unit: the answer to Close."""


Heartbeat = Ready | Alive
Message = RunJob | Isolate | Ping | Close | Ready | Done | Duration | Failed | Alive | Closed
BUILDING, MEASURING, CLOSING = -1, -2, -3

_KINDS: tuple[Any, ...] = (RunJob, Isolate, Ping, Close, Ready, Done, Duration, Failed, Alive, Closed)
_PACKER = msgpack.Packer()  # one for the process: making one costs more than packing


class _Form(NamedTuple):
    """Of a message on the wire. `rest`: the type of its last field when that is no integer."""

    kind: Any
    code: bytes
    integers: struct.Struct
    rest: type | None


def _form(code: int, kind: Any) -> _Form:
    types = [get_origin(of) or of for of in get_type_hints(kind).values()]
    rest = types.pop() if types and types[-1] is not int else None
    assert all(of is int for of in types)
    return _Form(kind, bytes([code]), struct.Struct(f"<{len(types)}q"), rest)


_FORMS = tuple(_form(code, kind) for code, kind in enumerate(_KINDS))
_FORM_OF = {form.kind: form for form in _FORMS}


def pack(message: Message) -> bytes:
    """Raises struct.error for an integer of more than 64 bits, MessageError for more than MAX_BYTES."""
    _, code, integers, rest = _FORM_OF[type(message)]
    fields: tuple[Any, ...] = message
    if rest is None:
        return code + integers.pack(*fields)
    if not fields[-1]:
        return code + integers.pack(*fields[:-1])
    packed: bytes = _PACKER.pack(fields[-1])
    if integers.size + len(packed) >= MAX_BYTES:
        raise MessageError(f"{type(message).__name__} of {len(packed)} bytes, expected less than {MAX_BYTES}")
    return code + integers.pack(*fields[:-1]) + packed


def unpack(data: bytes | memoryview) -> Message:
    """Raises MessageError for anything that is not one of the messages, field by field."""
    if not data or data[0] >= len(_FORMS):
        raise MessageError(f"unknown message {bytes(data[:80])!r}")
    kind, _, integers, rest = _FORMS[data[0]]
    end = 1 + integers.size
    if len(data) < end or (rest is None and len(data) > end):
        raise MessageError(f"{len(data)} bytes for {kind.__name__}, which takes {end}")
    fields = integers.unpack_from(data, 1)
    if rest is not None:
        fields += (_unpack_rest(data[end:], rest) if len(data) > end else rest(),)
    message: Message = tuple.__new__(kind, fields)
    return message


def _unpack_rest(data: bytes | memoryview, wanted: type) -> Any:
    try:
        rest: Any = msgpack.unpackb(data)
    except (ValueError, msgpack.UnpackException) as error:
        raise MessageError(f"not msgpack: {error}") from None
    if not (_are_figures(rest) if wanted is dict else type(rest) is wanted):
        raise MessageError(f"found {str(rest)[:80]!r}, expected {wanted.__name__}")
    return rest


def _are_figures(rest: Any) -> bool:
    return type(rest) is dict and all(type(key) is str and type(value) in (int, float) for key, value in rest.items())
