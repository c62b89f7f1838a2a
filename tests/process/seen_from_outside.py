"""How well a run used its cores, reckoned from outside: what the kernel counted of its processes, and its journal.

Nothing here is shared with what is judged: /proc, MessagePack and numpy alone. By hand, for any run:

    python tests/process/seen_from_outside.py OUT -- trilane run --frames 300 --out OUT

prints its three efficiencies from /proc, from the journal's jobs, and as report.json has them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

PERIOD_S = 0.02
SELDOM_S = 0.1  # for runs by hand: fifty looks a second take a quarter of a core from the run that is judged
WORKED = 3  # place of a job among the journal's kinds of record
Places = Mapping[str, tuple[tuple[int, ...], int]]


class Sampler:
    """Context manager: while it is open, the CPU time of every process that descends from `root`."""

    def __init__(self, root: int, period_s: float = PERIOD_S) -> None:
        self._root, self._period_s = root, period_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._sample, daemon=True)
        self._threads_ns: dict[int, dict[int, int]] = {}
        self.rows: dict[int, list[tuple[int, int]]] = {}

    def __enter__(self) -> Sampler:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _sample(self) -> None:
        while not self._stop.wait(self._period_s):
            for pid in _descendants(self._root):
                ended_and_alive = self._threads_ns.setdefault(pid, {})
                for task in _listed(f"/proc/{pid}/task"):
                    ns = _first_number(f"/proc/{pid}/task/{task}/schedstat")
                    if ns is not None:
                        ended_and_alive[int(task)] = ns
                now_ns = time.monotonic_ns()
                self.rows.setdefault(pid, []).append((now_ns, sum(ended_and_alive.values())))

    def cpu_ns(self, pid: int, begin_ns: int, end_ns: int) -> float:
        """Of a process between two times, linear between samples."""
        times, totals = np.array(self.rows[pid], dtype=np.float64).T
        return float(np.interp(end_ns, times, totals) - np.interp(begin_ns, times, totals))


def _listed(folder: str) -> list[str]:
    try:
        return [path.name for path in Path(folder).iterdir()]
    except OSError:
        return []


def _first_number(path: str) -> int | None:
    try:
        return int(Path(path).read_text(encoding="ascii").split()[0])
    except (OSError, IndexError, ValueError):
        return None


def _descendants(root: int) -> list[int]:
    parent_of = {}
    for name in _listed("/proc"):
        if name.isdigit():
            try:
                parent_of[int(name)] = int(Path(f"/proc/{name}/stat").read_text().rpartition(")")[2].split()[1])
            except (OSError, IndexError):
                continue
    found, waiting = [], [root]
    while waiting:
        parent = waiting.pop()
        children = [pid for pid, of in parent_of.items() if of == parent]
        found += children
        waiting += children
    return found


def jobs_of(journal: Path) -> tuple[list[tuple[Any, ...]], str]:
    """The rows of the jobs in a journal, and the name of the last stage."""
    with journal.open("rb") as file:
        begun, *rows = msgpack.Unpacker(file, use_list=False)
    return [row[1] for row in rows if row[0] == WORKED], begun[2]["stages"][-1]["name"]


def span_of(jobs: list[tuple[Any, ...]], last: str) -> tuple[int, int]:
    """From the end of the first presented frame to that of the last."""
    ends = [job[6] for job in jobs if job[0] == last]
    return min(ends), max(ends)


def efficiencies(places: Places, cpu_ns: Mapping[str, float], had_ns: float) -> dict[str, float]:
    """`places`: cores and threads of each unit; `cpu_ns`: of each in `had_ns`."""
    sets = {frozenset(cores) for cores, _ in places.values()}
    sets |= {frozenset().union(*some) for count in range(2, len(sets) + 1) for some in combinations(sets, count)}
    full = {
        these: sum(cpu_ns[unit] for unit, (cores, _) in places.items() if these.issuperset(cores)) / len(these)
        for these in sets
    }
    return {
        "efficiency": max(cpu_ns[unit] / threads for unit, (_, threads) in places.items()) / had_ns,
        "core_efficiency": max(full.values()) / had_ns,
        "machine_efficiency": full[max(full, key=len)] / had_ns,
    }


def of_journal(places: Places, journal: Path) -> dict[str, float]:
    """From the CPU time that each job says; of one across an edge as much of it as of its time lies within."""
    jobs, last = jobs_of(journal)
    begin_ns, end_ns = span_of(jobs, last)
    cpu_ns = dict.fromkeys(places, 0.0)
    for _, unit, _, _, _, job_begin_ns, job_end_ns, *_, job_cpu_ns in jobs:
        within_ns = max(min(job_end_ns, end_ns) - max(job_begin_ns, begin_ns), 0)
        cpu_ns[unit] += job_cpu_ns * within_ns / max(job_end_ns - job_begin_ns, 1)
    return efficiencies(places, cpu_ns, end_ns - begin_ns)


def of_processes(places: Places, pids: Mapping[str, int], sampler: Sampler, journal: Path) -> dict[str, float]:
    """From the CPU time that the kernel counted of each unit's process, what it has between its jobs included."""
    begin_ns, end_ns = span_of(*jobs_of(journal))
    cpu_ns = {unit: sampler.cpu_ns(pids[unit], begin_ns, end_ns) for unit in places}
    return efficiencies(places, cpu_ns, end_ns - begin_ns)


def main(folder: Path, command: list[str]) -> None:
    process = subprocess.Popen(command)
    with Sampler(os.getpid(), SELDOM_S) as sampler:
        process.wait()
    report = json.loads((folder / "report.json").read_text())
    units = report["units"]
    places = {unit: (tuple(row["cores"]), row["threads"]) for unit, row in units.items()}
    pids = {unit: row["pid"] for unit, row in units.items()}
    journal = folder / "journal.msgpack"
    found = {
        "proc": of_processes(places, pids, sampler, journal),
        "journal": of_journal(places, journal),
        "report": {key: report[key] for key in ("efficiency", "core_efficiency", "machine_efficiency")},
    }
    for name, row in found.items():
        print(name, *(f"{key} {value:.4f}" for key, value in row.items()))
    print("bound", json.dumps(report["bound"]), "others", report["other_programs"])


if __name__ == "__main__":
    place, _, *words = sys.argv[1:]
    main(Path(place), words)
