"""The gate of `trilane compare`, on real runs: one of a kind, or one with a stage that takes longer by a known share.

Each round runs every kind once, in another order. In a round one stage is slowed, in the next one the next stage. By
hand, on a machine that does nothing else:

    python tests/process/gate_pairs.py record OUT 20 -- trilane run --frames 100 --baseline 0 --no-video
    python tests/process/gate_pairs.py judge OUT
    python tests/process/gate_pairs.py judge OUT --runs 13 --stage infer

`record --load 0.5` runs a program on each core that takes half of it if nobody else wants it. `judge` sets the base of
each round beside the other kinds of it. `judge --runs N` draws 20 pairs of N runs a side from all rounds, with seeds;
these pairs share runs, so they are not independent.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import statistics
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import slowed_stages
import typer

from trilane.hw_profiles.host import usable_cores

#: Figures of a stage's time.
STAGE_TIMES = ("work", "CPU time", "instructions")
KINDS = {"base": 0.0, "same": 0.0, "+3%": 0.03, "+5%": 0.05, "+10%": 0.1, "+100%": 1.0}
LOAD = """
import os, sys, time
core, share = int(sys.argv[1]), float(sys.argv[2])
os.sched_setaffinity(0, [core])
while os.getppid() == int(sys.argv[3]):
    begin = time.perf_counter()
    while time.perf_counter() < begin + share * 0.02:
        pass
    time.sleep((1 - share) * 0.02)
"""
app = typer.Typer(add_completion=False)


@contextmanager
def loaded(share: float) -> Iterator[None]:
    """A program on each core that wants `share` of it, in turns of 20 ms."""
    words = [[str(core), str(share), str(os.getpid())] for core in usable_cores()] if share else []
    programs = [subprocess.Popen([sys.executable, "-c", LOAD, *each]) for each in words]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


@app.command()
def record(
    out: Path,
    rounds: int,
    command: list[str],
    load: float = 0.0,
    stage: str = "",
    kinds: Annotated[str, typer.Option(help="Of each round; a comma between two.")] = ",".join(KINDS),
) -> None:
    """Run every kind in every round, and keep the runs in OUT/ROUND-STAGE/KIND."""
    hook = out / "hook"
    slowed_stages.hook_in(hook)
    first = slowed_stages.run(hook, command, "")
    stages = [stage] if stage else [*first["stages"]]
    with loaded(load):
        for number in range(rounds):
            slowed = stages[number % len(stages)]
            for kind in random.Random(number).sample(kinds.split(","), kinds.count(",") + 1):
                folder = out / f"{number:03}-{slowed}" / kind
                folder.parent.mkdir(exist_ok=True)
                slowed_stages.run(hook, command, slowed if KINDS[kind] else "", KINDS[kind], keep=folder)
    shutil.rmtree(hook)


@app.command("judge")
def judged(out: Path, runs: int = 1, stage: str = "", limit: str = "slower=5%", pairs: int = 20) -> None:
    """Print, for each kind, what the gate and the comparison answer, and whether they name the slowed stage."""
    rounds = sorted(path for path in out.iterdir() if path.name.endswith(f"-{stage}" if stage else ""))
    shares = [json.loads(path.read_text())["other_programs"] for path in out.glob("*/*/report.json")]
    others = f"{statistics.median(shares):.1%} of the cores, {max(shares):.1%} at most"
    print(f"{len(rounds)} rounds; other programs had {others}")
    for kind in KINDS:
        if kind == "base" or not (rounds[0] / kind).is_dir():
            continue
        gates: Counter[str] = Counter()
        verdicts: Counter[str] = Counter()
        for base, other, slowed in drawn(rounds, kind, runs, pairs):
            found = compared(base, other, limit)
            figures = found["gates"][0]["figures"]
            broken = {str(figure["of"]) for figure in figures if figure["outcome"] == "broken"}
            gates[found["gates"][0]["outcome"] + named(broken, slowed)] += 1
            rows = found["comparisons"][0]["rows"]
            differing = {str(row["of"]) for row in rows if row["differs"] and row["measure"] in STAGE_TIMES}
            verdicts[found["comparisons"][0]["outcome"] + named(differing, slowed)] += 1
        print(f"{kind:6} {runs} a side: gate {dict(gates)}; comparison {dict(verdicts)}")


def compared(base: list[Path], other: list[Path], limit: str) -> dict[str, Any]:
    sides = [",".join(map(str, side)) for side in (base, other)]
    command = [sys.executable, "-m", "trilane.apps.cli.main", "compare", *sides, "--fail-if", limit, "--json"]
    done = subprocess.run(command, capture_output=True, check=False)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def named(stages: set[str], slowed: str) -> str:
    """What is said of stages: the slowed one alone, with others, or others alone; the frame time is no stage."""
    stages = stages - {"", "None"}
    if not stages:
        return ""
    if slowed not in stages:
        return ", another stage"
    return ", that stage" if len(stages) == 1 else ", that stage and others"


def drawn(rounds: list[Path], kind: str, runs: int, pairs: int) -> Iterator[tuple[list[Path], list[Path], str]]:
    """The base's runs, the other side's, and the stage that is slowed in these."""
    if runs == 1:
        for path in rounds:
            yield [path / "base"], [path / kind], path.name[4:]
        return
    for number in range(pairs):
        some = random.Random(number).sample(rounds, 2 * runs if kind == "same" else runs)
        others = some[runs:] if kind == "same" else random.Random(-1 - number).sample(rounds, runs)
        yield [path / "base" for path in some[:runs]], [path / kind for path in others], rounds[0].name[4:]


if __name__ == "__main__":
    app()
