"""Does one trial on this machine: starts its process, waits for its end, and says how it ended.

Rule: a process that was ended from outside is lost and may be tried again; what ends by itself has said its last word.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from trilane import machine
from trilane.apps.sweeps.store import Record
from trilane.apps.sweeps.trial import Trial
from trilane.stages.machine_facts import machine_facts

#: The module that is tried, which tests replace.
PROGRAM = "trilane"
#: For a trial that was asked to end, before it is killed.
END_S = 10.0
#: Exit codes of a process that somebody ended: by signals that do not come from its own defects, or interrupted.
ENDED_FROM_OUTSIDE = (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGINT, -signal.SIGHUP, 130)
host_facts = cache(machine_facts)


@dataclass(frozen=True)
class Place:
    """Where trials are done. `folder`: the sweep's, for their run folders.

    `working_folder`, `environment`: of the trials; this process's if None. `program`: the module that is tried.
    """

    folder: Path | None
    working_folder: Path | None = None
    environment: dict[str, str] | None = None
    program: str = field(default_factory=lambda: PROGRAM)


class Children:
    """The processes of trials that go on, which several threads start and one may end."""

    def __init__(self, inherited: tuple[int, ...] = ()) -> None:
        """`inherited`: descriptors that every process gets."""
        self._inherited = inherited
        self._lock = threading.Lock()
        self._going: set[subprocess.Popen[bytes]] = set()
        self._over = False

    def run(self, command: list[str], stdout: Any, stderr: Any, place: Place) -> int:
        """The exit code of `command`; that of SIGTERM, without a process, after `end`."""
        with self._lock:
            if self._over:
                return -signal.SIGTERM
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
                cwd=place.working_folder,
                env=place.environment,
                process_group=0,  # Ctrl-C is for the sweep, which ends its trials itself
                pass_fds=self._inherited,
            )
            self._going.add(process)
        try:
            return process.wait()
        finally:
            _end([process])
            with self._lock:
                self._going.discard(process)

    def end(self) -> None:
        """End every process, and start no further one."""
        with self._lock:
            self._over = True
            going = list(self._going)
        _end(going)


def _end(processes: list[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        process.terminate()  # which does nothing to one that has ended
    give_up_at = time.monotonic() + END_S
    for process in processes:
        try:
            process.wait(max(0.0, give_up_at - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def perform(trial: Trial, place: Place, children: Children) -> Record:
    """The line of `trials.jsonl` (docs/sweeps.md has its keys). What a lost trial left in the folder is removed.

    `children`: its process is one of them.
    """
    began_at, start = machine.here.now().isoformat(timespec="milliseconds"), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="trilane-trial-") as scratch:
        own = (place.folder or Path(scratch)) / trial.id
        _remove(own)
        with tempfile.TemporaryFile() as stdout, tempfile.TemporaryFile() as stderr:
            code = children.run(_command(trial, own, place.program), stdout, stderr, place)
            out, messages = (_text(file) for file in (stdout, stderr))
        ended = ended_as(code, out, messages)
        if ended["status"] == "lost":
            _remove(own)
        has_folder = place.folder is not None and own.is_dir()
    return {
        **about(trial),
        **ended,
        "began_at": began_at,
        "seconds": round(time.monotonic() - start, 3),
        "host": host_facts(),
        "folder": trial.id if has_folder else None,
    }


def about(trial: Trial) -> Record:
    """What is known of a trial before it is done."""
    return {
        "schema": 1,
        "id": trial.id,
        "command": ["trilane", *trial.arguments],
        "options": dict(trial.options),
        "repeat": trial.repeat,
        "clock": str(trial.kind.clock),
    }


def ended_as(code: int, out: str, messages: str) -> Record:
    """How a process ended: status, exit code, its JSON document and, unless it is done, its last message.

    `code`: negative for a signal, as `subprocess` has it.
    `out`, `messages`: its stdout and stderr.
    """
    result = _document(out)
    lines = [line for line in messages.splitlines() if line.strip()]
    error: str | None = lines[-1].strip() if lines else f"exit code {code}, no message"
    if code in ENDED_FROM_OUTSIDE:
        return {"status": "lost", "exit_code": code, "error": error, "result": None}
    if code == 0 and result is None:
        error = "exit code 0, but no JSON document on stdout"
    done = code == 0 and result is not None
    return {
        "status": "done" if done else "failed",
        "exit_code": code,
        "error": None if done else error,
        "result": result,
    }


def lost(trial: Trial, why: str) -> Record:
    """The record of a trial whose worker did not live to tell."""
    return {
        **about(trial),
        **{"status": "lost", "exit_code": None, "error": why, "result": None},
        **{"began_at": None, "seconds": None, "host": None, "folder": None},
    }


def _command(trial: Trial, own: Path, program: str) -> list[str]:
    words = [*trial.arguments, *(("--out", str(own)) if trial.kind.has_folder else ())]
    return [sys.executable, "-m", "trilane.apps.sweeps.child", str(os.getpid()), program, *words]


def _document(text: str) -> dict[str, Any] | None:
    try:
        found = json.loads(text)
    except ValueError:
        return None
    return found if isinstance(found, dict) else None


def _text(file: Any) -> str:
    file.seek(0)
    return str(file.read().decode(errors="replace"))


def _remove(own: Path) -> None:
    """The run folder of a trial, whole or not."""
    shutil.rmtree(own, ignore_errors=True)
    for partial in own.parent.glob(f"{own.name}.*.partial"):
        shutil.rmtree(partial, ignore_errors=True)
