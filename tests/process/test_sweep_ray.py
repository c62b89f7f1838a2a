"""Sweeps on a real Ray cluster of two nodes, which this machine pretends to be: the same trials as without, one of the
host clock at a time on each node, and those of a killed node done on the other.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import psutil
import pytest

from trilane.apps.sweep.engines import cluster
from trilane.apps.sweep.store import TRIALS
from trilane.errors import BadInputError

FAKE = "support.sweep_trial"
#: `trilane` that tries the module in place of Trilane.
#: SIGINT is heard even where the tests run in a background in which it is ignored.
PROGRAM = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    f"import trilane.apps.sweep.engines as p; p.PROGRAM = {FAKE!r}; from trilane.apps.cli.main import entry; entry()"
)
LIMIT_S = 100.0
FRAMES = range(1, 6)
SWEEP = ["sweep", "run", *(word for n in FRAMES for word in ("--frames", str(n)))]
RESOURCES = {"trilane_host_clock": 1}
OBJECT_BYTES = 80 << 20

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300), pytest.mark.filterwarnings("default")]


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SWEEP_TRIAL_LOG", str(tmp_path / "log"))
    monkeypatch.setenv("SWEEP_TRIAL_WAIT", "1")
    monkeypatch.setenv("SWEEP_TRIAL_TOGETHER", "2")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_worker_niceness", "0")
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    return tmp_path / "log"


@pytest.fixture
def nodes(log: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Any, Any]]:  # noqa: ARG001 - what trials log to
    """A cluster with a head and the node that may be killed, both with the environment of this test."""
    pytest.importorskip("ray", reason="the package ray is absent: extra ray")
    from ray.cluster_utils import Cluster

    before = set(psutil.Process().children(recursive=True))
    machines = Cluster()
    about = {"num_cpus": 2, "resources": RESOURCES, "object_store_memory": OBJECT_BYTES}
    try:
        machines.add_node(include_dashboard=False, **about)
        other = machines.add_node(**about)
        monkeypatch.setenv("RAY_ADDRESS", machines.address)
        yield machines, other
    finally:
        machines.shutdown()
    assert not psutil.wait_procs(set(psutil.Process().children(recursive=True)) - before, timeout=LIMIT_S)[1]


def started(folder: Path, *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", PROGRAM, *SWEEP, "--out", str(folder), "--json", *words]
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, **pipes)


def ended(process: subprocess.Popen[str]) -> dict[str, Any]:
    """The document that the sweep prints, all of whose trials are done."""
    try:
        out, said = process.communicate(timeout=LIMIT_S)
    finally:
        process.kill()
    assert process.returncode == 0, said
    document: dict[str, Any] = json.loads(out)
    assert document["counts"]["done"] == len(FRAMES)
    return document


def records(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / TRIALS).read_text().splitlines()]


def notes(log: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


def test_two_nodes_give_the_trials_of_one_machine(nodes: tuple[Any, Any], tmp_path: Path, log: Path) -> None:  # noqa: ARG001
    ended(started(tmp_path / "two", "--engine", "ray"))
    spans = defaultdict(list)
    begins = {note["pid"]: note for note in notes(log) if note["what"] == "begin"}
    for note in notes(log):
        if note["what"] == "end":
            spans[note["node"]].append((begins[note["pid"]]["at"], note["at"]))
    assert len(spans) == 2
    for of_a_node in spans.values():
        assert all(end <= begin for (_, end), (begin, _) in pairwise(sorted(of_a_node)))
    os.environ["SWEEP_TRIAL_WAIT"] = "0"
    os.environ["SWEEP_TRIAL_TOGETHER"] = "1"
    ended(started(tmp_path / "one"))
    kept = ("id", "command", "options", "status", "result", "folder")
    one, two = ({each["id"]: [each[key] for key in kept] for each in records(tmp_path / way)} for way in ("one", "two"))
    assert one == two
    assert len(one) == len(records(tmp_path / "two")) == len(FRAMES)
    assert all((tmp_path / "two" / name / "report.json").is_file() for name in two)


def test_what_a_killed_node_was_doing_is_done_on_the_other(nodes: tuple[Any, Any], tmp_path: Path, log: Path) -> None:
    machines, other = nodes
    process = started(tmp_path / "s", "--engine", "ray")
    end = time.monotonic() + LIMIT_S
    while sum(note["what"] == "begin" for note in notes(log)) < 2:
        assert time.monotonic() < end, process.communicate()
        time.sleep(0.02)
    killed = {note["pid"]: psutil.Process(note["pid"]) for note in notes(log)}
    machines.remove_node(other, allow_graceful=False)
    ended(process)
    found = records(tmp_path / "s")
    assert sorted(each["options"]["frames"] for each in found) == list(FRAMES)
    assert Counter(each["tries"] for each in found) == {1: len(FRAMES) - 1, 2: 1}
    assert Counter(note["what"] for note in notes(log)) == {"begin": len(FRAMES) + 1, "end": len(FRAMES)}
    assert not any(each.is_running() for each in killed.values())


def test_an_interrupt_ends_the_trials_on_all_nodes_and_resume_goes_on(
    nodes: tuple[Any, Any],  # noqa: ARG001
    tmp_path: Path,
    log: Path,
) -> None:
    process = started(tmp_path / "s", "--engine", "ray")
    end = time.monotonic() + LIMIT_S
    while not ((tmp_path / "s" / TRIALS).exists() and records(tmp_path / "s")):
        assert time.monotonic() < end, process.communicate()
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, said = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, out) == (130, ""), said
    assert "trials are done; --resume goes on" in said
    began = [psutil.Process(note["pid"]) for note in notes(log) if psutil.pid_exists(note["pid"])]
    assert not psutil.wait_procs(began, timeout=LIMIT_S)[1]
    before = len(records(tmp_path / "s"))
    assert before < len(FRAMES)
    assert ended(started(tmp_path / "s", "--engine", "ray", "--resume"))["counts"]["skipped"] == before
    assert sorted(each["options"]["frames"] for each in records(tmp_path / "s")) == list(FRAMES)


def test_no_cluster_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray", reason="the package ray is absent: extra ray")

    def init(**_settings: Any) -> None:
        raise ConnectionError("Could not find any running Ray instance.")

    monkeypatch.setattr(ray, "init", init)
    expected = "found no cluster, expected one that runs; start it: RAY_worker_niceness=0 ray start --head"
    with pytest.raises(BadInputError, match=expected), cluster(tmp_path):
        pass
