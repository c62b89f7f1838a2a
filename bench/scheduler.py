"""How fast is the scheduler in virtual time, beside SimPy on the same model, and do equal inputs give equal runs?

Rule: all models must present every frame at the same nanosecond. If a model does not, the bench fails. The models run
in interleaved rounds, with the same service times, and with Python's garbage collector off.
"""

from __future__ import annotations

import gc
import hashlib
import time
from collections import deque
from collections.abc import Callable, Generator
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from trilane.errors import BadInputError, TrilaneError, install_line
from trilane.hw_profiles.application import application_graph
from trilane.scheduler.events import Graph, Settings
from trilane.scheduler.recording import read, replay
from trilane.scheduler.state import HELD_JOBS
from trilane.scheduler.stats import median_interval
from trilane.scheduler.virtual import Service, VirtualDriver, simulate
from trilane.transport.slots import edge_rule

MS = 1_000_000
#: Mean service time by stage, ms. Each job takes half to one and a half times the mean.
SERVICE_MS = {"pose": 0.3, "raster": 4.0, "infer": 14.0, "composite": 2.0, "present": 3.0}
FPS = 60
PERIOD_NS = round(1e9 / FPS)
REPEATS, SEED_FRAMES = 10, 300
TRILANE, NO_REPORT, RECORDED = "trilane", "trilane, no report", "trilane, recorded"
SIMPY, LEAN = "simpy", "simpy lean"

#: Function that runs a model and returns the time of presentation of each frame, ns.
Run = Callable[[], list[int]]


def measure(minutes: float = 15.0, rounds: int = 7, seeds: int = 10, events: str = "") -> dict[str, Any]:
    """Measure the speed of Trilane's scheduler and of SimPy, and check whether equal inputs give equal runs.

    `minutes`: virtual duration of a run of the avatar's pipeline, at 60 frames a second, with the policy `pipelined`
    and `double` edges.
    `rounds`: number of interleaved rounds, which run each variant once.
    `seeds`: number of seeds for which repeats of a run are compared.
    `events`: run folder, or events.jsonl, to replay; "" for no replay.

    Three variants are Trilane's scheduler. `trilane` makes the report of the run; `trilane, no report` does not;
    `trilane, recorded` also keeps a recording. Two variants are models in SimPy. `simpy` uses SimPy's own parts:
    processes and resources. `simpy lean` has callbacks, and one timeout for each job. Both models keep no accounts, and
    know no faults, policies or drops.

    `rows` has a row for each variant (`way`):
    `frames`: number of frames.
    `events`: number of releases of frames and of ends of jobs, which is the same for all variants.
    `seconds`: median CPU time of a run.
    `seconds_low`, `seconds_high`: its 95 % interval; with fewer than six rounds, the least and the largest.
    `events_per_s`: `events` divided by `seconds`.
    `processed`: number of events by the variant's own count; SimPy needs several for a job.

    `over_trilane`: seconds of each variant divided by the seconds of `trilane` in the same round, as median and
    interval; below 1, the variant is faster.
    `over_simpy`, `over_simpy_lean`: the medians for `simpy` and `simpy lean`.
    `agree`: number of frames that all variants present at the same nanosecond; null without SimPy.
    `same_traces`: number of seeds for which 10 repeats of a run give the same trace; a unit dies in each of these runs.
    `different_traces`: number of different traces among the seeds.
    `replay`: number of `steps` in `events`, number of steps to which the scheduler now answers differently, and the
    `first` of these.
    `absent`: why SimPy is not measured.

    Raises BadInputError for an option out of range and for `events` that is no recording. Raises TrilaneError if a
    model presents a frame at another time.
    """
    if minutes <= 0 or rounds < 1 or seeds < 1:
        found = f"minutes {minutes:g}, rounds {rounds}, seeds {seeds}"
        raise BadInputError("bench scheduler", found, "positive numbers")
    replayed = _replayed(events) if events else {}
    frames = max(2, round(minutes * 60 * FPS))
    graph, service = application_graph(), _service(0, frames)
    variants = _trilane_variants(graph, service, frames)
    simpy_variants, absent = _simpy_variants(graph, service, frames)
    seconds = _cpu_seconds({**variants, **simpy_variants}, rounds)
    events_each = frames * (len(graph.stages) + 1)
    processed = {**dict.fromkeys(variants, events_each), **_processed(graph, service, frames, [*simpy_variants])}
    rows = [_row(variant, frames, events_each, runs, processed[variant]) for variant, runs in seconds.items()]
    config = {"minutes": minutes, "fps": FPS, "rounds": rounds, "seeds": seeds, "repeats": REPEATS}
    return {
        "rows": rows,
        **compared(seconds),
        "agree": frames if simpy_variants else None,
        **_determinism(seeds),
        "config": config,
        **absent,
        **replayed,
    }


def compared(seconds: dict[str, list[float]]) -> dict[str, Any]:
    """Return the keys `over_trilane`, `over_simpy` and `over_simpy_lean` of the result of `measure`.

    `seconds`: CPU seconds of each round, by variant. Without SimPy, the last two values are None.
    """
    ours = seconds[TRILANE]
    ratios = {
        variant: [other / own for other, own in zip(runs, ours, strict=True)]
        for variant, runs in seconds.items()
        if variant != TRILANE
    }
    return {
        "over_trilane": {variant: _with_interval(values) for variant, values in ratios.items()},
        "over_simpy": median(ratios[SIMPY]) if SIMPY in ratios else None,
        "over_simpy_lean": median(ratios[LEAN]) if LEAN in ratios else None,
    }


def _with_interval(values: list[float]) -> dict[str, float]:
    low, high = median_interval(values)
    return {"median": median(values), "low": low, "high": high}


def _cpu_seconds(variants: dict[str, Run], rounds: int) -> dict[str, list[float]]:
    """Run all `variants` in interleaved rounds, and return the CPU seconds of each round, by variant.

    Raises TrilaneError if a variant presents a frame at another time than `trilane`.
    """
    seconds: dict[str, list[float]] = {variant: [] for variant in variants}
    for number in range(rounds):
        names = list(variants)
        # Each round begins with another variant, so that none is always the first.
        first = number % len(names)
        ends: dict[str, list[int]] = {}
        for variant in names[first:] + names[:first]:
            taken, ends[variant] = _timed(variants[variant])
            seconds[variant].append(taken)
        if different := [variant for variant in ends if ends[variant] != ends[TRILANE]]:
            raise TrilaneError(f"{', '.join(different)} and trilane present frames at different times")
    return seconds


def _timed(run: Run) -> tuple[float, list[int]]:
    """Call `run` without garbage collection, and return (CPU seconds of the call, its result)."""
    collects = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        begin = time.process_time()
        answer = run()
        return time.process_time() - begin, answer
    finally:
        if collects:
            gc.enable()


def _determinism(seeds: int) -> dict[str, int]:
    traces = [_traces(seed) for seed in range(seeds)]
    return {
        "same_traces": sum(len(set(repeats)) == 1 for repeats in traces),
        "different_traces": len({repeats[0] for repeats in traces}),
    }


def _service(seed: int, frames: int) -> Service:
    """Return a function that gives each job's service time in ns: random, 0.5 to 1.5 times its stage's `SERVICE_MS`."""
    rng = np.random.default_rng(seed)
    table = {name: (ms * MS * rng.uniform(0.5, 1.5, frames)).astype(int).tolist() for name, ms in SERVICE_MS.items()}
    return lambda stage, _unit, frame, _begin_ns: table[stage][frame]


def _trilane_variants(graph: Graph, service: Service, frames: int) -> dict[str, Run]:
    def run(*, report: bool = True, keep: bool = False) -> list[int]:
        driver = VirtualDriver(graph, Settings(frames, "pipelined", period_ns=PERIOD_NS), service, keep=keep)
        driver.run()
        if report:
            driver.core.report(clock="virtual")
        return driver.core.ledger.presented_ns

    return {TRILANE: run, NO_REPORT: lambda: run(report=False), RECORDED: lambda: run(keep=True)}


def _simpy_variants(graph: Graph, service: Service, frames: int) -> tuple[dict[str, Run], dict[str, dict[str, str]]]:
    """Return (functions that run the models in SimPy, by variant; facts for the result of `measure`).

    Without SimPy there are no functions, and the facts are the key `absent`. With SimPy there are no facts.
    """
    try:
        models = _models()
    except ModuleNotFoundError:
        return {}, {"absent": {SIMPY: f"not installed: {install_line('peers')}"}}
    return {variant: partial(_run_model, model, graph, service, frames) for variant, model in models.items()}, {}


def _run_model(model: Any, graph: Graph, service: Service, frames: int) -> list[int]:
    presented_ns: list[int] = model(graph, service, frames, PERIOD_NS).run()
    return presented_ns


def _models() -> dict[str, Any]:
    """Return the functions that make the models in SimPy, by variant. Raises ModuleNotFoundError without SimPy."""
    import simpy

    return {SIMPY: partial(SimpyPipeline, simpy), LEAN: partial(LeanPipeline, simpy)}


def _processed(graph: Graph, service: Service, frames: int, variants: list[str]) -> dict[str, int]:
    """Return how many events SimPy processes in a run of each of `variants`, by variant."""
    return {variant: _count_events(_models()[variant](graph, service, frames, PERIOD_NS).env) for variant in variants}


def _count_events(env: Any) -> int:
    count = 0
    while env.peek() != float("inf"):
        env.step()
        count += 1
    return count


def _row(variant: str, frames: int, events: int, seconds: list[float], processed: int) -> dict[str, Any]:
    low, high = median_interval(seconds)
    times = {"seconds": median(seconds), "seconds_low": low, "seconds_high": high}
    rates = {"events_per_s": events / times["seconds"], "processed": processed}
    return {"way": variant, "frames": frames, "events": events, **times, **rates}


def _traces(seed: int) -> list[str]:
    """Do `REPEATS` equal runs in which the DSP unit dies. Return a digest of each run's steps and report."""
    settings = Settings(SEED_FRAMES, "deadline", period_ns=PERIOD_NS, deadline_ns=3 * PERIOD_NS)
    digests, faults = [], [(1_000 * MS + seed * 7 * MS, "dsp")]
    for _ in range(REPEATS):
        service = _service(seed, SEED_FRAMES)
        done = simulate(application_graph(), settings, service, restart_ns=50 * MS, faults=faults, keep=True)
        assert done.recording is not None
        digests.append(hashlib.sha256(repr((done.recording.steps, done.report)).encode()).hexdigest())
    return digests


def _replayed(events: str) -> dict[str, Any]:
    path = Path(events)
    recording = read(path / "events.jsonl" if path.is_dir() else path)
    differences = list(replay(recording))
    return {"replay": {"steps": len(recording.steps), "different": len(differences), "first": (differences or [""])[0]}}


# The avatar's pipeline in SimPy, for comparison: the same chain, slots, held jobs and order as the `pipelined` policy.
#
# Rule: the models only compute when each frame is presented. They have no ledger, no faults and no other policies.
# `SimpyPipeline` is written as SimPy's users write; `LeanPipeline` is as lean as SimPy allows.


class SimpyPipeline:
    """The pipeline as processes and resources of SimPy.

    `simpy`: the module. `graph`: stages, units and edges. `service`: service time of each job. `frames`: number of
    frames. `period_ns`: time between two released frames.
    `env`: SimPy's environment. `presented_ns`: time at which each frame is presented, in order, filled by `run`.
    """

    def __init__(self, simpy: Any, graph: Graph, service: Service, frames: int, period_ns: int) -> None:
        self.env = simpy.Environment()
        self.presented_ns: list[int] = []
        self._chain = [(stage.name, stage.unit) for stage in graph.stages]
        self._service = service
        slots = [edge_rule(text).slots for text in graph.edges]
        self._slots = [simpy.Container(self.env, count, init=count) for count in slots]
        self._held = {unit: simpy.PriorityResource(self.env, HELD_JOBS) for unit in graph.units}
        self._runs = {unit: simpy.Resource(self.env, 1) for unit in graph.units}
        self.env.process(self._source(frames, period_ns))

    def run(self) -> list[int]:
        """Run until the last frame is presented, and return `presented_ns`."""
        self.env.run()
        return self.presented_ns

    def _source(self, frames: int, period_ns: int) -> Generator[Any, Any, None]:
        for frame in range(frames):
            self.env.process(self._frame(frame))
            yield self.env.timeout(period_ns)

    def _frame(self, frame: int) -> Generator[Any, Any, None]:
        env, last = self.env, len(self._chain) - 1
        for position, (stage, unit) in enumerate(self._chain):
            if position < last:
                yield self._slots[position].get(1)
            with self._held[unit].request(priority=frame) as held:
                yield held
                with self._runs[unit].request() as runs:
                    yield runs
                    yield env.timeout(self._service(stage, unit, frame, int(env.now)))
            if position:
                self._slots[position - 1].put(1)
        self.presented_ns.append(int(env.now))


class LeanPipeline:
    """The model of `SimpyPipeline` with one timeout for each job, and with callbacks in place of processes.

    SimPy only keeps the clock and the order of events. Slots, held jobs and queues are plain numbers and lists. Both
    models have the same times to the nanosecond, unless two events have the same time. The model is only right for
    chains whose edges drop nothing, so that frames stay in order. A unit takes its oldest waiting frame, which is the
    first frame at the last of its stages where frames wait. Parameters and attributes: see `SimpyPipeline`.
    """

    def __init__(self, simpy: Any, graph: Graph, service: Service, frames: int, period_ns: int) -> None:
        self.env = simpy.Environment()
        self.presented_ns: list[int] = []
        self._chain = [(stage.name, stage.unit) for stage in graph.stages]
        self._last = len(self._chain) - 1
        self._positions = {
            unit: [position for position in range(self._last, -1, -1) if self._chain[position][1] == unit]
            for unit in graph.units
        }
        self._service, self._frames, self._period_ns = service, frames, period_ns
        self._released = 0
        self._waiting: list[deque[int]] = [deque() for _ in self._chain]
        self._free = [edge_rule(text).slots for text in graph.edges]
        self._held = dict.fromkeys(graph.units, 0)
        self._free_ns = dict.fromkeys(graph.units, 0)
        self._after(0, None, self._release)

    def run(self) -> list[int]:
        """Run until the last frame is presented, and return `presented_ns`."""
        self.env.run()
        return self.presented_ns

    def _after(self, delay_ns: int, value: Any, callback: Any) -> None:
        self.env.timeout(delay_ns, value).callbacks.append(callback)

    def _release(self, _event: Any) -> None:
        self._waiting[0].append(self._released)
        self._released += 1
        if self._released < self._frames:
            self._after(self._period_ns, None, self._release)
        self._fill(self._chain[0][1])

    def _fill(self, unit: str) -> None:
        """Hand jobs to `unit` until it holds `HELD_JOBS` jobs, or until no waiting frame can get a slot."""
        while self._held[unit] < HELD_JOBS:
            for position in self._positions[unit]:
                if self._waiting[position] and (position == self._last or self._free[position]):
                    break
            else:
                return
            self._dispatch(position, unit, self._waiting[position].popleft())

    def _dispatch(self, position: int, unit: str, frame: int) -> None:
        if position < self._last:
            self._free[position] -= 1
        self._held[unit] += 1
        now_ns = self.env.now
        begin_ns = max(now_ns, self._free_ns[unit])
        end_ns = self._free_ns[unit] = begin_ns + self._service(self._chain[position][0], unit, frame, begin_ns)
        self._after(end_ns - now_ns, (position, unit, frame), self._done)

    def _done(self, event: Any) -> None:
        position, unit, frame = event.value
        self._held[unit] -= 1
        if position == self._last:
            self.presented_ns.append(self.env.now)
        else:
            self._waiting[position + 1].append(frame)
            self._fill(self._chain[position + 1][1])
        if position:
            self._free[position - 1] += 1
            self._fill(self._chain[position - 1][1])
        self._fill(unit)
