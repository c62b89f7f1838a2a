"""Two hundred malformed messages with the token and two hundred without, to the dashboard of a small real run."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("starlette", reason="the extra dashboard is not installed")
pytest.importorskip("uvicorn", reason="the extra dashboard is not installed")
pytest.importorskip("prometheus_client", reason="the extra dashboard is not installed")
pytest.importorskip("websockets", reason="the extra dashboard is not installed")

from support.malformed_requests import Server, is_refused, send_one
from trilane import machine
from trilane.apps.run.report import read_report
from trilane.units import UNITS

pytestmark = pytest.mark.slow

COUNT = 200
PATIENCE_S = 240.0
FEW = ("--policy", "latest", "--fps", "5")  # frames a second, so that the server has time on one core
CORES = [word for unit in UNITS for word in ("--cores", f"{unit}={min(machine.here.cores())}")]  # so none are tried


def refusals(server: Server) -> int:
    """How often the server says that it refused something."""
    text = server.answer(server.request(f"/metrics?{server.query}")).decode()
    return sum(int(count) for count in re.findall(r"trilane_dashboard_refused_total\{.*\} (\d+)", text))


def test_a_run_goes_on_under_malformed_messages_and_each_is_counted(drawable_bundle: Path, tmp_path: Path) -> None:
    """Each is answered with one line and a status of 400 to 499, or closes its WebSocket; no frame is lost."""
    words = ["run", "--avatar", str(drawable_bundle), "--size", "64x64", "--picture", "128x96", "--dashboard", "--json"]
    stderr = tmp_path / "stderr"
    with stderr.open("w") as said:
        command = [sys.executable, "-m", "trilane.apps.cli.main", *words, "--out", "run", "--no-video", *FEW, *CORES]
        run = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=said)
        try:
            url, end = None, time.monotonic() + PATIENCE_S
            while url is None and run.poll() is None and time.monotonic() < end:
                time.sleep(0.1)
                url = re.search(r"http://([\d.]+):(\d+)/\?token=(\S+)", stderr.read_text())
            assert url is not None, stderr.read_text()
            known = Server(url[1], int(url[2]), url[3])
            wrong = []
            for server in (known, Server(known.host, known.port, "")):
                answers = [(number, *send_one(server, 33, number)) for number in range(COUNT)]
                wrong += [each for each in answers if not is_refused(each[1], each[2])]
            assert not wrong
            assert refusals(known) == 2 * COUNT
            assert known.answer(known.request(f"/?{known.query}")).startswith(b"HTTP/1.1 200")
            while not list(tmp_path.glob("run.*.partial/journal.msgpack")):  # the placement may still be measured
                assert run.poll() is None and time.monotonic() < end, stderr.read_text()
                time.sleep(0.1)
            time.sleep(1.0)
            run.send_signal(signal.SIGINT)
            assert run.wait(PATIENCE_S) == 130
        finally:
            run.kill()
            run.wait()
    assert "Traceback" not in stderr.read_text()
    report = read_report(tmp_path / "run")
    assert report.frames.lost == 0 < report.frames.presented
    assert report.failure is None and len(report.messages) <= 1  # that it was interrupted
    assert all(row.restarts == 0 for row in report.units.values())
