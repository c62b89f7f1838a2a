"""What a person could try, from what bounded the frame time. Rule: a table of causes; each names what it rests on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from trilane.apps.explained.path import ASLEEP, RELEASE, WORK
from trilane.apps.explained.waits import DOWN, HELD, LOST, OVERHEAD, PREEMPTED, THROTTLED

#: Of the frame time; what bounds less of it is not worth an attempt.
LEAST_SHARE: Final = 0.1
MOST: Final = 4

#: Of stages of the avatar's pipeline: what makes their work shorter.
SHORTER = {
    "pose": "`--skinning gpu` takes the vertices off the CPU; `trilane explain SCENE` says what a scene models",
    "raster": "a smaller `--size` draws fewer texels",
    "infer": "a smaller `--size`, another `--runtime`, or more cores for it (`--cores dsp=0,1`)",
    "composite": "a smaller `--output`",
    "present": "a smaller `--output`: the picture is encoded there",
}
OF_CAUSES = {
    THROTTLED: "a performance profile with more power, such as `--performance-profile burst`, caps {unit} less",
    DOWN: "{unit} was restarted: the run's messages say why",
    LOST: "{unit} was restarted: the run's messages say why",
    HELD: "another `--policy`, `--edge` or `--latch` lets {stage} begin sooner (docs/policies-and-edges.md)",
    ASLEEP: "{stage} sleeps in its jobs: what it waits for is outside of Trilane",
    OVERHEAD: "{stage} is handed over late: fewer, longer jobs, or fewer programs beside the run on this machine",
    RELEASE: "nothing: frames come as often as was asked for, and there is time to spare",
}


def advice(budget: Sequence[Mapping[str, Any]], shared: Sequence[Mapping[str, Any]], policy: str) -> list[str]:
    """Sentences, the most promising first.

    `budget`: rows of the document. `shared`: its rows of shared cores. `policy`: of the run.
    """
    found = []
    taken = {row["stage"]: row for row in shared}
    works = [row for row in budget if row["what"] == WORK]
    if policy == "sequential" and len(works) > 1:
        found.append("one frame is worked on at a time: `--policy pipelined` lets the units work at once")
    for row in budget:
        if row["share"] < LEAST_SHARE:
            continue
        found.append(f"{row['ms']:.1f} ms a frame, {row['stage']} ({row['what']}): {_try(row, taken)}")
    return found[:MOST]


def _try(row: Mapping[str, Any], taken: Mapping[str, Mapping[str, Any]]) -> str:
    stage, unit = row["stage"], row["unit"]
    if row["what"] == WORK:
        return SHORTER.get(stage, f"shorter work of {stage}, or a unit of its own for it")
    if row["what"] == PREEMPTED:
        shared = taken.get(stage, {"taken_ms": {}, "others_ms": 0.0})
        units = [other for other, ms in shared["taken_ms"].items() if ms]
        if units and sum(shared["taken_ms"].values()) >= shared["others_ms"]:
            return f"{unit} and {', '.join(units)} share a core: `--cores` gives them cores of their own"
        return "mostly no job of this run had the core: end other programs; threads that spin between jobs take it too"
    return OF_CAUSES.get(row["what"], "nothing: it is before what is known").format(stage=stage, unit=unit)
