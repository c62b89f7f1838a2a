"""What goes over the bus. Rule: a fixed list of messages with typed fields; anything else is refused, and never pickle.

On the wire: msgpack of [name, field, ...].
"""

from __future__ import annotations

from typing import Any, NamedTuple, get_origin, get_type_hints

import msgpack

MAX_BYTES = 1 << 16
MAX_TEXT = 4000


class MessageError(ValueError):
    """Bytes that are not one of the messages."""


class RunJob(NamedTuple):
    """To a unit: do one stage of one frame."""

    id: int
    stage: str
    frame: int
    slot_in: int
    slot_out: int
    epoch: int


class Isolate(NamedTuple):
    """To a unit: do this job and answer with its duration; nothing is noted of the frame."""

    stage: str
    frame: int
    slot_in: int
    slot_out: int


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
    t_pose_ns: int
    figures: dict[str, float]


class Duration(NamedTuple):
    """From a unit: the answer to Isolate, in ns."""

    value: int


class Failed(NamedTuple):
    """From a unit: a stage raised. `id`: of the job; -1 while building, -2 while measuring, -3 while closing."""

    id: int
    message: str
    exit_code: int


class Alive(NamedTuple):
    """From a unit that has nothing to do."""


class Closed(NamedTuple):
    """From a unit: the answer to Close."""


Message = RunJob | Isolate | Close | Ready | Done | Duration | Failed | Alive | Closed
BUILDING, MEASURING, CLOSING = -1, -2, -3
#: What goes over the bus; the rest goes over the line.
LIFE_SIGNS = (Ready, Alive)

_KINDS: dict[str, Any] = {
    kind.__name__: kind for kind in (RunJob, Isolate, Close, Ready, Done, Duration, Failed, Alive, Closed)
}
#: Name -> the message, and the types of its fields as they come off the wire.
_FORMS = {
    name: (kind, tuple(get_origin(of) or of for of in get_type_hints(kind).values())) for name, kind in _KINDS.items()
}
_PACKER = msgpack.Packer()  # one for the process: making one costs more than packing


def pack(message: Message) -> bytes:
    packed: bytes = _PACKER.pack((type(message).__name__, *message))
    return packed


def unpack(data: bytes | memoryview) -> Message:
    """Raises MessageError for anything that is not one of the messages, field by field."""
    try:
        content = msgpack.unpackb(data, use_list=False)
    except (ValueError, msgpack.UnpackException) as error:
        raise MessageError(f"not msgpack: {error}") from None
    form = _FORMS.get(content[0]) if type(content) is tuple and content and type(content[0]) is str else None
    if form is None:
        raise MessageError(f"unknown message {str(content)[:80]!r}")
    kind, types = form
    fields = content[1:]
    if tuple(map(type, fields)) != types or (dict in types and not _are_figures(fields[types.index(dict)])):
        raise MessageError(f"wrong fields for {content[0]}: {str(fields)[:80]}")
    message: Message = tuple.__new__(kind, fields)
    return message


def _are_figures(figures: dict[Any, Any]) -> bool:
    return all(type(key) is str and type(value) in (int, float) for key, value in figures.items())
