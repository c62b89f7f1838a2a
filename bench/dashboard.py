"""What does the dashboard cost the run that it shows?

Rule: one run goes on while nobody looks, the server alone, and pages take turns, so that a machine which grows slower
slows all of them. Frames are counted in the run's own journal, which has the clock of this process.
"""

from __future__ import annotations

import contextlib
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import psutil

from trilane.errors import BadInputError, MissingPartError, TrilaneError, install_line
from trilane.pipeline.journal import NAME, Begun, Worked, read_journal

#: Nobody: the server's process is stopped. Server: it follows the run, no page is open. Page: one that takes pictures
#: as fast as it gets them, and a client that asks and reads nothing.
VARIANTS = ("nobody", "server", "page")
SETTLE_S = 1.5  # at the beginning of each turn, which does not count
LEAST_S = 1.0
START_S = 120.0
END_S = 300.0
SERVER = "trilane.apps.dashboard.server_process"
PICTURE_KIND = 2
PICTURE = b'\x01{"type":"picture"}'
PATIENCE_S = 5.0


def measure(
    rounds: int = 10, seconds: float = 6.0, size: str = "256", avatar: str = "default", policy: str = "pipelined"
) -> dict[str, Any]:
    """A run under `trilane run --dashboard`, in which each variant has a turn of `seconds` in every round.

    Rows: a variant; `fps`: median over its turns; `ratio`, `low`, `high`: of its frame rate to that of `nobody` in the
    same round, median and middle half; `server_cpu`: cores that the server's process took; `pictures`: a second.

    Raises BadInputError, MissingPartError, and TrilaneError when the run fails.
    """
    _require(seconds)
    with tempfile.TemporaryDirectory(prefix="trilane-bench-") as folder:
        options = ["--size", size, "--avatar", avatar, "--policy", policy, "--no-video", "--out", "run"]
        with _running(Path(folder), options) as run:
            turns = [run.turn(variant, seconds) for _, variant in product(range(rounds), VARIANTS)]
        ends_ns = _presented_ns(Path(folder) / "run" / NAME)
    rates = [_rate(turn, ends_ns) for turn in turns]
    return {
        "rows": [_row(variant, turns, rates) for variant in VARIANTS],
        "config": {"rounds": rounds, "seconds": seconds, "size": size, "avatar": avatar, "policy": policy},
    }


@dataclass(frozen=True)
class Turn:
    """A stretch of the run. `server_s`: CPU time that the server took; `pictures`: that the page got."""

    variant: str
    begin_ns: int
    end_ns: int
    server_s: float
    pictures: int


class _Run:
    """A run that goes on, and its server."""

    def __init__(self, parent: subprocess.Popen[str], url: str, stderr: Path) -> None:
        self._parent, self._stderr = parent, stderr
        self._base, self._token = url.split("/?token=")
        servers = [each for each in psutil.Process(parent.pid).children(recursive=True) if SERVER in each.cmdline()]
        self._server = servers[0]

    def turn(self, variant: str, seconds: float) -> Turn:
        """`variant` for so long. Raises TrilaneError when the run has ended."""
        if variant == "nobody":
            self._server.send_signal(signal.SIGSTOP)
        with contextlib.ExitStack() as opened:
            pages = [opened.enter_context(self._page(reads)) for reads in (True, False) if variant == "page"]
            time.sleep(SETTLE_S)
            begin_ns, cpu_s, had = time.monotonic_ns(), self._server_s(), [page.pictures for page in pages]
            time.sleep(seconds)
            end_ns, cpu_s = time.monotonic_ns(), self._server_s() - cpu_s
            pictures = pages[0].pictures - had[0] if pages else 0
        self._server.send_signal(signal.SIGCONT)
        if self._parent.poll() is not None:
            raise TrilaneError(f"the run ended by itself: {self._stderr.read_text(errors='replace')[-500:]}")
        return Turn(variant, begin_ns, end_ns, cpu_s, pictures)

    def _server_s(self) -> float:
        times = self._server.cpu_times()
        return float(times.user + times.system)

    @contextlib.contextmanager
    def _page(self, reads: bool) -> Iterator[_Page]:
        from websockets.sync.client import connect

        url = f"{self._base.replace('http', 'ws')}/live?token={self._token}"
        with connect(url, origin=self._base, max_size=None, open_timeout=START_S, close_timeout=0.1) as socket:
            page = _Page(socket, reads)
            page.start()
            yield page
            page.is_over = True


class _Page(threading.Thread):
    """A client that asks for pictures; one that does not read asks once. `pictures`: that it got."""

    def __init__(self, socket: Any, reads: bool) -> None:
        super().__init__(name="page", daemon=True)
        self._socket, self._reads = socket, reads
        self.pictures = 0
        self.is_over = False

    def run(self) -> None:
        self._socket.send(PICTURE)
        with contextlib.suppress(Exception):  # it is closed while it waits
            while self._reads and not self.is_over:
                if self._socket.recv(PATIENCE_S)[0] == PICTURE_KIND:
                    self.pictures += 1
                    self._socket.send(PICTURE)


@contextlib.contextmanager
def _running(folder: Path, options: list[str]) -> Iterator[_Run]:
    """A run in `folder`, once it presents frames; it is ended cleanly. Raises TrilaneError."""
    stderr = folder / "stderr"
    command = [sys.executable, "-m", "trilane.apps.cli.main", "run", "--dashboard", "--json", *options]
    with stderr.open("w") as file:
        parent = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=file, text=True)
    try:
        end = time.monotonic() + START_S
        while not (found := re.search(r"dashboard: (\S+)", stderr.read_text())) or not _goes_on(folder):
            if parent.poll() is not None or time.monotonic() > end:
                raise TrilaneError(f"the run did not begin: {stderr.read_text(errors='replace')[-500:]}")
            time.sleep(0.2)
        yield _Run(parent, found[1], stderr)
        parent.send_signal(signal.SIGINT)
        parent.wait(END_S)
    finally:
        parent.kill()
        parent.wait()


def _goes_on(folder: Path) -> bool:
    """Whether the run's journal has more than its first record."""
    return any(journal.stat().st_size > 50_000 for journal in folder.glob(f"run.*.partial/{NAME}"))


def _presented_ns(journal: Path) -> list[int]:
    """When each frame was presented."""
    last, ends_ns = "", []
    for record in read_journal(journal):
        if isinstance(record, Begun):
            last = record.graph.stages[-1].name
        elif isinstance(record, Worked) and record.job.stage == last:
            ends_ns.append(record.job.end_ns)
    return ends_ns


def _rate(turn: Turn, ends_ns: list[int]) -> float:
    """Frames a second between the first and the last that were presented in the turn."""
    within = [end for end in ends_ns if turn.begin_ns <= end < turn.end_ns]
    return (len(within) - 1) * 1e9 / (within[-1] - within[0]) if len(within) > 1 else 0.0


def _row(variant: str, turns: list[Turn], rates: list[float]) -> dict[str, Any]:
    place = VARIANTS.index(variant)
    own = list(zip(turns, rates, strict=True))[place :: len(VARIANTS)]
    alone = rates[:: len(VARIANTS)]
    ratios = sorted(rate / base for (_, rate), base in zip(own, alone, strict=True) if base)
    lengths = [(turn.end_ns - turn.begin_ns) / 1e9 for turn, _ in own]
    return {
        "variant": variant,
        "fps": median(rate for _, rate in own),
        "ratio": median(ratios) if ratios else None,
        "low": ratios[len(ratios) // 4] if ratios else None,
        "high": ratios[(3 * len(ratios)) // 4] if ratios else None,
        "server_cpu": median(turn.server_s / length for (turn, _), length in zip(own, lengths, strict=True)),
        "pictures": median(turn.pictures / length for (turn, _), length in zip(own, lengths, strict=True)),
    }


def _require(seconds: float) -> None:
    if seconds < LEAST_S:
        raise BadInputError("--seconds", f"{seconds:g}", f"at least {LEAST_S:g}")
    for package in ("websockets", "uvicorn", "starlette", "prometheus_client"):
        try:
            __import__(package)
        except ImportError:
            raise MissingPartError(f"the dashboard needs the package {package}", install_line("dashboard")) from None
