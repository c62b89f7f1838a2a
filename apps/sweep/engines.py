"""Engines of a sweep: they do its trials on this machine or on the machines of a Ray cluster.

Rule: a trial whose process was ended from outside is lost and may be tried again. A trial that ended by itself is
final. A machine does one trial of the host clock at a time, and trials of the virtual clock on all its cores. No
process is left behind.

On Ray, a task does one trial as this machine would, and only the driver writes `trials.jsonl`. Ray itself repeats no
task. When the driver ends, its workers and their trials end too.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import psutil

from trilane import machine
from trilane.apps.run.verdict import Trust, trust_of
from trilane.apps.sweep.definition import Trial, TrialClock
from trilane.apps.sweep.store import SWEEP, Engine, TrialRecord, planned
from trilane.errors import BadInputError, MissingPartError
from trilane.signals import INTERRUPTED
from trilane.stages.machine_facts import machine_facts

#: The module that a trial runs; tests replace it.
PROGRAM = "trilane"
#: Seconds from SIGTERM, which asks a trial to end, to SIGKILL.
END_S = 10.0
#: A run that the machine disturbed is repeated at most so many times.
REPEATS = 2
#: Exit codes of a process that was ended from outside: by an interrupt, or by a signal that a defect does not cause.
ENDED_FROM_OUTSIDE = (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGINT, -signal.SIGHUP, INTERRUPTED)
host_facts = cache(machine_facts)
#: Resource in Ray: each machine has 1 of it, and a trial of the host clock takes 1.
RESOURCE = "trilane_host_clock"
#: Seconds to wait for the answer of a cluster's head.
ANSWER_S = 5.0
START_LINE = (
    f"""RAY_worker_niceness=0 ray start --head --resources='{{"{RESOURCE}": 1}}', """
    "on the others with --address=HEAD:6379 in place of --head"
)
#: Environment variables that Ray sets in its workers. A trial gets the values from before Ray.
SET_BY_RAY = ("OMP_NUM_THREADS", "CUDA_VISIBLE_DEVICES", "PYTHONBREAKPOINT")


@dataclass(frozen=True)
class TrialPlace:
    """Where and with which program trials are done.

    `folder`: folder of the sweep, for the run folders; None to keep no run folders.
    `working_folder`: working folder of the trials' processes; None: the folder of this process.
    `environment`: environment of the trials' processes; None: the environment of this process.
    `program`: module that the trials run.
    """

    folder: Path | None
    working_folder: Path | None = None
    environment: dict[str, str] | None = None
    program: str = field(default_factory=lambda: PROGRAM)


class Children:
    """The running processes of trials. Several threads start processes, and any thread may end all of them.

    `inherited`: file descriptors that every process inherits.
    """

    def __init__(self, inherited: tuple[int, ...] = ()) -> None:
        self._inherited = inherited
        self._lock = threading.Lock()
        self._going: set[subprocess.Popen[bytes]] = set()
        self._over = False

    def run(self, command: list[str], stdout: Any, stderr: Any, place: TrialPlace) -> int:
        """Run `command`, and return its exit code; a negative code is the number of a signal.

        After a call of `end`, start nothing and return -SIGTERM.

        `stdout`, `stderr`: files for the output, as for `subprocess.Popen`. `place`: working folder and environment.
        """
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
                process_group=0,  # Ctrl-C reaches only the sweep, which then ends its trials
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
        process.terminate()  # it does nothing to a process that has ended
    give_up_at = time.monotonic() + END_S
    for process in processes:
        try:
            process.wait(max(0.0, give_up_at - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def perform(trial: Trial, place: TrialPlace, children: Children) -> TrialRecord:
    """Do `trial`, and return its record.

    A run that the machine disturbed is repeated up to `REPEATS` times, and the least disturbed run is kept. Files of a
    lost trial are removed. `place`: folders of the trial. `children`: object that starts the trial's process.
    """
    began_at, start = machine.here.now().isoformat(timespec="milliseconds"), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="trilane-trial-") as scratch:
        own = (place.folder or Path(scratch)) / trial.id
        kept = own.with_name(f"{own.name}.kept")
        shutil.rmtree(kept, ignore_errors=True)  # of a sweep that was killed during a repeat
        ended, repeated = _once(trial, own, place, children), 0
        while repeated < REPEATS and not trust_in(ended).trusted:
            if own.is_dir():
                own.rename(kept)
            again, repeated = _once(trial, own, place, children), repeated + 1
            if again.status == "done" and disturbance(again) < disturbance(ended):
                ended = again
                shutil.rmtree(kept, ignore_errors=True)
            elif kept.is_dir():
                shutil.rmtree(own, ignore_errors=True)
                kept.rename(own)
            if again.status == "lost":
                break
        trust = trust_in(ended)
        has_folder = place.folder is not None and own.is_dir()
    return ended.model_copy(
        update={
            "repeated": repeated,
            "unsure": () if trust.trusted else trust.reasons,
            "began_at": began_at,
            "seconds": round(time.monotonic() - start, 3),
            "host": host_facts(),
            "folder": trial.id if has_folder else None,
        }
    )


def _once(trial: Trial, own: Path, place: TrialPlace, children: Children) -> TrialRecord:
    """Do `trial` once, and return the result of `ended_as`. Remove its run folder before, and after a lost trial.

    `own`: run folder of the trial. `place`, `children`: as in `perform`.
    """
    _remove(own)
    with tempfile.TemporaryFile() as stdout, tempfile.TemporaryFile() as stderr:
        code = children.run(_command(trial, own, place.program), stdout, stderr, place)
        out, messages = (_text(file) for file in (stdout, stderr))
    ended = ended_as(trial, code, out, messages)
    if ended.status == "lost":
        _remove(own)
    return ended


def trust_in(ended: TrialRecord) -> Trust:
    """Return whether the times of a trial can be trusted, with reasons.

    A trial counts as trusted if it is not done, or if its result lacks the share of other programs.
    """
    result = ended.result or {}
    is_judged = ended.status == "done" and "other_programs" in result
    return trust_of(result) if is_judged else Trust(True, ())


def disturbance(ended: TrialRecord) -> tuple[bool, float]:
    """Return (not trusted, share of other programs), a sort key that puts less disturbed trials first.

    If the share is not known, it counts as 1.
    """
    others = (ended.result or {}).get("other_programs")
    return not trust_in(ended).trusted, 1.0 if others is None else others


def ended_as(trial: Trial, code: int, out: str, messages: str) -> TrialRecord:
    """Return a record that says how the process of `trial` ended.

    `code`: exit code; a negative code is the number of a signal. `out`, `messages`: text of its stdout and stderr.
    """
    result, status = _document(out), "failed"
    lines = [line for line in messages.splitlines() if line.strip()]
    error: str | None = lines[-1].strip() if lines else f"exit code {code}, no message"
    if code in ENDED_FROM_OUTSIDE:
        result, status = None, "lost"
    elif code == 0 and result is not None:
        error, status = None, "done"
    elif code == 0:
        error = "exit code 0, but no JSON document on stdout"
    update = {"status": status, "exit_code": code, "error": error, "result": result}
    return planned(trial).model_copy(update=update)


def _command(trial: Trial, own: Path, program: str) -> list[str]:
    words = [*trial.arguments, *(("--out", str(own)) if trial.kind.has_folder else ())]
    return [sys.executable, "-m", "trilane.apps.sweep.child", str(os.getpid()), program, *words]


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
    """Remove the run folder `own` of a trial, and drafts of it that were not completed."""
    shutil.rmtree(own, ignore_errors=True)
    for draft in own.parent.glob(f"{own.name}.*.partial"):
        shutil.rmtree(draft, ignore_errors=True)


def at_once(clock: TrialClock) -> int:
    """Return how many trials run at once on this machine: 1 on the host clock, 1 per core on the virtual clock."""
    return 1 if clock is TrialClock.HOST else len(machine.here.cores())


def run_here(trials: Sequence[Trial], place: TrialPlace, inherited: tuple[int, ...] = ()) -> Generator[TrialRecord]:
    """Do `trials`, all with the same command, on this machine, and yield their records as they end.

    Closing the generator ends the trials that still run.

    `place`: folders of the trials. `inherited`: file descriptors that every trial inherits.
    """
    children = Children(inherited)
    with ThreadPoolExecutor(at_once(trials[0].kind.clock)) as pool:
        waiting = [pool.submit(perform, trial, place, children) for trial in trials]
        try:
            for ended in as_completed(waiting):
                yield ended.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            children.end()


def run_inside(trials: Sequence[Trial], call: Callable[[list[str]], tuple[int, str, str]]) -> Generator[TrialRecord]:
    """Do `trials` of the virtual clock in this process, one after the other, and yield their records as they end.

    `call`: function from the words of a command line after `trilane` to (exit code, text of stdout, text of stderr).
    """
    for trial in trials:
        began_at, start = machine.here.now().isoformat(timespec="milliseconds"), time.monotonic()
        ended = ended_as(trial, *call(trial.arguments))
        seconds = round(time.monotonic() - start, 3)
        yield ended.model_copy(update={"began_at": began_at, "seconds": seconds, "host": host_facts()})


def at_once_on_ray(clock: TrialClock) -> int:
    """Return how many trials with `clock` the connected Ray cluster does at once, at least 1.

    Raises MissingPartError without Ray.
    """
    name = RESOURCE if clock is TrialClock.HOST else "CPU"
    return max(1, int(required_ray().cluster_resources().get(name, 1)))


@contextmanager
def cluster(folder: Path) -> Iterator[Engine]:
    """Connect to a Ray cluster, give its engine, and disconnect afterwards.

    The cluster is the one at the address in RAY_ADDRESS. If this variable is not set, it is the one on this machine.

    `folder`: folder of the sweep. Machines of the cluster that can read it keep their run folders there.

    Raises MissingPartError without Ray, BadInputError without a running cluster.
    """
    ray = required_ray()
    try:
        _try_address(os.environ.get("RAY_ADDRESS", ""))
        ray.init(address="auto", log_to_driver=False, logging_level="ERROR")
    except OSError as error:
        raise BadInputError("--engine ray", "no cluster", "one that runs", f"start it: {START_LINE}") from error
    try:
        yield partial(_run_on, ray, TrialPlace(folder, Path.cwd()))
    finally:
        ray.shutdown()


def _try_address(address: str) -> None:
    """Raise OSError if `address` is HOST:PORT and nothing listens there.

    Without this check, Ray would try for many minutes.
    """
    host, _, port = address.rpartition(":")
    if host and port.isdecimal() and "/" not in host:
        socket.create_connection((host, int(port)), ANSWER_S).close()


def required_ray() -> Any:
    """Return the package `ray`. Raises MissingPartError without it."""
    try:
        import ray
    except ImportError as error:
        raise MissingPartError("the engine ray needs the package ray", extra="ray") from error
    return ray


def _run_on(ray: Any, place: TrialPlace, trials: Sequence[Trial]) -> Generator[TrialRecord]:
    resources = _resources(ray, trials[0].kind.clock)
    task = ray.remote(num_cpus=1, resources=resources, max_retries=0)(perform_there)
    going = {task.remote(trial, str(place.folder), str(place.working_folder), place.program): trial for trial in trials}
    while going:
        (ended,), _ = ray.wait(list(going), num_returns=1)
        yield _record(ray, ended, going.pop(ended))


def _resources(ray: Any, clock: TrialClock) -> dict[str, int]:
    """Return the Ray resources that a trial takes besides a core.

    Raises BadInputError if no machine has these resources.
    """
    if clock is TrialClock.VIRTUAL:
        return {}
    if RESOURCE not in ray.cluster_resources():
        remedy = f"it keeps trials from disturbing each other; start them so: {START_LINE}"
        raise BadInputError("--engine ray", f"no machine with the resource {RESOURCE}", "1 on each", remedy)
    return {RESOURCE: 1}


def _record(ray: Any, reference: Any, trial: Trial) -> TrialRecord:
    """Return the record behind `reference`; if the worker ended without a record, the trial is lost."""
    try:
        found: TrialRecord = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except ray.exceptions.RayError as error:
        return planned(trial).model_copy(update={"status": "lost", "error": str(error).partition("\n")[0]})
    return found


def perform_there(trial: Trial, folder: str, working_folder: str, program: str) -> TrialRecord:
    """Do `trial` in a Ray worker, on the machine that Ray chose, and return its record.

    `folder`: folder of the sweep on the driver's machine. If this machine cannot read it, run folders are not kept.
    `working_folder`: working folder of the driver. If this machine has no such folder, the worker's own is used.
    `program`: module that the trial runs.

    Raises BadInputError if the trial has the host clock and the worker has a lower priority than its parent process.
    """
    worker = psutil.Process()
    parent = worker.parent() or worker
    if trial.kind.clock is TrialClock.HOST and worker.nice() > parent.nice():
        found = f"workers on {machine.here.host_name()} that give way to other programs (niceness {worker.nice()})"
        raise BadInputError("--engine ray", found, f"niceness {parent.nice()}", f"start Ray so: {START_LINE}")
    shared = Path(folder) if (Path(folder) / SWEEP).is_file() else None
    here = Path(working_folder) if Path(working_folder).is_dir() else None
    environment = restored(os.environ, parent.environ())
    return perform(trial, TrialPlace(shared, here, environment, program), Children())


def restored(worker: Mapping[str, str], parent: Mapping[str, str]) -> dict[str, str]:
    """Return the environment `worker` of a Ray worker, with the variables in `SET_BY_RAY` as they are in `parent`.

    `parent`: environment of the worker's parent process, in which Ray has not set these variables.
    """
    kept = {name: value for name, value in worker.items() if name not in SET_BY_RAY}
    return kept | {name: parent[name] for name in SET_BY_RAY if name in parent}
