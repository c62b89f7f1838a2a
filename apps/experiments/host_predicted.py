"""Are the predictions of `trilane predict --profile host` right, for runs of an avatar and for single networks?

Rule: each prediction is made before its measurement. A run is a whole `trilane run` in processes of its own. A network
is called in a process of its own, which starts after the prediction. No time from the measurement enters a prediction.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from trilane.apps.avatar_files import remade_avatar
from trilane.apps.predict.asked_prediction import answer_of, application_of, predict_networks
from trilane.apps.predict.predict_options import PredictOptions
from trilane.apps.run.asked_run import run_asked
from trilane.apps.run.run_job import Hooks
from trilane.avatars.bundle import load_bundle
from trilane.bench.lib.interleaved_processes import ProcessVariant, runners
from trilane.errors import BadInputError
from trilane.hw_profiles.host_model import NETWORK
from trilane.hw_profiles.profile_files import load_runnable
from trilane.hw_profiles.rates import FrameInterval
from trilane.hw_profiles.schema import SIGMAS
from trilane.stages.configure import requested_runtime
from trilane.stages.run_options import RunOptions
from trilane.units import HOST

RUN, ALONE = "run", "network"
MIN_FRAMES = 100  # a shorter run is not placed by measured times


def measure(
    avatar: str = "default", width: tuple[int, ...] = (8, 24, 32, 40, 48), frames: int = 200, seconds: float = 3.0
) -> dict[str, Any]:
    """Return predicted and measured times of an avatar, with its own network and with an untrained one of each `width`.

    Each network has two rows in `rows`. `name`: name of the avatar, or `width` with the number. `what`: `run` (mean
    frame time of a run of `frames` frames) or `network` (median time of calls during `seconds` seconds).
    `predicted_ms`: predicted time, with the 80 % interval `low_ms` to `high_ms`. `measured_ms`: measured time.
    `error`: predicted / measured - 1. `inside`: whether the measured time is in the interval. `others`: share of the
    cores that other programs had in the run; null if unknown, and for calls. Above 0.1, the row says little.

    `run`, `network`: summaries of the rows of that kind. `inside`: number of rows in their interval, out of `of` rows.
    `median_error`: median of the absolute errors. `leave_one_out_error`: root mean square of log(predicted / measured).
    `inside_left_out`: number of rows in the 80 % interval that follows from the errors of all other rows;
    null for a single row.

    `config`: values of the options.

    Raises BadInputError for fewer than 100 frames, a width out of range, or an avatar that cannot be read. Raises
    MissingPartError without PyTorch, and TrilaneError if a run fails.
    """
    if frames < MIN_FRAMES:
        raise BadInputError("--frames", str(frames), f"at least {MIN_FRAMES}")
    for each in width:
        RunOptions.checked({"width": each})
    rows: list[dict[str, Any]] = []
    with TemporaryDirectory(prefix="trilane-predict-") as folder:
        for asked in (None, *width):
            made = str(remade_avatar(avatar, RunOptions(width=asked))[0]) if asked else avatar
            name = f"width {asked}" if asked else avatar
            predicted = _of_run(made)
            measured_ms, others = _run(made, frames, Path(folder) / str(len(rows)))
            rows.append(_row(name, RUN, predicted, measured_ms, others))
            file = load_bundle(made).network_path
            predicted = _of_network(file)
            rows.append(_row(name, ALONE, predicted, _calls(file, seconds), None))
    summaries = {what: summary([row for row in rows if row["what"] == what]) for what in (RUN, ALONE)}
    config = {"avatar": avatar, "width": list(width), "frames": frames, "seconds": seconds}
    return {"rows": rows, **summaries, "config": config}


def _of_run(avatar: str) -> FrameInterval:
    options = PredictOptions(profile=HOST, avatar=avatar)
    chip, plan = application_of(load_runnable(HOST), options)
    return answer_of(chip, plan, options).frame


def _run(avatar: str, frames: int, out: Path) -> tuple[float, float | None]:
    """Run the avatar, and return (mean frame time in ms, share of the cores that other programs had).

    The share is None if it is not known. `avatar`: name or folder. `frames`: number of frames. `out`: run folder.
    """
    options = RunOptions(avatar=avatar, frames=frames, baseline_frames=0, out=out)
    report = run_asked(options, quiet, ("trilane", "bench")).report
    return report.frame_time_ms.mean or 0.0, report.other_programs


def _of_network(file: Path) -> FrameInterval:
    (answer,) = predict_networks(load_runnable(HOST), PredictOptions(profile=HOST, network=(file,)))
    return answer.frame


def _calls(file: Path, seconds: float) -> float:
    runtime, _ = requested_runtime("auto")
    variant = ProcessVariant("runtime", file, runtime, load_runnable(HOST).units[NETWORK].threads)
    with runners({ALONE: variant}) as by_name:
        return median(by_name[ALONE].run_for(seconds))


def _row(name: str, what: str, predicted: FrameInterval, measured_ms: float, others: float | None) -> dict[str, Any]:
    ms, low, high = predicted
    return {
        "name": name,
        "what": what,
        "predicted_ms": ms,
        "low_ms": low,
        "high_ms": high,
        "measured_ms": measured_ms,
        "error": ms / measured_ms - 1,
        "inside": low is not None and high is not None and low <= measured_ms <= high,
        "others": others,
    }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the summary of the rows of one kind.

    `rows`: `rows` of `measure`, which also describes the keys.
    """
    squares, others = [math.log1p(row["error"]) ** 2 for row in rows], len(rows) - 1
    inside_left_out = sum(others * one <= SIGMAS**2 * (sum(squares) - one) for one in squares)
    return {
        "inside": sum(row["inside"] for row in rows),
        "of": len(rows),
        "median_error": median(abs(row["error"]) for row in rows),
        "leave_one_out_error": math.sqrt(sum(squares) / len(squares)),
        "inside_left_out": inside_left_out if others else None,
    }


@contextlib.contextmanager
def quiet() -> Iterator[Hooks]:
    """Return a context manager that yields hooks of a run which print nothing."""
    yield Hooks(lambda *_: None, lambda _: None)
