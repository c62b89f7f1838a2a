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
