"""What passes between a run and the server that shows it, two processes. Rule: msgpack, and nothing but this table.

A message is an array of its place in MESSAGES and its fields. It goes as one packet over a pair of sockets that only
these two processes have. Neither waits for the other: what cannot be sent at once is left out, and said so.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import msgpack

from trilane.unexpected_value import UnexpectedValue

MOST_BYTES: Final = 1 << 17


class Opened(NamedTuple):
    """To the server, first: the `token` of who may ask, and the size of the window's pictures."""

    token: str
    height: int
    width: int


class RunBegins(NamedTuple):
    """To the server: a run writes its journal into `folder`. `facts`: of `RunFacts`, `controls`: of `Control`."""

    folder: str
    facts: Mapping[str, Any]
    controls: Sequence[Mapping[str, Any]]


class StateIs(NamedTuple):
    """To the server: running, paused, restarting, ended or failed, and why."""

    state: str
    why: str


class Refused(NamedTuple):
    """To the server: what the control was asked to do cannot be done."""

    control: str
    why: str


class Asked(NamedTuple):
    """To the run: somebody wants the control to have the value."""

    control: str
    value: str | float | None


Message = Opened | RunBegins | StateIs | Refused | Asked
MESSAGES: Final[tuple[type[Any], ...]] = (Opened, RunBegins, StateIs, Refused, Asked)
_FIELDS: Final[dict[type[Any], tuple[type | tuple[type, ...], ...]]] = {
    Opened: (str, int, int),
    RunBegins: (str, dict, list),
    StateIs: (str, str),
    Refused: (str, str),
    Asked: (str, (str, float, int, type(None))),
}


def packed(message: Message) -> bytes:
    """The packet of `message`."""
    data: bytes = msgpack.packb([MESSAGES.index(type(message)), *message])
    return data


def unpacked(data: bytes) -> Message:
    """The message of a packet. Raises UnexpectedValue for bytes that are none."""
    try:
        place, *fields = msgpack.unpackb(data)
        kind = MESSAGES[place]
    except (ValueError, TypeError, IndexError, msgpack.UnpackException) as error:
        raise UnexpectedValue(str(error)[:80] or type(error).__name__, "a message of the dashboard") from None
    types = _FIELDS[kind]
    if len(fields) != len(types) or not all(map(isinstance, fields, types)):
        raise UnexpectedValue(str(fields)[:80], f"fields of {kind.__name__}")
    message: Message = kind(*fields)
    return message


class Channel:
    """One end of the pair. `fd` becomes readable when a message or the end of the other side has come."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        end.setblocking(False)

    @property
    def fd(self) -> int:
        return self._end.fileno()

    def send(self, message: Message) -> bool:
        """Whether it was sent: not to an end that is gone, or that has left too much unread."""
        try:
            self._end.send(packed(message))
        except OSError:
            return False
        return True

    def receive(self) -> Message | None:
        """The next message; None when there is none yet. Raises EOFError when the other end is gone."""
        try:
            data = self._end.recv(MOST_BYTES)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:
            raise EOFError
        return unpacked(data)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._end.close()


def channel_pair() -> tuple[Channel, socket.socket]:
    """This process's end, and the other's, to be handed on."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return Channel(ours), theirs
