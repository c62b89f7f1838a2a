"""A program that a sweep can try in place of Trilane: it says what it was asked, and does as its words say.

`SWEEP_TRIAL_LOG` names a file that gets a line when it begins and one when it ends. It takes `SWEEP_TRIAL_WAIT`
seconds, and ends once `SWEEP_TRIAL_TOGETHER` trials have begun or half a minute has passed. `--code N` ends it with N;
`--die-once FILE` makes it make FILE and kill itself, unless FILE is there. `--others 0.3,0.1` is the share that other
programs had when it is called first and second. `--fps N` makes N a figure of its result.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from pathlib import Path


def main() -> int:
    parser = argparse.ArgumentParser()
    for name in ("--die-once", "--out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--code", type=int, default=0)
    parser.add_argument("--others", default="")
    parser.add_argument("--fps", type=float)
    asked, other = parser.parse_known_args()
    note("begin", other)
    if asked.out is not None:
        asked.out.mkdir()
        (asked.out / "report.json").touch()
    if asked.die_once is not None and not asked.die_once.exists():
        asked.die_once.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(float(os.environ.get("SWEEP_TRIAL_WAIT", "0")))
    wait_for_others(int(os.environ.get("SWEEP_TRIAL_TOGETHER", "1")))
    note("end", other)
    others = {"other_programs": share_of(asked.others, asked.out)} if asked.others else {}
    figures = {"fps": asked.fps} if asked.fps else {}
    told = {"schema": 1, "words": other, "threads": os.environ.get("OMP_NUM_THREADS")}
    print(json.dumps({**told, **others, **figures}))
    if asked.code:
        print("before the last line\nerror: as it was asked", file=sys.stderr)
    return int(asked.code)


def share_of(shares: str, folder: Path) -> float:
    """The share of this call, which is kept in the run folder too."""
    calls = Path(os.environ["SWEEP_TRIAL_LOG"]).read_text().count('"begin"')
    (folder / "report.json").write_text(shares.split(",")[calls - 1])
    return float(shares.split(",")[calls - 1])


def wait_for_others(count: int) -> None:
    """Until the log has so many trials that began."""
    give_up_at = time.monotonic() + 30.0
    log = Path(os.environ["SWEEP_TRIAL_LOG"])
    while log.read_text().count('"begin"') < count and time.monotonic() < give_up_at:
        time.sleep(0.02)


def note(what: str, words: list[str]) -> None:
    """Add a line to the log, in one write, so that lines of several processes do not mix."""
    line = {
        "what": what,
        "at": time.monotonic(),
        "pid": os.getpid(),
        "words": words,
        "node": os.environ.get("RAY_RAYLET_PID"),
    }
    with Path(os.environ["SWEEP_TRIAL_LOG"]).open("ab", buffering=0) as file:
        file.write(json.dumps(line).encode() + b"\n")


if __name__ == "__main__":
    sys.exit(main())
