"""What passes between page, server and run, there and back; clients that read, that do not, and that leave."""

from __future__ import annotations

import asyncio
import json
import struct
from typing import Any

import msgpack
import pytest

from trilane.apps.dashboard import view
from trilane.apps.dashboard.channel import (
    ChangesAsked,
    ChangesRefused,
    ControlAsked,
    Opened,
    RunBegins,
    StateIs,
    channel_pair,
    packed,
    unpacked,
)
from trilane.apps.dashboard.run_facts import Control, control_of, controls_of_run
from trilane.apps.dashboard.view import (
    MOST_CLIENTS,
    MOST_QUEUED,
    Client,
    Clients,
    ControlSaid,
    MalformedError,
    PictureAsked,
    Seek,
    heard,
    said,
    shown,
)
from trilane.unexpected_value import UnexpectedValue


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ({"type": "picture"}, PictureAsked(type="picture")),
        ({"type": "control", "name": "pause"}, ControlSaid(type="control", name="pause")),
        ({"type": "control", "name": "zoom", "value": 2}, ControlSaid(type="control", name="zoom", value=2.0)),
        ({"type": "control", "name": "o", "value": [1, 2.5]}, ControlSaid(type="control", name="o", value=[1.0, 2.5])),
        ({"type": "seek", "t_ms": 0, "span_ms": 1}, Seek(type="seek", t_ms=0.0, span_ms=1.0)),
    ],
)  # fmt: skip
def test_a_client_is_understood(message: dict[str, Any], expected: Any) -> None:
    assert heard(b"\x01" + json.dumps(message).encode()) == expected


@pytest.mark.parametrize(
    "text",
    [
        "", "1", "[]", '{"type":"hello"}', '{"type":"picture","x":1}', '{"type":"seek","t_ms":"1","span_ms":1}',
        '{"type":"seek","t_ms":-1,"span_ms":1}', '{"type":"seek","t_ms":1,"span_ms":0}', '{"type":"control"}',
        '{"type":"seek","t_ms":1,"span_ms":1e9}', '{"type":"control","name":"n","value":true}',
        '{"type":"control","name":"n","value":{}}', '{"type":"control","name":"n","value":[1]}',
        '{"type":"control","name":"n","value":Infinity}', '{"type":"control","name":"n","value":["a","b"]}',
        '{"type":"control","name":"' + 41 * "n" + '"}', '{"type":"control","name":"n","value":"' + 513 * "v" + '"}',
    ],
)  # fmt: skip
def test_nothing_else_is(text: str) -> None:
    with pytest.raises(MalformedError):
        heard(b"\x01" + text.encode())


@pytest.mark.parametrize("data", [b"", b"\x00{}", b'\x02{"type":"picture"}', b'{"type":"picture"}', b"\x01\xff"])
def test_another_kind_is_no_message(data: bytes) -> None:
    with pytest.raises(MalformedError):
        heard(data)


def test_the_page_is_told_in_bytes_that_are_written_down() -> None:
    assert said({"type": "note", "text": "ä"}) == b'\x01{"type":"note","text":"\\u00e4"}'
    assert shown(7, 250.0, 12.5, b"JPEG") == b"\x02" + struct.pack("<I", 7) + struct.pack("<dd", 250.0, 12.5) + b"JPEG"
    with pytest.raises(ValueError, match="not JSON compliant"):
        said({"x": float("nan")})


MESSAGES = [
    Opened("token", 480, 640), RunBegins("/runs/a", {"name": "a"}, [{"name": "play"}]), StateIs("paused", ""),
    ChangesRefused("size", "found 17"),
    ControlAsked("zoom", 2.5), ControlAsked("pause", None), ChangesAsked({"policy": "latest", "size": "128"}),
]  # fmt: skip


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: type(message).__name__)
def test_run_and_server_understand_each_other(message: Any) -> None:
    assert unpacked(packed(message)) == message


@pytest.mark.parametrize(
    "row",
    [
        [],
        [5, "x"],
        [9, "x"],
        [-6, "x"],
        ["0"],
        [2, "paused"],
        [2, "paused", 1],
        [0, "t", "480", 640],
        {"a": 1},
        3,
        None,
    ],
)
def test_bytes_of_no_message_are_refused(row: Any) -> None:
    with pytest.raises(UnexpectedValue):
        unpacked(msgpack.packb(row))


def test_a_channel_carries_messages_and_the_end_and_waits_for_nobody() -> None:
    ours, theirs = channel_pair()
    assert ours.receive() is None
    assert ours.send(StateIs("running", ""))
    assert theirs.recv(1 << 16) == packed(StateIs("running", ""))
    theirs.send(packed(ControlAsked("pause", None)))
    assert ours.receive() == ControlAsked("pause", None)
    sent = [ours.send(ChangesRefused("x", "y" * 10_000)) for _ in range(1000)]  # nobody reads
    assert sent[0] and not sent[-1]
    theirs.close()
    assert not ours.send(StateIs("ended", ""))
    with pytest.raises(EOFError):
        ours.receive()
    ours.close()


ZOOM = Control("zoom", "number", True, min=0.25, max=4.0)
ORBIT = Control("orbit", "drag", True, min=-360.0, max=360.0)
POLICY = Control("policy", "choice", False, choices=("pipelined", "latest"))
PAUSE = Control("pause", "action", True)


@pytest.mark.parametrize(
    ("control", "value", "is_accepted"),
    [
        (ZOOM, 0.25, True), (ZOOM, 4, True), (ZOOM, 4.01, False), (ZOOM, 0, False), (ZOOM, "1", False),
        (ZOOM, None, False), (ZOOM, True, False), (ZOOM, [1.0, 1.0], False), (ORBIT, [360.0, -360.0], True),
        (ORBIT, [361.0, 0.0], False), (ORBIT, 1.0, False), (POLICY, "latest", True), (POLICY, "Latest", False),
        (POLICY, None, False), (POLICY, 1.0, False), (PAUSE, None, True), (PAUSE, 1.0, False), (PAUSE, "", False),
    ],
)  # fmt: skip
def test_a_control_says_what_it_takes(control: Control, value: Any, is_accepted: bool) -> None:
    why = control.refusal(value)
    assert (why == "") == is_accepted
    assert is_accepted or "expected" in why


def test_a_control_that_cannot_be_used_says_why_and_controls_travel() -> None:
    choices = {name: ("a",) for name in ("policy", "edge", "performance_profile", "size", "runtime", "avatar")}
    controls = controls_of_run(("cpu", "gpu"), choices, {"performance_profile": "capped already"})
    named = {control.name: control for control in controls}
    assert named["performance_profile"].refusal("a") == "capped already" and named["edge"].refusal("a") == ""
    assert named["kill"].choices == ("cpu", "gpu") and named["kill"].live and not named["size"].live
    rows = msgpack.unpackb(msgpack.packb([control.as_json(None) for control in controls]))
    assert [control_of({key: row[key] for key in row if key != "value"}) for row in rows] == list(controls)


class Socket:
    """Takes messages while `is_open`; later ones wait for ever."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.is_open = True

    async def send_bytes(self, data: bytes) -> None:
        if not self.is_open:
            await asyncio.Event().wait()
        self.sent.append(data)

    async def close(self, code: int = 1000, reason: str | None = None) -> None:
        """Nobody asks for it here."""


def test_what_is_put_is_sent_in_order_until_the_task_is_cancelled() -> None:
    async def run() -> None:
        socket, gone = Socket(), list[int]()
        client = Client(socket, lambda: gone.append(1))
        task = asyncio.create_task(client.send_all())
        for number in range(300):
            client.put(bytes([number % 256]))
            await asyncio.sleep(0)
        await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.wait([task], timeout=60)
        assert task.cancelled() and not gone
        assert socket.sent == [bytes([number % 256]) for number in range(300)]

    asyncio.run(run())


def test_a_client_that_leaves_too_much_unsent_is_dropped_once() -> None:
    async def run() -> None:
        socket, gone = Socket(), list[int]()
        socket.is_open = False
        client = Client(socket, lambda: gone.append(1))
        task = asyncio.create_task(client.send_all())
        await asyncio.sleep(0)
        for _ in range(MOST_QUEUED):
            client.put(b"x")
        await asyncio.sleep(0)
        assert not gone  # one is being sent, the others wait
        for _ in range(3):
            client.put(b"x")
        assert gone == [1]
        await asyncio.wait_for(task, 5)

    asyncio.run(run())


def test_a_client_that_takes_nothing_for_so_long_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view, "SEND_S", 0.01)

    async def run() -> None:
        socket, gone = Socket(), list[int]()
        socket.is_open = False
        client = Client(socket, lambda: gone.append(1))
        client.put(b"x")
        await asyncio.wait_for(client.send_all(), 5)
        assert gone == [1]

    asyncio.run(run())


def test_all_are_told_and_no_more_than_a_few_are_there() -> None:
    everybody, sockets = Clients(), [Socket() for _ in range(MOST_CLIENTS)]
    pages = [Client(each, lambda: None) for each in sockets]
    joined = [everybody.joined(page) for page in pages]
    for each in joined:
        assert not everybody.are_full
        each.__enter__()
    assert everybody.are_full and len(everybody) == MOST_CLIENTS
    pages[2].asks_picture = True
    assert everybody.waiting == [pages[2]]
    everybody.tell(b"news")
    assert all(page._queue.get_nowait() == b"news" for page in pages)
    for each in joined:
        each.__exit__(None, None, None)
    assert len(everybody) == 0 and not everybody.are_full
