"""What bounded the frame time in words, and what a person could try. Rule: each cause names what it rests on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from trilane.pipeline.critical_path import ASLEEP, RELEASE, TAKEN, WORK
from trilane.pipeline.unit_history import DOWN, HELD, LOST, OVERHEAD, PREEMPTED, THROTTLED

#: Of the frame time; what bounds less of it is not worth an attempt.
LEAST_SHARE: Final = 0.1
MOST: Final = 4


def bound_text(bound: Mapping[str, Any]) -> str:
    """Of the `bound` of a report: the unit that most of the path is, and the stage, with their shares and intervals."""
    named = [f"{part['name']} {_share(part)}" for part in (bound["unit"], bound["stage"]) if part]
    return ", and of stages most ".join(named)


def _share(part: Mapping[str, Any]) -> str:
    if part["share_low"] is None:
        return f"{part['share']:.0%} of the path"
    rivals = f", not surely more than {' or '.join(part['rivals'])}" if part.get("rivals") else ""
    return f"{part['share']:.0%} of the path ({part['share_low']:.0%} to {part['share_high']:.0%}){rivals}"


#: Of stages of the avatar's pipeline: what makes their work shorter.
SHORTER = {
    "pose": "`--skinning gpu` takes the vertices off the CPU; `trilane explain SCENE` says what a scene models",
    "raster": "a smaller `--size` draws fewer texels",
    "infer": "a smaller `--size`, or another `--runtime`",
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


def advice(budget: Sequence[Mapping[str, Any]], policy: str, spare_cores: int) -> list[str]:
    """Sentences: first what other programs took, then the most promising.

    `budget`: rows of the document. `policy`: of the run. `spare_cores`: of this machine beyond one for each unit.
    """
    found = []
    works = [row for row in budget if row["what"] == WORK]
    if policy == "sequential" and len(works) > 1:
        found.append("one frame is worked on at a time: `--policy pipelined` lets the units work at once")
    nobodys = [row for row in budget if row["what"] == PREEMPTED]
    if sum(row["share"] for row in nobodys) >= LEAST_SHARE:
        found.append(
            f"{sum(row['ms'] for row in nobodys):.1f} ms a frame, {', '.join(row['stage'] for row in nobodys)} "
            f"({PREEMPTED}): no job of this run had the core: end other programs; threads that spin take it too"
        )
    found += [
        f"{row['ms']:.1f} ms a frame, {row['stage']} ({row['what']}): {_try(row, spare_cores)}"
        for row in budget
        if row["share"] >= LEAST_SHARE and row["what"] != PREEMPTED
    ]
    return found[:MOST]


def _try(row: Mapping[str, Any], spare_cores: int) -> str:
    stage, unit = row["stage"], row["unit"]
    if row["what"] == TAKEN and spare_cores >= 0:
        return f"this machine has a core for every unit: `--cores` gives {unit} one of its own"
    if row["what"] in (WORK, TAKEN):
        more_cores = ", or more cores for it (`--cores dsp=...`)" if stage == "infer" and spare_cores > 0 else ""
        return SHORTER.get(stage, f"shorter work of {stage}, or a unit of its own for it") + more_cores
    return OF_CAUSES.get(row["what"], "nothing: it is before what is known").format(stage=stage, unit=unit)
