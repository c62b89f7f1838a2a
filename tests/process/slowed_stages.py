"""Which stage's slowing costs a run the most frame time: that must be the one that the run names as its bound.

Each stage in turn takes SHARE more CPU time in every job: its unit's thread goes on computing before the job ends.
The runs take turns, in another order each round. By hand, on a quiet machine:

    python tests/process/slowed_stages.py OUT ROUNDS -- trilane run --frames 200 --baseline 0 --no-video

prints for each stage the median of frame time over that of the run beside it in which nothing is slowed, beside the
cost that those runs say; and the bound that they name. OUT: a folder for the runs, which is removed at the end.
"""

from __future__ import annotations

import json
import math
import os
import random
import shutil
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from trilane.pipeline.run_metrics import PathShare

SHARE = 0.2
#: Python imports a module of this name when it starts, in the units' processes too.
HOOK = """
import os, time
from trilane.pipeline.job_times import JobClock
from trilane.pipeline.unit_loop import BoundStage

run, begin, end = BoundStage.run, JobClock.begin, JobClock.end
job = {}

def begun(self, *arguments):
    begin(self, *arguments)
    job["begin_ns"] = time.process_time_ns()

def named(self, *arguments, **options):
    job["stage"] = self.name
    return run(self, *arguments, **options)

def slowed(self, *arguments):
    if job.pop("stage", "") == os.environ["SLOWED_STAGE"]:
        end_ns = time.process_time_ns()
        end_ns += float(os.environ["SLOWED_SHARE"]) * (end_ns - job["begin_ns"])
        while time.process_time_ns() < end_ns:
            pass
    end(self, *arguments)

JobClock.begin, JobClock.end, BoundStage.run = begun, slowed, named
"""


def run(hook: Path, command: list[str], stage: str) -> dict[str, Any]:
    """The report of one run in which `stage` takes `SHARE` more; "": none does."""
    out = hook / "run"
    path = os.pathsep.join(filter(None, (str(hook), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": path, "SLOWED_STAGE": stage, "SLOWED_SHARE": str(SHARE)}
    subprocess.run([*command, "--out", str(out)], env=environment, check=True, capture_output=True)
    report: dict[str, Any] = json.loads((out / "report.json").read_text(encoding="utf-8"))
    shutil.rmtree(out)
    return report


def main(folder: Path, rounds: int, command: list[str]) -> None:
    folder.mkdir(parents=True)
    (folder / "sitecustomize.py").write_text(HOOK, encoding="utf-8")
    stages = [*run(folder, command, "")["stages"]]
    cost: dict[str, list[float]] = {stage: [] for stage in stages}
    grown: dict[str, list[float]] = {stage: [] for stage in stages}
    plains = []
    for number in range(rounds):
        order = random.Random(number).sample(stages, len(stages))
        for stage in order:
            plain, slow = run(folder, command, ""), run(folder, command, stage)
            plains.append(plain)
            cost[stage].append(slow["frame_time_ms"]["mean"] / plain["frame_time_ms"]["mean"] - 1)
            cpu = [report["stages"][stage]["cpu_ms"]["mean"] for report in (slow, plain)]
            grown[stage].append(cpu[0] / cpu[1] - 1)
    replays = [report["bound"]["slowed"] for report in plains if "slowed" in report["bound"]]
    for stage in stages:
        each = " ".join(f"{value:+.3f}" for value in cost[stage])
        more = statistics.median(grown[stage])
        said = statistics.median(replay["costs"][stage]["cost"] for replay in replays) if replays else math.nan
        frame = statistics.median(cost[stage])
        print(f"{stage:10} CPU time {more:+.1%}  frame time {frame:+.1%}  ({each})  said {said:+.1%}")
    print("costs most:", max(stages, key=lambda stage: statistics.median(cost[stage])))
    bounds = [report["bound"]["stage"] for report in plains]
    named = [PathShare.model_validate(bound).names for bound in bounds]
    print("named:", {name: named.count(name) for name in sorted(set(named))})
    near = [f"{replay['over_measured']:.3f}" for replay in replays]
    print(f"replay over run: {' '.join(near)}; trusted {sum(replay['is_trusted'] for replay in replays)}")
    print(f"other programs: {statistics.median(report['other_programs'] for report in plains):.1%} of the cores")
    shutil.rmtree(folder)


if __name__ == "__main__":
    place, turns, _, *words = sys.argv[1:]
    main(Path(place), int(turns), words)
