"""The channels of `bench handoff`, both ends in this process: bytes arrive, libraries are asked in their best form."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trilane.bench.lib import handoff_variants
from trilane.bench.lib.handoff_variants import (
    IceoryxChannel,
    PipeChannel,
    QueueChannel,
    SlotChannel,
    ZmqChannel,
    _SlotEnd,
)
from trilane.transport.messages import JobPipeEnd, RunJob


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_a_slot_is_shared_and_announced_by_a_job(monkeypatch: pytest.MonkeyPatch) -> None:
    """The channel as a child gets it has descriptors of its own; both see the same bytes, and the parent's close."""
    before = open_files()
    channel = SlotChannel(64, None)  # type: ignore[arg-type]
    monkeypatch.setattr(handoff_variants, "DupFd", lambda fd: SimpleNamespace(detach=lambda: os.dup(fd)))
    assert re.search(r"handoff\b(?!_)", str(Path(channel._place).readlink()))
    copies = []
    for _ in range(2):
        copies.append(SlotChannel.__new__(SlotChannel))
        copies[-1].__setstate__(channel.__getstate__())
    assert all(isinstance(end, JobPipeEnd) for copy in copies for end in copy._ends)
    closed: list[JobPipeEnd] = []
    close = JobPipeEnd.close
    monkeypatch.setattr(JobPipeEnd, "close", lambda end: (closed.append(end), close(end)))
    producer, consumer = copies[0].producer(), copies[1].consumer()
    assert closed == [copies[0]._ends[1], copies[1]._ends[0]], "each child closes the end that is not its own"
    assert producer.buffer().shape == (64,) and producer.buffer().dtype == np.uint8
    for value in (7, 9):
        producer.buffer()[:] = value
        producer.hand_over()
        assert (consumer.receive() == value).all()
        consumer.release()
    producer._job_pipe.close()  # type: ignore[attr-defined]
    open_before = open_files()
    channel.close()
    assert open_before - open_files() == 5, "the region, and two descriptors of each end"
    with pytest.raises(EOFError):
        consumer.receive()
    consumer._job_pipe.close()  # type: ignore[attr-defined]
    del producer, consumer, copies
    assert open_files() <= before + 2, "maps of the region"


def test_a_slots_messages_are_numbered_and_others_are_passed_over() -> None:
    sent: list[Any] = []
    answers = iter([None, "something else", RunJob(5, 0, 5, 0, 0, 0, 0, 0)])
    pipe = SimpleNamespace(send=sent.append, receive=lambda: next(answers), ended=False)
    payload = np.zeros(8, np.uint8)
    end = _SlotEnd(payload, pipe)  # type: ignore[arg-type]
    for _ in range(3):
        end.hand_over()
    still = {"stage": 0, "slot_in": 0, "slot_out": 0, "epoch": 0, "t_dispatch_ns": 0, "fresh": 0}
    assert sent == [RunJob(id=n, frame=n, **still) for n in range(3)]
    assert end.receive() is payload is end.buffer()


class Asked:
    """Notes every call by its name, and answers with what was told."""

    def __init__(self, **answers: Any) -> None:
        self.calls: list[Any] = []
        self._answers = answers

    def __getattr__(self, name: str) -> Any:
        def call(*what: Any, **options: Any) -> Any:
            self.calls.append((name, what, options))
            return self._answers.get(name)

        return call


def test_an_array_goes_through_a_queue_whole() -> None:
    there = np.arange(5, dtype=np.uint8)
    queue: Any = Asked(get=there)
    channel = QueueChannel(5, SimpleNamespace(Queue=lambda: queue))  # type: ignore[arg-type]
    producer, consumer = channel.producer(), channel.consumer()
    assert producer.buffer().shape == (5,) and producer.buffer().dtype == np.uint8 and not producer.buffer().any()
    producer.hand_over()
    assert consumer.receive() is there
    assert consumer.buffer().size == 0
    channel.close()
    ((put, (array,), _), *rest) = queue.calls
    assert put == "put" and array is producer.buffer()
    assert rest == [("get", (), {"timeout": 60.0}), ("close", (), {})]


def test_raw_bytes_go_through_a_pipe_into_an_array_that_is_there() -> None:
    ends: Any = Asked(), Asked()
    made = (PipeChannel(5, SimpleNamespace(Pipe=lambda: ends)), PipeChannel(5, SimpleNamespace(Pipe=lambda: ends)))  # type: ignore[arg-type]
    producer, consumer = made[0].producer(), made[1].consumer()
    assert [end.calls for end in ends] == [[("close", (), {})]] * 2, "each child closes the end that is not its own"
    producer.hand_over()
    own = consumer.receive()
    for end, name, array in ((ends[0], "send_bytes", producer.buffer()), (ends[1], "recv_bytes_into", own)):
        called, (data,), _ = end.calls[1]
        assert called == name and data == array.data and data.nbytes == 5 and array.dtype == np.uint8
    made[0].close()
    assert [end.calls[-1][0] for end in ends] == ["close"] * 2 and [len(end.calls) for end in ends] == [3, 3]


def test_bytes_are_a_frame_of_zeromq_and_neither_side_copies(monkeypatch: pytest.MonkeyPatch) -> None:
    sockets: list[Any] = []

    def socket(kind: str) -> Any:
        sockets.append(Asked(recv=SimpleNamespace(buffer=b"\1\2\3\4\5")))
        sockets[-1].kind = kind
        return sockets[-1]

    told = SimpleNamespace(Context=lambda: SimpleNamespace(socket=socket), PAIR="pair", RCVTIMEO="patience")
    monkeypatch.setattr(handoff_variants, "zmq", told)
    channel = ZmqChannel(5, None)  # type: ignore[arg-type]
    folder, endpoint = channel._folder.path, channel._endpoint
    assert endpoint == f"ipc://{folder / 'handoff'}"
    child = ZmqChannel.__new__(ZmqChannel)
    child.__dict__.update(channel.__getstate__())
    assert set(child.__dict__) == {"_size", "_endpoint"}
    producer, consumer = child.producer(), child.consumer()
    producer.hand_over()
    assert consumer.receive().tolist() == [1, 2, 3, 4, 5]
    assert (producer.buffer().shape, consumer.buffer().shape) == ((5,), (0,))
    ours, theirs = sockets
    assert [each.kind for each in sockets] == ["pair", "pair"]
    patience = ("setsockopt", ("patience", 60_000), {})
    assert ours.calls == [patience, ("bind", (endpoint,), {}), ("send", (producer.buffer().data,), {"copy": False})]
    assert theirs.calls == [patience, ("connect", (endpoint,), {}), ("recv", (), {"copy": False})]
    channel.close()
    assert not folder.exists()


def test_a_sample_of_iceoryx_is_written_in_place(request: pytest.FixtureRequest) -> None:
    """Two samples reach the other end; a folder and a prefix of its own keep what iceoryx2 leaves, until `close`."""
    pytest.importorskip("iceoryx2")
    channel = IceoryxChannel(64, None)  # type: ignore[arg-type]
    request.addfinalizer(channel.close)
    folder = Path(channel._folder)
    assert folder.parent == Path("/tmp") and folder.name.startswith(f"iox-{os.getpid()}-")  # noqa: S108
    assert channel._prefix == f"{folder.name}_"
    consumer, producer = channel.consumer(), channel.producer()
    for value in (7, 9):
        payload = producer.buffer()
        assert payload.shape == (64,)
        payload[:] = value
        producer.hand_over()
        del payload
        found = consumer.receive()
        assert found.tolist() == [value] * 64
        del found
        consumer.release()
    waited: list[Any] = []
    answers = iter([None, None, SimpleNamespace(payload=lambda: SimpleNamespace(as_memory_view=lambda: b"\1\2"))])
    consumer._listener = SimpleNamespace(blocking_wait=lambda: waited.append(1))  # type: ignore[attr-defined]
    consumer._subscriber = SimpleNamespace(receive=lambda: next(answers))  # type: ignore[attr-defined]
    assert consumer.receive().tolist() == [1, 2] and len(waited) == 2
    assert list(folder.iterdir())
    assert list(handoff_variants.SHM.glob(f"{channel._prefix}*"))
    del producer, consumer
    channel.close()
    assert not folder.exists() and not list(handoff_variants.SHM.glob(f"{channel._prefix}*"))


def test_without_iceoryx_the_parent_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "iceoryx2", None)
    with pytest.raises(ModuleNotFoundError):
        IceoryxChannel(64, None)  # type: ignore[arg-type]
