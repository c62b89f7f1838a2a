"""Makes the facts of a verdict from a report, or from the figures of a live run.

Rule: the functions are pure. The verdict leaves out unknown values. It does not look for a bound, but uses the bound
that the report or the live run names.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

from trilane.apps.explain.reasons import SHORTER
from trilane.apps.run.report import Check, Report
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
from trilane.pipeline.run_metrics import Bound, PolicyMetrics, RunMetrics, StageTimes
from trilane.scheduler.policy import POLICIES, works_on_one_frame
from trilane.units import NO_FIGURES, TARGET_FPS

if TYPE_CHECKING:
    from trilane.apps.watch.figures import MomentFigures, StageFigures

#: Ratio of the latency to the latency with one frame at a time. Above it, the verdict proposes late latching.
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
    return judged(facts_of(report, report.config, report.accuracy, folder))


def facts_of(
    run: RunMetrics, config: Mapping[str, Any], accuracy: Mapping[str, Mapping[str, Any]], folder: str = ""
) -> Facts:
    """Return the facts for the verdict of a run that has ended.

    `run`: figures of the run; a `Report` also has its failure, baseline, check and pace. `config`, `accuracy`: blocks
    of report.json. `folder`: see `verdict_of`.
    """
    report = run if isinstance(run, Report) else None
    slow_motion = report.pace.slow_motion if report and report.pace else 1.0
    target, is_paced = _target_fps(config) / slow_motion, _is_paced(config, run.policy)
    # A run in slow motion that is not paced counts its deadline misses at another rate than the target.
    frames, has_lateness = run.frames, run.frames.presented > 1 and (is_paced or slow_motion == 1)
    lateness = _lateness(frames.presented, run.deadline_misses, frames.dropped, frames.lost, is_paced=is_paced)
    bound = _named_bound(run.bound, run.stages, run.frame_time_ms.mean)
    baseline = report and report.baseline
    return Facts(
        Rate(run.fps, run.fps_low, run.fps_high) if run.fps else None,
        target,
        lateness if has_lateness else None,
        trust_of(run.model_dump(include={"clock", "other_programs", "processor", "temperature_c"})),
        is_held_to_rate=is_paced,
        failure=(report and report.failure) or "",
        frame_ms=run.frame_time_ms.mean if run.frames.presented > 1 else None,
        slow=slow_percentile(dict(run.frame_time_ms)),
        latency_ms=run.latency_ms.mean,
        alone=(baseline.fps, baseline.latency_ms.mean) if baseline and baseline.fps else None,
        bound=bound,
        idle={unit: (1 - row.busy, _causes(dict(row.idle))) for unit, row in run.units.items()},
        image=_image(config, accuracy, report.check if report else None),
        tries=tuple(_tries(run, config, baseline, bound, target, folder)),
    )


def facts_so_far(figures: MomentFigures, late: int, config: Mapping[str, Any], policy: str) -> Facts:
    """Return the facts for the verdict of a run that still goes on.

    `figures`: figures so far. `late`: number of late frames so far. `config`: block `config` of report.json, as far as
    it is known. `policy`: policy of the run.
    """
    frames, times, is_paced = figures.frames, figures.frame_time_ms, _is_paced(config, policy)
    dropped = {f"{drop.edge}:{drop.cause}": drop.frames for drop in frames.dropped}
    return Facts(
        Rate(figures.run_fps) if figures.run_fps else None,
        _target_fps(config),
        _lateness(frames.presented, late, dropped, sum(frames.lost.values()), is_paced=is_paced),
        NOT_YET,
        is_held_to_rate=is_paced,
        frame_ms=times["mean"],
        slow=slow_percentile(times),
        latency_ms=figures.latency_ms["mean"],
        bound=_named_bound(figures.bound, figures.stages, times["mean"]),
        idle={name: (1 - unit.run.busy, _causes(unit.run.idle)) for name, unit in figures.units.items()},
        image=_image(config, figures.accuracy),
        source=SO_FAR,
    )


def _target_fps(config: Mapping[str, Any]) -> float:
    """Return the rate that a run must hold, in frames a second, without a slow motion.

    The rate comes from `--fps`, the scene or the pipeline file; if none of them has a rate, TARGET_FPS counts.
    `config`: block `config` of report.json, as far as it is known.
    """
    return float((config.get("scene") or {}).get("fps") or TARGET_FPS)


def _is_paced(config: Mapping[str, Any], policy: str) -> bool:
    """Return whether a fixed rate or random arrivals released the frames.

    In other runs, the pipeline takes a frame as soon as it can. `config`: see `_target_fps`. `policy`: policy of the
    run.
    """
    run = (config.get("pipeline") or {}).get("run") or {}
    return bool(run.get("fps") or run.get("arrivals") or (policy in POLICIES and POLICIES[policy].paced))


def _lateness(presented: int, late: int, dropped: Mapping[str, int], lost: int, *, is_paced: bool) -> LateFrames:
    """Return how many frames were not in time.

    `presented`, `late`, `lost`: numbers of frames. `dropped`: numbers of dropped frames by `edge:cause`. `is_paced`:
    result of `_is_paced`.
    """
    left_out = wanted_drops(dropped)
    if is_paced:
        return LateFrames(presented + left_out + lost, late, left_out, lost)
    return LateFrames(presented - 1, late, 0, lost, left_out)


def _named_bound(
    bound: Bound | None, stages: Mapping[str, StageTimes | StageFigures], frame_ms: float | None
) -> NamedBound | None:
    """Return `bound` with ms on the critical path by stage; None without a bound.

    The result names the stage that bounds. It also names other stages of its unit with a share of LEAST_NAMED or more.
    `stages`: figures of all stages, by name. `frame_ms`: mean frame time, ms; None or 0 if unknown.
    """
    if bound is None:
        return None
    unit, stage = bound.unit, bound.stage
    of_unit = frozenset(name for name, row in stages.items() if row.unit == unit.name)
    shares = bound.stages or ({stage.name: stage.share} if stage else {})
    first = [stage.name] if stage else []
    others = [name for name in sorted(of_unit, key=lambda each: -shares.get(each, 0.0)) if name not in first]
    named = [*first, *(name for name in others if shares.get(name, 0.0) >= LEAST_NAMED)]
    path = bound.path.unit.name if bound.path else ""
    return NamedBound(
        unit.name,
        {name: shares[name] * frame_ms if frame_ms and name in shares else None for name in named},
        unit.share,
        unit.cost,
        unit.rivals or (),
        of_unit,
        "" if path == unit.name else path,
    )


def _causes(idle: Mapping[str, float | None]) -> dict[str, float]:
    return {cause: share for cause, share in idle.items() if share}


def _image(config: Mapping[str, Any], accuracy: Mapping[str, Mapping[str, Any]], check: Check | None = None) -> str:
    """Return a text on the image error of a run.

    If the run's frames were checked, the text has their error. Otherwise, it has the error in the validation of the
    worst avatar, or says that the error is unknown. `config`, `accuracy`: blocks of report.json.
    """
    if check:
        against, least = check.against.partition(":")[0], check.worst_psnr_db
        return f"{check.psnr_db:.1f} dB against {against}, worst {least:.1f} of {check.frames} frames of this run"
    if not accuracy:
        return NO_TRUTH if "pipeline" in config else UNKNOWN
    for facts in accuracy.values():
        if facts.get("source", NO_FIGURES) == NO_FIGURES:
            return f"{UNKNOWN}: {facts.get('why', 'the avatar has no validation')}; this run: --check 4"
    error, worst = min(map(_validated, accuracy.values()))
    seen = "" if worst == math.inf else f", worst view {worst:.1f}"
    return f"{error:.1f} dB{seen} (validation); this run: --check 4"


def _validated(facts: Mapping[str, Any]) -> tuple[float, float]:
    """Return (usual PSNR, PSNR of the worst view) from the validation of an avatar, in dB.

    The usual PSNR is the mean; without a mean, it is the PSNR of the worst band of zoom. An unknown PSNR of the worst
    view is infinite. `facts`: the avatar's entry in the block `accuracy` of the report.
    """
    mean = facts.get("psnr_db")
    known = min(facts["psnr_db_by_band"].values()) if mean is None else mean
    worst = (facts.get("worst") or {}).get("psnr_db")
    return known, math.inf if worst is None else worst


def _tries(
    run: RunMetrics,
    config: Mapping[str, Any],
    baseline: PolicyMetrics | None,
    bound: NamedBound | None,
    target: float,
    folder: str,
) -> Iterator[str]:
    """Yield proposals, the most useful first. Every run gets the last one, `trilane explain`.

    The first is to end other programs, if together they took more than MOST_OTHERS of the cores' time. A run that is
    paced or below `target` gets the proposals of `_shorter`.
    A run that holds `target` may get late latching (see MUCH_LATER). If it is the run of a scene, it may also get a
    larger picture (see MUCH_LEFT).
    `run`, `config`, `folder`: see `facts_of`. `baseline`: figures with one frame at a time; None if unknown.
    `bound`: bound of the run; None if unknown. `target`: rate to hold, in frames a second.
    """
    if run.other_programs is not None and run.other_programs > MOST_OTHERS:
        yield f"end other programs ({percent(run.other_programs)}) and run again"
    left = 1 - target / run.fps if run.fps else 0.0
    if left < 0 or _is_paced(config, run.policy):
        yield from _shorter(run, config, bound)
    latency_ms = run.latency_ms.mean or 0.0
    if left >= 0 and baseline and latency_ms > MUCH_LATER * (baseline.latency_ms.mean or 0.0) > 0:
        yield "--latch 3 for newer poses: a frame alone takes less than half of the latency"
    if left >= MUCH_LEFT and "pipeline" not in config:
        yield f"a larger --picture: {100 * left:.0f} % of each frame's time is left"
    yield f"trilane explain {folder or 'RUN'}"


def _shorter(run: RunMetrics, config: Mapping[str, Any], bound: NamedBound | None) -> Iterator[str]:
    """Yield proposals to shorten the frame time.

    A run with one frame at a time on several units gets a policy under which the units work simultaneously. If a unit
    bounds the run, the stage that bounds gets less work. In a pipeline file, it gets another unit if there is one.
    `run`, `config`, `bound`: see `_tries`.
    """
    if works_on_one_frame(run.policy) and len(run.units) > 1:
        yield "--policy pipelined: the units then work at once"
    if bound is None or bound.unit not in run.units or not bound.stages:
        return  # no unit bounds the run, but other programs, the rate or the policy
    stage = next(iter(bound.stages))
    if pipeline := config.get("pipeline"):
        units = [unit for unit in run.units if unit != run.stages[stage].unit]
        if units:
            yield f"trilane predict {pipeline['file']} --set stages.{stage}.unit={units[0]}"
        return
    yield f"{stage}: {SHORTER.get(stage, 'less work, or a unit of its own')}".replace("`", "")
