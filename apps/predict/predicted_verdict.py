"""Makes the verdict of a prediction for an application, for a network by itself, or for a pipeline.

Rule: the functions are pure. A prediction can be trusted if the 80 % interval of its rate is known and does not contain
the target. If a prediction uses the times of a run that is not trusted, the prediction is not trusted either.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Any, Final

from trilane.apps.run.verdict import COMPUTED, DISPLAY, Facts, LateFrames, NamedBound, Rate, Trust, Verdict, judged
from trilane.apps.run.verdict_facts import NO_TRUTH
from trilane.hw_profiles.prediction import ROUNDED, ApplicationPrediction, NetworkPrediction
from trilane.hw_profiles.rates import FrameInterval, HeldRate, wanted_drops
from trilane.hw_profiles.schema import SHARE_TEXT
from trilane.units import TARGET_FPS

NO_PICTURES: Final = "trilane quality measures it here: a prediction has no pictures"
OVER_MINUTES: Final = "--minutes 30: what heat leaves of it"


def document_of(prediction: ApplicationPrediction | NetworkPrediction) -> dict[str, Any]:
    """Return `prediction` with its verdict as JSON values, as `trilane predict --json` prints it."""
    return {**prediction.as_json(), "verdict": predicted_verdict(prediction).shown()}


def predicted_verdict(prediction: ApplicationPrediction | NetworkPrediction) -> Verdict:
    """Return the verdict of a prediction of an application, or of a network by itself."""
    rate = prediction.rate
    needs = rate.needs if rate else prediction.frame
    if isinstance(prediction, NetworkPrediction):
        target, network = rate.fps if rate else TARGET_FPS, {"network": needs.ms}
        bound = NamedBound(prediction.unit, network, 1.0, of_unit=frozenset(network))
        return _judged(needs, target, bound, _less_work(prediction.precision), "", image=NO_PICTURES)
    target = rate.fps if rate else prediction.config.fps
    is_held = prediction.is_capped_throughout and (rate is None or prediction.fps < rate.fps * (1 - ROUNDED))
    stages = {name: (stage.unit, stage.service_ms.mean or 0.0) for name, stage in prediction.stages.items()}
    return _judged(
        needs,
        target,
        _bound(stages, needs.ms, is_held=is_held),
        "--what-if: every policy and edge on this chip",
        "" if prediction.timeline else OVER_MINUTES,
        is_held=is_held,
        latency_ms=prediction.latency_ms.mean,
        idle={unit: (1 - row.busy, row.idle) for unit, row in prediction.units.items()},
        image=NO_PICTURES,
    )


def pipeline_verdict(row: Mapping[str, Any], of_run: Trust | None = None, *, is_cold: bool = False) -> Verdict:
    """Return the verdict of the prediction of a pipeline by itself or beside others.

    `row`: entry of `pipelines` in `trilane predict --json`.
    `of_run`: judgement of the run whose times the prediction uses; None if it uses no run.
    `is_cold`: whether heat over minutes can be predicted, but was not asked for.
    """
    rate = HeldRate.model_validate(row["rate"]) if "rate" in row else None
    needs = rate.needs if rate else FrameInterval(*row["needs_ms"].values())
    frames, latency = row["frames"], row["latency_ms"]
    stages = {
        name: (stage["unit"], float(stage["alone_ms"] or stage["service_ms"]["mean"]))
        for name, stage in row["stages"].items()
    }
    # Without the rate, the unit with the most work would determine the period.
    cycle = () if row.get("limit") == "rate" else row.get("cycle", ())
    bound = _bound({name: stages[name] for name in cycle if name in stages} or stages, needs.ms)
    shorter = _less_work(row.get("precision"))
    if "cycle" in row and bound:
        others = [unit for unit in row["units"] if unit != bound.unit]
        shorter = f"--set stages.{next(iter(bound.stages))}.unit={others[0]}" if others else ""
    dropped = wanted_drops(frames["dropped"])
    late = LateFrames(frames["presented"] + dropped, row["deadline_misses"], dropped)
    seen = "--trace FILE: which frames are late, and what they wait for" if rate and late.missed else ""
    return _judged(
        needs,
        rate.fps if rate else TARGET_FPS,
        bound,
        shorter,
        seen or (OVER_MINUTES if is_cold else ""),
        of_run=of_run,
        lateness=late if rate else None,
        latency_ms=latency["mean"] if latency["samples"] else None,
        idle={unit: (1 - one["busy"], one["idle"]) for unit, one in row["units"].items()},
        image=NO_TRUTH if row.get("kind") in (None, "pipeline") else NO_PICTURES,
    )


def _judged(
    needs: FrameInterval,
    target: float,
    bound: NamedBound | None,
    if_slow: str,
    if_fast: str,
    *,
    lateness: LateFrames | None = None,
    is_held: bool = False,
    of_run: Trust | None = None,
    **facts: Any,
) -> Verdict:
    """Return the verdict of a prediction.

    `needs`: frame time that neither the rate nor the display limits. `target`: rate to hold, in frames a second.
    `bound`, `lateness`: fields of `Facts`. `facts`: further fields of `Facts`, by name.
    `if_slow`: proposal if the frame time is too long. `if_fast`: proposal if it is short enough. Each may be "".
    `is_held`: whether only the refresh rate of the chip's display limits the rate.
    `of_run`: judgement of the run whose times the prediction uses; None if it uses no run.
    """
    ms, low, high = needs
    least, most = (None, None) if low is None or high is None or not low else (1e3 / high, 1e3 / low)
    trust = _trust_in(least, most, target, is_held=is_held)
    if of_run and not of_run.trusted:
        trust = Trust(False, (f"its times are from an UNSURE run: {', '.join(of_run.reasons)}", *trust.reasons))
    proposal = if_slow if ms * target > 1e3 else if_fast
    return judged(
        Facts(
            Rate(1e3 / ms if ms else inf, least, most, SHARE_TEXT),
            target,
            lateness,
            trust,
            frame_ms=ms,
            bound=bound,
            tries=(proposal,) if proposal else (),
            source=COMPUTED,
            **facts,
        )
    )


def _less_work(precision: str | None) -> str:
    if precision in (None, "int8"):
        return "a smaller network, or another --profile"
    return f"--precision w8a8 in place of {precision}"


def _trust_in(low: float | None, high: float | None, target: float, *, is_held: bool) -> Trust:
    if low is None or high is None:
        return Trust(False, ("computed, with an unknown error",))
    interval = f"{SHARE_TEXT} interval"
    if low < target <= high:
        return Trust(False, (f"computed, and the {interval} of {low:.0f} to {high:.0f} fps holds the target",))
    if low < high:
        return Trust(True, (f"computed, and the whole {interval} is on one side of the target",))
    why = f"the display holds the rate over the whole {interval}" if is_held else "the times have no interval"
    return Trust(True, (f"computed; {why}",))


def _bound(stages: Mapping[str, tuple[str, float]], frame_ms: float, *, is_held: bool = False) -> NamedBound | None:
    """Return the bound: the unit whose stages take most of a frame's time; None if all times are 0.

    `stages`: (unit, time in ms) of each stage that counts, by name; at least one. `frame_ms`: time of a frame.
    `is_held`: whether the display limits the rate. In this case, the display is the bound.
    """
    by_unit: dict[str, float] = {}
    for unit, ms in stages.values():
        by_unit[unit] = by_unit.get(unit, 0.0) + ms
    unit = max(by_unit, key=by_unit.__getitem__)
    if not by_unit[unit] or not frame_ms:
        return None
    own = {name: ms for name, (of, ms) in stages.items() if of == unit}
    if is_held:
        return NamedBound(DISPLAY, own, 1.0)
    own = dict(sorted(own.items(), key=lambda row: -row[1]))
    return NamedBound(unit, own, min(by_unit[unit] / frame_ms, 1.0), of_unit=frozenset(own))
