"""How often does `trilane compare` see a difference where there is none, and does it see those that there are?

Rule: every run is a whole one, in processes of its own, as `trilane run` does it; those of a pair follow each other.
"""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from math import log
from pathlib import Path
from statistics import median, stdev
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from trilane.apps.comparison.compared import compare
from trilane.apps.comparison.difference import LEAST_FRAMES, STATISTICS, Outcome
from trilane.apps.comparison.rows import WORK
from trilane.apps.comparison.sides import Side, read_side
from trilane.errors import BadInputError

if TYPE_CHECKING:
    from trilane.apps.run_job import Hooks

STAGE, UNIT = "infer", "dsp"
LONGER = 1.05
#: A job that is held is held for so many times the longest that it took.
ROOM = 1.5


def measure(pairs: int = 10, frames: int = 300, size: str = "192") -> dict[str, Any]:
    """Of `pairs` of pairs of runs, what is said: of two runs of one kind, and of two that differ.

    `frames`, `size`: of each run of the default scene. The placement is that of the first run.

    A row per pair: `question` (`same`; `sequential` beside pipelined; `held`: infer is held 5 % longer), the `verdict`,
    and `others`: the share of the cores that other programs had, the larger of both runs. `outcomes`: of pairs of one
    kind, how many were said to differ, not to differ, and of how many it could not be told. `scatter`: of the runs of
    one kind, the standard deviation of the logarithm of each stage's typical time on its core, which
    `trilane.apps.comparison.noise` takes to be `WORK`. `starvation_named`: whether the verdict on sequential says that
    the DSP is starved. `stage_named`: whether that on the held stage names it and no other. Raises BadInputError.
    """
    if frames <= LEAST_FRAMES:
        raise BadInputError("--frames", str(frames), f"at least {LEAST_FRAMES + 1}")
    with TemporaryDirectory(prefix="trilane-compare-") as folder:
        runs = _Runs(Path(folder), frames, size)
        first = runs.run()
        runs.pin(first)
        same = [(runs.run(), runs.run()) for _ in range(pairs)]
        rows = [_row("same", *pair) for pair in same]
        rows.append(_row("sequential", runs.run(), runs.run(policy="sequential")))
        held_ns = round(ROOM * _longest_ns(first))
        rows.append(_row("held", runs.run(held_ns=held_ns), runs.run(held_ns=round(LONGER * held_ns))))
    verdicts = {row["question"]: row["verdict"] for row in rows}
    return {
        "rows": rows,
        "pairs": pairs,
        "outcomes": {str(each): sum(row["outcome"] == each for row in rows[:pairs]) for each in Outcome},
        "scatter": _scatter([side for pair in same for side in pair]),
        "starvation_named": f"unit {UNIT} ({STAGE}) is starved" in verdicts["sequential"],
        "stage_named": _named(verdicts["held"], runs.stages) == [STAGE],
        "config": {"frames": frames, "size": size, "held_ms": held_ns / 1e6, "longer": LONGER, "cores": runs.cores},
    }


def _named(verdict: str, stages: Sequence[str]) -> list[str]:
    """The stages that are said to take longer or shorter."""
    return [stage for stage in stages if f"{stage} takes " in verdict]


def _row(question: str, base: Side, other: Side) -> dict[str, Any]:
    others = [told.document["other_programs"] for side in (base, other) for told in side.runs]
    known = [share for share in others if share is not None]
    found = compare(base, [other])[0].as_json()
    return {
        "question": question,
        "verdict": found["verdict"],
        "outcome": found["outcome"],
        "others": max(known, default=None),
    }


def _scatter(sides: Sequence[Side]) -> dict[str, float]:
    """Of each stage, over the runs of all `sides`."""
    times: dict[str, list[float]] = defaultdict(list)
    for side in sides:
        for told in side.runs:
            for key, series in (told.frames.series if told.frames else {}).items():
                if key.measure == WORK:
                    times[key.of].append(log(STATISTICS["typical"](series.values, series.weights)))
    return {stage: stdev(values) for stage, values in times.items()}


def _longest_ns(side: Side) -> float:
    return float(median(told.document["stages"][STAGE]["service_ms"]["p99"] for told in side.runs) * 1e6)


class _Runs:
    """Runs into `folder`, one after the other; `cores` of the units, as options, once they are pinned."""

    def __init__(self, folder: Path, frames: int, size: str) -> None:
        self._folder, self._frames, self._size = folder, frames, size
        self.cores: tuple[str, ...] = ()
        self.stages: tuple[str, ...] = ()
        self._count = 0

    def run(self, policy: str = "pipelined", held_ns: int = 0) -> Side:
        from trilane.apps.asked_run import run_asked
        from trilane.stages.run_options import RunOptions

        self._count += 1
        out = self._folder / str(self._count)
        options = RunOptions(
            frames=self._frames, size=self._size, policy=policy, cores=self.cores, baseline_frames=0, out=out
        )
        run_asked(options, quiet, ("trilane", "bench"), {STAGE: held_ns} if held_ns else {})
        return read_side(str(out))

    def pin(self, side: Side) -> None:
        """The runs that follow have the placement of this one."""
        report = side.runs[0].document
        self.stages = tuple(report["stages"])
        self.cores = tuple(f"{unit}={','.join(map(str, row['cores']))}" for unit, row in report["units"].items())


@contextlib.contextmanager
def quiet() -> Iterator[Hooks]:
    from trilane.apps.run_job import Hooks

    yield Hooks(lambda *_: None, lambda _: None)
