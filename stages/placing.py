"""Which cores the units of a run get. Rule: as asked; else the least predicted frame time; else the rule for any run.

A run that is long enough is rehearsed for a moment: what each unit needs for a frame is measured, with the numbers of
threads that it may have, and kept for the next run of the same network, shapes, runtime, output and machine. A run
that is too short to gain by it, or is held to a chip's pace, is placed by the rule of `trilane.hw_profiles.host`.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilane.cache import cached_arrays
from trilane.hw_profiles.host import host_cores, rule_placement, settings_of, usable_cores
from trilane.hw_profiles.placement_facts import NS_PER_MS, described, placement_of, predictions, unit_rows
from trilane.pipeline.rehearsal import rehearse
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.placement import Ranked, chosen, ranked
from trilane.scheduler.placement_model import Rules, frame_ns
from trilane.scheduler.places import Core, Place, Placement, Times, Work
from trilane.stages.avatar_assets import network_of
from trilane.stages.avatar_pipeline import avatar_pipeline
from trilane.stages.config import RunConfig
from trilane.stages.configure import Checked
from trilane.stages.dsp.runtime import RUNTIMES
from trilane.stages.machine_facts import cpu_facts, package_version
from trilane.units import BEFORE_INFER, UNITS

#: Shorter runs do not gain what a rehearsal takes, about a second.
LEAST_FRAMES = 100
FRAMES = 5  # of the scene, evenly spread, that are rehearsed
CACHE = "placement-1"
MOST_LOGICAL, MOST_CORES = 8, 16
FIRST = BEFORE_INFER[0][1]
SEQUENTIAL = "sequential"

RULE, MEASURED, ASKED = "rule", "measured", "asked"


def placed(checked: Checked, policy: str, starter: UnitStarter, driver: str = "") -> Checked:
    """`checked` with its units on the cores that are best for it, and what is to be said of that.

    `policy`: of the run. `starter`: a fork server. `driver`: OpenGL's, which the times depend on.
    Raises TrilaneError when a unit cannot start or a stage fails, KeyboardInterrupt when interrupted.
    """
    asked = {unit: Place(own, len(own)) for unit, own in checked.asked_cores.items()}
    cores = host_cores(sorted({*usable_cores(), *(core for place in asked.values() for core in place.cores)}))
    rule = rule_placement(usable_cores(), checked.asked_cores)
    why = _why_not(checked, cores)
    if why:
        how = ASKED if len(asked) == len(UNITS) else RULE
        return _with(checked, rule, {"how": how, "why": why, "units": unit_rows(rule)})
    times, at = _kept_times(checked, cores, rule, starter, driver)
    rules = Rules(FIRST, policy == SEQUENTIAL)
    found = ranked(considered(cores, asked), times, rules, asked)
    by_rule = Ranked(rule, frame_ns(rule, cores, times, rules))
    best = chosen(found, by_rule)
    facts = {
        "how": MEASURED,
        "why": "as asked, the others by their times" if asked else "the least predicted frame time",
        "units": unit_rows(best.placement),
        "measured_at": at,
        **predictions(best, by_rule, found),
        "times": times_rows(times),
    }
    return _with(checked, best.placement, facts)


def considered(cores: Sequence[Core], asked: Placement) -> list[Core]:
    """Those to place units on: all, or of more than MOST_LOGICAL one of each physical core, and the first MOST_CORES.

    Placements on more are too many to list. Cores that were `asked` for stay.
    """
    if len(cores) <= MOST_LOGICAL:
        return list(cores)
    fixed = {core for place in asked.values() for core in place.cores}
    first = {core.physical: core.number for core in reversed(cores)}
    chosen_numbers = {*sorted(first.values())[:MOST_CORES], *fixed}
    return [core for core in cores if core.number in chosen_numbers]


def times_rows(times: Times) -> list[dict[str, Any]]:
    """What was measured: a row for each unit and number of threads, times in ms."""
    return [
        {"unit": unit, "threads": threads, "ms": work.serial_ns / NS_PER_MS, "core_ms": work.core_ns / NS_PER_MS}
        for unit, works in times.items()
        for threads, work in works.items()
    ]


def _why_not(checked: Checked, cores: Sequence[Core]) -> str:
    """Why nothing is measured; empty when it is."""
    if len(checked.asked_cores) == len(UNITS):
        return "as asked"
    if len(cores) == 1:
        return "there is one core"
    if checked.config.pace_ns:
        return "the units are held to the pace of a chip"
    if checked.config.scene.frames < LEAST_FRAMES:
        return f"fewer than {LEAST_FRAMES} frames, too short to measure"
    return ""


def _with(checked: Checked, placement: Placement, facts: Mapping[str, Any]) -> Checked:
    note = f"placement: {described(placement)} ({_reason(facts)})"
    config = checked.config.model_copy(update={"units": settings_of(placement)})
    return replace(checked, config=config, notes=(*checked.notes, note), placement=facts)


def _reason(facts: Mapping[str, Any]) -> str:
    if facts["how"] != MEASURED:
        return str(facts["why"])
    others = [(row["units"], row["predicted_ms"]) for row in facts["alternatives"][:2]]
    if facts["rule"] not in (facts["units"], *(units for units, _ in others)):
        others.insert(0, (facts["rule"], facts["rule_ms"]))
    text = f"{facts['why']}: {facts['predicted_ms']:.1f} ms by times of {facts['measured_at']}"
    return "; ".join([text, *(f"{described(placement_of(units))}: {ms:.1f}" for units, ms in others)])


def _kept_times(
    checked: Checked, cores: Sequence[Core], rule: Placement, starter: UnitStarter, driver: str
) -> tuple[Times, str]:
    """What each unit needs for a frame, and when that was measured, UTC."""

    def measured() -> dict[str, NDArray[Any]]:
        rows = [
            (UNITS.index(unit), threads, *work)
            for unit, works in measured_times(checked, cores, rule, starter).items()
            for threads, work in works.items()
        ]
        return {"works": np.array(rows, np.int64), "at_s": np.array(time.time(), np.int64)}

    made = cached_arrays(CACHE, [*_made_from(checked, cores, rule), driver], measured)
    times: dict[str, dict[int, Work]] = {unit: {} for unit in UNITS}
    for unit, threads, *work in made["works"].tolist():
        times[UNITS[unit]][threads] = Work(*work)
    return times, time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(int(made["at_s"])))


def thread_counts(cores: int, rule: Placement) -> dict[str, list[int]]:
    """The numbers of threads, beside 1, that each unit is measured with: those that a placement may give it.

    Each, what the `rule` for any run and the options give it. The network also up to four, half of the cores, all, and
    all but those of the others.
    """
    counts = {unit: {place.threads} for unit, place in rule.items()}
    counts["dsp"] |= {*range(2, min(cores, 4) + 1), cores // 2, cores - 2, cores - 1, cores}
    return {unit: sorted(count for count in of if count > 1) for unit, of in counts.items()}


def _made_from(checked: Checked, cores: Sequence[Core], rule: Placement) -> list[str]:
    """All that the times depend on."""
    config = checked.config
    said = config.model_dump_json(exclude={"out_dir", "units", "scene", "pace_ns"})
    scene = config.scene.model_dump_json(exclude={"name", "frames", "fps"})
    machine = [str(cpu_facts()), str([tuple(core) for core in cores]), str(thread_counts(len(cores), rule))]
    network = network_of(checked.assets).digest
    versions = [str(package_version(name)) for name in (RUNTIMES[config.runtime].package, "trilane")]
    return [said, scene, *machine, network, *versions]


def measured_times(checked: Checked, cores: Sequence[Core], rule: Placement, starter: UnitStarter) -> Times:
    """What each unit needs for a frame, measured now.

    `checked`: what is to be run. `cores`: there are. `rule`: whose numbers of threads are measured too. `starter`: a
    fork server. One of the scene's tensor shapes is used, which is prepared soonest; all have about the same area.
    Raises as `placed`.
    """
    fastest = [core.number for core in sorted(cores, key=lambda core: (-core.permille, core.number))]
    one = {unit: Place((fastest[0],), 1) for unit in UNITS}
    variants = [
        {**one, unit: Place(tuple(sorted(fastest[:count])), count)}
        for unit, counts in thread_counts(len(cores), rule).items()
        for count in counts
    ]
    scene = checked.config.scene
    with tempfile.TemporaryDirectory(prefix="trilane-rehearsal-") as folder:
        one_shape = scene.model_copy(update={"size": _one_shape(checked.config)})
        config = checked.config.model_copy(update={"out_dir": Path(folder), "scene": one_shape, "shapes": ()})
        first, *others = (
            avatar_pipeline(config.model_copy(update={"units": _spinning(placement, len(cores))}), checked.assets)
            for placement in (one, *variants)
        )
        spread = [number * scene.frames // FRAMES for number in range(FRAMES)]
        return rehearse(first, others, spread, checked.assets, starter)


def _spinning(placement: Placement, cores: int) -> dict[str, Any]:
    """Settings in which a unit's threads spin if there are cores for it alone, as they then will in the run."""
    return {
        unit: settings.model_copy(update={"spin": 1 < settings.threads <= cores - len(UNITS) + 1})
        for unit, settings in settings_of(placement).items()
    }


def _one_shape(config: RunConfig) -> str:
    """The tensor shape nearest to a square."""
    height, width = min(config.buckets, key=lambda shape: (abs(shape[0] - shape[1]), shape))
    return f"{height}x{width}"
