"""Makes the facts of a verdict from a report, or from the figures of a live run.

Rule: the functions are pure. Both sources have the keys of docs/report.md, as far as their values are known. The
verdict leaves out unknown values, and has the bound that a report or a live run names.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

from trilane.apps.explain.reasons import SHORTER
from trilane.apps.run.verdict import (
    LEAST_NAMED,
    MOST_OTHERS,
    SO_FAR,
    UNKNOWN,
    Facts,
    LateFrames,
    NamedBound,
    Rate,
    Trust,
    Verdict,
    judged,
    percent,
    slow_percentile,
    trust_of,
)
from trilane.hw_profiles.rates import wanted_drops
from trilane.scheduler.policy import POLICIES, works_on_one_frame
from trilane.units import NO_FIGURES, TARGET_FPS

if TYPE_CHECKING:
    from trilane.apps.run.report import Report

#: Ratio of latency to the latency of a frame alone. Above this ratio, the verdict proposes late latching.
MUCH_LATER: Final = 2.0
#: Unused share of a frame's time from which the verdict proposes larger pictures.
MUCH_LEFT: Final = 0.5
NOT_YET: Final = Trust(False, ("the run goes on: its machine is judged at its end",))
NO_TRUTH: Final = "nothing to compare with: a pipeline of your own has no true picture"


def verdict_of(report: Report, folder: str = "") -> Verdict:
    """Return the verdict of a run.

    `report`: report of the run. `folder`: path of the run folder, which appears in commands that the verdict proposes;
    "" if unknown.
    """
    return judged(facts_of(report.as_json(), folder))


def facts_of(document: Mapping[str, Any], folder: str = "", *, goes_on: bool = False) -> Facts:
    """Return the facts on which the verdict of a run rests.

    `document`: mapping with the known keys of report.json. `folder`: see `verdict_of`.
    `goes_on`: whether the run has not ended yet; in that case, `document` has the figures so far.
    """
    frames, times, latency = (document.get(key) or {} for key in ("frames", "frame_time_ms", "latency_ms"))
    has_times = frames.get("presented", 0) > 1
    target, is_paced = target_fps(document), _is_paced(document)
    fps = document.get("fps") if has_times else None
    rate = Rate(fps, document.get("fps_low"), document.get("fps_high")) if fps else None
    bound = bound_of(document)
    baseline = document.get("baseline")
    trust = NOT_YET if goes_on else trust_of(document)
    return Facts(
        rate,
        target,
        _lateness(document, is_paced=is_paced) if has_times else None,
        trust,
        is_held_to_rate=is_paced,
        failure=document.get("failure") or "",
        frame_ms=times.get("mean") if has_times else None,
        slow=slow_percentile(times),
        latency_ms=latency.get("mean"),
        alone=(baseline["fps"], baseline["latency_ms"]["mean"]) if baseline and baseline["fps"] else None,
        bound=bound,
        idle={unit: (1 - row["busy"], _causes(row["idle"])) for unit, row in document.get("units", {}).items()},
        image=_image(document),
        tries=() if goes_on else tuple(_tries(document, bound, target, folder)),
        source=SO_FAR if goes_on else "",
    )


def target_fps(document: Mapping[str, Any]) -> float:
    """Return the rate that a run must hold, in frames a second.

    The rate comes from `--fps`, the scene or the pipeline file; if none of them has a rate, TARGET_FPS counts. In slow
    motion, the rate is divided by the factor of the slow motion. `document`: mapping with the known keys of
    report.json.
    """
    config = document.get("config") or {}
    fps = float((config.get("scene") or {}).get("fps") or TARGET_FPS)
    return fps / float((document.get("pace") or {}).get("slow_motion", 1.0))


def _is_paced(document: Mapping[str, Any]) -> bool:
    """Return whether a fixed rate or random arrivals released the frames.

    In other runs, the pipeline takes a frame as soon as it can. `document`: mapping with the keys of report.json.
    """
    run = ((document.get("config") or {}).get("pipeline") or {}).get("run") or {}
    policy = POLICIES.get(document.get("policy", ""))
    return bool(run.get("fps") or run.get("arrivals") or (policy and policy.paced))


def _lateness(document: Mapping[str, Any], *, is_paced: bool) -> LateFrames | None:
    """Return how many frames were not in time; None for a run in slow motion that is not paced.

    A run in slow motion that is not paced counts its deadline misses at another rate than the target.
    `document`: mapping with the keys of report.json. `is_paced`: result of `_is_paced`.
    """
    frames, late = document["frames"], document["deadline_misses"]
    dropped = wanted_drops(frames["dropped"])
    if is_paced:
        lost = frames.get("lost", 0)  # a prediction loses none
        return LateFrames(frames["presented"] + dropped + lost, late, dropped, lost)
    if (document.get("pace") or {}).get("slow_motion", 1.0) != 1.0:
        return None
    return LateFrames(frames["presented"] - 1, late, 0, frames["lost"], dropped)


def bound_of(document: Mapping[str, Any]) -> NamedBound | None:
    """Return the bound that a report names, with each stage's ms on the critical path; None if no bound is named.

    `document`: mapping with the known keys of report.json.
    """
    bound = document.get("bound")
    if not bound:
        return None
    unit, stage = bound["unit"], bound.get("stage")
    of_unit = frozenset(name for name, row in document.get("stages", {}).items() if row["unit"] == unit["name"])
    shares = bound.get("stages") or ({stage["name"]: stage["share"]} if stage else {})
    frame_ms = (document.get("frame_time_ms") or {}).get("mean")
    first = [stage["name"]] if stage else []
    others = [name for name in sorted(of_unit, key=lambda each: -shares.get(each, 0.0)) if name not in first]
    named = [*first, *(name for name in others if shares.get(name, 0.0) >= LEAST_NAMED)]
    path = ((bound.get("path") or {}).get("unit") or {}).get("name", "")
    return NamedBound(
        unit["name"],
        {name: shares[name] * frame_ms if frame_ms and name in shares else None for name in named},
        unit.get("share", 0.0),
        unit.get("cost"),
        unit.get("rivals") or (),
        of_unit,
        "" if path == unit["name"] else path,
    )


def _causes(idle: Mapping[str, float | None]) -> dict[str, float]:
    return {cause: share for cause, share in idle.items() if share}


def _image(document: Mapping[str, Any]) -> str:
    """Return a text on the image error of a run.

    If the run's frames were checked, the text has their error. If they were not, the text has the error from the
    validation of the worst avatar, or says that the error is unknown. `document`: mapping with the known keys of
    report.json.
    """
    avatars = document.get("accuracy") or {}
    if check := document.get("check"):
        against = str(check["against"]).partition(":")[0]
        worst = check["worst_psnr_db"]
        return f"{check['psnr_db']:.1f} dB against {against}, worst {worst:.1f} of {check['frames']} frames of this run"
    if not avatars:
        is_own = "pipeline" in (document.get("config") or {})
        return NO_TRUTH if is_own else UNKNOWN
    for facts in avatars.values():
        if facts.get("source", NO_FIGURES) == NO_FIGURES:
            return f"{UNKNOWN}: {facts.get('why', 'the avatar has no validation')}; this run: --check 4"
    error, worst = min(map(_validated, avatars.values()))
    seen = "" if worst is None else f", worst view {worst:.1f}"
    return f"{error:.1f} dB{seen} (validation); this run: --check 4"


def _validated(facts: Mapping[str, Any]) -> tuple[float, float | None]:
    """Return (usual PSNR, PSNR of the worst view) from the validation of an avatar, in dB.

    The usual PSNR is the mean; without a mean, it is the PSNR of the worst band of zoom. An unknown PSNR of the worst
    view is None. `facts`: the avatar's entry in the block `accuracy` of the report.
    """
    mean = facts.get("psnr_db")
    known = min(facts["psnr_db_by_band"].values()) if mean is None else mean
    return known, (facts.get("worst") or {}).get("psnr_db")


def _tries(document: Mapping[str, Any], bound: NamedBound | None, target: float, folder: str) -> Iterator[str]:
    """Yield proposals that follow from the run's figures, the most useful first.

    `document`: mapping with the known keys of report.json. `bound`: result of `bound_of`. `target`: rate to hold, in
    frames a second. `folder`: see `verdict_of`.
    """
    others = document.get("other_programs")
    if others is not None and others > MOST_OTHERS:
        yield f"end other programs ({percent(others)}) and run again"
    left = 1 - target / document["fps"] if document.get("fps") else 0.0
    if left < 0 or _is_paced(document):
        yield from _shorter(document, bound)
    latency_ms, baseline = (document.get("latency_ms") or {}).get("mean") or 0.0, document.get("baseline")
    if left >= 0 and baseline and latency_ms > MUCH_LATER * (baseline["latency_ms"]["mean"] or 0.0) > 0:
        yield "--latch 3 for newer poses: a frame alone takes less than half of the latency"
    if left >= MUCH_LEFT and "pipeline" not in (document.get("config") or {}):
        yield f"a larger --picture: {100 * left:.0f} % of each frame's time is left"
    yield f"trilane explain {folder or 'RUN'}"


def _shorter(document: Mapping[str, Any], bound: NamedBound | None) -> Iterator[str]:
    """Yield proposals to shorten the frame time.

    For a run with one frame at a time, the first proposal is a policy under which the units work at once. If a unit
    bounds the run, and not, for example, the rate, another proposal concerns the stage that bounds.
    `document`: mapping with the known keys of report.json. `bound`: result of `bound_of`.
    """
    if works_on_one_frame(document.get("policy", "")) and len(document["units"]) > 1:
        yield "--policy pipelined: the units then work at once"
    if bound is None or bound.unit not in document["units"] or not bound.stages:
        return  # no unit bounds the run, but other programs, the rate or the policy
    stage = next(iter(bound.stages))
    if pipeline := (document.get("config") or {}).get("pipeline"):
        units = [unit for unit in document["units"] if unit != document["stages"][stage]["unit"]]
        if units:
            yield f"trilane predict {pipeline['file']} --set stages.{stage}.unit={units[0]}"
        return
    yield f"{stage}: {SHORTER.get(stage, 'less work, or a unit of its own')}".replace("`", "")
