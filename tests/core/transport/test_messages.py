"""Messages to the byte, what is no message, and the pipes that they cross."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import threading
from pathlib import Path
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilane.errors import TrilaneError
from trilane.transport.messages import (
    MAX_BYTES,
    PACKETS,
    Close,
    Closed,
    Done,
    Failed,
    JobPipe,
    MessageError,
    Ping,
    PongMessage,
    Ready,
    RunJob,
    job_pipe_pair,
    pack,
    unpack,
)


def words(*values: int) -> bytes:
    return b"".join(value.to_bytes(8, "little", signed=True) for value in values)


#: Message -> its bytes: which message it is, its integers, and msgpack of what is left when that is not empty.
BYTES = [
    (RunJob(1, 2, 3, -1, 5, 6, 7, 8, 9), b"\0" + words(1, 2, 3, -1, 5, 6, 7, 8, 9)),
    (Ping(), b"\1"),
    (Close(), b"\2"),
    (Ready(77), b"\3" + words(77)),
    (Done(1, 2**62, 3, 4, 5, 6, 7, 8, 9, 10, {}), b"\4" + words(1, 2**62, 3, 4, 5, 6, 7, 8, 9, 10)),
    (Done(*range(10), {"a": 1.5}), b"\4" + words(*range(10)) + b"\x81\xa1a\xcb\x3f\xf8" + bytes(6)),
    (Failed(-1, 2, "no"), b"\5" + words(-1, 2) + b"\xa2no"),
    (Failed(-2, 2, ""), b"\5" + words(-2, 2)),
    (PongMessage(), b"\6"),
    (Closed(), b"\7"),
]


@pytest.mark.parametrize(("message", "data"), BYTES, ids=[type(row[0]).__name__ for row in BYTES])
def test_a_message_has_the_bytes_that_are_written_down(message: Any, data: bytes) -> None:
    assert pack(message) == data
    again = unpack(data)
    assert (again, type(again)) == (message, type(message))


DONE = pack(Done(*range(10), {}))  # without metrics nothing follows the integers


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "unknown message b''"),
        (b"\x0aabc", r"unknown message b'\\nabc'"),
        (b"\2\0", "2 bytes for Close, which takes 1"),
        (b"\3" + words(1) + b"\0", "10 bytes for Ready, which takes 9"),
        (b"\5" + words(1, 2)[:15], "16 bytes for Failed, which takes 17"),
        (b"\5" + words(1, 2) + b"\1", "found '1', expected str"),
        (b"\5" + words(1, 2) + b"\xc1", "not msgpack: "),
        *(
            (DONE + msgpack.packb(metrics), r"expected dict|not msgpack")
            for metrics in (
                None,
                [1.0],
                1,
                "ms",
                {1: 2.0},
                {"ms": "2"},
                {"ms": True},
                {"ms": None},
                {"ms": 1.0, "n": "2"},
            )
        ),
    ],
)
def test_bytes_that_are_no_message_are_refused(data: bytes, said: str) -> None:
    with pytest.raises(MessageError, match=said):
        unpack(data)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_refused(data: bytes) -> None:
    with contextlib.suppress(MessageError):
        assert pack(unpack(data))


def test_whole_numbers_are_metrics_too() -> None:
    assert unpack(DONE + msgpack.packb({"ms": 2.5, "n": 3})) == Done(*range(10), {"ms": 2.5, "n": 3})


def test_the_largest_message_passes_whole_and_a_larger_one_is_not_packed() -> None:
    """17 bytes of integers and 3 of the text's length."""
    largest = Failed(1, 1, "e" * (MAX_BYTES - 17 - 3))
    ours, theirs = (JobPipe(end) for end in job_pipe_pair())
    ours.send(largest)
    ours.send(Ping())
    assert len(pack(largest)) == MAX_BYTES
    assert [theirs.receive(), theirs.receive()] == [largest, Ping()]
    ours.close()
    theirs.close()
    with pytest.raises(MessageError, match="Failed of 4080 bytes, expected less than 4096"):
        pack(Failed(1, 1, largest.message + "e"))


def test_pipes_are_crossed_keep_messages_apart_and_are_not_inherited() -> None:
    ours, theirs = job_pipe_pair()
    try:
        for end, other in ((ours, theirs), (theirs, ours)):
            os.write(end.writes, b"one")
            os.write(end.writes, b"two")
            assert [os.read(other.reads, 99), os.read(other.reads, 99)] == [b"one", b"two"]
        assert not any(os.get_inheritable(fd) for fd in (*ours, *theirs))
        JobPipe(ours, waits=True), JobPipe(theirs)
        assert [os.get_blocking(fd) for fd in (*ours, *theirs)] == [True, False, False, False]
        assert (JobPipe(ours).fileno(), JobPipe(ours).ended) == (ours.reads, False)
    finally:
        ours.close()
        theirs.close()


def test_a_job_pipe_waits_for_a_message_or_not_at_all() -> None:
    ours, theirs = job_pipe_pair()
    patient, hasty = JobPipe(ours, waits=True), JobPipe(theirs)
    assert hasty.receive() is None and not hasty.ended
    threading.Timer(0.05, hasty.send, [Ping()]).start()
    assert patient.receive() == Ping()
    hasty.close()
    assert patient.receive() is None and patient.ended
    patient.close()


def test_sending_to_an_end_that_is_closed_or_full_does_nothing() -> None:
    ours, theirs = (JobPipe(end) for end in job_pipe_pair())
    for number in range(10_000):
        ours.send(RunJob(number, 0, 0, 0, 0, 0, 0, 0))
    jobs = [theirs.receive() for _ in range(PACKETS + 1)]
    assert jobs == [*(RunJob(number, 0, 0, 0, 0, 0, 0, 0) for number in range(PACKETS)), None]
    theirs.close()
    ours.send(Ping())
    assert ours.receive() is None and ours.ended
    ours.close()


def test_messages_sent_before_an_end_closed_with_work_unread_are_received() -> None:
    ours, theirs = (JobPipe(end) for end in job_pipe_pair())
    theirs.send(PongMessage())
    ours.send(Ping())
    theirs.close()
    assert ours.receive() == PongMessage() and not ours.ended
    assert ours.receive() is None and ours.ended
    ours.close()


def test_a_job_pipe_refuses_bytes_that_are_no_message() -> None:
    end, other = job_pipe_pair()
    os.write(end.writes, b"no message")
    job_pipe = JobPipe(other)
    with pytest.raises(MessageError):
        job_pipe.receive()
    end.close()
    job_pipe.close()


def open_files() -> set[Path]:
    return set(Path("/proc/self/fd").iterdir())


@pytest.mark.parametrize(("missing", "is_enough"), [(0, True), (1, False)])
def test_a_pipe_of_sixteen_pages_will_do_and_a_smaller_one_will_not(
    missing: int, is_enough: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = open_files()
    monkeypatch.setattr(fcntl, "fcntl", lambda *_: 16 * os.sysconf("SC_PAGESIZE") - missing)
    if is_enough:
        for end in job_pipe_pair():
            end.close()
    else:
        said = r"^no pipe for 16 messages: 65535 bytes for a pipe, by /proc.*pipe-user-pages-soft"
        with pytest.raises(TrilaneError, match=said):
            job_pipe_pair()
    assert open_files() == before


def test_a_process_without_files_for_pipes_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    before, pipes = open_files(), iter([os.pipe2])

    def pipe2(flags: int) -> tuple[int, int]:
        for make in pipes:
            return make(flags)
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr("os.pipe2", pipe2)
    with pytest.raises(TrilaneError, match="too many open files"):
        job_pipe_pair()
    assert open_files() == before
