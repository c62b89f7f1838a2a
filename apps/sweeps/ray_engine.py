"""Trials on the machines of a Ray cluster: one of the host clock at a time on each, virtual ones on all their cores.

Rule: a task does one trial as this machine would, and its driver, this process, alone writes the sweep's folder. Ray
tries nothing again by itself: what a lost worker or machine was doing is lost, and the sweep does it once more. A
driver that leaves takes its workers with it, and they their trials.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import psutil

from trilane import machine
from trilane.apps.sweeps.perform import Children, Place, lost, perform
from trilane.apps.sweeps.store import SWEEP, Record
from trilane.apps.sweeps.sweep import Engine
from trilane.apps.sweeps.trial import Clock, Trial
from trilane.errors import BadInputError, MissingPartError

#: What a machine has one of, and a trial of the host clock takes.
RESOURCE = "trilane_host_clock"
#: For the head of a cluster to answer.
ANSWER_S = 5.0
START_LINE = (
    f"""RAY_worker_niceness=0 ray start --head --resources='{{"{RESOURCE}": 1}}', """
    "on the others with --address=HEAD:6379 in place of --head"
)
#: Variables that Ray sets in its workers. A trial has them as its machine has.
SET_BY_RAY = ("OMP_NUM_THREADS", "CUDA_VISIBLE_DEVICES", "PYTHONBREAKPOINT")


@contextmanager
def cluster(folder: Path) -> Iterator[Engine]:
    """The engine, while connected to the cluster that RAY_ADDRESS or this machine has.

    `folder`: the sweep's; where a machine of the cluster sees it, run folders are kept there.
    Raises MissingPartError without Ray, BadInputError without a cluster.
    """
    ray = required_ray()
    try:
        _try_address(os.environ.get("RAY_ADDRESS", ""))
        ray.init(address="auto", log_to_driver=False, logging_level="ERROR")
    except OSError as error:
        raise BadInputError("--engine ray", "no cluster", "one that runs", f"start it: {START_LINE}") from error
    try:
        yield partial(_run_on, ray, Place(folder, Path.cwd()))
    finally:
        ray.shutdown()


def _try_address(address: str) -> None:
    """Raises OSError for HOST:PORT where nobody listens, which Ray would try for many minutes."""
    host, _, port = address.rpartition(":")
    if host and port.isdecimal() and "/" not in host:
        socket.create_connection((host, int(port)), ANSWER_S).close()


def required_ray() -> Any:
    """The package. Raises MissingPartError without it."""
    try:
        import ray
    except ImportError as error:
        raise MissingPartError("the engine ray needs the package ray", extra="ray") from error
    return ray


def _run_on(ray: Any, place: Place, trials: Sequence[Trial]) -> Generator[Record]:
    resources = _resources(ray, trials[0].kind.clock)
    task = ray.remote(num_cpus=1, resources=resources, max_retries=0)(perform_there)
    going = {task.remote(trial, str(place.folder), str(place.working_folder), place.program): trial for trial in trials}
    while going:
        (ended,), _ = ray.wait(list(going), num_returns=1)
        yield _record(ray, ended, going.pop(ended))


def _resources(ray: Any, clock: Clock) -> dict[str, int]:
    """What a trial takes besides a core. Raises BadInputError when no machine has it."""
    if clock is Clock.VIRTUAL:
        return {}
    if RESOURCE not in ray.cluster_resources():
        remedy = f"it keeps trials from disturbing each other; start them so: {START_LINE}"
        raise BadInputError("--engine ray", f"no machine with the resource {RESOURCE}", "1 on each", remedy)
    return {RESOURCE: 1}


def _record(ray: Any, reference: Any, trial: Trial) -> Record:
    try:
        found: Record = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except ray.exceptions.RayError as error:
        return lost(trial, str(error).partition("\n")[0])
    return found


def perform_there(trial: Trial, folder: str, working_folder: str, program: str) -> Record:
    """Do `trial` on the machine where Ray has put it.

    `folder`: the sweep's on the driver's machine, used if this one sees it.
    `working_folder`: the driver's, used if it is here.
    Raises BadInputError when the trial measures, but would have less of the machine than other programs.
    """
    worker = psutil.Process()
    parent = worker.parent() or worker
    if trial.kind.clock is Clock.HOST and worker.nice() > parent.nice():
        found = f"workers on {machine.here.host_name()} that give way to other programs (niceness {worker.nice()})"
        raise BadInputError("--engine ray", found, f"niceness {parent.nice()}", f"start Ray so: {START_LINE}")
    shared = Path(folder) if (Path(folder) / SWEEP).is_file() else None
    here = Path(working_folder) if Path(working_folder).is_dir() else None
    environment = restored(os.environ, parent.environ())
    return perform(trial, Place(shared, here, environment, program), Children())


def restored(worker: Mapping[str, str], parent: Mapping[str, str]) -> dict[str, str]:
    """The environment of a Ray worker with those variables as on its machine that would change what is measured."""
    kept = {name: value for name, value in worker.items() if name not in SET_BY_RAY}
    return kept | {name: parent[name] for name in SET_BY_RAY if name in parent}
