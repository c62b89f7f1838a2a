"""Malformed requests and messages for a dashboard: `malformed_requests.py URL --count 200`.

Rule: each one is drawn from a seed and its number, so a finding can be made again. The answer to each must begin with
a status of 400 to 499, or, once a WebSocket is open, be a refusal or close that connection. What the server prints is
for the caller to look at.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import json
import socket
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import Final
from urllib.parse import urlsplit

PATIENCE_S: Final = 60.0
REFUSED: Final = b'"refused"'
KEY: Final = "dGhlIHNhbXBsZSBub25jZQ=="


@dataclass(frozen=True)
class Server:
    """Where a dashboard listens. `token`: the one that the request says, the run's own or another."""

    host: str
    port: int
    token: str

    @property
    def query(self) -> str:
        return f"token={self.token}" if self.token else ""

    def request(self, target: str, *lines: str, method: str = "GET", version: str = "1.1") -> bytes:
        """A request for `target`, with the header that the server expects and `lines`."""
        head = [f"{method} {target} HTTP/{version}", f"Host: {self.host}:{self.port}", "Connection: close", *lines]
        return ("\r\n".join(head) + "\r\n\r\n").encode("latin-1")

    def handshake(self, *lines: str) -> bytes:
        """Of a WebSocket; without `lines` it is sound."""
        own = lines or (f"Sec-WebSocket-Key: {KEY}", "Sec-WebSocket-Version: 13")
        head = [f"GET /live?{self.query} HTTP/1.1", f"Host: {self.host}:{self.port}", "Upgrade: websocket"]
        head += ["Connection: Upgrade", f"Origin: http://{self.host}:{self.port}", *own]
        return ("\r\n".join(head) + "\r\n\r\n").encode("latin-1")

    def answer(self, *parts: bytes, until: bytes = b"") -> bytes:
        """All that the server says to `parts` until it ends the connection, or has said `until`.

        Each part is sent after the answer to the last began.
        """
        said = b""
        with socket.create_connection((self.host, self.port), PATIENCE_S) as client:
            for part in parts[:-1]:
                client.sendall(part)
                said += client.recv(1 << 16)
            client.sendall(parts[-1])
            with contextlib.suppress(ConnectionResetError):  # the server has closed before it read everything
                while not (until and until in said) and (more := client.recv(1 << 16)):
                    said += more
        return said


def _fields(server: Server, random: Random) -> bytes:
    fields = "&".join(f"{random.choice('abct')}{k}={k}" for k in range(random.randint(17, 2000)))
    return server.request(f"/?{server.query}&{fields}"[:8000])


def _nul(server: Server, random: Random) -> bytes:
    return server.request(f"/{random.choice(['', 'css/', '../', 'a' * 300])}%00{random.randint(0, 99)}.js")


def _long(server: Server, random: Random) -> bytes:
    return server.request("/" + random.choice(["a", "%ff", "..%2f", "a/"]) * random.randint(300, 2000))


def _line(server: Server, random: Random) -> bytes:
    line = random.choice(["GET", "GET / HTTP/9.9", "\x00\x01 / HTTP/1.1", "GET \xff HTTP/1.1", "GET  / HTTP/1.1", "{}"])
    return f"{line}\r\nHost: {server.host}:{server.port}\r\n\r\n".encode("latin-1")


def _headers(server: Server, random: Random) -> bytes:
    lines = ["Content-Length: -1", "Content-Length: x", "Transfer-Encoding: gzip", ": empty", "no colon", "a b: c"]
    return server.request(f"/?{server.query}", random.choice(lines))


def _method(server: Server, random: Random) -> bytes:
    method = random.choice(["POST", "PUT", "DELETE", "BREW", "OPTIONS", "PROPFIND"])
    return server.request(f"/?{server.query}", "Content-Length: 0", method=method)


def _range(server: Server, random: Random) -> bytes:
    span = random.choice(["bytes=x-", "bytes=9-1", "bytes=999999999-", "bytes=1-2-3"])
    return server.request(f"/?{server.query}", f"Range: {span}")


def _version(server: Server, random: Random) -> bytes:
    return server.request(f"/?{server.query}", version=random.choice(["0.9", "9.9", "2.0", "1.2"]))


def _large(server: Server, random: Random) -> bytes:
    return server.request(f"/?{server.query}", f"X-Large: {'a' * random.randint(17_000, 200_000)}")


def _body(server: Server, random: Random) -> bytes:
    line = random.choice(["Content-Length: 1", f"Content-Length: {10**15}", "Transfer-Encoding: chunked"])
    return server.request(f"/?{server.query}", line)


def _token(server: Server, random: Random) -> bytes:
    token = random.choice(["%ff", "%ed%a0%80", "\xe9", "%", "a" * 4000, f"{server.token}&token={server.token}"])
    return server.request(f"/metrics?token={token}x")


def _handshake(server: Server, random: Random) -> bytes:
    version = "Sec-WebSocket-Version: 13"
    lines = [(version,), (version, "Sec-WebSocket-Key: x"), (f"Sec-WebSocket-Key: {KEY}", "Sec-WebSocket-Version: 7")]
    key = base64.b64encode(random.randbytes(random.choice([0, 5, 400]))).decode()
    lines += [(version, f"Sec-WebSocket-Key: {key}")]
    lines += [(f"Sec-WebSocket-Key: {KEY}", "Sec-WebSocket-Version: thirteen")]
    return server.handshake(*random.choice(lines))


def frame(opcode: int, payload: bytes, *, is_masked: bool = True) -> bytes:
    """A WebSocket frame with a mask of zeros; `opcode` may have more than a client may say."""
    bit = 0x80 if is_masked else 0
    length = bytes([bit | len(payload)]) if len(payload) < 126 else bytes([bit | 126]) + struct.pack(">H", len(payload))
    return bytes([0x80 | opcode]) + length + (bytes(4) if is_masked else b"") + payload


def _frames(_server: Server, random: Random) -> bytes:
    control = json.dumps({"type": "control", "name": "x" * random.randint(41, 99)}).encode()
    said = [b"", b"\x01", b"\x01{", b"\x02x", b"\x01" + b"[" * 3000, b"\x01" + b"9" * 4000, b"\x01\xff\xfe"]
    said += [
        b"\x01null",
        b"\x01" + control,
        b'\x01{"type":"seek","t_ms":NaN,"span_ms":1}',
        b'\x01{"type":"picture","more":1}',
    ]
    whole = [frame(2, each) for each in said] + [frame(1, b"\xff\xff"), frame(1, b"text"), frame(2, bytes(5000))]
    whole += [frame(11, b""), frame(0, b"x"), frame(0x42, b"x"), frame(9, bytes(200)), frame(2, b"x", is_masked=False)]
    return random.choice([*whole, b"\xff" + random.randbytes(60)])


REQUESTS: Final[tuple[Callable[[Server, Random], bytes], ...]] = (
    _fields, _nul, _long, _line, _headers, _method, _range, _version, _large, _body, _token, _handshake,
)  # fmt: skip


def send_one(server: Server, seed: int, number: int) -> tuple[str, bytes]:
    """Send message `number`; what kind it is, and what was answered."""
    random = Random(f"{seed}/{number}")
    if number % 3 == 2 and server.token:
        return "frames", server.answer(server.handshake(), _frames(server, random), until=REFUSED)
    make = REQUESTS[number % len(REQUESTS)] if number < len(REQUESTS) else random.choice(REQUESTS)
    return make.__name__[1:], server.answer(make(server, random))


def is_refused(kind: str, answer: bytes) -> bool:
    """Whether `answer` has a status of 400 to 499 and a line, or is that of an open WebSocket."""
    head, _, body = answer.partition(b"\r\n\r\n")
    if kind == "frames":
        return head.startswith(b"HTTP/1.1 101") and (REFUSED in body or b"\x88" in body)
    return head.startswith(b"HTTP/1.1 4") and body.strip().count(b"\n") == 0


def main() -> int:
    """Send `--count` messages to a dashboard with its token and as many without; 1 where one is not refused."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("url")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    parts = urlsplit(args.url)
    counts: Counter[str] = Counter()
    for token in (parts.query.removeprefix("token="), ""):
        server = Server(str(parts.hostname), int(parts.port or 80), token)
        for number in range(args.count):
            kind, answer = send_one(server, args.seed, number)
            counts[f"{'with' if token else 'without'} a token: {kind}"] += 1
            if not is_refused(kind, answer):
                counts["not refused"] += 1
                print(f"{kind} {number} {'with' if token else 'without'} a token: {answer[:80]!r}")
    print(dict(sorted(counts.items())))
    return 1 if counts["not refused"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
