"""A client of the dashboard of a live run, as its page is one, and the command that serves it."""

from __future__ import annotations

import hashlib
import http.client
import json
import re
import struct
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from websockets.sync import client as websockets

PATIENCE_S = 60.0
SETTLED_S = 1.0


class Page:
    """A client as the page is one. `told`: the last message of each type; `refused`, `notes`: all of theirs."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self.told: dict[str, dict[str, Any]] = {}
        self.refused: list[dict[str, Any]] = []
        self.notes: list[str] = []
        self.hellos = 0
        self.pictures: list[tuple[int, str]] = []

    def say(self, **message: Any) -> None:
        self._socket.send(b"\x01" + json.dumps(message).encode())

    def control(self, name: str, value: Any = None) -> None:
        self.say(type="control", name=name, value=value)

    def hear(self, timeout_s: float = 0.5) -> None:
        """One message, if one comes."""
        try:
            data = self._socket.recv(timeout_s)
        except TimeoutError:
            return
        if data[0] == 2:
            frame = struct.unpack("<I", data[1:5])[0]
            self.pictures.append((frame, hashlib.sha256(data[21:]).hexdigest()))
            return
        message = json.loads(data[1:])
        self.told[message["type"]] = message
        self.refused += [message] if message["type"] == "refused" else []
        self.notes += [message["text"]] if message["type"] == "note" else []
        if message["type"] == "hello":  # another run, whose figures follow
            self.hellos += 1
            self.told.pop("figures", None)

    def until(self, condition: Callable[[], Any], what: str) -> None:
        end = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end, f"waited {PATIENCE_S} s for {what}; told {self.told.get('state')}"
            self.hear()

    def picture(self) -> str:
        """The digest of the next picture."""
        count = len(self.pictures)
        self.say(type="picture")
        self.until(lambda: len(self.pictures) > count, "a picture")
        return self.pictures[-1][1]

    def settle(self) -> int:
        """How many frames are presented once none is in flight, by figures that come after this call.

        The number has to stay for a second: a slow source has moments without a frame in flight while it goes on, a
        pause is told before the scheduler has heard of it, and older figures may wait in the socket.
        """
        seen, since = -1, time.monotonic()
        while time.monotonic() - since < SETTLED_S:
            self.told.pop("figures", None)
            self.until(lambda: self.told.get("figures", {}).get("frames", {}).get("in_flight") == 0, "frames in flight")
            if self.presented != seen:
                seen, since = self.presented, time.monotonic()
        return seen

    @property
    def presented(self) -> int:
        return int(self.told.get("figures", {}).get("frames", {}).get("presented", 0))

    @property
    def state(self) -> str:
        return str(self.told.get("state", {}).get("is"))


class Served:
    """The run's command and where it is served."""

    def __init__(self, parent: subprocess.Popen[str], url: str) -> None:
        self.parent = parent
        matched = re.fullmatch(r"http://127\.0\.0\.1:([0-9]+)/\?token=(.+)", url)
        assert matched is not None, url
        self.url, self.port, self.token = url, int(matched[1]), matched[2]

    def connect(self, token: str | None = None, origin: str | None = None, **more: Any) -> Any:
        """A WebSocket, as of the page unless told otherwise."""
        url = f"ws://127.0.0.1:{self.port}/live?token={self.token if token is None else token}"
        ours = f"http://127.0.0.1:{self.port}"
        return websockets.connect(url, origin=ours if origin is None else origin or None, max_size=None, **more)

    def handshake(self) -> bytes:
        """The bytes with which a WebSocket begins."""
        lines = [
            f"GET /live?token={self.token} HTTP/1.1", f"Host: 127.0.0.1:{self.port}", "Upgrade: websocket",
            f"Origin: http://127.0.0.1:{self.port}", "Connection: Upgrade", "Sec-WebSocket-Version: 13",
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        ]  # fmt: skip
        return "\r\n".join([*lines, "", ""]).encode()

    def get(self, path: str, **headers: str) -> tuple[int, str, dict[str, str]]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        try:
            connection.request("GET", path, headers=headers)
            answer = connection.getresponse()
            return answer.status, answer.read().decode(errors="replace"), {k.lower(): v for k, v in answer.getheaders()}
        finally:
            connection.close()

    def counts(self) -> dict[str, int]:
        """How often the server refused what, by /metrics."""
        text = self.get(f"/metrics?token={self.token}")[1]
        found = re.findall(r'trilane_dashboard_refused_total\{why="(\w+)"\} (\d+)', text)
        return {why: int(count) for why, count in found}

    @contextmanager
    def counted(self, why: str, at_least: int = 1) -> Iterator[None]:
        """What is done here is refused so often."""
        before = self.counts()[why]
        yield
        end = time.monotonic() + PATIENCE_S
        while self.counts()[why] < before + at_least and time.monotonic() < end:
            time.sleep(0.1)
        assert self.counts()[why] >= before + at_least


@contextmanager
def serving(command: Sequence[str], folder: Path) -> Iterator[Served]:
    """Start the command in `folder`, and yield it once it says where it is served; end it afterwards."""
    with (folder / "stderr").open("w+") as stderr:
        parent = subprocess.Popen(list(command), cwd=folder, stdout=subprocess.PIPE, stderr=stderr, text=True)
        try:
            end, found = time.monotonic() + PATIENCE_S, None
            while found is None and parent.poll() is None and time.monotonic() < end:
                time.sleep(0.1)
                found = re.search(r"dashboard: (\S+)", (folder / "stderr").read_text())
            assert found is not None, (folder / "stderr").read_text()
            yield Served(parent, found[1])
        finally:
            parent.kill()
            parent.communicate()
