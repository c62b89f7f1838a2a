"""A run that is asked of a process of its own: what goes through its pipe; the runs and the process are doubles."""

from __future__ import annotations

import multiprocessing
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilane.bench.lib import avatar_process
from trilane.bench.lib.avatar_process import Asked, AvatarProcess, Ran, avatar_processes, serve
from trilane.errors import TrilaneError
from trilane.scheduler.ledger import JobRecord
from trilane.stages import avatar_pipeline, configure
from trilane.stages.run_options import RunOptions

ASKED = Asked("default", "64x64", 20, "ort", (3, 5), video=True, edge="latest")
JOBS = (JobRecord("pose", "cpu", 0, 1, 2, 3, 4), JobRecord("infer", "dsp", 0, 4, 5, 6, 7))


def test_a_run_is_begun_by_its_policy_and_answered_with_its_jobs() -> None:
    ours, theirs = Pipe()
    process = AvatarProcess(ours, "default at 64x64")
    process.begin("pipelined")
    assert theirs.recv() == "pipelined"
    theirs.send(([tuple(job) for job in JOBS], {"cpu": "3"}))
    assert process.result() == Ran(JOBS, {"cpu": "3"})
    theirs.send("no driver")
    with pytest.raises(TrilaneError, match=r"^default at 64x64: no driver$"):
        process.result()
    with pytest.raises(TrilaneError, match=r"^default at 64x64: no answer in 0\.001 s$"):
        process.receive(0.001)
    theirs.close()
    with pytest.raises(TrilaneError, match=r"^default at 64x64: its process ended$"):
        process.result()
    assert (avatar_process.START_S, avatar_process.RUN_S) == (120, 600)


class ToldPipe:
    """Hands out `policies`, then is closed."""

    def __init__(self, *policies: str) -> None:
        self.policies, self.sent = list(policies), list[Any]()

    def recv(self) -> str:
        if not self.policies:
            raise EOFError
        return self.policies.pop(0)

    def send(self, what: Any) -> None:
        self.sent.append(what)


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What was run; the run under `fails` fails, the one under `raises` raises."""
    asked: list[Any] = []

    def configured(request: Any, folder: Path) -> Any:
        asked.append((request, folder))
        return SimpleNamespace(changed=changed)

    def changed(**new: Any) -> Any:
        config = SimpleNamespace(**new)
        again = lambda **more: SimpleNamespace(config=SimpleNamespace(**new, **more), assets="assets")  # noqa: E731
        return SimpleNamespace(config=config, changed=again)

    def run_avatar(config: Any, assets: str, **options: Any) -> Any:
        asked.append((config.record, config.out_dir.is_dir(), assets, options))
        if options["policy"] == "raises":
            raise ValueError("of the run")
        failure = SimpleNamespace(message="the gpu died") if options["policy"] == "fails" else None
        return SimpleNamespace(failure=failure, jobs=list(JOBS))

    monkeypatch.setattr(configure, "configure", configured)
    monkeypatch.setattr(avatar_pipeline, "run_avatar", run_avatar)
    return asked


def test_the_process_runs_under_each_policy_until_its_pipe_closes(runs: list[Any]) -> None:
    pipe: Any = ToldPipe("sequential", "pipelined")
    serve(pipe, ASKED)
    answer = [tuple(job) for job in JOBS], {"cpu": "3", "gpu": "3", "dsp": "5"}
    assert pipe.sent == [True, answer, answer]
    request = RunOptions(avatar="default", size="64x64", frames=20, runtime="ort")
    assert runs == [
        (request, Path.cwd()),
        *((True, True, "assets", {"policy": policy, "edge": "latest"}) for policy in ("sequential", "pipelined")),
    ]


@pytest.mark.parametrize(("policy", "said"), [("fails", "the gpu died"), ("raises", "ValueError: of the run")])
def test_the_process_says_why_a_run_failed_and_ends(policy: str, said: str, runs: list[Any]) -> None:
    pipe: Any = ToldPipe(policy, "pipelined")
    serve(pipe, ASKED)
    assert pipe.sent == [True, said] and len(runs) == 2


def test_processes_are_ready_when_they_are_handed_out_and_end_with_the_block(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []

    class Process:
        def __init__(self, target: Any, args: Any, daemon: bool) -> None:
            assert target is serve and daemon
            self.pipe, self.asked = args

        def start(self) -> None:
            told.append(("start", self.asked))
            self.pipe.send(True if self.asked.avatar != "broken" else "BadInputError: no such avatar")
            self.kept = self.pipe.__class__(self.pipe._handle, readable=True, writable=True)
            self.pipe._handle = None  # the child has it, whatever the parent closes

        def join(self, wait_s: float) -> None:
            with pytest.raises(EOFError):
                self.kept.recv()
            told.append(("join", wait_s))

        def kill(self) -> None:
            self.kept.close()
            told.append("kill")

    def context(kind: str) -> Any:
        assert kind == "spawn"
        return SimpleNamespace(Pipe=Pipe, Process=Process)

    monkeypatch.setattr(multiprocessing, "get_context", context)
    with avatar_processes([ASKED, ASKED]) as pair:
        assert [one._name for one in pair] == ["default at 64x64"] * 2
        assert told == [("start", ASKED)] * 2
    assert told[2:] == [("join", 5), "kill"] * 2
    broken = Asked("broken", "64x64", 20, "ort", (3,), video=False)
    said = r"^broken at 64x64: BadInputError: no such avatar$"
    with pytest.raises(TrilaneError, match=said), avatar_processes([ASKED, broken]):
        pass
    assert told[-4:] == [("join", 5), "kill"] * 2
