"""Trials on the machines of a Ray cluster: one of the host clock at a time on each, virtual ones on all their cores.

Rule: a task does one trial as this machine would, and its driver, this process, alone writes the sweep's folder. Ray
tries nothing again by itself: what a lost worker or machine was doing is lost, and the sweep does it once more.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from trilane.apps.sweeps.perform import Children, Place, lost, perform
from trilane.apps.sweeps.store import SWEEP, Record
from trilane.apps.sweeps.sweep import Engine
from trilane.apps.sweeps.trial import Clock, Trial
from trilane.errors import BadInputError, MissingPartError

#: What a machine has one of, and a trial of the host clock takes.
RESOURCE = "trilane_host_clock"
START_LINE = (
    f"""ray start --resources='{{"{RESOURCE}": 1}}' --head, and without --head but with --address on the others"""
)


@contextmanager
def cluster(folder: Path) -> Iterator[Engine]:
    """The engine, while connected to the cluster that RAY_ADDRESS or this machine has.

    `folder`: the sweep's; where a machine of the cluster sees it, run folders are kept there.
    Raises MissingPartError without Ray, BadInputError without a cluster.
    """
    ray = required_ray()
    try:
        ray.init(address="auto", log_to_driver=False, logging_level="ERROR")
    except ConnectionError as error:
        raise BadInputError("--engine ray", "no cluster", "one that runs", f"start it: {START_LINE}") from error
    try:
        yield partial(_run_on, ray, Place(folder, Path.cwd()))
    finally:
        ray.shutdown()


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
    try:
        while going:
            (ended,), _ = ray.wait(list(going), num_returns=1)
            yield _record(ray, ended, going.pop(ended))
    finally:
        for reference in going:
            ray.cancel(reference)  # interrupts the task, which ends its process
        ray.wait(list(going), num_returns=len(going)) if going else None


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
    except ray.exceptions.RayTaskError:
        raise  # a defect of `perform`
    except ray.exceptions.RayError as error:
        return lost(trial, str(error).partition("\n")[0])
    return found


def perform_there(trial: Trial, folder: str, working_folder: str, program: str) -> Record:
    """Do `trial` on the machine where Ray has put it.

    `folder`: the sweep's on the driver's machine, used if this one sees it.
    `working_folder`: the driver's, used if it is here.
    """
    shared = Path(folder) if (Path(folder) / SWEEP).is_file() else None
    here = Path(working_folder) if Path(working_folder).is_dir() else None
    return perform(trial, Place(shared, here, program), Children())
