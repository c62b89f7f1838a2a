"""The table of faults: what `trilane run` says and leaves when something is taken from it.

    python tests/process/fault_table.py [KIND ...] [--source CHECKOUT] [--moments COUNT]

prints a row of Markdown for each outcome of each fault: how often, exit code, first sentence that an undisturbed run
does not say, whether all frames are counted, and what is left behind. KIND is one of KINDS below; all if none is given.
CHECKOUT is another source tree whose runs are looked at, such as that of an older commit. COUNT is how many moments a
fault is tried at, ten by default; a table of fewer is for a machine that is slow.

- `processes`: each process is killed, and stopped for `STOPPED_S` seconds, at ten moments from start to end.
- `signals`: the command gets each signal that ends a process, at ten moments.
- `memory`: each process may have so many addresses (`ulimit -v`), at ten limits.
- `disk`: the run folder is on a disk of so many bytes, at ten sizes; a disk in memory is mounted, which needs root.
- `filled`: another program takes all that is left of that disk, at ten moments.
- `files`: no file may be longer than so many bytes (`ulimit -f`), at ten limits.
- `folders`: run folder, `segments/`, journal, or working directory is removed at ten moments.

The child processes take every signal as if a person had typed the command: what this script inherited from `nohup`
or a shell's background job is undone for them.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil

from trilane.pipeline.fork_server import process_name

ROOT = Path(__file__).resolve().parents[2]
FRAMES = 60
STOPPED_S = 3.0
MOMENTS = 10
LONGEST_S = 240.0
MB = 1 << 20
COMMAND, SERVER = "command", "fork server"
UNITS = ("cpu", "gpu", "dsp")
SIGNALS = (signal.SIGKILL, signal.SIGSTOP)
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU)
#: Most addresses of a process and most bytes of a file, by place; a default run fits into the last.
ADDRESSES = tuple(200 * MB * (place + 1) for place in range(MOMENTS))
FILE_BYTES = (0, 4096, *(2**power * MB for power in range(MOMENTS - 2)))
#: Size of the disk, by place; the space that a run reserves for its report is 4 MB.
DISK_BYTES = (*(2**power * 65536 for power in range(6)), *(4 * MB + 2**power * 65536 for power in range(MOMENTS - 6)))
LARGE_DISK_BYTES = 64 * MB
FOLDERS = {
    "run folder": "runs/out.*.partial",
    "segments/": "runs/out.*.partial/segments",
    "journal": "runs/out.*.partial/journal.msgpack",
    "working directory": ".",
}


@dataclass
class Started:
    """A run that was started: its process, and the folder that it works in.

    `begin_s`: time of its start. `stderr`: descriptor of a pipe, as a file may not be written under every limit.
    """

    run: psutil.Popen
    folder: Path
    begin_s: float
    stderr: int

    def wait_until(self, at_s: float) -> bool:
        """Wait until `at_s` after the start; return whether the run still goes on."""
        time.sleep(max(0.0, self.begin_s + at_s - time.monotonic()))
        return self.run.poll() is None

    def said(self) -> str:
        """Return what the run wrote to stderr so far, and close the pipe."""
        text = b""
        os.set_blocking(self.stderr, False)
        with suppress(BlockingIOError):
            while chunk := os.read(self.stderr, MB):
                text += chunk
        os.close(self.stderr)
        return text.decode(errors="replace")

    def named(self, name: str) -> psutil.Process | None:
        """Return the process `name`; None before it is there and after its end."""
        if name == COMMAND:
            return self.run
        for process in self.run.children(recursive=True):
            try:
                is_server = name == SERVER and "trilane.pipeline.fork_server" in process.cmdline()
                if is_server or (name in UNITS and process.name() == process_name(name)):
                    return process
            except psutil.Error:
                continue
        return None


@dataclass
class Table:
    """Runs with faults and what came of them.

    `source`: source tree whose runs are looked at. `moments`: number of moments at which a fault is tried.
    """

    source: Path
    moments: int = MOMENTS
    length_s: float = 0.0
    usual: set[str] = field(default_factory=set)

    def measure(self) -> None:
        """Find out how long an undisturbed run takes, and the first words of what it says.

        The second run counts: the first reads its files from the disk, and moments in its time would lie after the end.
        """
        self._measure_once()
        self._measure_once()
        print(f"An undisturbed run takes {self.length_s:.1f} s.\n")
        print("| fault | times | exit | first sentence | frames | left behind |\n|---|---|---|---|---|---|", flush=True)

    def _measure_once(self) -> None:
        with self._folder() as folder:
            begin = time.monotonic()
            started = self._start(folder, lambda: None, ())
            code = started.run.wait(LONGEST_S)
            self.length_s = time.monotonic() - begin
            said = started.said()
            if code:
                sys.exit(f"an undisturbed run fails: {said}")
            self.usual = {line.partition(":")[0] for line in said.splitlines()}

    def row(self, fault: str, outcomes: Iterator[tuple[str, str, str, str]]) -> None:
        """Print the outcomes of a fault; those that differ in their figures alone are one row."""
        found: dict[tuple[str, ...], list[tuple[str, str, str, str]]] = {}
        for outcome in outcomes:
            found.setdefault(tuple(re.sub(r"\d[\d.]*", "N", part) for part in outcome), []).append(outcome)
        for alike in found.values():
            print(f"| {fault} | {len(alike)} | {' | '.join(alike[0])} |", flush=True)

    def with_fault(
        self,
        fault: Callable[[Started], bool] = lambda _started: True,
        limit: Callable[[], None] = lambda: None,
        words: tuple[str, ...] = ("--no-video",),
        disk_bytes: int = 0,
    ) -> tuple[str, str, str, str]:
        """Run with `limit` set in the child and `fault` done to it; return the cells of its row.

        `fault(started)`: returns whether there was anything to do it to.
        """
        with self._folder(disk_bytes) as folder:
            started = self._start(folder, limit, words)
            is_done = fault(started)
            family = [] if started.run.poll() is not None else started.run.children(recursive=True)
            try:
                code = str(started.run.wait(LONGEST_S))
            except psutil.TimeoutExpired:
                started.run.kill()
                code = "HANGS"
            _, alive = psutil.wait_procs(family, timeout=5)
            said = started.said()
            if not is_done:
                return "-", "it was not there then", "-", "-"
            cells = (code, self._sentence(said, folder), _frames(folder), _left(folder, alive))
            for process in alive:
                process.kill()
            return cells

    @contextmanager
    def _folder(self, disk_bytes: int = 0) -> Iterator[Path]:
        with TemporaryDirectory(prefix="faults-") as name:
            folder = Path(name)
            (folder / "work" / "runs").mkdir(parents=True)
            (folder / "tmp").mkdir()
            disk = folder / "work" / "runs"
            if disk_bytes:
                subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={disk_bytes}", "disk", disk], check=True)
            try:
                yield folder
            finally:
                if disk_bytes:
                    subprocess.run(["umount", "--lazy", disk], check=True)

    def _start(self, folder: Path, limit: Callable[[], None], words: tuple[str, ...]) -> Started:
        def in_child() -> None:
            for number in ENDING:
                signal.signal(number, signal.SIG_DFL)
            signal.pthread_sigmask(signal.SIG_SETMASK, ())
            limit()

        asked = ("run", "--frames", str(FRAMES), "--baseline", "0", "--out", "runs/out", *words)
        paths = {"PYTHONPATH": str(self.source / "src"), "TMPDIR": str(folder / "tmp")}
        reads, writes = os.pipe()
        begin_s = time.monotonic()
        run = psutil.Popen(
            [sys.executable, "-m", "trilane", *asked],
            stdout=subprocess.DEVNULL,
            stderr=writes,
            cwd=folder / "work",
            env={**os.environ, **paths, "PYTHONDONTWRITEBYTECODE": "1"},
            preexec_fn=in_child,
        )
        os.close(writes)
        return Started(run, folder, begin_s, reads)

    def _sentence(self, said: str, folder: Path) -> str:
        """Return the first line that an undisturbed run does not say, and that it ended in a traceback."""
        lines = said.splitlines()
        own = [line for line in lines if line.strip() and line.partition(":")[0] not in self.usual]
        first = own[0].replace(f"{folder}/work", "…").replace("|", "/") if own else "-"
        return first + " TRACEBACK" * any(line.startswith("Traceback") for line in lines)


def _frames(folder: Path) -> str:
    report = next(folder.rglob("report.json"), None)
    if report is None or not report.stat().st_size:
        return "no report"
    counts = json.loads(report.read_bytes())["frames"]
    total = counts["presented"] + counts["lost"] + sum(counts["dropped"].values()) + counts["not_begun"]
    return "all counted" if total == counts["requested"] == FRAMES else f"ADD UP TO {total}"


def _left(folder: Path, alive: list[psutil.Process]) -> str:
    names = [path.name for path in (folder / "work").rglob("*.partial")]
    names += [f"tmp/{path.name}" for path in (folder / "tmp").iterdir()]
    kinds = [re.sub(r"out\.\d+", "out.PID", name.rsplit("-", 1)[0]) for name in names]
    return ", ".join([*sorted(set(kinds)), *[f"{len(alive)} PROCESSES"] * bool(alive)]) or "nothing"


def processes(table: Table) -> None:
    """Kill and stop each process."""
    for name in (SERVER, *UNITS, COMMAND):
        for number in SIGNALS:
            _signal_rows(table, name, number)


def signals(table: Table) -> None:
    """Send the command each signal that ends a process."""
    for number in ENDING:
        _signal_rows(table, COMMAND, number)


def _signal_rows(table: Table, name: str, number: signal.Signals) -> None:
    def send(started: Started, at_s: float) -> bool:
        if not started.wait_until(at_s) or (process := started.named(name)) is None:
            return False
        process.send_signal(number)
        if number == signal.SIGSTOP:
            time.sleep(STOPPED_S)
            if process.is_running():
                process.send_signal(signal.SIGCONT)
        return True

    moments = _moments(table)
    table.row(f"{name}: {number.name}", (table.with_fault(lambda run, at=at_s: send(run, at)) for at_s in moments))


def memory(table: Table) -> None:
    """Limit the addresses of every process."""
    for most in ADDRESSES:
        limit = lambda most=most: resource.setrlimit(resource.RLIMIT_AS, (most, most))  # noqa: E731
        table.row(f"memory: ulimit -v of {most // MB} MB", iter([table.with_fault(limit=limit)]))


def disk(table: Table) -> None:
    """Limit the disk of the run folder."""
    for size in DISK_BYTES:
        table.row(f"disk: {size // 1024} KB", iter([table.with_fault(words=(), disk_bytes=size)]))


def filled(table: Table) -> None:
    """Take all that is left of the disk while the run goes on."""

    def fill(started: Started, at_s: float) -> bool:
        if not started.wait_until(at_s):
            return False
        with suppress(OSError), (started.folder / "work/runs/other").open("wb", buffering=0) as file:
            while file.write(bytes(4096)) == 4096:
                pass
        return True

    outcomes = (
        table.with_fault(lambda run, at=at_s: fill(run, at), words=(), disk_bytes=LARGE_DISK_BYTES)
        for at_s in _moments(table)
    )
    table.row("disk: filled by others", outcomes)


def files(table: Table) -> None:
    """Limit the length of every file."""
    for most in FILE_BYTES:
        limit = lambda most=most: resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))  # noqa: E731
        table.row(f"files: ulimit -f of {most // 1024} KB", iter([table.with_fault(limit=limit, words=())]))


def folders(table: Table) -> None:
    """Remove a folder that the run needs."""

    def remove(started: Started, pattern: str, at_s: float) -> bool:
        if not started.wait_until(at_s):
            return False
        found = list((started.folder / "work").glob(pattern)) if pattern != "." else [started.folder / "work"]
        for path in found:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
        return bool(found)

    for name, pattern in FOLDERS.items():
        outcomes = (
            table.with_fault(lambda run, at=at_s, of=pattern: remove(run, of, at), words=()) for at_s in _moments(table)
        )
        table.row(f"removed: {name}", outcomes)


def _moments(table: Table) -> list[float]:
    """Return times in the length of a run, the start and the end included."""
    return [table.length_s * (place + 0.5) / table.moments for place in range(table.moments)]


KINDS = {kind.__name__: kind for kind in (processes, signals, memory, disk, filled, files, folders)}


def main() -> None:
    parser = argparse.ArgumentParser(description="Prints the table of faults.")
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"kinds of faults: {', '.join(KINDS)}; all if none")
    parser.add_argument("--source", type=Path, default=ROOT, help="source tree whose runs are looked at")
    parser.add_argument("--moments", type=int, default=MOMENTS, help="number of moments of each fault (%(default)s)")
    asked = parser.parse_args()
    if unknown := set(asked.kinds) - KINDS.keys():
        parser.error(f"found {', '.join(unknown)}, expected {', '.join(KINDS)}")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that mounted disks and folders are removed
    table = Table(asked.source.resolve(), asked.moments)
    table.measure()
    for kind in asked.kinds or KINDS:
        KINDS[kind](table)


if __name__ == "__main__":
    main()
