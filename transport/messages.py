"""The messages between the scheduler and its units, and a unit's link: the job pipe and the heartbeat socket together.

There is a fixed list of messages with typed fields; anything else is refused. The first byte of a message tells its
kind. The integer fields follow, with 64 bits each. A field of another type comes last, packed with msgpack; an empty
field takes no bytes. Integers are not packed with msgpack: a process that has just been woken would need twice the time
to read them. Nothing is ever pickled.

Jobs and their answers must keep their order, so they go over the job pipe. The job pipe is two pipes, one each way, in
packet mode (O_DIRECT of pipe(2)): every read returns one whole message. A message wakes the other process directly,
without a thread between. Heartbeats go over a socket of their own, so that jobs and heartbeats do not delay each other.
Neither end ever waits for the other: a heartbeat that the other end does not read is dropped.

The folder of a unit's ZeroMQ socket is private. It exists only until the unit has connected, because a connection does
not need the name of its socket. A parent that is killed before that leaves its folder behind. The next run finds that
nobody holds the folder's lock, and removes the folder.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shutil
import struct
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self, get_origin, get_type_hints

import msgpack
import zmq

from trilane.errors import TrilaneError, reason
from trilane.machine import SHORTEST_SLICE_NS, use_slice

MAX_BYTES = 4096  # of a message; a pipe takes no more in one piece (PIPE_BUF of pipe(7))
MAX_TEXT = 2000  # bytes of UTF-8 in `Failed.message`


class MessageError(ValueError):
    """The bytes are no known message."""


class RunJob(NamedTuple):
    """To a unit: run one of its stages for one frame.

    `id`: number of the job; its answer, `Done` or `Failed`, carries the same number.
    `stage`: index in the unit's list of stages, from 0.
    `frame`: number of the frame.
    `slot_in`, `slot_out`: slots of the stage's input edge and output edge; -1 if the stage has no such edge. If a
    bypass ends at the stage, the numbers of the bypass's slots begin after the slots of the input edge. If the stage
    has several inputs, `slot_in` holds a slot of each, the first in the lowest byte.
    `epoch`: epoch of the output edge, or of the input edge if there is no output edge.
    `t_dispatch_ns`: time at which the scheduler handed over the job, in ns of CLOCK_MONOTONIC.
    `fresh`: 1 when the stage must ignore what earlier frames left behind, else 0.
    `rung`: rung of the frame's work, 0 for all of it.
    """

    id: int
    stage: int
    frame: int
    slot_in: int
    slot_out: int
    epoch: int
    t_dispatch_ns: int
    fresh: int
    rung: int = 0


class Ping(NamedTuple):
    """To a unit that has no job: answer with `PongMessage`."""


class Close(NamedTuple):
    """To a unit: complete your files, release everything, answer with `Closed` and end."""


class Ready(NamedTuple):
    """From a unit, as a heartbeat: its stages are built and their slots are bound. `pid`: its process id."""

    pid: int


class Done(NamedTuple):
    """From a unit: the job `id` has ended. Points in time are ns of CLOCK_MONOTONIC, durations are ns.

    `t_sampled_ns`: time at which the stage sampled the frame's input; 0 from a stage that waits for other stages.
    `preempted_ns`: duration of the job's parts in which the unit had no core.
    `asleep_ns`: duration of the job's parts in which the unit slept and no device worked for it.
    `preempted_before_ns`: duration between the previous job and this job in which the unit had no core.
    `skips`: 1 when the frame takes the pipeline's bypass, else 0.
    `cpu_ns`, `cpu_before_ns`: CPU time of all threads of the unit in this job, and between the previous job and this
    job.
    `metrics`: numbers that the stage itself reports about the job, by name.
    """

    id: int
    t_begin_ns: int
    t_end_ns: int
    t_sampled_ns: int
    preempted_ns: int
    asleep_ns: int
    preempted_before_ns: int
    skips: int
    cpu_ns: int
    cpu_before_ns: int
    metrics: dict[str, float]


class Failed(NamedTuple):
    """From a unit: something raised an error.

    `id`: number of the job; BUILDING or CLOSING outside a job.
    `exit_code`: exit code that the error asks the program to end with.
    `message`: text for people, at most MAX_TEXT bytes.
    """

    id: int
    exit_code: int
    message: str


class PongMessage(NamedTuple):
    """From a unit, as a heartbeat: the answer to `Ping`."""


class Closed(NamedTuple):
    """From a unit: the answer to `Close`."""


Heartbeat = Ready | PongMessage
Message = RunJob | Ping | Close | Ready | Done | Failed | PongMessage | Closed
#: `Failed.id` of an error outside a job: while stages are built, and while they are closed.
BUILDING, CLOSING = -1, -2

#: The first byte of a message is the index of its kind here.
_KINDS: tuple[Any, ...] = (RunJob, Ping, Close, Ready, Done, Failed, PongMessage, Closed)
_PACKER = msgpack.Packer()  # shared by all messages: making a packer costs more than packing


class _Form(NamedTuple):
    """How a kind of message is written as bytes.

    `kind`: class of the message.
    `code`: first byte of the message.
    `integers`: format of the integer fields.
    `rest`: type of the last field if this field is no integer; else None.
    """

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
    """Return the bytes of `message`.

    Raises struct.error for an integer of more than 64 bits, and MessageError for more than MAX_BYTES bytes.
    """
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
    """Return the message whose bytes are `data`.

    Raises MessageError for bytes that are no message, or that have a field of a wrong type.
    """
    if not data or data[0] >= len(_FORMS):
        raise MessageError(f"unknown message {bytes(data[:80])!r}")
    kind, _, integers, rest = _FORMS[data[0]]
    end = 1 + integers.size
    if len(data) < end or (rest is None and len(data) > end):
        raise MessageError(f"{len(data)} bytes for {kind.__name__}, which takes {end}")
    fields = integers.unpack_from(data, 1)
    if rest is not None:
        fields += (_unpack_rest(data[end:], rest) if len(data) > end else rest(),)
    message: Message = kind(*fields)
    return message


def _unpack_rest(data: bytes | memoryview, expected: type) -> Any:
    try:
        rest: Any = msgpack.unpackb(data)
    except (ValueError, msgpack.UnpackException) as error:
        raise MessageError(f"not msgpack: {error}") from None
    is_fit = type(rest) is expected
    if is_fit and expected is dict:  # the metrics of a job
        is_fit = all(type(key) is str and type(value) in (int, float) for key, value in rest.items())
    if not is_fit:
        raise MessageError(f"found {str(rest)[:80]!r}, expected {expected.__name__}")
    return rest


PACKETS = 16  # messages that a pipe holds; each takes a page of the 64 KiB that Linux gives a pipe


class JobPipeEnd(NamedTuple):
    """The file descriptors of one end of a job pipe. Child processes inherit only descriptors that are passed on."""

    reads: int
    writes: int

    def close(self) -> None:
        for fd in self:
            os.close(fd)


def job_pipe_pair() -> tuple[JobPipeEnd, JobPipeEnd]:
    """Return both ends of a new job pipe, which are alike; raises TrilaneError if the system gives no such pipe."""
    fds: list[int] = []
    try:
        for _ in range(2):
            fds += os.pipe2(os.O_CLOEXEC | os.O_DIRECT)
            size = fcntl.fcntl(fds[-1], fcntl.F_GETPIPE_SZ)
            if size < PACKETS * os.sysconf("SC_PAGESIZE"):
                raise OSError(errno.EDQUOT, f"{size} bytes for a pipe, by /proc/sys/fs/pipe-user-pages-soft")
    except OSError as error:
        for fd in fds:
            os.close(fd)
        raise TrilaneError(f"no pipe for {PACKETS} messages: {reason(error)}") from None
    return JobPipeEnd(fds[2], fds[1]), JobPipeEnd(fds[0], fds[3])


class JobPipe:
    """One end of a job pipe. Messages arrive in order or not at all.

    `waits`: whether `receive` waits until there is a message.
    `ended`: whether the other end is closed and every message that it sent has been received.
    """

    def __init__(self, end: JobPipeEnd, *, waits: bool = False) -> None:
        self.ended = False
        self._end = end
        self._reads, self._writes = end
        os.set_blocking(end.reads, waits)
        os.set_blocking(end.writes, False)

    def fileno(self) -> int:
        """Return a descriptor that is readable when `receive` has something to return or the other end is closed."""
        return self._reads

    def send(self, message: Message) -> None:
        """Send `message` without waiting. If the other end is closed or the pipe is full, drop `message`.

        The scheduler learns of a lost or stuck unit from its process's end or a missed deadline. Raises as `pack` does.
        """
        try:
            os.write(self._writes, pack(message))
        except (BlockingIOError, BrokenPipeError):
            return

    def receive(self) -> Message | None:
        """Return the next message; None when the other end is closed.

        An end that does not wait also returns None if no message has come.

        Raises MessageError for bytes that are no message.
        """
        try:
            data = os.read(self._reads, MAX_BYTES)
        except BlockingIOError:
            return None
        self.ended = not data
        return unpack(data) if data else None

    def close(self) -> None:
        self._end.close()


PREFIX = "trilane-"
LOCK = "lock"
MAX_PATH = 80  # of the folder's path; the path of a Unix socket inside it may have 108


class SocketFolder:
    """A private folder (mode 0700) for the files of sockets. A lock on a file inside shows that a process uses it."""

    def __init__(self) -> None:
        base = tempfile.gettempdir()
        base = base if len(base) < MAX_PATH else "/tmp"  # noqa: S108 - mkdtemp below makes a private folder in it
        remove_abandoned(Path(base))
        while not self._is_made(base):  # before it was locked, another process took it for abandoned and removes it
            os.close(self._lock)

    def _is_made(self, base: str) -> bool:
        """Make and lock a folder in `base`; return False if another process locks or removes the folder first."""
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX, dir=base))
        self._lock = os.open(self.path / LOCK, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return os.fstat(self._lock).st_nlink > 0
        return False

    def endpoint(self, name: str) -> str:
        """Return the ZeroMQ address of the socket `name` in this folder."""
        return f"ipc://{self.path / name}"

    def remove(self) -> None:
        """Remove the folder and let go of its lock."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exc: object) -> None:
        self.remove()


def remove_abandoned(base: Path) -> None:
    """Remove this user's abandoned socket folders in `base`. A folder is abandoned if nobody holds its lock."""
    for folder in base.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):
            if folder.is_symlink() or folder.stat().st_uid != os.getuid():
                continue
            lock = os.open(folder / LOCK, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)


HIGH_WATER = 64  # messages in ZeroMQ's queue; a unit has at most a few outstanding
LINGER_MS = 1000  # how long a unit that ends tries to deliver its last heartbeat


class HeartbeatSocket:
    """One end of a unit's heartbeat connection.

    `socket`: the ZeroMQ socket; one end binds it, the other connects it.
    """

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], linger_ms: int = 0) -> None:
        """Make a socket of `context`.

        `linger_ms`: how long the socket tries to deliver sent heartbeats after it is closed, in milliseconds.
        """
        self.socket: zmq.Socket[bytes] = context.socket(zmq.PAIR)
        self.socket.setsockopt(zmq.LINGER, linger_ms)
        self.socket.setsockopt(zmq.MAXMSGSIZE, MAX_BYTES)
        self.socket.setsockopt(zmq.SNDHWM, HIGH_WATER)
        self.socket.setsockopt(zmq.RCVHWM, HIGH_WATER)

    def bind(self, endpoint: str) -> None:
        """Bind the scheduler's end to the ZeroMQ address `endpoint`, where the unit's heartbeats arrive from now on."""
        self.socket.bind(endpoint)

    def connect(self, endpoint: str) -> None:
        """Connect the unit's end to the ZeroMQ address `endpoint`, where its heartbeats go from now on."""
        self.socket.connect(endpoint)

    @property
    def heartbeat_fd(self) -> int:
        """A descriptor that is readable when `heartbeats` should be called."""
        return self.socket.fileno()

    def send_heartbeat(self, message: Heartbeat) -> None:
        """Send `message` without waiting. If the other end has stopped reading, drop `message`."""
        with contextlib.suppress(zmq.Again):
            self.socket.send(pack(message), zmq.DONTWAIT)

    def heartbeats(self) -> list[Message]:
        """Return all heartbeats since the last call; raises MessageError for bytes that are no message."""
        messages = []
        while self.socket.poll(0):  # ZeroMQ's descriptor becomes readable again only after the socket was empty
            messages.append(unpack(self.socket.recv(zmq.DONTWAIT)))
        return messages

    def close(self) -> None:
        self.socket.close()


def context_on_cores(cores: Sequence[int]) -> zmq.Context[zmq.Socket[bytes]]:
    """Return a ZeroMQ context for a unit. Its I/O thread runs on `cores` and preempts other work there when it wakes.

    `cores`: cores other than the unit's own. On the unit's own cores, the I/O thread would wait behind the next job.
    Call this from the thread that makes the first socket. The I/O thread inherits the short time slice set here, and
    the caller keeps the short slice too.
    """
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    for core in cores:
        context.set(zmq.THREAD_AFFINITY_CPU_ADD, core)
    use_slice(SHORTEST_SLICE_NS)
    return context


class Link(HeartbeatSocket):
    """One end of a unit's connection: the heartbeat socket and the `job_pipe`. Both keep messages in order."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], job_pipe: JobPipe, linger_ms: int = 0) -> None:
        """Take over `job_pipe`, which `close` closes. `context`, `linger_ms`: as for `HeartbeatSocket`."""
        super().__init__(context, linger_ms)
        self.job_pipe = job_pipe

    def close(self) -> None:
        """Close the socket and the job pipe. Sent heartbeats are still delivered within `linger_ms`."""
        super().close()
        self.job_pipe.close()
