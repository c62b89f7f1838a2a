"""The two ends of every hand-over that `bench handoff` compares: where to write, how to announce, how to receive.

Rule: `Producer.buffer` is filled before the clock starts; `Consumer.receive` returns when every byte can be read.
"""

from __future__ import annotations

import os
import shutil
import socket
import tempfile
from collections.abc import Callable
from multiprocessing.context import SpawnContext
from multiprocessing.queues import Queue
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from trilane.stages.contracts import SlotLayout
from trilane.transport.bus import Link
from trilane.transport.memory import RegionLayout, create_region, map_region
from trilane.transport.messages import Message, RunJob, pack, unpack

U8 = NDArray[np.uint8]
SLOTS = 2
WAIT_MS = 60_000


class Producer(Protocol):
    """The end that has the bytes first."""

    def buffer(self) -> U8:
        """Where the next bytes are written."""

    def hand_over(self) -> None:
        """They are written: tell the other end, or send them."""


class Consumer(Protocol):
    """The end that waits for them."""

    def receive(self) -> U8:
        """Wait for the next bytes; they may be read until `release`."""

    def release(self) -> None:
        """They were read."""


class Channel(Protocol):
    """Made in the parent, sent to both children, opened there."""

    def producer(self, end: socket.socket) -> Producer:
        """In the child that writes. `end`: of a SOCK_SEQPACKET pair with the other child."""

    def consumer(self, end: socket.socket) -> Consumer:
        """In the child that reads."""

    def close(self) -> None:
        """In the parent, when both are gone."""


class SlotChannel:
    """As the pipeline: slots of a sealed memfd region, announced by a message over a `Link`."""

    def __init__(self, size: int, _context: SpawnContext) -> None:
        self._layout = RegionLayout(SLOTS, SlotLayout(1, size))
        self._region = create_region("handoff", self._layout)
        self._parent = os.getpid()

    def slots(self) -> list[U8]:
        """In a child: views of the slots' payloads."""
        fd = os.open(f"/proc/{self._parent}/fd/{self._region}", os.O_RDWR)
        views = [packet.payload for packet in map_region(fd, self._layout)]
        os.close(fd)
        return views

    def producer(self, end: socket.socket) -> Producer:
        return _SlotProducer(self.slots(), Link(end, WAIT_MS).send)

    def consumer(self, end: socket.socket) -> Consumer:
        return _SlotConsumer(self.slots(), Link(end, WAIT_MS).receive)

    def close(self) -> None:
        os.close(self._region)


class ZmqSlotChannel(SlotChannel):
    """The same slots and message, announced over a ZeroMQ PAIR: what the choice of the bus is worth."""

    def __init__(self, size: int, context: SpawnContext) -> None:
        super().__init__(size, context)
        self._endpoint = _Endpoint()

    def producer(self, end: socket.socket) -> Producer:  # noqa: ARG002 - it has a socket of its own
        pair = self._endpoint.open(bind=True)
        return _SlotProducer(self.slots(), lambda message: pair.send(pack(message)))

    def consumer(self, end: socket.socket) -> Consumer:  # noqa: ARG002
        pair = self._endpoint.open(bind=False)
        return _SlotConsumer(self.slots(), lambda: unpack(pair.recv()))

    def close(self) -> None:
        super().close()
        self._endpoint.remove()


class _SlotProducer:
    def __init__(self, payloads: list[U8], send: Callable[[Message], Any]) -> None:
        self._payloads, self._send, self._count = payloads, send, 0

    def buffer(self) -> U8:
        return self._payloads[self._count % SLOTS]

    def hand_over(self) -> None:
        slot = self._count % SLOTS
        self._send(RunJob(self._count, "infer", self._count, slot, slot, 0))
        self._count += 1


class _SlotConsumer:
    def __init__(self, payloads: list[U8], wait: Callable[[], Message | None]) -> None:
        self._payloads, self._wait = payloads, wait

    def receive(self) -> U8:
        while not isinstance(message := self._wait(), RunJob):
            pass
        return self._payloads[message.slot_in]

    def release(self) -> None:
        """The acknowledgement gives the slot back."""


class _Endpoint:
    """A ZeroMQ PAIR between two processes, with a name in a folder of its own."""

    def __init__(self) -> None:
        import zmq  # noqa: F401 - says here, in the parent, that it is not installed

        self._folder = tempfile.mkdtemp(prefix="trilane-", dir="/tmp")

    def open(self, *, bind: bool) -> Any:
        import zmq

        pair = zmq.Context().socket(zmq.PAIR)
        pair.setsockopt(zmq.RCVTIMEO, WAIT_MS)
        (pair.bind if bind else pair.connect)(f"ipc://{self._folder}/pair")
        return pair

    def remove(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)


class QueueChannel:
    """A `multiprocessing.Queue`: the array is pickled, copied through a pipe, and made again."""

    def __init__(self, size: int, context: SpawnContext) -> None:
        self._size, self._queue = size, context.Queue()

    def producer(self, end: socket.socket) -> Producer:  # noqa: ARG002 - it has a channel of its own
        return _QueueEnd(self._queue, self._size)

    def consumer(self, end: socket.socket) -> Consumer:  # noqa: ARG002
        return _QueueEnd(self._queue, 0)

    def close(self) -> None:
        self._queue.close()


class _QueueEnd:
    def __init__(self, channel: Queue[Any], size: int) -> None:
        self._queue, self._own = channel, np.zeros(size, np.uint8)

    def buffer(self) -> U8:
        return self._own

    def hand_over(self) -> None:
        self._queue.put(self._own)

    def receive(self) -> U8:
        array: U8 = self._queue.get(timeout=WAIT_MS / 1000)
        return array

    def release(self) -> None:
        """The array is this process's own."""


class ZmqChannel:
    """The bytes themselves as a ZeroMQ frame, copied as pyzmq does it by default."""

    def __init__(self, size: int, _context: SpawnContext) -> None:
        self._size, self._endpoint = size, _Endpoint()

    def producer(self, end: socket.socket) -> Producer:  # noqa: ARG002 - it has a socket of its own
        return _ZmqEnd(self._endpoint.open(bind=True), self._size)

    def consumer(self, end: socket.socket) -> Consumer:  # noqa: ARG002
        return _ZmqEnd(self._endpoint.open(bind=False), 0)

    def close(self) -> None:
        self._endpoint.remove()


class _ZmqEnd:
    def __init__(self, pair: Any, size: int) -> None:
        self._pair, self._own = pair, np.zeros(size, np.uint8)

    def buffer(self) -> U8:
        return self._own

    def hand_over(self) -> None:
        self._pair.send(self._own)

    def receive(self) -> U8:
        return np.frombuffer(self._pair.recv(), np.uint8)

    def release(self) -> None:
        """The bytes are this process's own."""


class IceoryxChannel:
    """iceoryx2: a loaned sample is written in place and sent, an event wakes the other end. Nothing is copied."""

    def __init__(self, size: int, _context: SpawnContext) -> None:
        import iceoryx2  # noqa: F401 - says here, in the parent, that it is not installed

        self._size, self._name = size, f"trilane/handoff/{os.getpid()}/{size}"

    def producer(self, end: socket.socket) -> Producer:  # noqa: ARG002 - it has a channel of its own
        return _IceoryxProducer(self._name, self._size)

    def consumer(self, end: socket.socket) -> Consumer:  # noqa: ARG002
        return _IceoryxConsumer(self._name)

    def close(self) -> None:
        """Its services go with the children."""


def _iceoryx_services(name: str) -> tuple[Any, Any, Any]:
    import ctypes

    import iceoryx2 as iox

    iox.set_log_level(iox.LogLevel.Error)
    node = iox.NodeBuilder.new().create(iox.ServiceType.Ipc)
    service = iox.ServiceName.new(name)
    samples = node.service_builder(service).publish_subscribe(iox.Slice[ctypes.c_uint8]).open_or_create()
    return node, samples, node.service_builder(service).event().open_or_create()


class _IceoryxProducer:
    def __init__(self, name: str, size: int) -> None:
        self._node, samples, event = _iceoryx_services(name)
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
    def __init__(self, name: str) -> None:
        self._node, samples, event = _iceoryx_services(name)
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


#: Way -> its channel. `slot` is Trilane's, one message from end to end.
CHANNELS: dict[str, Callable[[int, SpawnContext], Channel]] = {
    "slot": SlotChannel,
    "slot by zeromq": ZmqSlotChannel,
    "iceoryx2": IceoryxChannel,
    "zeromq copied": ZmqChannel,
    "pickled queue": QueueChannel,
}
