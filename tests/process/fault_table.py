"""Kills, stops and signals each process of `trilane run` at ten moments: `python tests/process/fault_table.py`.

Prints a row for each process and signal: exit codes, whether all frames are counted, and what was left behind. A
stopped process is let go after `STOPPED_S` seconds.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import psutil

from trilane.pipeline.fork_server import process_name

SHM = Path("/dev/shm")  # noqa: S108 - looked at, not written to
FRAMES = 200
STOPPED_S = 3.0
MOMENTS = 10
LONGEST_S = 240.0
COMMAND, SERVER = "command", "fork server"
UNITS = ("cpu", "gpu", "dsp")
SIGNALS = (signal.SIGKILL, signal.SIGSTOP)
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


def command(folder: Path) -> list[str]:
    words = ("run", "--frames", str(FRAMES), "--baseline", "0", "--no-video", "--out", str(folder / "run"))
    return [sys.executable, "-m", "trilane", *words]


def named(run: psutil.Process, name: str) -> psutil.Process | None:
    """The process `name` of the run; None before it is there and after its end."""
    if name == COMMAND:
        return run
    for process in run.children(recursive=True):
        try:
            is_server = name == SERVER and "trilane.pipeline.fork_server" in process.cmdline()
            if is_server or (name in UNITS and process.name() == process_name(name)):
                return process
        except psutil.Error:
            continue
    return None


def length_s() -> float:
    """How long an undisturbed run takes, from the start of its command to its end."""
    with TemporaryDirectory() as folder:
        begin = time.monotonic()
        subprocess.run(command(Path(folder)), capture_output=True, check=True)
        return time.monotonic() - begin


def run_with(name: str, number: signal.Signals, at_s: float) -> str:
    """Send the signal to the process `at_s` after the start of the command; say what came of it."""
    names = set(SHM.glob("*trilane*"))
    with TemporaryDirectory() as folder, (Path(folder) / "said").open("w+b") as said:
        begin = time.monotonic()
        run = psutil.Popen(command(Path(folder)), stdout=subprocess.DEVNULL, stderr=said)
        time.sleep(max(0.0, begin + at_s - time.monotonic()))
        family = {run, *run.children(recursive=True)} if run.poll() is None else {run}
        victim = named(run, name) if run.poll() is None else None
        if victim is None:
            run.wait(LONGEST_S)
            return "no such process then"
        victim.send_signal(number)
        if number == signal.SIGSTOP:
            time.sleep(STOPPED_S)
            if victim.is_running():
                victim.send_signal(signal.SIGCONT)
        try:
            code = run.wait(LONGEST_S)
        except psutil.TimeoutExpired:
            run.kill()
            return "HANGS"
        _, alive = psutil.wait_procs([process for process in family if process != run], timeout=5)
        left = len(alive) + len(set(SHM.glob("*trilane*")) - names)
        said.seek(0)
        is_traced = b"Traceback" in said.read()
        frames = _frames(Path(folder) / "run" / "report.json")
    return f"exit {code}, {frames}" + f", {left} LEFT" * bool(left) + ", TRACEBACK" * is_traced


def _frames(report: Path) -> str:
    if not report.exists():
        return "no report"
    counts = json.loads(report.read_bytes())["frames"]
    total = counts["presented"] + counts["lost"] + sum(counts["dropped"].values()) + counts["not_begun"]
    return f"all of {FRAMES} frames counted" if total == counts["requested"] == FRAMES else f"ADD UP TO {total}"


def main() -> None:
    whole_s = length_s()
    print(f"an undisturbed run takes {whole_s:.1f} s")
    rows = [(name, number) for name in (SERVER, *UNITS) for number in SIGNALS]
    rows += [(COMMAND, number) for number in (*SIGNALS, *ENDING)]
    for name, number in rows:
        found = Counter(run_with(name, number, whole_s * (place + 0.5) / MOMENTS) for place in range(MOMENTS))
        print(
            f"| {name} | {number.name} | {'; '.join(f'{count} x {what}' for what, count in found.items())} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
