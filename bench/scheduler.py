"""How fast is the scheduler in virtual time, beside SimPy on the same model, and is it the same every time?

Rule: both present every frame at the same nanosecond or the bench fails; their runs are interleaved, with the same
service times.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from trilane.compiled import form
from trilane.errors import BadInputError, TrilaneError
from trilane.hw_profiles.application import application_graph
from trilane.install import install_line
from trilane.scheduler.events import Graph, Settings
from trilane.scheduler.recording import read, replay
from trilane.scheduler.virtual import Service, VirtualDriver, simulate

MS = 1_000_000
#: Mean service time in ms; each job takes from half of it to one and a half.
SERVICE_MS = {"pose": 0.3, "raster": 4.0, "infer": 14.0, "composite": 2.0, "present": 3.0}
FPS = 60
PERIOD_NS = round(1e9 / FPS)
REPEATS, SEED_FRAMES = 10, 300


def measure(minutes: float = 30.0, turns: int = 3, seeds: int = 10, events: str = "") -> dict[str, Any]:
    """The speed of both, and whether equal inputs give equal runs.

    `minutes`: of the avatar's pipeline at 60 frames a second, policy `pipelined`, edges `double`.
    `turns`: runs of each, interleaved; the median counts.
    `seeds`: for how many seeds equal runs are compared.
    `events`: a run's folder or events.jsonl, to be replayed.

    Rows: `way`, `frames`, median CPU `seconds`, `events_per_s` (an event: a frame's release or a job's end, the same
    number in both), `processed` (by the way's own count; SimPy takes several to a job). `agree`: frames that both
    present at the same nanosecond. `same_traces`: for how many seeds 10 repeats of a run in which a unit dies give one
    trace; `different_traces`: traces between the seeds. `replay`: of `events`, the `steps` and how many are answered
    differently.
    Raises BadInputError when `events` is not a recording, TrilaneError when SimPy disagrees.
    """
    if minutes <= 0 or turns < 1 or seeds < 1:
        raise BadInputError("bench scheduler", f"minutes {minutes:g}, turns {turns}, seeds {seeds}", "positive numbers")
    replayed = _replayed(events) if events else {}
    frames = max(2, round(minutes * 60 * FPS))
    graph, service = application_graph(), _service(0, frames)
    variants: dict[str, Callable[[], list[int]]] = {"trilane": lambda: _trilane(graph, service, frames)}
    absent = _add_simpy(variants, graph, service, frames)
    seconds = _cpu_seconds(variants, turns)
    counts = _processed(graph, service, frames, with_simpy=not absent)
    events_each = frames * (len(graph.stages) + 1)
    rows = [_row(variant, frames, events_each, median(runs), counts[variant]) for variant, runs in seconds.items()]
    config = {"core": form(), "minutes": minutes, "fps": FPS, "turns": turns, "seeds": seeds, "repeats": REPEATS}
    return {
        "rows": rows,
        **_compared(rows, frames),
        **_determinism(seeds),
        "config": config,
        **absent,
        **replayed,
    }


def _cpu_seconds(variants: dict[str, Callable[[], list[int]]], rounds: int) -> dict[str, list[float]]:
    """CPU time of every round of each variant. Raises TrilaneError when they present frames at different times."""
    seconds: dict[str, list[float]] = {variant: [] for variant in variants}
    ends: dict[str, list[int]] = {}
    for _ in range(rounds):
        for variant, run in variants.items():
            begin = time.process_time()
            ends[variant] = run()
            seconds[variant].append(time.process_time() - begin)
    if any(other != ends["trilane"] for other in ends.values()):
        raise TrilaneError("SimPy's model presents frames at other times than Trilane's scheduler")
    return seconds


def _compared(rows: list[dict[str, Any]], frames: int) -> dict[str, Any]:
    speeds = {row["way"]: row["events_per_s"] for row in rows}
    has_simpy = "simpy" in speeds
    return {
        "over_simpy": speeds["trilane"] / speeds["simpy"] if has_simpy else None,
        "agree": frames if has_simpy else None,
    }


def _determinism(seeds: int) -> dict[str, int]:
    traces = [_traces(seed) for seed in range(seeds)]
    return {
        "same_traces": sum(len(set(repeats)) == 1 for repeats in traces),
        "different_traces": len({repeats[0] for repeats in traces}),
    }


def _service(seed: int, frames: int) -> Service:
    """Service times from a table made beforehand, so that both runs pay for a look-up and no more."""
    rng = np.random.default_rng(seed)
    table = {name: (ms * MS * rng.uniform(0.5, 1.5, frames)).astype(int).tolist() for name, ms in SERVICE_MS.items()}
    return lambda stage, _unit, frame, _begin_ns: table[stage][frame]


def _trilane(graph: Graph, service: Service, frames: int) -> list[int]:
    driver = VirtualDriver(graph, Settings(frames, "pipelined", period_ns=PERIOD_NS), service)
    driver.run()
    driver.core.ledger.report(clock="virtual", requested=frames)
    return driver.core.ledger.presented_ns


def _add_simpy(
    ways: dict[str, Callable[[], list[int]]], graph: Graph, service: Service, frames: int
) -> dict[str, dict[str, str]]:
    """Add SimPy's run to `ways`, or answer why it is absent."""
    try:
        from trilane.bench.lib.simpy_model import SimpyPipeline
    except ModuleNotFoundError:
        return {"absent": {"simpy": f"not installed: {install_line('peers')}"}}
    ways["simpy"] = lambda: SimpyPipeline(graph, service, frames, PERIOD_NS).run()
    return {}


def _processed(graph: Graph, service: Service, frames: int, *, with_simpy: bool) -> dict[str, int]:
    """How many events each of the two processes, by its own count."""
    counts = {"trilane": frames * (len(graph.stages) + 1)}
    if with_simpy:
        from trilane.bench.lib.simpy_model import SimpyPipeline

        counts["simpy"] = SimpyPipeline(graph, service, frames, PERIOD_NS).run_counting()
    return counts


def _row(way: str, frames: int, events: int, seconds: float, processed: int) -> dict[str, Any]:
    rates = {"seconds": seconds, "events_per_s": events / seconds}
    return {"way": way, "frames": frames, "events": events, **rates, "processed": processed}


def _traces(seed: int) -> list[str]:
    """Digests of every step of equal runs under the `deadline` policy, in which the DSP dies once."""
    settings = Settings(SEED_FRAMES, "deadline", period_ns=PERIOD_NS, deadline_ns=3 * PERIOD_NS)
    digests = []
    for _ in range(REPEATS):
        faults = [(1_000 * MS + seed * 7 * MS, "dsp")]
        done = simulate(
            application_graph(), settings, _service(seed, SEED_FRAMES), restart_ns=50 * MS, faults=faults, keep=True
        )
        assert done.recording is not None
        digests.append(hashlib.sha256(repr((done.recording.steps, done.report)).encode()).hexdigest())
    return digests


def _replayed(events: str) -> dict[str, Any]:
    path = Path(events)
    recording = read(path / "events.jsonl" if path.is_dir() else path)
    differences = list(replay(recording))
    return {"replay": {"steps": len(recording.steps), "different": len(differences), "first": (differences or [""])[0]}}
