"""A run under its dashboard, as the page and those who should not get in meet it. One run for all of it, in order.

The pictures of the tiny network mean nothing, and the scene stands still: two pictures differ only when the camera was
steered.
"""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import psutil
import pytest

pytest.importorskip("starlette", reason="the extra dashboard is not installed")
pytest.importorskip("uvicorn", reason="the extra dashboard is not installed")
pytest.importorskip("prometheus_client", reason="the extra dashboard is not installed")
websockets = pytest.importorskip("websockets.sync.client", reason="the extra dashboard is not installed")

from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402

from support.dashboard_client import PATIENCE_S, Page, Served, serving  # noqa: E402
from trilane.apps.dashboard.view import MOST_CLIENTS  # noqa: E402
from trilane.apps.run.report import read_report  # noqa: E402

pytestmark = pytest.mark.slow

NO_MORE_S = 0.6  # in which a run that is not held would present more frames


def command(bundle: Path) -> list[str]:
    still = ["--motion", "builtin:t-pose", "--camera", "builtin:static"]
    pace = ["--profile", "snapdragon-888", "--pace", "--slow-motion", "16"]  # 20 frames a second
    base = [sys.executable, "-m", "trilane.apps.cli.main", "run", "--avatar", str(bundle), "--size", "64x64"]
    return [*base, *still, *pace, "--picture", "128x96", "--dashboard", "--json", "--out", "run"]


@pytest.fixture(scope="module")
def served(drawable_bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Served, Path]]:
    """A run that goes on until the tests end it, and the folder in which it was started."""
    folder = tmp_path_factory.mktemp("dashboard")
    with serving(command(drawable_bundle), folder) as served:
        yield served, folder


@pytest.fixture(scope="module")
def page(served: tuple[Served, Path]) -> Iterator[Page]:
    """A page that stays open."""
    with served[0].connect(max_queue=None) as socket:  # it goes on reading while a test does other things
        page = Page(socket)
        page.until(lambda: page.presented > 5, "frames")
        yield page


@pytest.fixture
def server(served: tuple[Served, Path], page: Page) -> Iterator[Served]:
    """The server, while a page is open; afterwards the run still goes on."""
    yield served[0]
    before = page.presented
    page.until(lambda: page.presented > before, "frames after it")


def test_the_page_is_told_what_it_shows(page: Page) -> None:
    hello = page.told["hello"]
    assert hello["is_live"] and hello["run"]["name"] == "run" and hello["run"]["units"] == ["cpu", "gpu", "dsp"]
    rows = {row["name"]: row for row in hello["controls"]}
    assert {name for name, row in rows.items() if not row["live"]} == {
        "policy", "edge", "performance_profile", "size", "runtime", "avatar"
    }  # fmt: skip
    assert all(row["value"] in row["choices"] for row in rows.values() if row["kind"] == "choice" and not row["live"])
    assert page.state == "running"
    page.until(lambda: page.told.get("slices", {}).get("jobs"), "slices")
    assert {"fps", "units", "stages", "latency_ms"} <= page.told["figures"].keys()


@pytest.mark.parametrize("path", ["/", "/metrics", "/trace.pftrace"])
@pytest.mark.parametrize("query", ["", "?token=", "?token=no", "?token={0}&token={0}", "?tokens={0}"])
def test_without_the_token_nothing_is_told(served: tuple[Served, Path], path: str, query: str) -> None:
    server = served[0]
    with server.counted("wrong_token"):
        status, body, _ = server.get(path + query.format(server.token))
        assert status == 403 and "trilane_" not in body


@pytest.mark.parametrize("host", ["evil.example:{0}", "evil.example", "127.0.0.1", "127.0.0.1:1", "[::1]:{0}", ""])
def test_a_name_that_was_made_to_point_here_gets_nothing(served: tuple[Served, Path], host: str) -> None:
    server = served[0]
    with server.counted("foreign_host"):
        assert server.get(f"/?token={server.token}", Host=host.format(server.port))[0] == 421


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "https://127.0.0.1:{0}", "null", ""])
def test_another_sites_page_gets_no_connection(server: Served, origin: str) -> None:
    with server.counted("foreign_origin"), pytest.raises(InvalidStatus, match="403"):
        server.connect(origin=origin.format(server.port))


def test_a_connection_needs_the_token(server: Served) -> None:
    with server.counted("wrong_token"), pytest.raises(InvalidStatus, match="403"):
        server.connect(token="no")  # noqa: S106 - it is none


def test_answers_forbid_everything_from_elsewhere(served: tuple[Served, Path]) -> None:
    server = served[0]
    for path in (f"/?token={server.token}", "/app.js", f"/metrics?token={server.token}", "/?token=no", "/none"):
        _, _, headers = server.get(path)
        policy = headers["content-security-policy"]
        assert policy.startswith("default-src 'none'") and "unsafe" not in policy and "*" not in policy
        assert (headers["x-content-type-options"], headers["referrer-policy"]) == ("nosniff", "no-referrer")
        assert headers["cache-control"] == "no-store" and "server" not in headers


def test_no_file_beside_the_page_is_served(served: tuple[Served, Path]) -> None:
    server = served[0]
    for path in ("/../app.py", "/%2e%2e/app.py", "/..%2fapp.py", "//etc/passwd", "/vendor/../../app.py"):
        status, body, _ = server.get(path)
        assert status in (404, 400, 307) and "Starlette" not in body and "root:" not in body


def test_a_message_that_is_too_long_ends_the_connection(server: Served) -> None:
    with server.counted("oversized"), server.connect() as socket, pytest.raises(ConnectionClosed, match="1009"):
        socket.send(b"\x01" + b" " * 5000)
        while True:
            socket.recv(PATIENCE_S)


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\x01", b"\x02abc", b"\xff" * 100, b"\x01{", b'\x01{"type":"x"}', b'\x01{"type":"picture","more":1}',
        b'\x01{"type":"control","name":1}', b'\x01{"type":"control","name":"zoom","value":NaN}',
        b'\x01{"type":"control","name":"orbit","value":[1,2,3]}', b'\x01{"type":"seek","t_ms":-1,"span_ms":1}',
        b"\x01[[[[[[", b'\x01"\xff\xfe"', '{"type":"picture"}',
    ],
)  # fmt: skip
def test_what_is_no_message_is_refused(server: Served, data: Any) -> None:
    with server.counted("malformed"), server.connect() as socket:
        page = Page(socket)
        socket.send(data)
        page.until(lambda: page.refused, "a refusal")
        assert page.refused[0]["why"]


def test_who_goes_on_with_nonsense_is_put_out(server: Served) -> None:
    with server.connect() as socket, pytest.raises(ConnectionClosed, match="1008"):
        for _ in range(100):
            socket.send(b"\x00")
            socket.recv(PATIENCE_S)


def test_bytes_that_are_no_frame_end_the_connection(server: Served) -> None:
    with server.counted("malformed"), server.connect() as connection:
        connection.socket.sendall(b"\xff\xff" + bytes(64))
        with pytest.raises(ConnectionClosed):
            while True:
                connection.recv(PATIENCE_S)


@pytest.mark.parametrize(
    ("control", "value"),
    [
        ("zoom", 9), ("zoom", 0), ("zoom", "2"), ("zoom", None), ("orbit", [1e9, 0]), ("orbit", 1), ("kill", "npu"),
        ("policy", "fastest"), ("edge", "fifo:0"), ("size", "17"), ("size", 96), ("avatar", "/etc"),
        ("runtime", "none"), ("pause", 1), ("reboot", None), ("seek", 1),
    ],
)  # fmt: skip
def test_a_control_out_of_its_range_is_refused(server: Served, page: Page, control: str, value: Any) -> None:
    with server.counted("control"):
        page.refused.clear()
        page.control(control, value)
        page.until(lambda: page.refused, "a refusal")
        assert page.refused[0]["control"] == control and "expected" in page.refused[0]["why"]


def test_of_two_hundred_connections_a_few_are_served(server: Served, page: Page) -> None:
    with ExitStack() as opened:
        sockets = [opened.enter_context(socket.create_connection(("127.0.0.1", server.port))) for _ in range(200)]
        for each in sockets:
            each.sendall(server.handshake())
        answers = [each.recv(12) for each in sockets]
        served = MOST_CLIENTS - 1  # beside the page
        assert Counter(answers) == {b"HTTP/1.1 101": served, b"HTTP/1.1 403": 200 - served}
        before = page.presented
        page.until(lambda: page.presented > before, "frames beside them")
    assert server.counts()["too_many_clients"] >= 200 - served


def test_a_client_that_never_reads_is_dropped(server: Served, page: Page) -> None:
    with server.counted("slow_client"), socket.create_connection(("127.0.0.1", server.port), PATIENCE_S) as slow:
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.sendall(server.handshake())
        assert slow.recv(12) == b"HTTP/1.1 101"
        wrong = b"\x01" + json.dumps({"type": "control", "name": "z" * 40, "value": "y" * 60}).encode()
        frame = b"\x82" + bytes([0x80 | 126, 0, len(wrong)]) + bytes(4) + wrong  # masked with zeros
        before = page.presented
        with contextlib.suppress(OSError):
            for _ in range(10_000):  # each has an answer, which is not read
                slow.sendall(frame)
        page.until(lambda: page.presented > before, "frames meanwhile")


def test_steering_changes_the_picture_and_nothing_else_does(page: Page) -> None:
    first = page.picture()
    assert page.picture() == first
    page.control("orbit", [25.0, 10.0])
    page.until(lambda: page.picture() != first, "a turned picture")
    turned = page.picture()
    assert page.told["state"]["config"]["orbit"] == [-25.0, 10.0]
    page.control("zoom", 2.0)
    page.until(lambda: page.picture() != turned, "a nearer picture")
    page.control("recentre")
    page.until(lambda: page.picture() == first, "the first picture again")


def test_a_run_is_held_and_stepped(page: Page) -> None:
    page.control("pause")
    page.until(lambda: page.state == "paused", "the hold")
    held = page.settle()
    page.control("step")
    page.until(lambda: page.presented > held, "a step")
    later = time.monotonic() + NO_MORE_S
    page.until(lambda: time.monotonic() > later, "no more")
    assert page.settle() == held + 1
    page.control("play")
    page.until(lambda: page.state == "running", "the run to go on")


def test_a_killed_unit_comes_back(server: Served, page: Page) -> None:
    pids = {process.pid for process in psutil.Process(server.parent.pid).children(recursive=True)}
    page.control("kill", "dsp")
    page.until(lambda: page.told["figures"]["units"]["dsp"]["restarts"] == 1, "the restart")
    page.until(lambda: page.told["figures"]["units"]["dsp"]["is_up"], "the unit")
    assert "unit dsp is killed, as was asked" in page.notes
    assert {process.pid for process in psutil.Process(server.parent.pid).children(recursive=True)} != pids


def test_another_policy_begins_the_run_anew_and_says_so(page: Page) -> None:
    states: list[str] = []
    page.control("policy", "sequential")
    page.until(lambda: states.append(page.state) or page.state == "restarting", "the restart")  # type: ignore[func-returns-value]
    assert "policy sequential" in page.told["state"]["why"]
    page.until(lambda: page.hellos == 2 and page.state == "running", "the second run")
    assert page.told["state"]["config"]["policy"] == "sequential"
    page.until(lambda: page.presented > 0, "its frames")


def test_every_run_is_left_whole_and_was_not_harmed(served: tuple[Served, Path]) -> None:
    parent, folder = served[0].parent, served[1]
    children = psutil.Process(parent.pid).children(recursive=True)
    parent.send_signal(signal.SIGINT)
    parent.communicate(timeout=PATIENCE_S)
    for name, policy, lost in (("run", "pipelined", {"died:dsp"}), ("run-2", "sequential", set[str]())):
        report = read_report(folder / name)
        frames = report.frames
        assert (report.config["policy"], report.failure, frames.dropped) == (policy, None, {})
        assert set(frames.lost_by_cause) <= lost
        assert frames.presented == frames.requested - frames.lost > 0
    assert not psutil.wait_procs(children, PATIENCE_S)[1]
