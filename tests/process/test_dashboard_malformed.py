"""What is no request and no message: refused in one line and counted, without a traceback, and the page goes on."""

from __future__ import annotations

from urllib.parse import urlsplit

import pytest

pytest.importorskip("starlette", reason="the extra dashboard is not installed")
pytest.importorskip("uvicorn", reason="the extra dashboard is not installed")
pytest.importorskip("prometheus_client", reason="the extra dashboard is not installed")
pytest.importorskip("websockets", reason="the extra dashboard is not installed")

from support.dashboard_double import DoubleView, Served
from support.malformed_requests import Server, is_refused, send_one

COUNT = 30


@pytest.mark.parametrize("has_token", [True, False])
def test_what_is_malformed_is_refused_and_counted(
    has_token: bool, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    view = DoubleView()
    with Served(view) as served:
        parts = urlsplit(served.url)
        known = Server(str(parts.hostname), int(parts.port or 0), served.place.token)
        server = known if has_token else Server(known.host, known.port, "")
        answers = [send_one(server, 33, number) for number in range(COUNT)]
        page = known.answer(known.request(f"/?{known.query}"))
        greeted = known.answer(known.handshake(), until=b'"hello"')
    wrong = [(kind, answer[:200]) for kind, answer in answers if not is_refused(kind, answer)]
    assert not wrong
    assert sum(served.app.refusals.as_json().values()) == COUNT
    assert page.startswith(b"HTTP/1.1 200") and b'"hello"' in greeted
    assert not [record for record in caplog.records if record.exc_info]
    assert "Traceback" not in "".join(capfd.readouterr())
    assert view.said == []


@pytest.mark.parametrize("fields", [16, 17, 1000])
def test_a_query_of_many_fields_is_malformed(fields: int) -> None:
    with Served(DoubleView()) as served:
        server = Server("127.0.0.1", served.place.port, served.place.token)
        answer = server.answer(server.request(f"/?{server.query}" + "&a=b" * (fields - 1)))
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 200" if fields == 16 else b"HTTP/1.1 400")
    assert (body == b"refused: malformed\n") == (fields > 16)
    assert served.app.refusals.as_json()["malformed"] == (fields > 16)


@pytest.mark.parametrize(
    ("lines", "version", "status", "count"),
    [
        ((), "1.1", b"200", ""),
        ((), "1.0", b"200", ""),
        (("Content-Length: 0",), "1.1", b"200", ""),
        ((f"X: {'a' * 10_000}",), "1.1", b"200", ""),
        ((), "9.9", b"400", "malformed"),
        ((), "0.9", b"400", "malformed"),
        ((f"X: {'a' * 70_000}",), "1.1", b"4", "oversized"),
        (("Content-Length: 99999999999",), "1.1", b"400", "malformed"),
        (("Transfer-Encoding: chunked",), "1.1", b"400", "malformed"),
    ],
)
def test_the_head_of_a_request_is_sound(lines: tuple[str, ...], version: str, status: bytes, count: str) -> None:
    """With the right token. A long head that comes in pieces is refused by the library, as malformed."""
    with Served(DoubleView()) as served:
        server = Server("127.0.0.1", served.place.port, served.place.token)
        answer = server.answer(server.request(f"/?{server.query}", *lines, version=version))
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 " + status)
    counts = served.app.refusals.as_json()
    assert sum(counts.values()) == bool(count)
    if count == "malformed":
        assert (body, counts[count]) == (b"refused: malformed\n", 1)


@pytest.mark.parametrize("line", ["HTTP/9.9", "HTTP/1.1\r\nContent-Length: 5"])
def test_the_head_of_a_websocket_is_sound(line: str) -> None:
    with Served(DoubleView()) as served:
        server = Server("127.0.0.1", served.place.port, served.place.token)
        answer = server.answer(server.handshake().replace(b"HTTP/1.1", line.encode(), 1))
    assert answer.startswith(b"HTTP/1.1 400")
    assert served.app.refusals.as_json()["malformed"] == 1
