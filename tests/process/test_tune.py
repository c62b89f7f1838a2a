"""A search of real processes: killed half way, it goes on with the same trials, and none is done twice.

`support.sweep_trial` is tried in place of Trilane; its `--fps` is the figure that is tuned.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import psutil
import pytest

from trilane.apps.sweep.store import TRIALS

pytest.importorskip("optuna")

PROGRAM = (
    "import trilane.apps.sweep.engines as p; p.PROGRAM = 'support.sweep_trial'; "
    "from trilane.apps.cli.main import entry; entry()"
)
VALUES, COUNT = range(1, 21), 12
TUNE = ["tune", "fps", "run", "--axis", f"fps={','.join(map(str, VALUES))}", "--trials", str(COUNT), "--keep", "fps<19"]
LIMIT_S = 60.0

pytestmark = pytest.mark.usefixtures("no_new_process")


def started(folder: Path, *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", PROGRAM, *TUNE, "--out", str(folder), "--json", *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def order(folder: Path) -> list[float]:
    return [json.loads(line)["options"]["fps"] for line in (folder / TRIALS).read_text().splitlines()]


def test_a_search_in_which_nothing_keeps_ends_with_1(tmp_path: Path) -> None:
    search = started(tmp_path / "s", "--keep", "fps>1000")
    out, said = search.communicate(timeout=LIMIT_S)
    assert (search.returncode, json.loads(out)["best"]) == (1, None), said


def test_a_killed_search_goes_on_with_the_same_trials(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = tmp_path / "log"
    monkeypatch.setenv("SWEEP_TRIAL_LOG", str(log))
    whole, said = started(tmp_path / "whole").communicate(timeout=LIMIT_S)
    answer = json.loads(whole)
    assert answer["best"]["metrics"]["fps"] == 18.0, said
    assert answer["not_tried"]["count"] == len(VALUES) - COUNT
    log.unlink()
    monkeypatch.setenv("SWEEP_TRIAL_WAIT", "0.2")
    first = started(tmp_path / "s")
    end = time.monotonic() + LIMIT_S
    while not (tmp_path / "s" / TRIALS).exists() or len(order(tmp_path / "s")) < 4:
        assert time.monotonic() < end and first.poll() is None, first.communicate()
        time.sleep(0.02)
    going = psutil.Process(first.pid).children(recursive=True)
    first.send_signal(signal.SIGKILL)
    first.communicate(timeout=LIMIT_S)
    assert not psutil.wait_procs(going, timeout=LIMIT_S)[1]
    refused = started(tmp_path / "s")
    assert "--resume goes on with it" in refused.communicate(timeout=LIMIT_S)[1]
    assert refused.returncode == 2
    second = started(tmp_path / "s", "--resume")
    out, said = second.communicate(timeout=LIMIT_S)
    assert second.returncode == 0, said
    assert json.loads(out)["best"] == answer["best"]
    assert order(tmp_path / "s") == order(tmp_path / "whole")
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert Counter(line["what"] for line in lines)["end"] == COUNT
