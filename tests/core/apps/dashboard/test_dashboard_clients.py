"""Clients of the dashboard that read, that do not, and that leave."""

from __future__ import annotations

import asyncio

import pytest

from trilane.apps.dashboard import view
from trilane.apps.dashboard.view import MOST_CLIENTS, MOST_QUEUED, Client, Clients


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
