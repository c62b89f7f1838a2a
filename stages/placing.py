"""Chooses the cores of a run's units: by request, by the shortest tried or predicted frames, or by a rule.

A run that is long enough is rehearsed first. The rehearsal measures the time that each unit needs for a frame, with
each number of threads that it may have. The few placements with the shortest predicted frames are then tried with real
frames. Both results are kept for the next run with the same network, shapes, runtime, output and machine. The rule of
`trilane.hw_profiles.host` places a run that is too short to gain by a rehearsal or is held to a chip's pace.

Nothing is tried while other programs use the cores. A floating unit avoids these programs, but a pinned unit waits for
them. Therefore frame times would depend more on the programs than on the placements. In this case the prediction
decides, a note says so, and the next run may try placements again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilane.cache import cached_arrays
from trilane.hw_profiles.host import (
    described,
    host_cores,
    placement_of,
    predictions,
    rule_placement,
    settings_of,
    unit_rows,
    usable_cores,
)
from trilane.pipeline.rehearsal import Rehearsed
from trilane.pipeline.surroundings import OtherPrograms
from trilane.pipeline.unit_starter import UnitStarter
from trilane.scheduler.placement import (
    CpuCore,
    Place,
    Placement,
    Ranked,
    Rules,
    Times,
    UnitWork,
    chosen,
    fastest,
    frame_ns,
    ranked,
    typical,
    worth_trying,
)
from trilane.stages.avatar_assets import networks_of
from trilane.stages.avatar_pipeline import measured_times, thread_counts, tried
from trilane.stages.configure import Checked
from trilane.stages.dsp.runtime import RUNTIMES
from trilane.stages.machine_facts import cpu_facts, versions_with
from trilane.units import BEFORE_INFER, NS_PER_MS, UNITS

#: Least number of frames of a run that is rehearsed; shorter runs gain less than a rehearsal costs.
LEAST_FRAMES = 100
CACHE, TRIAL_CACHE = "placement-3", "placement-trial-2"
MOST_LOGICAL, MOST_CORES = 8, 16
FIRST = BEFORE_INFER[0][1]
SEQUENTIAL = "sequential"

RULE, MEASURED, TRIED, ASKED = "rule", "measured", "tried", "asked"
MEASURING = "measuring the stages for their placement on cores (once for this avatar, scene and machine) ..."


def placed(
    checked: Checked, policy: str, starter: UnitStarter, driver: str = "", say: Callable[[str], None] = lambda _: None
) -> Checked:
    """Return `checked` with its units on the best cores, and with a note that names these cores.

    `checked`: run to place.
    `policy`: policy of the run.
    `starter`: unit starter.
    `driver`: name of the OpenGL driver, on which the times depend.
    `say`: function that is called with a message before a measurement that takes seconds.
    Raises TrilaneError if a unit cannot start or a stage fails, KeyboardInterrupt if interrupted.
    """
    asked = {unit: Place(own, len(own)) for unit, own in checked.asked_cores.items()}
    cores = host_cores(sorted({*usable_cores(), *(core for place in asked.values() for core in place.cores)}))
    rule = rule_placement(usable_cores(), checked.asked_cores)
    why = _why_not(checked, cores)
    if why:
        how = ASKED if len(asked) == len(UNITS) else RULE
        return _with(checked, rule, {"how": how, "why": why, "units": unit_rows(rule)})
    made_from = [*_made_from(checked, cores, rule), driver]
    (times, _), at = _kept(checked, cores, rule, starter, made_from, say)
    rules = Rules(FIRST, policy == SEQUENTIAL)
    found = ranked(considered(cores, asked), times, rules, asked)
    by_rule = Ranked(rule, frame_ns(rule, cores, times, rules))
    candidates = [chosen(found, by_rule)] if rules.sequential else worth_trying(found, by_rule)
    key = [*made_from, at, *(described(each.placement) for each in candidates)]
    numbers = [core.number for core in cores]
    trial = choice(checked, numbers, candidates, starter, say, lambda make: cached_arrays(TRIAL_CACHE, key, make))
    best = candidates[trial.best]
    facts = {
        "how": TRIED if trial.frame_ms else MEASURED,
        "why": "; ".join([*(["as asked, the others by their times"] if asked else []), trial.why]),
        "units": unit_rows(best.placement),
        "measured_at": at,
        **predictions(best, by_rule, found),
        "times": times_rows(times),
    }
    if trial.frame_ms:
        facts["tried"] = [
            {"units": unit_rows(each.placement), "frame_ms": frame_ms}
            for each, frame_ms in zip(candidates, trial.frame_ms, strict=True)
        ]
    return _with(checked, best.placement, facts)


def considered(cores: Sequence[CpuCore], asked: Placement) -> list[CpuCore]:
    """Return the cores on which units may be placed: all `cores`, or some of them if there are more than MOST_LOGICAL.

    Placements on more cores would be too many to list. In this case one logical core of each physical core stays, up to
    MOST_CORES of them. Cores of the `asked` placement always stay.
    """
    if len(cores) <= MOST_LOGICAL:
        return list(cores)
    fixed = {core for place in asked.values() for core in place.cores}
    # Reversed, so that the first logical core of each physical core is kept.
    first = {core.physical: core.number for core in reversed(cores)}
    chosen_numbers = {*sorted(first.values())[:MOST_CORES], *fixed}
    return [core for core in cores if core.number in chosen_numbers]


def times_rows(times: Times) -> list[dict[str, Any]]:
    """Return a row for each unit and number of threads, with the measured times of a frame.

    Its keys are `unit`, `threads`, `ms`, and `core_ms`, the CPU time of all threads.
    """
    return [
        {"unit": unit, "threads": threads, "ms": work.serial_ns / NS_PER_MS, "core_ms": work.core_ns / NS_PER_MS}
        for unit, works in times.items()
        for threads, work in works.items()
    ]


def _why_not(checked: Checked, cores: Sequence[CpuCore]) -> str:
    """Return the reason why the run `checked` is not rehearsed on `cores`, as text; empty if it is rehearsed."""
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
    if facts["how"] == TRIED:
        others = [(row["units"], row["frame_ms"]) for row in sorted(facts["tried"], key=lambda row: row["frame_ms"])]
        frame_ms = next(ms for units, ms in others if units == facts["units"])
    elif facts["how"] == MEASURED:
        others = [(row["units"], row["predicted_ms"]) for row in facts["alternatives"][:2]]
        frame_ms = facts["predicted_ms"]
        if facts["rule"] not in (facts["units"], *(units for units, _ in others)):
            others.insert(0, (facts["rule"], facts["rule_ms"]))
    else:
        return str(facts["why"])
    text = f"{frame_ms:.1f} ms, {facts['why']}; by times of {facts['measured_at']}"
    rest = [f"{described(placement_of(units))}: {ms:.1f}" for units, ms in others if units != facts["units"]]
    return "; ".join([text, *rest])


def rehearsed(
    checked: Checked, starter: UnitStarter, driver: str = "", say: Callable[[str], None] = lambda _: None
) -> tuple[Rehearsed, str]:
    """Return (measured or cached times by which a run of `checked` is placed, date and time of the measurement, UTC).

    Parameters and errors are as in `placed`.
    """
    cores, rule = host_cores(usable_cores()), rule_placement(usable_cores(), {})
    return _kept(checked, cores, rule, starter, [*_made_from(checked, cores, rule), driver], say)


def _kept(
    checked: Checked,
    cores: Sequence[CpuCore],
    rule: Placement,
    starter: UnitStarter,
    made_from: Sequence[str],
    say: Callable[[str], None],
) -> tuple[Rehearsed, str]:
    """Return (the time that each unit needs for a frame, when it was measured, UTC)."""

    def measured() -> dict[str, NDArray[Any]]:
        say(MEASURING)
        found = measured_times(checked, cores, rule, starter)
        rows = [
            (UNITS.index(unit), threads, *work)
            for unit, works in found.times.items()
            for threads, work in works.items()
        ]
        took_ns = {f"stage {name}": np.array(ns, np.int64) for name, ns in found.took_ns.items()}
        return {"works": np.array(rows, np.int64), "at_s": np.array(time.time(), np.int64), **took_ns}

    made = cached_arrays(CACHE, made_from, measured)
    times: dict[str, dict[int, UnitWork]] = {unit: {} for unit in UNITS}
    for unit, threads, *work in made["works"].tolist():
        times[UNITS[unit]][threads] = UnitWork(*work)
    took_ns = {key.partition(" ")[2]: ns.tolist() for key, ns in made.items() if key.startswith("stage ")}
    at = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(int(made["at_s"])))
    return Rehearsed(times, took_ns), at


def _made_from(checked: Checked, cores: Sequence[CpuCore], rule: Placement) -> list[str]:
    """Return all facts on which the times of a rehearsal depend, as texts."""
    config = checked.config
    said = config.model_dump_json(exclude={"out_dir", "units", "scene", "pace_ns"})
    scene = config.scene.model_dump_json(exclude={"name", "frames", "fps"})
    machine = [str(cpu_facts()), str([tuple(core) for core in cores]), str(thread_counts(len(cores), rule))]
    networks = [network.digest for network in networks_of(checked.assets)]
    return [said, scene, *machine, *networks, *versions_with(RUNTIMES[config.runtime].package)]


#: Number of rounds in which placements are tried. After TRY_S seconds no round starts, except the first LEAST_ROUNDS.
ROUNDS, LEAST_ROUNDS, TRY_S = 6, 3, 5.0
#: Largest share of the cores that other programs may use while placements are compared, and seconds of measuring it.
QUIET_ENOUGH, LOOK_S = 0.1, 0.25
PREDICTED = "the least predicted frame time"
TRYING = "trying {} placements with frames of the scene (once for this avatar, scene and machine) ..."

Arrays = Mapping[str, NDArray[Any]]


class TriedPlacement(NamedTuple):
    """The result of trying placements.

    `best`: index of the placement to take.
    `why`: reason in words.
    `frame_ms`: frame times of the placements, ms; empty if none was tried.
    """

    best: int
    why: str
    frame_ms: tuple[float, ...] = ()


class _BusyError(Exception):
    """Other programs use too many of the cores to compare frame times. `share`: share of the cores that they use."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share


def choice(
    checked: Checked,
    cores: Sequence[int],
    candidates: Sequence[Ranked],
    starter: UnitStarter,
    say: Callable[[str], None] = lambda _: None,
    kept: Callable[[Callable[[], Arrays]], Arrays] = lambda make: make(),
) -> TriedPlacement:
    """Return which of `candidates` has the shortest frames; the first one if nothing is tried.

    `checked`: run to place.
    `cores`: available cores.
    `candidates`: placements to compare, the one with the shortest predicted frames first.
    `starter`: unit starter.
    `say`: function that is called with a message before a measurement that takes seconds.
    `kept`: function that returns the result of its argument, from a cache or by calling its argument.
    Raises TrilaneError if a unit cannot start or a stage fails, KeyboardInterrupt if interrupted.
    """
    if len(candidates) == 1:
        return TriedPlacement(0, PREDICTED)

    def measured() -> Arrays:
        others = OtherPrograms(cores)
        # The system counts time in steps of 10 ms, so a shorter measurement would say little.
        time.sleep(LOOK_S)
        _refuse_when_busy(others.share())
        say(TRYING.format(len(candidates)))
        rounds = tried(checked, [each.placement for each in candidates], ROUNDS, starter, TRY_S, LEAST_ROUNDS)
        _refuse_when_busy(median(each.others for each in rounds))
        return {"frame_ns": np.array([each.frame_ns for each in rounds])}

    try:
        frame_ns = typical(kept(measured)["frame_ns"].tolist())
    except _BusyError as busy:
        return TriedPlacement(0, f"{PREDICTED}; not tried while other programs have {busy.share:.0%} of the cores")
    frame_ms = tuple(value / NS_PER_MS for value in frame_ns)
    return TriedPlacement(fastest(frame_ns), f"the fastest of {len(candidates)} that were tried", frame_ms)


def _refuse_when_busy(share: float) -> None:
    if share > QUIET_ENOUGH:
        raise _BusyError(share)
