"""Messages between the process of a run and the process of its server, in msgpack.

Rule: every message has a type in MESSAGES. A message is an array: the index of its type in MESSAGES, followed by its
fields. Each message is one packet on a pair of sockets, which only these two processes have. Neither process waits for
the other: a message that cannot be sent at once is lost. `ServerLink` starts and ends the server's process. If the
server's process ends by itself, the run goes on without a server.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgpack

from trilane.apps.dashboard.access import ServerAddress
from trilane.transport.live_window import create_window, path_of
from trilane.unexpected_value import UnexpectedValue

MOST_BYTES: Final = 1 << 17
CLOSE_S: Final = 3.0
SERVER_ENDED: Final = "the dashboard's server has ended; the run goes on without it"


class Opened(NamedTuple):
    """The first message to the server.

    `token`: secret that clients must send.
    `height`, `width`: size of pictures in pixels.
    """

    token: str
    height: int
    width: int


class RunBegins(NamedTuple):
    """A message to the server: a run begins.

    `folder`: folder into which the run writes its journal.
    `facts`: fields of the run's `RunFacts`, by name.
    `controls`: fields of each `Control`, by name.
    """

    folder: str
    facts: Mapping[str, Any]
    controls: Sequence[Mapping[str, Any]]


class StateIs(NamedTuple):
    """A message to the server: the state of the run has changed.

    `state`: running, paused, restarting, ended or failed. Until the first frame, the page shows a running run as
    `starting`.
    `why`: reason in words, "" without a reason.
    """

    state: str
    why: str


class ChangesRefused(NamedTuple):
    """A message to the server: the run refuses a request of the page, or a new run did not begin.

    `control`: name of the control; `restart` for several controls; "" for a new run that did not begin.
    `why`: reason in words.
    """

    control: str
    why: str


class ControlAsked(NamedTuple):
    """A message to the run: the page requests a use of one control.

    `control`: name of the control.
    `value`: requested value, None for a control without a value.
    """

    control: str
    value: str | float | None


class ChangesAsked(NamedTuple):
    """A message to the run: the page requests a new run.

    `values`: requested values of controls, by the control's name.
    """

    values: Mapping[str, str]


Message = Opened | RunBegins | StateIs | ChangesRefused | ControlAsked | ChangesAsked

MESSAGES: Final[tuple[type[Any], ...]] = (Opened, RunBegins, StateIs, ChangesRefused, ControlAsked, ChangesAsked)

_FIELDS: Final[dict[type[Any], tuple[type | tuple[type, ...], ...]]] = {
    Opened: (str, int, int),
    RunBegins: (str, dict, list),
    StateIs: (str, str),
    ChangesRefused: (str, str),
    ControlAsked: (str, (str, float, int, type(None))),
    ChangesAsked: (dict,),
}


def packed(message: Message) -> bytes:
    """Return `message` as the bytes of a packet."""
    data: bytes = msgpack.packb([MESSAGES.index(type(message)), *message])
    return data


def unpacked(data: bytes) -> Message:
    """Return the message in the packet `data`. Raises UnexpectedValue for bytes that are no message."""
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


class ChannelEnd:
    """One end of a channel between the run and its server.

    `end`: socket of this end.
    `fd`: file descriptor that becomes readable when a message arrives or the other end is closed.
    """

    def __init__(self, end: socket.socket) -> None:
        self._end = end
        end.setblocking(False)

    @property
    def fd(self) -> int:
        return self._end.fileno()

    def send(self, message: Message) -> bool:
        """Return whether `message` was sent. It is not sent if the other end is closed or has a full buffer."""
        try:
            self._end.send(packed(message))
        except OSError:
            return False
        return True

    def receive(self) -> Message | None:
        """Return the next message; None if no message has arrived.

        Raises EOFError if the other end is closed, UnexpectedValue for a packet that is no message.
        """
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


def channel_pair() -> tuple[ChannelEnd, socket.socket]:
    """Return the two ends of a new channel: this process's end, and the socket for the other process."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    return ChannelEnd(ours), theirs


class ServerLink:
    """Starts a server process and connects the run to it.

    `place`: address of the server.
    `height`, `width`: size of pictures in pixels.
    `hear`: function that gets each request of the page, on a thread of its own.
    `tell`: function that gets sentences for a person.

    `window`: file through which the server sees the pictures of the run.
    """

    def __init__(
        self,
        place: ServerAddress,
        height: int,
        width: int,
        hear: Callable[[ControlAsked | ChangesAsked], None],
        tell: Callable[[str], None],
    ) -> None:
        self._hear, self._tell = hear, tell
        self._window_fd = create_window(height, width)
        self.window: Path = path_of(self._window_fd)
        self._channel, theirs = channel_pair()
        self._end_fd = os.eventfd(0, os.EFD_CLOEXEC)
        with theirs:
            fds = (place.listener.fileno(), theirs.fileno(), self._window_fd)
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "trilane.apps.dashboard.live_server", *map(str, fds)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=fds,
                process_group=0,  # so that Ctrl-C interrupts only the run, which then ends the server
            )
        self.send(Opened(place.token, height, width))
        self._thread = threading.Thread(target=self._listen, name="dashboard", daemon=True)
        self._thread.start()

    def send(self, message: Message) -> None:
        """Send `message` to the server. The message is lost if the server is gone or its buffer is full."""
        self._channel.send(message)

    def close(self) -> None:
        """End the server, and wait for the end of its process."""
        os.eventfd_write(self._end_fd, 1)
        self._thread.join()
        self._channel.close()
        try:
            self._process.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._end_fd)
        os.close(self._window_fd)

    def _listen(self) -> None:
        poller = select.poll()
        poller.register(self._channel.fd, select.POLLIN)
        poller.register(self._end_fd, select.POLLIN)
        with contextlib.suppress(EOFError):
            while self._end_fd not in [fd for fd, _ in poller.poll()]:
                message = self._channel.receive()
                if isinstance(message, ControlAsked | ChangesAsked):
                    self._hear(message)
            return
        self._tell(SERVER_ENDED)
