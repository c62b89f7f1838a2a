"""The channels that `trilane bench handoff` compares. Each has an end that writes and an end that reads.

Rule: the array of `Producer.buffer` is filled before the clock starts. `Consumer.receive` returns when every byte can
be read.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from multiprocessing.queues import Queue
from multiprocessing.reduction import DupFd
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import zmq

from trilane.arrays import U8
from trilane.transport.messages import JobPipe, JobPipeEnd, RunJob, SocketFolder, job_pipe_pair
from trilane.transport.packets import RegionLayout, SlotLayout, create_region, header_dtype, map_region

WAIT_MS = 60_000
SHM = Path("/dev/shm")  # noqa: S108 - only files with this program's prefix are removed, which iceoryx2 left


class Producer(Protocol):
    """The end of a channel that writes."""

    def buffer(self) -> U8:
        """Return the array that the producer fills with the next bytes."""

    def hand_over(self) -> None:
        """Announce or send the bytes in the array that `buffer` returned last."""


class Consumer(Protocol):
    """The end of a channel that reads."""

    def receive(self) -> U8:
        """Wait for the next bytes, and return them. They stay valid until the call of `release`."""

    def release(self) -> None:
        """Give back the bytes that `receive` returned. The consumer calls this after it has read them."""


class Channel(Protocol):
    """A channel from one process to another.

    The parent process makes the channel and sends it to both child processes. Each child process opens one end.
    """

    def producer(self) -> Producer:
        """Open and return the end that writes. The child process that writes calls this."""

    def consumer(self) -> Consumer:
        """Open and return the end that reads. The child process that reads calls this."""

    def close(self) -> None:
        """Release the channel. The parent process calls this after both child processes have ended."""


class SlotChannel:
    """Trilane's channel: a slot in shared memory (a sealed memfd region), announced by a message over a `JobPipe`.

    There is only one slot, which is given back before the next hand-over. A run also reuses the slot that was given
    back last (transport/slots.py), and iceoryx2 reuses its samples in the same way. Two slots in turns would double the
    memory that passes through the caches, and the time of reading.
    """

    def __init__(self, size: int, _context: SpawnContext) -> None:
        self._layout = RegionLayout(1, SlotLayout(header_dtype(), size))
        self._fd = create_region("handoff", self._layout)
        self._place = f"/proc/{os.getpid()}/fd/{self._fd}"
        self._ends = job_pipe_pair()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_ends": [[DupFd(fd) for fd in end] for end in self._ends]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        there, back = (JobPipeEnd(*(fd.detach() for fd in end)) for end in state["_ends"])
        self.__dict__.update(state, _ends=(there, back))

    def producer(self) -> Producer:
        self._ends[1].close()
        return _SlotEnd(self._slot(), JobPipe(self._ends[0], waits=True))

    def consumer(self) -> Consumer:
        self._ends[0].close()
        return _SlotEnd(self._slot(), JobPipe(self._ends[1], waits=True))

    def _slot(self) -> U8:
        (packet,) = map_region(os.open(self._place, os.O_RDWR), self._layout)
        return packet.payload

    def close(self) -> None:
        os.close(self._fd)
        for end in self._ends:
            end.close()


class _SlotEnd:
    def __init__(self, payload: U8, job_pipe: JobPipe) -> None:
        self._payload, self._job_pipe, self._count = payload, job_pipe, 0

    def buffer(self) -> U8:
        return self._payload

    def hand_over(self) -> None:
        self._job_pipe.send(RunJob(self._count, 0, self._count, 0, 0, 0, 0, 0))
        self._count += 1

    def receive(self) -> U8:
        while True:
            message = self._job_pipe.receive()
            if isinstance(message, RunJob):
                return self._payload
            if self._job_pipe.ended:
                raise EOFError

    def release(self) -> None:
        """Do nothing, because the bench's acknowledgement of each frame gives the slot back."""


class _OwnEnd:
    """An end of a channel that copies bytes. Its array of `size` bytes belongs to its own process."""

    def __init__(self, size: int) -> None:
        self._own = np.zeros(size, np.uint8)

    def buffer(self) -> U8:
        return self._own

    def release(self) -> None:
        """Do nothing, because the bytes belong to this process."""


class QueueChannel:
    """A channel through a `multiprocessing.Queue`: the array is pickled, copied through a pipe, and unpickled."""

    def __init__(self, size: int, context: SpawnContext) -> None:
        self._size, self._queue = size, context.Queue()

    def producer(self) -> Producer:
        return _QueueEnd(self._queue, self._size)

    def consumer(self) -> Consumer:
        return _QueueEnd(self._queue, 0)

    def close(self) -> None:
        self._queue.close()


class _QueueEnd(_OwnEnd):
    def __init__(self, channel: Queue[Any], size: int) -> None:
        super().__init__(size)
        self._queue = channel

    def hand_over(self) -> None:
        self._queue.put(self._own)

    def receive(self) -> U8:
        array: U8 = self._queue.get(timeout=WAIT_MS / 1000)
        return array


class PipeChannel:
    """A channel through a `multiprocessing.Pipe` in its best form: raw bytes are received into an existing array."""

    def __init__(self, size: int, context: SpawnContext) -> None:
        self._size, self._ends = size, context.Pipe()

    def producer(self) -> Producer:
        self._ends[1].close()
        return _PipeEnd(self._ends[0], self._size)

    def consumer(self) -> Consumer:
        self._ends[0].close()
        return _PipeEnd(self._ends[1], self._size)

    def close(self) -> None:
        for end in self._ends:
            end.close()


class _PipeEnd(_OwnEnd):
    def __init__(self, end: Connection, size: int) -> None:
        super().__init__(size)
        self._end = end

    def hand_over(self) -> None:
        self._end.send_bytes(self._own.data)

    def receive(self) -> U8:
        self._end.recv_bytes_into(self._own.data)
        return self._own


class ZmqChannel:
    """A channel that sends the bytes as a ZeroMQ frame. pyzmq itself copies neither sent nor received bytes."""

    def __init__(self, size: int, _context: SpawnContext) -> None:
        self._folder = SocketFolder()
        self._size, self._endpoint = size, self._folder.endpoint("handoff")

    def __getstate__(self) -> dict[str, Any]:
        return {"_size": self._size, "_endpoint": self._endpoint}

    def producer(self) -> Producer:
        return _ZmqEnd(self._endpoint, self._size, bind=True)

    def consumer(self) -> Consumer:
        return _ZmqEnd(self._endpoint, 0, bind=False)

    def close(self) -> None:
        self._folder.remove()


class _ZmqEnd(_OwnEnd):
    def __init__(self, endpoint: str, size: int, bind: bool) -> None:
        super().__init__(size)
        self._socket = zmq.Context().socket(zmq.PAIR)
        self._socket.setsockopt(zmq.RCVTIMEO, WAIT_MS)
        (self._socket.bind if bind else self._socket.connect)(endpoint)

    def hand_over(self) -> None:
        self._socket.send(self._own.data, copy=False)

    def receive(self) -> U8:
        return np.frombuffer(self._socket.recv(copy=False).buffer, np.uint8)


class IceoryxChannel:
    """A channel through iceoryx2. A loaned sample is written in place and sent, and an event wakes the other end.

    Nothing is copied. Polling would be faster than the event, but would keep a core busy without work.

    iceoryx2 leaves files for the user's next program. In this bench, these files get their own folder and prefix, so
    that `close` can remove them. The names of the folder and the prefix are short, because the path of a Unix socket
    must be short. The constructor raises ModuleNotFoundError if iceoryx2 is not installed.
    """

    def __init__(self, size: int, _context: SpawnContext) -> None:
        import iceoryx2  # noqa: F401 - says here, in the parent, that it is not installed

        self._size = size
        self._folder = tempfile.mkdtemp(prefix=f"iox-{os.getpid()}-", dir="/tmp")
        self._prefix = f"{Path(self._folder).name}_"

    def producer(self) -> Producer:
        return _IceoryxProducer(self._folder, self._prefix, self._size)

    def consumer(self) -> Consumer:
        return _IceoryxConsumer(self._folder, self._prefix)

    def close(self) -> None:
        """Remove the files that iceoryx2 left for this channel."""
        shutil.rmtree(self._folder, ignore_errors=True)
        for left in SHM.glob(f"{self._prefix}*"):
            left.unlink(missing_ok=True)


def _iceoryx_services(folder: str, prefix: str) -> tuple[Any, Any, Any]:
    import ctypes

    import iceoryx2 as iox

    iox.set_log_level(iox.LogLevel.Error)
    config = iox.config.default()
    config.global_cfg.root_path = iox.Path.new(folder)
    config.global_cfg.prefix = iox.FileName.new(prefix)
    node = iox.NodeBuilder.new().config(config).create(iox.ServiceType.Ipc)
    service = iox.ServiceName.new("trilane/handoff")
    samples = node.service_builder(service).publish_subscribe(iox.Slice[ctypes.c_uint8]).open_or_create()
    return node, samples, node.service_builder(service).event().open_or_create()


class _IceoryxProducer:
    def __init__(self, folder: str, prefix: str, size: int) -> None:
        self._node, samples, event = _iceoryx_services(folder, prefix)
        self._publisher = samples.publisher_builder().initial_max_slice_len(size).create()
        self._notifier = event.notifier_builder().create()
        self._size = size
        self._sample: Any = None

    def buffer(self) -> U8:
        self._sample = self._publisher.loan_slice_uninit(self._size)
        return np.frombuffer(self._sample.payload().as_memory_view(), np.uint8)

    def hand_over(self) -> None:
        self._sample.assume_init().send()
        self._notifier.notify()


class _IceoryxConsumer:
    def __init__(self, folder: str, prefix: str) -> None:
        self._node, samples, event = _iceoryx_services(folder, prefix)
        self._subscriber = samples.subscriber_builder().create()
        self._listener = event.listener_builder().create()
        self._sample: Any = None

    def receive(self) -> U8:
        while (sample := self._subscriber.receive()) is None:
            self._listener.blocking_wait()
        self._sample = sample
        return np.frombuffer(sample.payload().as_memory_view(), np.uint8)

    def release(self) -> None:
        self._sample.delete()


SLOT, BARE = "slot", "slot, 256 KiB of it written"
#: Variant -> function of the size in bytes and the context of multiprocessing, which makes the channel. `BARE` is like
#: `SLOT`, but only a small part of the slot is written, so that writing hardly changes the caches.
CHANNELS: dict[str, Callable[[int, SpawnContext], Channel]] = {
    SLOT: SlotChannel,
    BARE: SlotChannel,
    "iceoryx2": IceoryxChannel,
    "zeromq": ZmqChannel,
    "pipe": PipeChannel,
    "pickled queue": QueueChannel,
}
#: Variant that uses only part of its slot -> number of bytes that are written and read.
WRITTEN = {BARE: 256 * 1024}
