"""The facts of a verdict, from a report, from a run that goes on, and from a prediction.

Rule: pure. A report, a moment of a run and a prediction have the same keys (docs/report.md), as far as each knows them;
what is not known is left out of the verdict. The bound is the report's own, never another one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import inf
from typing import TYPE_CHECKING, Any, Final

from trilane.apps.explain.reasons import SHORTER
from trilane.apps.run.verdict import (
    COMPUTED,
    DISPLAY,
    LEAST_NAMED,
    MOST_OTHERS,
    SO_FAR,
    TARGET_FPS,
    UNKNOWN,
    Bound,
    Facts,
    Lateness,
    Rate,
    Trust,
    Verdict,
    judged,
    percent,
    slow_percentile,
    trust_of,
)
from trilane.hw_profiles.rates import wanted_drops
from trilane.scheduler.policy import POLICIES
from trilane.units import NO_FIGURES

if TYPE_CHECKING:
    from trilane.apps.run.report import Report

#: Latency over the latency of one frame alone. From this ratio on, a later pose is worth an attempt.
MUCH_LATER: Final = 2.0
#: Part of a frame's time that has to be left before more work for a frame is proposed.
MUCH_LEFT: Final = 0.5
#: Part of a rate by which two computations of it may differ.
ROUNDED: Final = 1e-6
NOT_YET: Final = Trust(False, ("the run goes on: its machine is judged at its end",))
NO_TRUTH: Final = "nothing to compare with: a pipeline of your own has no true picture"


def verdict_of(report: Report, folder: str = "") -> Verdict:
    """Return the verdict of a run. `folder`: its run folder, for advice."""
    return judged(facts_of(report.as_json(), folder))


def facts_of(document: Mapping[str, Any], folder: str = "", *, goes_on: bool = False) -> Facts:
    """Return the facts of a run.

    `document`: keys of report.json, as far as they are known. `folder`: run folder, for advice. `goes_on`: whether the
    run goes on, so that its figures are of the run so far.
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
    """Return the rate that a run has to hold: that of `--fps`, its scene or its file, as slow as its pace is."""
    config = document.get("config") or {}
    fps = float((config.get("scene") or {}).get("fps") or TARGET_FPS)
    return fps / float((document.get("pace") or {}).get("slow_motion", 1.0))


def _is_paced(document: Mapping[str, Any]) -> bool:
    """Return whether frames were released at a rate from outside."""
    run = ((document.get("config") or {}).get("pipeline") or {}).get("run") or {}
    policy = POLICIES.get(document.get("policy", ""))
    return bool(run.get("fps") or run.get("arrivals") or (policy and policy.paced))


def _lateness(document: Mapping[str, Any], *, is_paced: bool) -> Lateness | None:
    """Return how many frames were not in time; None where the misses count against another rate."""
    frames, late = document["frames"], document["deadline_misses"]
    dropped = wanted_drops(frames["dropped"])
    if is_paced:
        lost = frames.get("lost", 0)  # a prediction loses none
        return Lateness(frames["presented"] + dropped + lost, late, dropped, lost)
    if (document.get("pace") or {}).get("slow_motion", 1.0) != 1.0:
        return None
    return Lateness(frames["presented"] - 1, late, 0, frames["lost"], dropped)


def bound_of(document: Mapping[str, Any]) -> Bound | None:
    """Return the bound that a report names, with its stages' ms on the critical path; None without a path."""
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
    return Bound(
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
    """Return the error of the picture: of the run's own frames, and of the avatar that is worst by its validation."""
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
    """Return the mean PSNR of an avatar's validation, or that of its worst distance, and the PSNR of its worst view."""
    mean = facts.get("psnr_db")
    known = min(facts["psnr_db_by_band"].values()) if mean is None else mean
    return known, (facts.get("worst") or {}).get("psnr_db")


def _tries(document: Mapping[str, Any], bound: Bound | None, target: float, folder: str) -> Iterator[str]:
    """Yield what the run's own numbers say to try, the most useful first."""
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


def _shorter(document: Mapping[str, Any], bound: Bound | None) -> Iterator[str]:
    """Yield what makes the bound shorter; nothing where the run waits for its frames."""
    if document.get("policy") == "sequential" and len(document["units"]) > 1:
        yield "--policy pipelined: the units then work at once"
    if bound is None or bound.unit not in document["units"] or not bound.stages:
        return  # the time is no unit's: other programs', the rate's, the policy's
    stage = next(iter(bound.stages))
    if pipeline := (document.get("config") or {}).get("pipeline"):
        units = [unit for unit in document["units"] if unit != document["stages"][stage]["unit"]]
        if units:
            yield f"trilane predict {pipeline['file']} --set stages.{stage}.unit={units[0]}"
        return
    yield f"{stage}: {SHORTER.get(stage, 'less work, or a unit of its own')}".replace("`", "")


def predicted_verdict(answer: Mapping[str, Any], of_run: Trust | None = None) -> Verdict:
    """Return the verdict of a prediction: of an application, a network by itself, or a pipeline.

    `answer`: what `trilane predict --json` says of it. Everything is computed; it can be trusted where the interval of
    its frame time is known and does not hold the time that the rate leaves.
    `of_run`: judgement of the run whose times it takes. The prediction is not trusted more than this run.
    """
    times = _needed(answer)
    config = answer.get("config") or {}
    target = float((answer.get("rate") or {}).get("fps") or config.get("fps") or TARGET_FPS)
    low, high = times.get("low"), times.get("high")
    least, most = (None, None) if low is None or high is None or not low else (1e3 / high, 1e3 / low)
    units, latency = answer.get("units") or {}, answer.get("latency_ms")
    is_own = "cycle" in answer or answer.get("kind") == "pipeline"  # by itself, and beside others
    return judged(
        Facts(
            Rate(1e3 / times["mean"] if times["mean"] else inf, least, most, "80 %"),
            target,
            _predicted_lateness(answer),
            _resting_on(of_run, _trust_in(least, most, target, is_held=_is_held_by_display(answer))),
            frame_ms=times["mean"],
            latency_ms=latency["mean"] if latency and latency.get("samples", 1) else None,
            bound=_predicted_bound(answer, times["mean"]),
            idle={unit: (1 - row["busy"], _causes(row["idle"])) for unit, row in units.items()},
            image=NO_TRUTH if is_own else "trilane quality measures it here: a prediction has no pictures",
            tries=tuple(_predicted_tries(answer, times["mean"] * target > 1e3)),
            source=COMPUTED,
        )
    )


def _predicted_lateness(answer: Mapping[str, Any]) -> Lateness | None:
    """Return how many frames of the simulated run were not in time; None where none was released at a rate.

    Jitter, and pipelines beside this one, make frames late although a mean one fits.
    """
    return _lateness(answer, is_paced=True) if "frames" in answer and "rate" in answer else None


def _needed(answer: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ms that a frame needs where nothing holds it, and the bounds of its 80 % interval."""
    if rate := answer.get("rate"):
        keys = {"mean": "reserve", "low": "reserve_high", "high": "reserve_low"}
        left = {name: rate[key] for name, key in keys.items()}
        return {name: None if part is None else (1 - part) * 1e3 / rate["fps"] for name, part in left.items()}
    if "network_ms" in answer:
        return {"mean": answer["network_ms"], "low": answer["low_ms"], "high": answer["high_ms"]}
    return dict(answer.get("needs_ms") or answer["frame_time_ms"])


def _trust_in(low: float | None, high: float | None, target: float, *, is_held: bool) -> Trust:
    if low is None or high is None:
        return Trust(False, ("computed, with an unknown error",))
    if low < target <= high:
        return Trust(False, (f"computed, and the 80 % interval of {low:.0f} to {high:.0f} fps holds the target",))
    if low < high:
        return Trust(True, ("computed, and the whole 80 % interval is on one side of the target",))
    why = "the display holds the rate over the whole 80 % interval" if is_held else "the times have no interval"
    return Trust(True, (f"computed; {why}",))


def _resting_on(of_run: Trust | None, trust: Trust) -> Trust:
    """Return the judgement `trust` of a prediction that takes times of a run; None: of no run."""
    if of_run is None or of_run.trusted:
        return trust
    return Trust(False, (f"its times are from an UNSURE run: {', '.join(of_run.reasons)}", *trust.reasons))


def _is_held_by_display(answer: Mapping[str, Any]) -> bool:
    """Return whether only the chip's display keeps the predicted frames from being quicker."""
    rate = answer.get("rate")
    return bool(answer.get("display_capped")) and (rate is None or answer["fps"] < rate["fps"] * (1 - ROUNDED))


def _predicted_bound(answer: Mapping[str, Any], frame_ms: float) -> Bound | None:
    """Return the unit whose stages take most of a frame's time: of the stages that bound a pipeline file, else of all.

    A network by itself is its unit's only stage.
    """
    stages = answer.get("stages")
    if not stages:
        unit = answer.get("unit")
        return unit and Bound(unit, {"network": frame_ms}, 1.0, of_unit=frozenset({"network"}))
    cycle = [name for name in answer.get("cycle") or stages if name in stages]
    ms_of = {name: float(stages[name].get("alone_ms") or stages[name]["service_ms"]["mean"]) for name in stages}
    if answer.get("limit") == "rate":  # the source waits, and what would bound it without is the fullest unit
        cycle = list(stages)
    by_unit: dict[str, float] = {}
    for name in cycle:
        by_unit[stages[name]["unit"]] = by_unit.get(stages[name]["unit"], 0.0) + ms_of[name]
    unit = max(by_unit, key=by_unit.__getitem__)
    if not by_unit[unit] or not frame_ms:
        return None  # what takes no time is bound by nothing
    if _is_held_by_display(answer):
        return Bound(DISPLAY, {name: ms_of[name] for name in cycle if stages[name]["unit"] == unit}, 1.0)
    own = sorted((name for name in cycle if stages[name]["unit"] == unit), key=lambda name: -ms_of[name])
    return Bound(unit, {name: ms_of[name] for name in own}, min(by_unit[unit] / frame_ms, 1.0), of_unit=frozenset(own))


def _predicted_tries(answer: Mapping[str, Any], is_slow: bool) -> Iterator[str]:
    bound = _predicted_bound(answer, 1.0)
    if "cycle" in answer and is_slow and bound:
        others = [unit for unit in answer["units"] if unit != bound.unit]
        if others:
            yield f"--set stages.{next(iter(bound.stages))}.unit={others[0]}"
    elif is_slow and "policy" in (answer.get("config") or {}):
        yield "--what-if: every policy and edge on this chip"
    elif is_slow and answer.get("precision") not in (None, "int8"):
        yield f"--precision w8a8 in place of {answer['precision']}"
    elif is_slow:
        yield "a smaller network, or another --profile"
    elif (lateness := _predicted_lateness(answer)) and lateness.missed:
        yield "--trace FILE: which frames are late, and what they wait for"
    elif "temperature_c" in answer and not answer["temperature_c"]:
        yield "--minutes 30: what heat leaves of it"
